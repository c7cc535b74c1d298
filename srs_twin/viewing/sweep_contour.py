"""A metric over two fields as filled contours: of a regular grid, or of scattered points by triangulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from matplotlib.tri import Triangulation

from srs_twin.viewing.sweep_panels import color_bar, legend_above, mark_rows, say, span
from srs_twin.viewing.sweep_table import Values, group_means

_LEVELS = 14
_BOTH_SIGNS = 0.1  # of the greatest value: how far a value lies beyond zero for zero to be the middle colour
_FLATTEST = 1e-3  # least sine of a triangle's corners; flatter ones say nothing of the plane
_MOST_DOTS = 400


@dataclass(frozen=True)
class Points:
    """The points of a plane, a row each, in order of y, then x.

    Attributes:
        x: shape (points,).
        y: shape (points,).
        z: mean of the values there, NaN where there is none, shape (points,).
        failed: whether every run there failed, shape (points,).
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    failed: np.ndarray

    @staticmethod
    def of(x: np.ndarray, y: np.ndarray, z: np.ndarray, failed: np.ndarray) -> Points:
        """Put rows at the same place together."""
        there = np.isfinite(x) & np.isfinite(y)
        places, which = np.unique(np.stack([y[there], x[there]], axis=-1), axis=0, return_inverse=True)
        which = which.reshape(-1)
        all_failed = group_means(which, len(places), failed[there].astype(float)) == 1.0
        return Points(places[:, 1], places[:, 0], group_means(which, len(places), z[there]), all_failed)

    @property
    def known(self) -> np.ndarray:
        """Which points have a value."""
        return np.isfinite(self.z)

    @property
    def grid(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """x, y and values (y, x) of a full grid of two by two or more; None where they are no such grid."""
        columns, rows = np.unique(self.x), np.unique(self.y)
        if min(len(columns), len(rows)) < 2 or len(columns) * len(rows) != len(self.z):
            return None
        return columns, rows, np.ma.masked_invalid(self.z.reshape(len(rows), len(columns)))


def draw_contours(
    figure: Figure,
    panels: Sequence[Axes],
    x: Values,
    y: Values,
    values: Sequence[Values],
    failed: np.ndarray,
) -> None:
    """Draw one panel a plant, all with the same colours.

    Args:
        figure: gets the colour bar.
        panels: one an entry of `values`.
        x: field along x.
        y: field along y.
        values: metric of each plant.
        failed: which runs failed, shape (rows,).
    """
    points = [Points.of(x.numbers, y.numbers, each.numbers, failed) for each in values]
    levels, cmap = _scale([p.z for p in points])
    for axes, each in zip(panels, points, strict=True):
        if not each.known.any():
            say(axes, failed)
        else:
            _fill(axes, each, levels, cmap)
        for what, which in (("failed", each.failed), ("no value", ~each.known & ~each.failed)):
            mark_rows(axes, each.x[which], each.y[which], what)
        for limits, ends in ((axes.set_xlim, span([x])), (axes.set_ylim, span([y]))):
            room = 0.03 * (ends[1] - ends[0])
            limits(ends[0] - room, ends[1] + room)
        legend_above(axes)
    if any(each.known.any() for each in points):
        color_bar(figure, BoundaryNorm(levels, 256), cmap, values[0], levels[::2].tolist())


def _fill(axes: Axes, points: Points, levels: np.ndarray, cmap: str) -> None:
    """Fill the plane between the points; where they span none, colour the points themselves."""
    grid, known = points.grid, points.known
    style: dict[str, Any] = {"levels": levels, "cmap": cmap}
    thin: dict[str, Any] = {"levels": levels, "colors": "k", "linewidths": 0.3, "alpha": 0.5}
    mesh = None if grid else _mesh(points.x[known], points.y[known])
    dots: dict[str, Any] = {"s": 3.0, "color": "0.25", "linewidths": 0.0}
    if grid is not None and _has_cell(grid[2]):
        axes.contourf(*grid, **style)
        axes.contour(*grid, **thin)
    elif mesh is not None:
        axes.tricontourf(mesh, points.z[known], **style)
        axes.tricontour(mesh, points.z[known], **thin)
    else:
        dots = {"s": 45.0, "c": points.z[known], "cmap": cmap, "vmin": levels[0], "vmax": levels[-1]}
    if "c" in dots or known.sum() <= _MOST_DOTS:
        axes.scatter(points.x[known], points.y[known], zorder=3, **dots)


def _has_cell(values: np.ndarray) -> bool:
    """Whether at least one cell of a grid has a value at all four corners."""
    there = ~np.ma.getmaskarray(values)
    return bool((there[1:, 1:] & there[1:, :-1] & there[:-1, 1:] & there[:-1, :-1]).any())


def _mesh(x: np.ndarray, y: np.ndarray) -> Triangulation | None:
    """Return triangles between points, None where they span no plane."""
    if len(x) < 3:
        return None
    # Fields have units of their own: as they lie on the paper.
    u, v = (((each - each.min()) / (np.ptp(each) or 1.0)) for each in (x, y))
    try:
        corners = Triangulation(u, v).triangles
    except (RuntimeError, ValueError):
        return None  # all on a line
    sides = np.stack([u[corners], v[corners]], axis=-1)
    first, second = sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]
    area = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    longest = np.max(
        [np.sum((sides[:, i] - sides[:, j]) ** 2, axis=-1) for i, j in ((0, 1), (1, 2), (2, 0))], axis=0
    )
    flat = area < _FLATTEST * longest
    return None if flat.all() else Triangulation(x, y, corners, mask=flat)


def _scale(values: Sequence[np.ndarray]) -> tuple[np.ndarray, str]:
    """Return levels common to all panels and the colours: about zero where there are both signs."""
    low, high = span([Values("", each) for each in values])
    most = max(abs(low), abs(high))
    if low < 0 < high and min(-low, high) > _BOTH_SIGNS * most:
        return np.asarray(MaxNLocator(_LEVELS, symmetric=True).tick_values(-most, most)), "RdBu_r"
    return np.asarray(MaxNLocator(_LEVELS).tick_values(low, high)), "viridis"
