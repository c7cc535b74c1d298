"""Reasons: why the data tell no number of a parameter, in words."""

from __future__ import annotations

import numpy as np

from srs_twin.identification.unknowns import Unknown
from srs_twin.identification.verdicts import Knowledge

_PART = 0.05
"""Of a direction of length 1: parameters with a smaller share have no part in it."""


def wanted_beyond(unknown: Unknown, z: float) -> str:
    """Return why an unknown has no number whose coordinate z ends at a bound."""
    lower = z - unknown.coordinate(unknown.low) < unknown.coordinate(unknown.high) - z
    bound, side = (unknown.low, "least") if lower else (unknown.high, "most")
    return f"the data want it at the {side} that is allowed, {bound:g} {unknown.unit}, or beyond"


def hidden_because(
    unknowns: tuple[Unknown, ...], inside: np.ndarray, known: Knowledge | None, place: int
) -> str:
    """Return why a parameter inside its bounds has no number.

    Args:
        unknowns: of the search.
        inside: which of them do not end at a bound.
        known: what the data tell of those; None: nothing.
        place: of the parameter among them.
    """
    if known is None:
        return "nothing can be told"
    rows = [row for row in known.blind if abs(row[place]) > _PART]
    others = sorted(
        {
            unknowns[inside[k]].name
            for row in rows
            for k in range(len(row))
            if k != place and abs(row[k]) > _PART
        }
    )
    if not rows:
        return f"its standard error is {known.errors[place]:.2g} in units that matter, 1 or more"
    if not others:
        return "the residuals do not depend on it"
    return f"together with {', '.join(others)} it cancels: only their combinations act"


def cancels(
    unknowns: tuple[Unknown, ...], inside: np.ndarray, known: Knowledge | None
) -> tuple[dict[str, float], ...]:
    """Return the directions in which the residuals do not change: name → share, the largest above 0.

    Args:
        unknowns: as in `hidden_because`.
        inside: likewise.
        known: likewise.
    """
    if known is None:
        return ()
    names = [unknowns[i].name for i in inside]
    rows = []
    for row in known.blind:
        signed = row * np.sign(row[np.argmax(np.abs(row))])
        rows.append(
            {name: round(float(v), 3) for name, v in zip(names, signed, strict=True) if abs(v) > _PART}
        )
    return tuple(rows)
