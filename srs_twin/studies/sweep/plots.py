"""Plots of sweep results, which show a metric over a field or another metric.

Results are averaged over seeds but not over other fields. If additional fields vary,
each combination of their values has a separate line.
"""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from srs_twin.studies.sweep.points import Plot
from srs_twin.studies.sweep.table import (
    COMPARISON,
    ColumnValues,
    SweepTable,
    group_means,
)
from srs_twin.studies.sweep.task import PLAN
from srs_twin.viewing.plots.labels import field_label
from srs_twin.viewing.plots.style import drawing, finish, side_by_side, style_of

_MAX_LINES = 12
"""Maximum number of values in a legend, above which a colour bar is drawn."""

_COLORMAP = "viridis"
_FAILED_COLOR = "#CC3311"
"""Colour of failed runs, which neither the plants nor the colour map use."""


_LEGEND: dict[str, Any] = {"fontsize": 8, "frameon": False}

# Figure dimensions, inches.
_WIDTH = 9.0
_HEIGHT = 4.2
_TOP = 0.75
_BOTTOM = 0.5
_KEY_WIDTH = 1.3
"""Width of the right margin for a colour bar or legend."""


@drawing
def draw(plot: Plot, results: SweepTable) -> Figure:
    """Draw a plot of sweep results, which does not depend on the row order."""
    owners = results.owners(plot.metric)
    owners = [owner for owner in owners if owner != COMPARISON] or owners
    if plot.kind == "line" and plot.by is None:
        separate = _separate_fields(plot, results)
        plot = plot.model_copy(update={"by": separate[0] if separate else None})
    figure = _draw_runs(plot, results, owners)
    figure.suptitle(_title(plot, results, owners), x=0.01, ha="left", fontsize=10)
    return figure


def _separate_fields(plot: Plot, results: SweepTable) -> list[str]:
    if plot.kind == "scatter":
        return []
    return results.unplotted_settings(filter(None, (plot.x, plot.by)))


def _title(plot: Plot, results: SweepTable, owners: list[str]) -> str:
    columns = (
        results.metric(plot.metric, owners[0]),
        results.values(plot.x, owners[0]),
    )
    metric, name = (column.label.partition(" (")[0] for column in columns)
    against = "against" if plot.kind == "scatter" else "over"
    title = f"{metric[:1].upper()}{metric[1:]} {against} {name}"
    notes = _notes(plot, results, owners)
    if notes:
        return f"{title}\n({'; '.join(notes)})"
    return title


def _notes(plot: Plot, results: SweepTable, owners: list[str]) -> list[str]:
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
        notes.append(f"one line for each {', '.join(map(field_label, separate))}")
    if failed:
        notes.append(f"{failed} of {len(results.failed)} runs failed")
    if missing:
        notes.append(f"{missing} values missing")
    if len(distinct) == 1:
        notes.append(f"every value is {distinct[0]:.4g}")
    return notes


def _set_ticks(axis: Axis, values: ColumnValues) -> None:
    known = values.numbers[np.isfinite(values.numbers)]
    if values.names:
        axis.set_ticks(range(len(values.names)), labels=values.names)
    elif known.size and np.array_equal(known, np.round(known)):
        axis.set_major_locator(MaxNLocator(integer=True))


def _write_empty_note(axes: Axes, failed: np.ndarray) -> None:
    rows = len(failed)
    failures = int(failed.sum())
    if not rows:
        text = "there are no runs"
    elif failures == rows == 1:
        text = "the run failed"
    elif failures == rows:
        text = f"all {rows} runs failed"
    else:
        text = f"no value in {rows - failures} runs"
        if failures:
            text += f", {failures} failed"
    axes.text(
        0.5,
        0.5,
        f"nothing to draw: {text}",
        transform=axes.transAxes,
        ha="center",
        fontsize=10,
    )


class _Colors:
    """Colours for the values of the field `by`, with a legend or a colour bar.

    Attributes:
        column: values of the field `by` for the first owner, or zeros if the plot has
            no such field.
        norm: function that maps values to positions on the colour map.
        by_group: colour of each value, or an empty dictionary if colours distinguish
            the owners.
    """

    def __init__(self, columns: list[ColumnValues], *, used: bool) -> None:
        numbers = np.concatenate([column.numbers for column in columns])
        self.column = columns[0]
        self.groups = np.unique(numbers[np.isfinite(numbers)])
        self.few = len(self.groups) <= _MAX_LINES
        self.norm = Normalize()
        self.norm.autoscale_None(self.groups)
        self.by_group: dict[float, str] = {}
        if used:
            if self.few:
                positions = np.linspace(0.0, 0.92, len(self.groups))
            else:
                positions = self.norm(self.groups)
            colors = map(to_hex, colormaps[_COLORMAP](positions))
            self.by_group = dict(zip(self.groups.tolist(), colors, strict=True))

    def draw_key(self, figure: Figure, axes: Axes) -> None:
        if not self.few:
            self._draw_bar(figure)
            return
        handles = [
            Line2D([], [], color=color, label=self.column.text(group))
            for group, color in self.by_group.items()
        ]
        axes.legend(
            handles=handles,
            title=textwrap.fill(self.column.label, 18),
            title_fontsize=8,
            loc="upper left",
            bbox_to_anchor=(1.0, 1.0),
            alignment="left",
            **_LEGEND,
        )

    def _draw_bar(self, figure: Figure) -> None:
        bottom = _BOTTOM / _HEIGHT
        left = 1 - (_KEY_WIDTH - 0.12) / _WIDTH
        rectangle = (left, bottom, 0.16 / _WIDTH, 1 - _TOP / _HEIGHT - bottom)
        axes = figure.add_axes(rectangle, label="colors")
        bar = figure.colorbar(ScalarMappable(self.norm, _COLORMAP), cax=axes)
        bar.set_label(self.column.label, fontsize=9)
        bar.ax.tick_params(labelsize=8)
        if self.column.names:
            names = self.column.names
            bar.set_ticks(range(len(names)), labels=list(names))


def _draw_runs(plot: Plot, results: SweepTable, owners: list[str]) -> Figure:
    is_colored = plot.by is not None
    right = _KEY_WIDTH if is_colored else 0.25
    figure, ((axes,),) = side_by_side(_HEIGHT, 1, right=right, top=_TOP)
    axes.tick_params(labelsize=8)
    constant = ColumnValues("", np.zeros(len(results.failed)))
    by = [results.values(plot.by, owner) if plot.by else constant for owner in owners]
    colors = _Colors(by, used=is_colored)
    draw_points = _draw_lines if plot.kind == "line" else _draw_dots
    groups = results.groups(_separate_fields(plot, results))
    drawn = 0
    for owner, column in zip(owners, by, strict=True):
        x = results.values(plot.x, owner).numbers
        y = results.metric(plot.metric, owner).numbers
        for _, k in groups:
            columns = np.array([x, y, column.numbers])[:, k]
            drawn += draw_points(axes, owner, columns, colors)
    finish(axes, results.metric(plot.metric, owners[0]).label)
    along = results.values(plot.x, owners[0])
    axes.set_xlabel(along.label, fontsize=9)
    _set_ticks(axes.xaxis, along)
    _mark_failed(axes, along.numbers[results.failed])
    if not drawn:
        _write_empty_note(axes, results.failed)
    _draw_legend(axes, owners, plot)
    if is_colored:
        colors.draw_key(figure, axes)
    return figure


def _mark_failed(axes: Axes, x: np.ndarray) -> None:
    x = np.unique(x[np.isfinite(x)])
    if len(x):
        axes.plot(
            x,
            np.full(len(x), 0.025),
            "x",
            color=_FAILED_COLOR,
            markeredgewidth=1.1,
            markersize=4.5,
            zorder=4,
            transform=axes.get_xaxis_transform(),
            clip_on=False,
            label="failed",
        )


def _draw_legend(axes: Axes, owners: list[str], plot: Plot) -> None:
    handles: list[Artist] = []
    # Metrics of a plan do not belong to a plant, so they have no legend entry.
    for owner in owners if PLAN not in owners else ():
        style = _line_style(owner)
        if plot.kind == "scatter":
            style["linestyle"] = "none"
        if plot.by is not None:
            style["color"] = "0.3"
        label = style_of(owner).label
        handles.append(Line2D([], [], **style, markersize=4, label=label))
    handles += axes.get_legend_handles_labels()[0]
    if handles:
        legend = axes.legend(
            handles=handles,
            ncols=len(handles),
            loc="lower right",
            bbox_to_anchor=(1.0, 0.99),
            borderaxespad=0.2,
            handletextpad=0.4,
            columnspacing=1.2,
            handlelength=2.8,
            **_LEGEND,
        )
        axes.add_artist(legend)


def _draw_lines(axes: Axes, owner: str, columns: np.ndarray, colors: _Colors) -> int:
    """Draw means over seeds for each value of `by`, and return the number of points."""
    drawn = 0
    x, y, by = columns
    size, width = (3.5, 1.3) if colors.few else (2.0, 0.9)
    for i, group in enumerate(colors.groups):
        # Markers shrink from line to line, so that coinciding lines remain visible.
        steps = 0
        if colors.column.names and colors.few:
            steps = len(colors.groups) - 1 - i
        rows = (by == group) & np.isfinite(x)
        positions, which = np.unique(x[rows], return_inverse=True)
        means = group_means(which.reshape(-1), len(positions), y[rows])
        style = _line_style(owner)
        if colors.by_group:
            style["color"] = colors.by_group[group]
        axes.plot(
            positions, means, linewidth=width, markersize=size + 2.0 * steps, **style
        )
        drawn += int(np.isfinite(means).sum())
    return drawn


def _draw_dots(axes: Axes, owner: str, columns: np.ndarray, colors: _Colors) -> int:
    x, y, by = columns[:, np.isfinite(columns).all(axis=0)]
    order = np.lexsort((y, x, by))
    style = style_of(owner)
    color: dict[str, Any] = {"color": style.color}
    if colors.by_group and colors.few:
        color = {"c": [colors.by_group[level] for level in by[order]]}
    elif colors.by_group:
        color = {"c": by[order], "cmap": _COLORMAP, "norm": colors.norm}
    axes.scatter(
        x[order], y[order], s=16, marker=style.marker, alpha=0.85, linewidths=0, **color
    )
    return len(order)


def _line_style(owner: str) -> dict[str, Any]:
    style = style_of(owner)
    return {"color": style.color, "linestyle": style.dash, "marker": style.marker}
