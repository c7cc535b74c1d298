"""Planes that pictures of sweeps are drawn on: panels side by side, marks of runs without a value."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from srs_twin.viewing.sweep_table import Values

_WIDTH, _HEIGHT = 9.0, 4.2
_LEFT, _RIGHT, _TOP, _BOTTOM = 0.75, 0.25, 0.75, 0.5
_KEY = 1.3  # right margin with a colour bar or a legend in it
# Colours of marks: neither a plant's nor one of the scales of values.
_MARKS = {"failed": ("x", "#CC3311"), "no value": ("o", "0.35")}


def column_panels(columns: int, *, key: bool) -> tuple[Figure, list[Axes]]:
    """Return a figure of the report's width and its panels side by side, with common axes.

    Args:
        columns: number of panels.
        key: whether room is left on the right for what colours mean.
    """
    figure = Figure(figsize=(_WIDTH, _HEIGHT))
    margins = {
        "left": _LEFT / _WIDTH, "right": 1 - (_KEY if key else _RIGHT) / _WIDTH,
        "top": 1 - _TOP / _HEIGHT, "bottom": _BOTTOM / _HEIGHT, "wspace": 0.08,
    }  # fmt: skip
    made = figure.subplots(1, columns, sharex=True, sharey=True, squeeze=False, gridspec_kw=margins)
    for axes in made[0]:
        axes.tick_params(labelsize=8)
    return figure, list(made[0])


def color_bar(
    figure: Figure, norm: Normalize, cmap: str, values: Values, ticks: Sequence[float] | None = None
) -> None:
    """Draw the bar that says which colour means what, in the room on the right."""
    bottom = _BOTTOM / _HEIGHT
    place = (1 - (_KEY - 0.12) / _WIDTH, bottom, 0.16 / _WIDTH, 1 - _TOP / _HEIGHT - bottom)
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
        axes.add_artist(axes.legend(
            handles=shown, fontsize=8, ncols=len(shown), loc="lower right", bbox_to_anchor=(1.0, 0.99),
            frameon=False, borderaxespad=0.2, handletextpad=0.4, columnspacing=1.2, handlelength=2.8,
        ))  # fmt: skip


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
        marker, color = _MARKS[what]
        transform = axes.get_xaxis_transform() if across else axes.transData
        axes.plot(
            x, y, linestyle="none", marker=marker, color=color, markersize=4.5, markeredgewidth=1.1,
            markerfacecolor="none", transform=transform, clip_on=not across, label=what, zorder=4,
        )  # fmt: skip


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
