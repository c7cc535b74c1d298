"""Plot of prediction intervals, with a tornado chart of their causes."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from srs_twin.studies.uncertainty.metric_uncertainty import (
    MetricDocument,
    SwingDocument,
    UncertaintyDocument,
    count_text,
)
from srs_twin.viewing.plots.labels import field_label, metric_label
from srs_twin.viewing.plots.style import PUBLISHED_COLOR, drawing, finish, style_of

_MAX_SWINGS = 10

_WIDTH = 4.6
"""Width of the figure, inches, which is narrow enough for a smartphone."""

_LEFT = 1.85
"""Minimum left margin, inches."""

_LEFT_OF_LABELS = 0.1
"""Minimum space to the left and right of the labels, inches."""

_TOP = 0.7
"""Height of the space above the panels for a title and a heading, inches."""

_ROW = 0.42
"""Height of each row in a panel, inches."""

_BETWEEN = 0.85
"""Height of the space between the panels for an axis and a heading, inches."""

_LINE_CHARACTERS = 74
"""Maximum number of characters in a text line below the panels."""

_LINE_HEIGHT = 0.15
"""Height of a text line, inches."""

_EFFECT = "effect of each parameter alone (95 %)"
_KEY = (
    "Per cent: total index, with its error. Whiskers: two standard errors. "
    "Hatched bars: causes whose order is not resolved."
)
_WARNING_COLOR = "#b03030"
_ERROR: dict[str, Any] = {
    "ecolor": "#333333",
    "elinewidth": 0.9,
    "capsize": 3,
    "fmt": "none",
}


@drawing
def draw_intervals(title: str, document: UncertaintyDocument) -> Figure:
    """Plot the intervals of the target metric and the effect of each quantity on it.

    The argument `document` is the return value of `Propagation.document`.
    """
    plant = document["target"]["plant"]
    metric = document["target"]["metric"]
    rows = {
        name: metrics[metric]
        for name, metrics in document["plants"].items()
        if metric in metrics
    }
    swings = document["swings"][:_MAX_SWINGS]
    lines = _text_lines(document)
    below = 0.6 + _LINE_HEIGHT * len(lines)
    heights = [_ROW * max(len(rows), 1), _ROW * max(len(swings), 1)]
    height = _TOP + sum(heights) + _BETWEEN + below
    figure = Figure(figsize=(_WIDTH, height))
    bottoms = [below + heights[1] + _BETWEEN, below]
    upper = figure.add_axes((0, 0, 1, 1))
    lower = figure.add_axes((0, 0, 1, 1))
    _draw_intervals(upper, rows, metric)
    _draw_swings(lower, swings, plant, rows[plant], metric)
    labels = [*upper.get_yticklabels(), *lower.get_yticklabels()]
    widest = max(label.get_window_extent().width for label in labels) / figure.dpi
    left = max(_LEFT, widest + 2 * _LEFT_OF_LABELS) / _WIDTH
    width = 1 - left - 0.15 / _WIDTH
    # Headings start at the left edge of the figure, because they are wider than the
    # panels.
    headings = [
        "50 and 95 %; tick: value; line: published",
        f"{style_of(plant).label}: {_EFFECT}",
    ]
    for axes, bottom, panel, heading in zip(
        (upper, lower), bottoms, heights, headings, strict=True
    ):
        axes.set_position((left, bottom / height, width, panel / height))
        figure.text(
            0.02, (bottom + panel + 0.08) / height, heading, fontsize=9, va="bottom"
        )
    figure.text(
        0.02, 1 - 0.1 / height, textwrap.fill(title, 50), fontsize=10.5, va="top"
    )
    for k, (line, color) in enumerate(reversed(lines)):
        figure.text(
            0.02,
            (0.08 + _LINE_HEIGHT * k) / height,
            line,
            fontsize=7.5,
            color=color,
            va="bottom",
        )
    return figure


def _draw_intervals(
    axes: Axes, rows: Mapping[str, MetricDocument], metric: str
) -> None:
    """Draw the 50 % and 95 % intervals, with error bars of two standard errors."""
    for y, (name, row) in enumerate(rows.items()):
        color = style_of(name).color
        wide = row["interval_95"]
        axes.plot(wide, [y, y], color=color, linewidth=1.5)
        axes.plot(
            row["interval_50"], [y, y], color=color, linewidth=7, solid_capstyle="butt"
        )
        errors = [2 * error for error in row["interval_95_error"]]
        axes.errorbar(wide, [y, y], xerr=errors, **_ERROR)
        axes.plot(
            [row["value"]], [y], "|", color="white", markersize=9, markeredgewidth=3.5
        )
        axes.plot(
            [row["value"]], [y], "|", color="black", markersize=9, markeredgewidth=1
        )
        if row["published"] is not None:
            axes.plot(
                [row["published"]] * 2,
                [y - 0.3, y + 0.3],
                color=PUBLISHED_COLOR,
                linewidth=2,
            )
    labels = [
        f"{style_of(name).label}\n{count_text(row['samples'], row['runs'])}"
        for name, row in rows.items()
    ]
    axes.set_yticks(range(len(rows)), labels)
    axes.set_ylim(-0.5, len(rows) - 0.5)
    finish(axes, "", metric_label(metric))


def _draw_swings(
    axes: Axes,
    swings: Sequence[SwingDocument],
    plant: str,
    row: MetricDocument,
    metric: str,
) -> None:
    """Draw a bar for the effect of each quantity, hatched if the rank is uncertain."""
    style = style_of(plant)
    labels = []
    for y, swing in enumerate(reversed(swings)):
        assert row["sensitivity"] is not None, "every bar belongs to a sensitivity"
        index = row["sensitivity"][swing["parameter"]]
        low, high = sorted((swing["low"], swing["high"]))
        best, worst = index["rank"]
        is_tied = best < worst
        axes.barh(
            y,
            high - low,
            left=low,
            height=0.65,
            facecolor=style.color if not is_tied else "white",
            edgecolor=style.color,
            hatch="////" if is_tied else None,
            alpha=0.6,
        )
        axes.errorbar([low, high], [y, y], xerr=swing["error"], **_ERROR)
        rank = f"{best} to {worst}" if is_tied else f"{best}"
        error = min(100 * index["total_error"], 100.0)
        fraction = f"{100 * index['total']:.0f} ± {error:.0f} %, rank {rank}"
        labels.append(field_label(f"robot.{swing['parameter']}") + f"\n{fraction}")
    axes.axvline(row["value"], color="#888888", linewidth=0.8)
    axes.set_yticks(range(len(labels)), labels)
    ends = [
        swing[end] + sign * swing["error"]
        for swing in swings
        for end in ("low", "high")
        for sign in (-1, 1)
    ]
    ends = ends or [row["value"]]
    width = max(max(ends) - min(ends), 1e-9)
    axes.set_xlim(min(ends) - 0.05 * width, max(ends) + 0.05 * width)
    axes.set_ylim(-0.5, max(len(labels), 1) - 0.5)
    finish(axes, "", metric_label(metric))


def _text_lines(document: UncertaintyDocument) -> list[tuple[str, str]]:
    warnings = [f"Warning: {text}" for text in document["warnings"]]
    return [
        (line, color)
        for texts, color in (([_KEY], "#333333"), (warnings, _WARNING_COLOR))
        for text in texts
        for line in textwrap.wrap(text, _LINE_CHARACTERS)
    ]
