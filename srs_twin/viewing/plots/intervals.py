"""Pictures of what is known of predictions: intervals beside published values, and a tornado."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from srs_twin.viewing.plots.labels import field_label, metric_label
from srs_twin.viewing.plots.style import PUBLISHED_COLOR, finish, side_by_side, style_of

Bar = tuple[str, float, float, float]
_SHOWN = 10


def draw_intervals(title: str, document: Mapping[str, Any], swings: Sequence[Bar]) -> Figure:
    """Draw the target's intervals on each plant, and what of them each number makes.

    Args:
        title: of the scenario.
        document: as `Propagation.document` returns it.
        swings: as `Propagation.swings` returns them.
    """
    plant, metric = document["target"]["plant"], document["target"]["metric"]
    swings = swings[:_SHOWN]
    figure, axes = side_by_side(
        1.6 + 0.32 * max(len(swings), 3), 2, left=1.15, top=0.75, space=0.75, width_ratios=[1.0, 1.1]
    )
    left, right = axes[0]
    shown = [name for name in document["plants"] if metric in document["plants"][name]]
    for place, name in enumerate(shown):
        row, style = document["plants"][name][metric], style_of(name)
        left.plot(row["interval_95"], [place, place], color=style.color, linewidth=1.5)
        left.plot(row["interval_50"], [place, place], color=style.color, linewidth=7, solid_capstyle="butt")
        left.plot([row["value"]], [place], "|", color="white", markersize=9, markeredgewidth=2)
        if row["published"] is not None:
            left.plot(
                [row["published"]] * 2, [place - 0.35, place + 0.35], color=PUBLISHED_COLOR, linewidth=2
            )
    left.set_yticks(range(len(shown)), [style_of(name).label for name in shown])
    left.set_ylim(-0.7, len(shown) - 0.3)
    finish(left, "", metric_label(metric), title="50 and 95 %; white: as it stands; black: published")
    style = style_of(plant)
    middle = document["plants"][plant][metric]["value"]
    for place, (_, low, high, total) in enumerate(reversed(swings)):
        right.barh(
            place, high - low, left=low, height=0.65, color=style.color, alpha=0.35 + 0.6 * min(total, 1.0)
        )
        right.text(max(low, high), place, f" {100 * total:.0f} %", va="center", fontsize=7)
    right.axvline(middle, color="#888888", linewidth=0.8)
    right.set_yticks(range(len(swings)), [field_label(f"robot.{row[0]}") for row in reversed(swings)])
    reached = [end for row in swings for end in row[1:3]] or [middle]
    room = 0.12 * max(max(reached) - min(reached), 1e-9)
    right.set_xlim(min(reached) - room, max(reached) + 1.5 * room)
    finish(right, "", metric_label(metric), title=f"{style.label}: 95 % of each number, total index")
    for panel in (left, right):
        panel.tick_params(labelsize=8)
        panel.title.set_fontsize(9)
    figure.suptitle(title, fontsize=11, wrap=True)
    return figure
