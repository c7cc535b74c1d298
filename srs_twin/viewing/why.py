"""The part of the report that says why the plants differ."""

from __future__ import annotations

from srs_twin.comparison.shares import MEASURES, Attribution
from srs_twin.viewing.html import Markup, element, picture, table
from srs_twin.viewing.waterfall import waterfall

_NOTHING = 5e-6  # in m, m/s, rad and rad/s alike: below what any two of these runs mean

_READING = (
    "Rows add up to the whole gap, twin minus analytical; of the body shape it is the distance between the "
    "two bodies. 'Averaged' assumptions are the analytical model's: every subset of them was switched to "
    "what the twin has, and each one's share is its Shapley value, the average over all orders of switching; "
    "in brackets the least and the most of it over these orders. 'First' comes what has to, before them.",
    "'Refined' ones belong to one plant alone: it was run again with this made smaller, and what that "
    "changed was carried on to nothing. What none of them explains is the last row. 'Matched' is what is "
    "left between the plants when both have stiff bends and the same friction at the same points. The column "
    "of the body shape splits a distance: a negative share there brings the bodies nearer.",
)


def why_section(attribution: Attribution) -> list[Markup]:
    """Return heading, picture, table and how to read them."""
    headings = ["assumption", "what it is", "how", *(f"{t}, {u}" for t, u in MEASURES.values())]
    rows = [
        [share.name, share.title, share.how, *map(_cell, share.value, share.low, share.high)]
        for share in attribution.shares
    ]
    whole = [("not explained", attribution.remainder), ("gap", attribution.gap)]
    rows += [[name, "", "", *map(_number, values)] for name, values in whole]
    left = "stiff bends and the same friction on both sides: what is left"
    rows.append(["matched (stiff bends)", left, "", *map(_number, attribution.matched)])
    same = ", ".join(attribution.same)
    return [
        element("h2", "Why the plants differ"),
        picture(
            waterfall(attribution), "From the analytical model to the twin, one assumption after another."
        ),
        table(headings, rows, numbers=range(3, len(headings))),
        *(element("p", sentence) for sentence in _READING),
        *([element("p", f"Not a difference in this scenario: {same}.")] if same else []),
    ]


def _cell(value: float, low: float, high: float) -> str:
    text = _number(value)
    return text if low == high else f"{text} [{_number(low)}, {_number(high)}]"


def _number(value: float) -> str:
    return f"{value:+.3g}" if abs(value) >= _NOTHING else "0"
