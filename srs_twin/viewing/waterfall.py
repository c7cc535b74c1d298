"""Waterfall: from the analytical model's value to the twin's, one assumption after another."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from srs_twin.comparison.shares import MEASURES, Attribution
from srs_twin.viewing.colors import STYLES

_UP, _DOWN, _REST = "#009E73", "#CC79A7", "#8a8f98"
_LONGEST_NAME = 2.05  # inches


def waterfall(attribution: Attribution) -> Figure:
    """Return one panel a measure; rows are the assumptions, as the shares are listed.

    Bars run from what was reached before to what is reached with one more assumption; thin lines show the
    least and the most of a share over the orders of switching.
    """
    names = [share.name for share in attribution.shares]
    rows = ["analytical", *names, "not explained", "twin"]
    height = 0.75 + 0.24 * len(rows)
    figure = Figure(figsize=(9.0, height))
    panels = figure.subplots(
        1, len(MEASURES), sharey=True,
        gridspec_kw={
            "left": _LONGEST_NAME / 9.0, "right": 0.985, "top": 1 - 0.35 / height, "bottom": 0.42 / height,
            "wspace": 0.1,
        },
    )  # fmt: skip
    for m, (axes, (title, unit)) in enumerate(zip(panels, MEASURES.values(), strict=True)):
        _panel(axes, attribution, m, len(rows))
        axes.set_title(title, fontsize=9)
        axes.set_xlabel(unit, fontsize=8)
    panels[0].set_yticks(range(len(rows)), rows, fontsize=8)
    panels[0].invert_yaxis()
    return figure


def _panel(axes: Axes, attribution: Attribution, m: int, rows: int) -> None:
    """Draw measure m."""
    reached = attribution.reference[m]
    # Of a distance there is none to begin with; its bars add up to what lies between the plants.
    levels = [reached]
    axes.barh(0, reached, height=0.6, color=STYLES["analytical"].color)
    parts = [(share.value[m], share.low[m], share.high[m]) for share in attribution.shares]
    parts.append((attribution.remainder[m],) * 3)
    for row, (value, low, high) in enumerate(parts, start=1):
        last = row == rows - 2
        color = _REST if last else _UP if value >= 0 else _DOWN
        axes.barh(row, value, left=reached, height=0.6, color=color, hatch="//" if last else None)
        axes.plot([reached + low, reached + high], [row, row], color="0.2", linewidth=0.8)
        axes.plot([reached + value] * 2, [row - 0.3, row + 1.3], color="0.5", linewidth=0.5)
        reached += value
        levels.append(reached)
    axes.barh(rows - 1, reached, height=0.6, color=STYLES["twin"].color)
    _zoom(axes, levels)
    axes.grid(True, axis="x", linewidth=0.4, alpha=0.5)
    axes.tick_params(labelsize=7)
    axes.ticklabel_format(axis="x", style="sci", scilimits=(-2, 3), useMathText=True)
    axes.xaxis.get_offset_text().set_fontsize(7)


def _zoom(axes: Axes, levels: list[float]) -> None:
    """Show the range in which the steps happen, with zero only where it is not far off."""
    low, high = min(levels), max(levels)
    span = max(high - low, 1e-3 * max(abs(low), abs(high)), 1e-9)
    low, high = low - 0.35 * span, high + 0.35 * span
    axes.set_xlim(
        min(low, 0.0) if min(levels) < span else low, max(high, 0.0) if max(levels) > -span else high
    )
