"""Plots of a sweep: a metric over two fields, along one field, or against another column.

A metric over two fields is drawn as filled contours, of a regular grid or by
triangulation of scattered points. Means are taken only over seeds. If other fields vary
as well, there is a line, or a row of contours, for each combination of their values. A
plot without any value contains a note instead.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

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

from srs_twin.studies.sweep.points import Plot, Published
from srs_twin.studies.sweep.table import (
    COMPARISON,
    ColumnValues,
    SweepTable,
    group_means,
)
from srs_twin.studies.sweep.task import PLAN
from srs_twin.viewing.plots.labels import field_label
from srs_twin.viewing.plots.style import (
    PUBLISHED_COLOR,
    drawing,
    finish,
    side_by_side,
    style_of,
)

_MAX_LINES = 12
"""Largest number of values in a legend; more values get a colour bar."""

_MAX_ROWS = 6
"""Largest number of rows of contours."""

_LEGEND: dict[str, Any] = {"fontsize": 8, "frameon": False}
_ABOVE: dict[str, Any] = {
    "loc": "lower right",
    "bbox_to_anchor": (1.0, 0.99),
    "borderaxespad": 0.2,
}
_SPACING: dict[str, Any] = {
    "handletextpad": 0.4,
    "columnspacing": 1.2,
    "handlelength": 2.8,
}

# Sizes of figures, inches.
_WIDTH = 9.0
_HEIGHT = 4.2
_TOP = 0.75
_BOTTOM = 0.5
_KEY_WIDTH = 1.3
"""Right margin for a colour bar or legend."""

_MARK: dict[str, Any] = {
    "linestyle": "none",
    "markersize": 4.5,
    "markerfacecolor": "none",
    "zorder": 4,
}

# Marks of failed runs; these colours occur neither in plants nor in colour scales.
_MARKS = {"failed": ("x", "#CC3311"), "no value": ("o", "0.35")}


@drawing
def draw(plot: Plot, results: SweepTable, published: Published | None = None) -> Figure:
    """Return the figure of a plot.

    Args:
        plot: plot; it shows each plant that has the metric, otherwise the comparison.
        results: results of a sweep; the order of rows does not matter.
        published: published values; a line plot shows those of its metric along x.

    Raises:
        InputError: a column does not exist.
    """
    owners = results.owners(plot.metric)
    # If plants have the metric, the comparison is not shown.
    owners = [owner for owner in owners if owner != COMPARISON] or owners
    if (
        plot.kind == "line"
        and plot.by is None
        and (separate := _separate_fields(plot, results))
    ):
        plot = plot.model_copy(update={"by": separate[0]})
    if plot.kind == "contour":
        figure = _draw_contours(plot, results, owners)
    else:
        figure = _draw_line_or_scatter(plot, results, owners, published)
    figure.suptitle(_title(plot, results, owners), x=0.01, ha="left", fontsize=10)
    return figure


def _separate_fields(plot: Plot, results: SweepTable) -> list[str]:
    """Return further varied fields whose values need a line or a row each."""
    if plot.kind == "scatter":
        return []
    return results.unplotted_settings(filter(None, (plot.x, plot.y, plot.by)))


def _title(plot: Plot, results: SweepTable, owners: list[str]) -> str:
    """Return the title, with notes on a second line."""
    labels = [results.metric(plot.metric, owners[0]).label]
    labels += [
        results.values(name, owners[0]).label for name in (plot.x, plot.y) if name
    ]
    metric, *names = (label.partition(" (")[0] for label in labels)
    against = "against" if plot.kind == "scatter" else "over"
    title = f"{metric[:1].upper()}{metric[1:]} {against} {' and '.join(names)}"
    notes = _notes(plot, results, owners)
    if notes:
        return f"{title}\n({'; '.join(notes)})"
    return title


def _notes(plot: Plot, results: SweepTable, owners: list[str]) -> list[str]:
    """Return notes on means, further fields, failed runs and missing values."""
    values = [results.metric(plot.metric, owner).numbers for owner in owners]
    distinct = np.unique(np.concatenate(values))
    distinct = distinct[np.isfinite(distinct)]
    failed = int(results.failed.sum())
    missing = sum(int((np.isnan(value) & ~results.failed).sum()) for value in values)
    notes = []
    if plot.kind != "scatter" and results.repeats:
        notes.append(
            f"each value the mean over {', '.join(map(field_label, results.repeats))}"
        )
    if separate := _separate_fields(plot, results):
        fields = ", ".join(map(field_label, separate))
        count = len(results.groups(separate))
        if plot.kind == "contour" and count > _MAX_ROWS:
            shown = f", {_MAX_ROWS} of {count} shown"
        else:
            shown = ""
        notes.append(
            f"one {'row' if plot.kind == 'contour' else 'line'} for each"
            f" {fields}{shown}"
        )
    if failed:
        notes.append(f"{failed} of {len(results.failed)} runs failed")
    if missing:
        notes.append(f"{missing} values missing")
    if len(distinct) == 1:
        notes.append(f"every value is {distinct[0]:.4g}")
    return notes


def _panels(columns: int, rows: int = 1, *, key: bool) -> tuple[Figure, np.ndarray]:
    """Return a figure and its panels (rows, columns) with common axes, optionally with space for a key."""
    height, space = (
        (_HEIGHT, 0.08) if rows == 1 else (_TOP + _BOTTOM + 2.2 * rows, 0.16)
    )
    right = _KEY_WIDTH if key else 0.25
    figure, panels = side_by_side(
        height,
        columns,
        rows,
        right=right,
        top=_TOP,
        space=space,
        sharex=True,
        sharey=True,
    )
    for axes in panels.flat:
        axes.tick_params(labelsize=8)
    return figure, panels


def color_bar(
    figure: Figure,
    norm: Normalize,
    cmap: str,
    values: ColumnValues,
    ticks: Sequence[float] | None = None,
) -> None:
    """Draw a colour bar in the right margin."""
    height = figure.get_figheight()
    bottom = _BOTTOM / height
    rectangle = (
        1 - (_KEY_WIDTH - 0.12) / _WIDTH,
        bottom,
        0.16 / _WIDTH,
        1 - _TOP / height - bottom,
    )
    axes = figure.add_axes(rectangle, label="colors")
    bar = figure.colorbar(ScalarMappable(norm, cmap), cax=axes, ticks=ticks)
    bar.set_label(values.label, fontsize=9)
    bar.ax.tick_params(labelsize=8)
    if values.names:
        bar.set_ticks(range(len(values.names)), labels=list(values.names))


def legend_above(axes: Axes, handles: Sequence[Line2D] = ()) -> None:
    """Draw a legend above the plot on the right: the handles, then labelled marks."""
    marked, _ = axes.get_legend_handles_labels()
    shown = [*handles, *(artist for artist in marked if isinstance(artist, Line2D))]
    if shown:
        legend = axes.legend(
            handles=shown, ncols=len(shown), **_LEGEND, **_ABOVE, **_SPACING
        )
        axes.add_artist(legend)


def set_ticks(axis: Axis, values: ColumnValues) -> None:
    """Set the ticks of an axis: texts for a text column, whole numbers for integers."""
    known = values.numbers[np.isfinite(values.numbers)]
    if values.names:
        axis.set_ticks(range(len(values.names)), labels=values.names)
    elif known.size and np.array_equal(known, np.round(known)):
        axis.set_major_locator(MaxNLocator(integer=True))


def mark_rows(
    axes: Axes, x: np.ndarray, y: np.ndarray, label: str, *, relative: bool = False
) -> None:
    """Mark runs without a value.

    Args:
        axes: axes.
        x: positions, in data coordinates.
        y: positions, in data coordinates.
        label: "failed" or "no value", for the legend.
        relative: whether y is a fraction of the height of the axes.
    """
    if len(x):
        if relative:
            transform = axes.get_xaxis_transform()
        else:
            transform = axes.transData
        marker, color = _MARKS[label]
        style = {"marker": marker, "color": color, "markeredgewidth": 1.1, **_MARK}
        axes.plot(x, y, **style, transform=transform, clip_on=not relative, label=label)


def write_empty_note(axes: Axes, failed: np.ndarray) -> None:
    """Write into empty axes the reason why there is nothing to draw."""
    rows = len(failed)
    failures = int(failed.sum())
    if not rows:
        text = "there are no runs"
    elif failures == rows:
        if rows == 1:
            text = "the run failed"
        else:
            text = f"all {rows} runs failed"
    else:
        text = f"no value in {rows - failures} runs" + (
            f", {failures} failed" if failures else ""
        )
    axes.text(
        0.5,
        0.5,
        f"nothing to draw: {text}",
        transform=axes.transAxes,
        ha="center",
        fontsize=10,
    )


def value_range(columns: Sequence[ColumnValues]) -> tuple[float, float]:
    """Return the range of all numbers, widened if it is empty; (0, 1) without numbers."""
    known = [column.numbers[np.isfinite(column.numbers)] for column in columns]
    numbers = np.concatenate([*known, np.zeros(0)])
    if not len(numbers):
        return 0.0, 1.0
    low = float(numbers.min())
    high = float(numbers.max())
    if high - low > 1e-9 * max(abs(low), abs(high)):
        return low, high
    margin = 0.5 * abs(low) or 0.5
    return low - margin, high + margin


_LEVELS = 14
"""Approximate number of contour levels."""

_MIN_OPPOSITE = 0.1
"""Smallest extent on the other side of zero, relative to the largest value, for a symmetric colour scale."""

_MIN_CIRCLE_RATIO = 1e-5
"""Smallest ratio of a triangle's inscribed to its circumscribed circle; flatter triangles are left out."""

_MAX_DOTS = 400
"""Largest number of points that are marked on contours."""


@dataclass(frozen=True)
class Points:
    """Points of a plane with their mean values, in order of y, then x.

    Attributes:
        x: x coordinates, shape (points,).
        y: y coordinates, shape (points,).
        z: mean value at each point, NaN if missing, shape (points,).
        failed: whether all runs at a point failed, shape (points,).
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    failed: np.ndarray

    @staticmethod
    def from_rows(
        x: np.ndarray, y: np.ndarray, z: np.ndarray, failed: np.ndarray
    ) -> Points:
        """Combine rows with the same coordinates."""
        known = np.isfinite(x) & np.isfinite(y)
        points, which = np.unique(
            np.stack([y[known], x[known]], axis=-1), axis=0, return_inverse=True
        )
        which = which.reshape(-1)
        all_failed = group_means(which, len(points), failed[known].astype(float)) == 1.0
        return Points(
            points[:, 1],
            points[:, 0],
            group_means(which, len(points), z[known]),
            all_failed,
        )

    @property
    def known(self) -> np.ndarray:
        """Whether a point has a value, shape (points,)."""
        known: np.ndarray = np.isfinite(self.z)
        return known

    @property
    def grid(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """x, y and values (y, x) of a complete grid of at least 2 by 2 points; None for other points."""
        columns = np.unique(self.x)
        rows = np.unique(self.y)
        if min(len(columns), len(rows)) < 2 or len(columns) * len(rows) != len(self.z):
            return None
        return (
            columns,
            rows,
            np.ma.masked_invalid(self.z.reshape(len(rows), len(columns))),
        )


def _draw_contours(plot: Plot, results: SweepTable, owners: list[str]) -> Figure:
    """Draw one panel per plant with common colours, and one row per value of further fields."""
    separate = _separate_fields(plot, results)
    groups = results.groups(separate)[:_MAX_ROWS]
    figure, panels = _panels(len(owners), len(groups), key=True)
    x = results.values(plot.x, owners[0])
    y = results.values(str(plot.y), owners[0])
    values = [results.metric(plot.metric, owner) for owner in owners]
    points = [
        [
            Points.from_rows(
                *(
                    column[k]
                    for column in (x.numbers, y.numbers, value.numbers, results.failed)
                )
            )
            for value in values
        ]
        for _, k in groups
    ]
    levels, cmap = _levels_and_colors([cell.z for row in points for cell in row])
    for (texts, k), row, cells in zip(groups, panels, points, strict=True):
        labels = [
            f"{field_label(name)}: {text}"
            for name, text in zip(separate, texts, strict=True)
        ]
        for axes, owner, cell in zip(row, owners, cells, strict=True):
            if cell.known.any():
                _fill(axes, cell, levels, cmap)
            else:
                write_empty_note(axes, results.failed[k])
            mark_rows(axes, cell.x[cell.failed], cell.y[cell.failed], "failed")
            unknown = ~cell.known & ~cell.failed
            mark_rows(axes, cell.x[unknown], cell.y[unknown], "no value")
            axes.set_xlim(_with_margin(value_range([x])))
            axes.set_ylim(_with_margin(value_range([y])))
            legend_above(axes)
            axes.set_title(
                ", ".join((style_of(owner).label, *labels)), fontsize=9, loc="left"
            )
            set_ticks(axes.xaxis, x)
        finish(row[0], y.label)
        set_ticks(row[0].yaxis, y)
    for axes in panels[-1]:
        axes.set_xlabel(x.label, fontsize=9)
    if any(cell.known.any() for row in points for cell in row):
        color_bar(
            figure, BoundaryNorm(levels, 256), cmap, values[0], levels[::2].tolist()
        )
    return figure


def _with_margin(ends: tuple[float, float]) -> tuple[float, float]:
    margin = 0.03 * (ends[1] - ends[0])
    return ends[0] - margin, ends[1] + margin


def _fill(axes: Axes, points: Points, levels: np.ndarray, cmap: str) -> None:
    """Draw filled contours between points; if the points span no area, colour the points themselves."""
    grid = points.grid
    known = points.known
    style: dict[str, Any] = {"levels": levels, "cmap": cmap}
    thin: dict[str, Any] = {
        "levels": levels,
        "colors": "k",
        "linewidths": 0.3,
        "alpha": 0.5,
    }
    if grid:
        mesh = None
    else:
        mesh = _triangulate(points.x[known], points.y[known])
    dots: dict[str, Any] = {"s": 3.0, "color": "0.25", "linewidths": 0.0}
    if grid is not None and _has_complete_cell(grid[2]):
        axes.contourf(*grid, **style)
        axes.contour(*grid, **thin)
    elif mesh is not None:
        axes.tricontourf(mesh, points.z[known], **style)
        axes.tricontour(mesh, points.z[known], **thin)
    else:
        dots = {
            "s": 45.0,
            "c": points.z[known],
            "cmap": cmap,
            "vmin": levels[0],
            "vmax": levels[-1],
        }
    if "c" in dots or known.sum() <= _MAX_DOTS:
        axes.scatter(points.x[known], points.y[known], zorder=3, **dots)


def _has_complete_cell(values: np.ndarray) -> bool:
    """Return whether at least one cell of a grid has a value at all four corners."""
    known = ~np.ma.getmaskarray(values)
    return bool(
        (known[1:, 1:] & known[1:, :-1] & known[:-1, 1:] & known[:-1, :-1]).any()
    )


def _triangulate(x: np.ndarray, y: np.ndarray) -> Triangulation | None:
    """Return a triangulation of points; None if they span no area."""
    if len(x) < 3:
        return None
    # Fields have different units, so triangles are formed in coordinates scaled to the
    # plot.
    u, v = (((values - values.min()) / (np.ptp(values) or 1.0)) for values in (x, y))
    try:
        scaled = Triangulation(u, v)
    except (RuntimeError, ValueError):
        return None  # all points are on a line
    with np.errstate(invalid="ignore"):  # triangles without an area
        ratios = np.ma.filled(TriAnalyzer(scaled).circle_ratios(rescale=False), 0.0)
    flat = ~(ratios >= _MIN_CIRCLE_RATIO)
    if flat.all():
        return None
    return Triangulation(x, y, scaled.triangles, mask=flat)


def _levels_and_colors(values: Sequence[np.ndarray]) -> tuple[np.ndarray, str]:
    """Return contour levels and colour map for all panels, symmetric about zero if both signs occur."""
    low, high = value_range([ColumnValues("", value) for value in values])
    largest = max(abs(low), abs(high))
    if low < 0 < high and min(-low, high) > _MIN_OPPOSITE * largest:
        levels = MaxNLocator(_LEVELS, symmetric=True).tick_values(-largest, largest)
        return np.asarray(levels), "RdBu_r"
    return np.asarray(MaxNLocator(_LEVELS).tick_values(low, high)), "viridis"


class _Colors:
    """Colours of the values of `by`, explained by a legend if they are few, otherwise by a colour bar.

    Attributes:
        column: values of the first owner; zeros if nothing distinguishes the runs.
        groups: distinct values.
        few: whether a legend is used.
        norm: map from values to positions on the colour map.
        by_group: value → colour; empty if owners determine the colours.
    """

    def __init__(self, columns: Sequence[ColumnValues], *, used: bool) -> None:
        numbers = np.concatenate([column.numbers for column in columns])
        self.column = columns[0]
        self.groups = np.unique(numbers[np.isfinite(numbers)])
        self.few = len(self.groups) <= _MAX_LINES
        self.norm = Normalize(*value_range(columns))
        if self.few:
            positions = np.linspace(0.0, 0.92, len(self.groups))
        else:
            positions = self.norm(self.groups)
        colors = map(to_hex, colormaps["viridis"](positions))
        if used:
            self.by_group = dict(zip(self.groups.tolist(), colors, strict=True))
        else:
            self.by_group = {}

    def draw_key(self, figure: Figure, axes: Axes) -> None:
        """Draw the legend or the colour bar."""
        if not self.few:
            color_bar(figure, self.norm, "viridis", self.column)
            return
        colors = self.by_group.items()
        handles = [
            Line2D([], [], color=color, label=self.column.text(group))
            for group, color in colors
        ]
        position: dict[str, Any] = {
            "loc": "upper left",
            "bbox_to_anchor": (1.0, 1.0),
            "alignment": "left",
        }
        title = textwrap.fill(self.column.label, 18)
        axes.legend(
            handles=handles, title=title, title_fontsize=8, **_LEGEND, **position
        )


def _draw_line_or_scatter(
    plot: Plot, results: SweepTable, owners: list[str], published: Published | None
) -> Figure:
    """Draw lines or dots, coloured by the column `by`, and marks of failed runs at the lower edge."""
    is_line = plot.kind == "line"
    is_colored = plot.by is not None
    figure, ((axes,),) = _panels(1, key=is_colored)
    constant = ColumnValues("", np.zeros(len(results.failed)))
    by = [results.values(plot.by, owner) if plot.by else constant for owner in owners]
    colors = _Colors(by, used=is_colored)
    x = results.values(plot.x, owners[0])
    values = results.metric(plot.metric, owners[0])
    drawn = 0
    for owner, column in zip(owners, by, strict=True):
        points = [
            results.values(plot.x, owner).numbers,
            results.metric(plot.metric, owner).numbers,
        ]
        for _, k in results.groups(_separate_fields(plot, results)):
            columns = np.array([*points, column.numbers])[:, k]
            drawn += (_draw_lines if is_line else _draw_dots)(
                axes, owner, columns, colors
            )
    finish(axes, values.label)
    axes.set_xlabel(x.label, fontsize=9)
    set_ticks(axes.xaxis, x)
    failed_x = np.unique(x.numbers[results.failed & np.isfinite(x.numbers)])
    mark_rows(axes, failed_x, np.full(len(failed_x), 0.025), "failed", relative=True)
    if not drawn:
        write_empty_note(axes, results.failed)
    # A plan has no plant to distinguish, so it has no legend entry.
    samples = [
        _sample(owner, line=is_line, plain=is_colored)
        for owner in owners
        if owner != PLAN
    ]
    if (
        is_line
        and published is not None
        and plot.x in published.at
        and plot.metric in published.metrics
    ):
        samples.append(_draw_published(axes, published, plot, x, by[0], colors))
    legend_above(axes, samples)
    if is_colored:
        colors.draw_key(figure, axes)
    return figure


def _draw_lines(axes: Axes, owner: str, columns: np.ndarray, colors: _Colors) -> int:
    """Draw a line per value of `by` through the means over seeds; return the number of points.

    Args:
        axes: axes.
        owner: owner of the metric.
        columns: x, y and `by` of each run, shape (3, runs).
        colors: colours of the values of `by`.
    """
    drawn, (x, y, by) = 0, columns
    for i, group in enumerate(colors.groups):
        # Markers become smaller from line to line, so that coinciding lines stay
        # visible.
        if colors.column.names and colors.few:
            steps = len(colors.groups) - 1 - i
        else:
            steps = 0
        rows = (by == group) & np.isfinite(x)
        positions, which = np.unique(x[rows], return_inverse=True)
        means = group_means(which.reshape(-1), len(positions), y[rows])
        style = _line_style(owner) | (
            {"color": colors.by_group[group]} if colors.by_group else {}
        )
        style |= {"markersize": (3.5 if colors.few else 2.0) + 2.0 * steps}
        axes.plot(positions, means, linewidth=1.3 if colors.few else 0.9, **style)
        drawn += int(np.isfinite(means).sum())
    return drawn


def _draw_dots(axes: Axes, owner: str, columns: np.ndarray, colors: _Colors) -> int:
    """Draw a dot per run, independent of the order of rows; return the number of dots, see `_draw_lines`."""
    x, y, by = columns[:, np.isfinite(columns).all(axis=0)]
    order = np.lexsort((y, x, by))
    style = style_of(owner)
    color: dict[str, Any] = {"color": style.color}
    if colors.by_group and colors.few:
        color = {"c": [colors.by_group[level] for level in by[order]]}
    elif colors.by_group:
        color = {"c": by[order], "cmap": "viridis", "norm": colors.norm}
    axes.scatter(
        x[order], y[order], s=16, marker=style.marker, alpha=0.85, linewidths=0, **color
    )
    return len(order)


def _draw_published(
    axes: Axes,
    published: Published,
    plot: Plot,
    x: ColumnValues,
    by: ColumnValues,
    colors: _Colors,
) -> Line2D:
    """Mark the published values of a metric along x, in the colour of their line if it is known.

    Returns:
        Legend entry.
    """
    style: dict[str, Any] = {
        "linestyle": "none",
        "marker": "*",
        "markersize": 10,
        "markeredgecolor": "white",
    }
    if plot.by and colors.few:
        groups = published.at.get(plot.by, ())
    else:
        groups = ()
    points = zip(published.at[plot.x], published.metrics[plot.metric], strict=True)
    for i, (position, value) in enumerate(points):
        if groups:
            color = colors.by_group.get(by.number(groups[i]))
        else:
            color = None
        if value is not None:
            color = color or PUBLISHED_COLOR
            axes.plot(
                x.number(position),
                value,
                color=color,
                markeredgewidth=0.6,
                zorder=5,
                **style,
            )
    # An unescaped dollar sign would start a formula.
    label = f"published, {published.source}".replace("$", r"\$")
    return Line2D([], [], color=PUBLISHED_COLOR, label=label, **style)


def _sample(owner: str, *, line: bool = True, plain: bool = False) -> Line2D:
    """Return the legend entry of an owner."""
    style = (
        _line_style(owner)
        | ({} if line else {"linestyle": "none"})
        | ({"color": "0.3"} if plain else {})
    )
    return Line2D([], [], **style, markersize=4, label=style_of(owner).label)


def _line_style(owner: str) -> dict[str, Any]:
    """Return colour, dash and marker of an owner's line."""
    style = style_of(owner)
    return {"color": style.color, "linestyle": style.dash, "marker": style.marker}
