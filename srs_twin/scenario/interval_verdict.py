"""Verdict on a published value by an interval whose ends have standard errors."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

UNDECIDED_ERRORS = 2.0
"""Distance from an end, in standard errors of the end, below which the verdict is undecided (95 %)."""


class IntervalVerdict(Enum):
    """Position of a published value relative to an interval."""

    WITHIN = "within"
    UNDECIDED = "undecided"
    OUTSIDE = "outside"


def interval_verdict(
    published: float, interval: Sequence[float], errors: Sequence[float] | None = None
) -> IntervalVerdict:
    """Return the verdict on a published value.

    Args:
        published: the value.
        interval: lower and upper end.
        errors: standard errors of the ends; None: the ends are exact.
    """
    low, high = interval
    for end, error in zip(interval, errors or (0.0, 0.0), strict=True):
        if abs(published - end) < UNDECIDED_ERRORS * error:
            return IntervalVerdict.UNDECIDED
    return IntervalVerdict.WITHIN if low <= published <= high else IntervalVerdict.OUTSIDE
