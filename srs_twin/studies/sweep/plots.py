"""Pictures of a sweep: a metric over two fields, along one, or against another column.

A metric over two fields is drawn as filled contours: of a regular grid, or of scattered points by
triangulation. Means are over seeds alone: where other fields vary as well, there is a line, or a row of
contours, for each combination of their values. What cannot be drawn (all failed, no value anywhere) gives a
picture that says so.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Normalize, to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from matplotlib.tri import TriAnalyzer, Triangulation

from srs_twin.studies.sweep.table import (
    COMPARISON,
    PLAN,
    Plot,
    Published,
    SweepTable,
    Values,
    group_means,
)
from srs_twin.viewing.plots.labels import field_label
from srs_twin.viewing.plots.style import PUBLISHED_COLOR, finish, side_by_side, style_of

if TYPE_CHECKING:
    import pyarrow as pa

_MOST_LINES = 12
_MOST_ROWS = 6  # of contours
_LEGEND: dict[str, Any] = {"fontsize": 8, "frameon": False}
_ABOVE: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.99), "borderaxespad": 0.2}
_SPACES: dict[str, Any] = {"handletextpad": 0.4, "columnspacing": 1.2, "handlelength": 2.8}
_WIDTH, _HEIGHT, _TOP, _BOTTOM = 9.0, 4.2, 0.75, 0.5
_KEY = 1.3  # right margin with a colour bar or a legend in it
_MARK: dict[str, Any] = {"linestyle": "none", "markersize": 4.5, "markerfacecolor": "none", "zorder": 4}
# Colours of marks: neither a plant's nor one of the scales of values.
_MARKS = {"failed": ("x", "#CC3311"), "no value": ("o", "0.35")}


def draw(
    plot: Plot, table: pa.Table | Mapping[str, Iterable[Any]], published: Published | None = None
) -> Figure:
    """Return the picture.

    Args:
        plot: what is wanted; of each plant that has the metric, else of the comparison.
        table: results of a sweep, a row a point: varied fields by their dotted path, `status`, metrics as
            ``<plant>.<metric>`` and ``comparison.<metric>``. The order of the rows changes nothing.
        published: published values; a line has those of its metric along x, with a marker of their own.

    Raises:
        InputError: there is no such column.
    """
    rows = SweepTable.of(table)
    owners = rows.owners(plot.metric)
    # A metric of the plants is theirs; the comparison's stands alone.
    owners = [owner for owner in owners if owner != COMPARISON] or owners
    contour = plot.kind == "contour"
    if plot.kind == "line" and plot.by is None and (apart := _apart(plot, rows)):
        plot = plot.model_copy(update={"by": apart[0]})
    figure = _contour(plot, rows, owners) if contour else _plane(plot, rows, owners, published)
    figure.suptitle(_title(plot, rows, owners), x=0.01, ha="left", fontsize=10)
    return figure


def _apart(plot: Plot, rows: SweepTable) -> list[str]:
    """Return the fields that a picture has to keep apart besides those that it names."""
    return [] if plot.kind == "scatter" else rows.mixed(filter(None, (plot.x, plot.y, plot.by)))


def _title(plot: Plot, rows: SweepTable, owners: list[str]) -> str:
    """Return the title, and below it what the picture leaves out."""
    metric = rows.metric(plot.metric, owners[0]).label.partition(" (")[0]
    drawn = [plot.x, *([plot.y] if plot.y else [])]
    names = [rows.values(name, owners[0]).label.partition(" (")[0] for name in drawn]
    notes = []
    if plot.kind != "scatter" and rows.repeats:
        notes = [f"each value the mean over {', '.join(map(field_label, rows.repeats))}"]
    if apart := _apart(plot, rows):
        what, count = ", ".join(map(field_label, apart)), len(rows.groups(apart))
        some = f", {_MOST_ROWS} of {count} shown" if plot.kind == "contour" and count > _MOST_ROWS else ""
        notes += [f"one {'row' if plot.kind == 'contour' else 'line'} for each {what}{some}"]
    failed = int(rows.failed.sum())
    notes += [f"{failed} of {len(rows.failed)} runs failed"] if failed else []
    values = [rows.metric(plot.metric, owner).numbers for owner in owners]
    lacking = sum(int((np.isnan(each) & ~rows.failed).sum()) for each in values)
    notes += [f"{lacking} values missing"] if lacking else []
    known = np.concatenate(values)
    different = np.unique(known[np.isfinite(known)])
    notes += [f"every value is {different[0]:.4g}"] if len(different) == 1 else []
    against = "against" if plot.kind == "scatter" else "over"
    title = f"{metric[:1].upper()}{metric[1:]} {against} {' and '.join(names)}"
    return "\n".join([title, *([f"({'; '.join(notes)})"] if notes else [])])


def _panels(columns: int, rows: int = 1, *, key: bool) -> tuple[Figure, np.ndarray]:
    """Return a figure and its panels (rows, columns) with common axes; a key has room on the right."""
    height, space = (_HEIGHT, 0.08) if rows == 1 else (_TOP + _BOTTOM + 2.2 * rows, 0.16)
    right = _KEY if key else 0.25
    figure, panels = side_by_side(
        height, columns, rows, right=right, top=_TOP, space=space, sharex=True, sharey=True
    )
    for axes in panels.flat:
        axes.tick_params(labelsize=8)
    return figure, panels


def color_bar(
    figure: Figure, norm: Normalize, cmap: str, values: Values, ticks: Sequence[float] | None = None
) -> None:
    """Draw the bar that says which colour means what, in the room on the right."""
    height = figure.get_figheight()
    bottom = _BOTTOM / height
    place = (1 - (_KEY - 0.12) / _WIDTH, bottom, 0.16 / _WIDTH, 1 - _TOP / height - bottom)
    bar = figure.colorbar(ScalarMappable(norm, cmap), cax=figure.add_axes(place, label="colors"), ticks=ticks)
    bar.set_label(values.label, fontsize=9)
    bar.ax.tick_params(labelsize=8)
    if values.names:
        bar.set_ticks(range(len(values.names)), labels=list(values.names))


def legend_above(axes: Axes, handles: Sequence[Line2D] = ()) -> None:
    """Lay a legend above the plane on the right, where it covers nothing: handles, then what was marked."""
    marked, _ = axes.get_legend_handles_labels()
    shown = [*handles, *(each for each in marked if isinstance(each, Line2D))]
    if shown:
        legend = axes.legend(handles=shown, ncols=len(shown), **_LEGEND, **_ABOVE, **_SPACES)
        axes.add_artist(legend)


def name_ticks(axis: Axis, values: Values) -> None:
    """Write texts at the ticks of an axis that stands for texts, and whole numbers where it counts."""
    known = values.numbers[np.isfinite(values.numbers)]
    if values.names:
        axis.set_ticks(range(len(values.names)), labels=values.names)
    elif known.size and np.array_equal(known, np.round(known)):
        axis.set_major_locator(MaxNLocator(integer=True))


def mark_rows(axes: Axes, x: np.ndarray, y: np.ndarray, what: str, *, across: bool = False) -> None:
    """Mark runs without a value, named in the legend.

    Args:
        axes: where.
        x: positions, in data.
        y: positions, in data.
        what: "failed" or "no value".
        across: y is a share of the height instead.
    """
    if len(x):
        transform = axes.get_xaxis_transform() if across else axes.transData
        marker, color = _MARKS[what]
        look = {"marker": marker, "color": color, "markeredgewidth": 1.1, **_MARK}
        axes.plot(x, y, **look, transform=transform, clip_on=not across, label=what)


def say(axes: Axes, failed: np.ndarray) -> None:
    """Say in the plane that there is nothing to draw, and why."""
    rows, bad = len(failed), int(failed.sum())
    if not rows:
        text = "there are no runs"
    elif bad == rows:
        text = "the run failed" if rows == 1 else f"all {rows} runs failed"
    else:
        text = f"no value in {rows - bad} runs" + (f", {bad} failed" if bad else "")
    axes.text(0.5, 0.5, f"nothing to draw: {text}", transform=axes.transAxes, ha="center", fontsize=10)


def span(all_values: Sequence[Values]) -> tuple[float, float]:
    """Return the least and the greatest of all numbers; 0 and 1 where there is none, apart in any case."""
    known = [values.numbers[np.isfinite(values.numbers)] for values in all_values]
    numbers = np.concatenate([*known, np.zeros(0)])
    if not len(numbers):
        return 0.0, 1.0
    low, high = float(numbers.min()), float(numbers.max())
    if high - low > 1e-9 * max(abs(low), abs(high)):
        return low, high
    room = 0.5 * abs(low) or 0.5
    return low - room, high + room


_LEVELS = 14
_BOTH_SIGNS = 0.1  # of the greatest value: how far a value lies beyond zero for zero to be the middle colour
_FLATTEST = 1e-5  # least ratio of a triangle's inner circle to its outer one; flatter ones say nothing
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


def _contour(plot: Plot, rows: SweepTable, owners: list[str]) -> Figure:
    """Draw one panel a plant, all with the same colours, and a row for each value of what varies besides."""
    apart = _apart(plot, rows)
    parts = rows.groups(apart)[:_MOST_ROWS]
    figure, panels = _panels(len(owners), len(parts), key=True)
    x, y = rows.values(plot.x, owners[0]), rows.values(str(plot.y), owners[0])
    values = [rows.metric(plot.metric, owner) for owner in owners]
    points = [
        [Points.of(x.numbers[k], y.numbers[k], each.numbers[k], rows.failed[k]) for each in values]
        for _, k in parts
    ]
    levels, cmap = _scale([each.z for row in points for each in row])
    for (texts, k), row, shown in zip(parts, panels, points, strict=True):
        where = [f"{field_label(name)}: {text}" for name, text in zip(apart, texts, strict=True)]
        for axes, owner, each in zip(row, owners, shown, strict=True):
            if each.known.any():
                _fill(axes, each, levels, cmap)
            else:
                say(axes, rows.failed[k])
            for what, which in (("failed", each.failed), ("no value", ~each.known & ~each.failed)):
                mark_rows(axes, each.x[which], each.y[which], what)
            for limits, ends in ((axes.set_xlim, span([x])), (axes.set_ylim, span([y]))):
                room = 0.03 * (ends[1] - ends[0])
                limits(ends[0] - room, ends[1] + room)
            legend_above(axes)
            axes.set_title(", ".join((style_of(owner).label, *where)), fontsize=9, loc="left")
            name_ticks(axes.xaxis, x)
        finish(row[0], y.label)
        name_ticks(row[0].yaxis, y)
    for axes in panels[-1]:
        axes.set_xlabel(x.label, fontsize=9)
    if any(each.known.any() for row in points for each in row):
        color_bar(figure, BoundaryNorm(levels, 256), cmap, values[0], levels[::2].tolist())
    return figure


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
        corners = Triangulation(u, v)
    except (RuntimeError, ValueError):
        return None  # all on a line
    with np.errstate(invalid="ignore"):  # of triangles without an area
        ratios = np.ma.filled(TriAnalyzer(corners).circle_ratios(rescale=False), 0.0)
    flat = ~(ratios >= _FLATTEST)
    return None if flat.all() else Triangulation(x, y, corners.triangles, mask=flat)


def _scale(values: Sequence[np.ndarray]) -> tuple[np.ndarray, str]:
    """Return levels common to all panels and the colours: about zero where there are both signs."""
    low, high = span([Values("", each) for each in values])
    most = max(abs(low), abs(high))
    if low < 0 < high and min(-low, high) > _BOTH_SIGNS * most:
        return np.asarray(MaxNLocator(_LEVELS, symmetric=True).tick_values(-most, most)), "RdBu_r"
    return np.asarray(MaxNLocator(_LEVELS).tick_values(low, high)), "viridis"


class _Shades:
    """Colours that tell the values of a column apart: by a legend where they are few, else by a bar.

    Attributes:
        by: the column, of each owner.
        groups: its different values.
        few: whether a legend names them.
        norm: from values to the places of their colours along the bar.
    """

    def __init__(self, by: Sequence[Values]) -> None:
        numbers = np.concatenate([each.numbers for each in by])
        self.by, self.groups = by[0], np.unique(numbers[np.isfinite(numbers)])
        self.few = len(self.groups) <= _MOST_LINES
        self.norm = Normalize(*span(by))
        shares = np.linspace(0.0, 0.92, len(self.groups)) if self.few else self.norm(self.groups)
        self.colors = dict(zip(self.groups.tolist(), map(to_hex, colormaps["viridis"](shares)), strict=True))

    def name(self, figure: Figure, axes: Axes) -> None:
        """Say which colour is which value."""
        if not self.few:
            color_bar(figure, self.norm, "viridis", self.by)
            return
        handles = [
            Line2D([], [], color=self.colors[group], label=self.by.text(group)) for group in self.groups
        ]
        beside: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "alignment": "left"}
        title = textwrap.fill(self.by.label, 18)
        axes.legend(handles=handles, title=title, title_fontsize=8, **_LEGEND, **beside)


def _plane(plot: Plot, rows: SweepTable, owners: list[str], published: Published | None) -> Figure:
    """Draw lines or dots with a colour a value of `by`, and at the lower edge where runs failed."""
    figure, ((axes,),) = _panels(1, key=plot.by is not None)
    lines, colored = plot.kind == "line", plot.by is not None
    same = Values("", np.zeros(len(rows.failed)))
    by = [rows.values(plot.by, owner) if plot.by else same for owner in owners]
    shades = _Shades(by)
    x, values = rows.values(plot.x, owners[0]), rows.metric(plot.metric, owners[0])
    drawn = 0
    for owner, shade in zip(owners, by, strict=True):
        along, height = rows.values(plot.x, owner).numbers, rows.metric(plot.metric, owner).numbers
        for _, k in rows.groups(_apart(plot, rows)):
            part = (along[k], height[k], Values("", shade.numbers[k], shade.names))
            drawn += (_draw_lines if lines else _draw_dots)(axes, owner, *part, shades, colored)
    finish(axes, values.label)
    axes.set_xlabel(x.label, fontsize=9)
    name_ticks(axes.xaxis, x)
    where = np.unique(x.numbers[rows.failed & np.isfinite(x.numbers)])
    mark_rows(axes, where, np.full(len(where), 0.025), "failed", across=True)
    if not drawn:
        say(axes, rows.failed)
    # Plans are told apart by what they vary over alone.
    samples = [_sample(owner, line=lines, plain=colored) for owner in owners if owner != PLAN]
    if lines and published is not None and plot.x in published.at and plot.metric in published.metrics:
        colors = shades.colors if colored and shades.few else {}
        samples.append(_draw_published(axes, published, plot, x, by[0], colors))
    legend_above(axes, samples)
    if colored:
        shades.name(figure, axes)
    return figure


def _draw_lines(
    axes: Axes, owner: str, x: np.ndarray, y: np.ndarray, by: Values, shades: _Shades, colored: bool
) -> int:
    """Draw a line a value of `by`, through the mean over seeds at each x; return the number of points."""
    drawn = 0
    for i, group in enumerate(shades.groups):
        # Smaller and smaller, for lines of names that lie upon each other.
        steps = len(shades.groups) - 1 - i if by.names and shades.few else 0
        there = (by.numbers == group) & np.isfinite(x)
        places, which = np.unique(x[there], return_inverse=True)
        means = group_means(which.reshape(-1), len(places), y[there])
        style = _look(owner) | ({"color": shades.colors[group]} if colored else {})
        style |= {"markersize": (3.5 if shades.few else 2.0) + 2.0 * steps}
        axes.plot(places, means, linewidth=1.3 if shades.few else 0.9, **style)
        drawn += int(np.isfinite(means).sum())
    return drawn


def _draw_dots(
    axes: Axes, owner: str, x: np.ndarray, y: np.ndarray, by: Values, shades: _Shades, colored: bool
) -> int:
    """Draw a dot a run, in an order that is not that of the rows; return how many there are."""
    there = np.isfinite(x) & np.isfinite(y) & np.isfinite(by.numbers)
    order = np.flatnonzero(there)[np.lexsort((y[there], x[there], by.numbers[there]))]
    shade, style = by.numbers[order], style_of(owner)
    color: dict[str, Any] = {"color": style.color}
    if colored and shades.few:
        color = {"c": [shades.colors[each] for each in shade]}
    elif colored:
        color = {"c": shade, "cmap": "viridis", "norm": shades.norm}
    axes.scatter(x[order], y[order], s=16, marker=style.marker, alpha=0.85, linewidths=0, **color)
    return len(order)


def _draw_published(
    axes: Axes, published: Published, plot: Plot, x: Values, by: Values, colors: Mapping[float, str]
) -> Line2D:
    """Mark the published values of a metric along x, in the colour of their line where it is known.

    Returns:
        What the legend shows of them.
    """
    style: dict[str, Any] = {"linestyle": "none", "marker": "*", "markersize": 10, "markeredgecolor": "white"}
    groups = published.at.get(plot.by, ()) if plot.by else ()
    for i, (place, value) in enumerate(
        zip(published.at[plot.x], published.metrics[plot.metric], strict=True)
    ):
        color = colors.get(by.number(groups[i])) if groups else None
        if value is not None:
            axes.plot(
                x.number(place), value, color=color or PUBLISHED_COLOR, markeredgewidth=0.6, zorder=5, **style
            )
    # A dollar would begin a formula.
    label = f"published, {published.source}".replace("$", r"\$")
    return Line2D([], [], color=PUBLISHED_COLOR, label=label, **style)


def _sample(owner: str, *, line: bool = True, plain: bool = False) -> Line2D:
    """Return what the legend shows of an owner."""
    look = _look(owner) | ({} if line else {"linestyle": "none"}) | ({"color": "0.3"} if plain else {})
    return Line2D([], [], **look, markersize=4, label=style_of(owner).label)


def _look(owner: str) -> dict[str, Any]:
    """Return colour, dash and marker of an owner's line."""
    style = style_of(owner)
    return {"color": style.color, "linestyle": style.dash, "marker": style.marker}
