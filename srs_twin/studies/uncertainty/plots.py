"""Plot of a prediction's uncertainty: intervals with published values, and a tornado chart of the causes."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from srs_twin.viewing.plots.labels import field_label, metric_label
from srs_twin.viewing.plots.style import PUBLISHED_COLOR, finish, side_by_side, style_of

_MAX_SWINGS = 10
"""Largest number of causes in the tornado chart."""

_LINE_CHARACTERS = 175
"""Length of a text line below the panels, characters."""

_LINE_HEIGHT = 0.15
"""Height of a text line, inches."""

_KEY = "Whiskers: two standard errors. Hatched bars: causes whose order is not resolved."
_WARNING_COLOR = "#b03030"
_ERROR: dict[str, Any] = {"ecolor": "#333333", "elinewidth": 0.9, "capsize": 3, "fmt": "none"}


def draw_intervals(title: str, document: Mapping[str, Any]) -> Figure:
    """Draw the target's intervals on each plant, and the effect of each uncertain quantity.

    Args:
        title: title of the scenario.
        document: result, see `Propagation.document`.
    """
    plant, metric = document["target"]["plant"], document["target"]["metric"]
    rows = {name: metrics[metric] for name, metrics in document["plants"].items() if metric in metrics}
    swings = document["swings"][:_MAX_SWINGS]
    lines = _text_lines(document)
    below = 0.55 + _LINE_HEIGHT * (len(lines) + 1)
    figure, axes = side_by_side(
        2.05 + 0.32 * max(len(swings), 3) + _LINE_HEIGHT * len(lines),
        2, left=1.4, top=0.95, bottom=below, space=0.75, width_ratios=[1.0, 1.1],
    )  # fmt: skip
    left, right = axes[0]
    _draw_intervals(left, rows, metric)
    _draw_swings(right, swings, plant, rows[plant], metric)
    for panel in (left, right):
        panel.tick_params(labelsize=8)
        panel.title.set_fontsize(9)
    counts = ", ".join(f"{style_of(name).label}: {_count_text(row)}" for name, row in rows.items())
    figure.suptitle(f"{title}\n{counts}", fontsize=11, wrap=True)
    for k, (line, color) in enumerate(reversed(lines)):
        height = (0.08 + _LINE_HEIGHT * k) / figure.get_figheight()
        figure.text(0.01, height, line, fontsize=7, color=color, va="bottom")
    return figure


def _draw_intervals(axes: Axes, rows: Mapping[str, Mapping[str, Any]], metric: str) -> None:
    """Draw the 50 and 95 % intervals, the ends of the latter with two standard errors."""
    for y, (name, row) in enumerate(rows.items()):
        color, wide = style_of(name).color, row["interval_95"]
        axes.plot(wide, [y, y], color=color, linewidth=1.5)
        axes.plot(row["interval_50"], [y, y], color=color, linewidth=7, solid_capstyle="butt")
        errors = [2 * error for error in row["interval_95_error"]]
        axes.errorbar(wide, [y, y], xerr=errors, **_ERROR)
        axes.plot([row["value"]], [y], "|", color="white", markersize=9, markeredgewidth=3.5)
        axes.plot([row["value"]], [y], "|", color="black", markersize=9, markeredgewidth=1)
        if row["published"] is not None:
            axes.plot([row["published"]] * 2, [y - 0.35, y + 0.35], color=PUBLISHED_COLOR, linewidth=2)
    axes.set_yticks(
        range(len(rows)), [f"{style_of(name).label}\n{_count_text(row)}" for name, row in rows.items()]
    )
    axes.set_ylim(-0.7, len(rows) - 0.3)
    finish(axes, "", metric_label(metric), title="50 and 95 %; tick: value; line: published")


def _draw_swings(
    axes: Axes, swings: Sequence[Mapping[str, Any]], plant: str, row: Mapping[str, Any], metric: str
) -> None:
    """Draw the effect of each quantity alone; hatched if its rank among the causes is not resolved."""
    style, count = style_of(plant), len(swings)
    for y, swing in enumerate(reversed(swings)):
        index = row["sensitivity"][swing["parameter"]]
        low, high = sorted((swing["low"], swing["high"]))
        best, worst = index["rank"]
        is_tied = best < worst
        axes.barh(
            y, high - low, left=low, height=0.65, facecolor=style.color if not is_tied else "white",
            edgecolor=style.color, hatch="////" if is_tied else None, alpha=0.6,
        )  # fmt: skip
        axes.errorbar([low, high], [y, y], xerr=swing["error"], **_ERROR)
        rank = f"{best} to {worst}" if is_tied else f"{best}"
        error = min(100 * index["total_error"], 100.0)
        text = f" {100 * index['total']:.0f} ± {error:.0f} %, rank {rank}"
        axes.text(high + swing["error"], y, text, va="center", fontsize=7)
    axes.axvline(row["value"], color="#888888", linewidth=0.8)
    axes.set_yticks(range(count), [field_label(f"robot.{swing['parameter']}") for swing in reversed(swings)])
    ends = [
        swing[end] + sign * swing["error"] for swing in swings for end in ("low", "high") for sign in (-1, 1)
    ]
    ends = ends or [row["value"]]
    width = max(max(ends) - min(ends), 1e-9)
    axes.set_xlim(min(ends) - 0.05 * width, max(ends) + 0.95 * width)
    finish(axes, "", metric_label(metric), title=f"{style.label}: 95 % of each number; total index")


def _count_text(row: Mapping[str, Any]) -> str:
    """Return the number of samples, and of runs if a surrogate was used."""
    samples, runs = row["samples"], row["runs"]
    return f"{samples} samples" + (f", {runs} runs" if runs < samples else "")


def _text_lines(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the lines below the panels, with their colours."""
    warnings = [f"Warning: {text}" for text in document["warnings"]]
    if document["remedy"]:
        options = " ".join(f"--{name} {count}" for name, count in document["remedy"].items())
        warnings.append(f"{options} should be enough.")
    notes = [_KEY, *document["remarks"]]
    return [
        (line, color)
        for texts, color in ((notes, "#333333"), (warnings, _WARNING_COLOR))
        for text in texts
        for line in textwrap.wrap(text, _LINE_CHARACTERS)
    ]
