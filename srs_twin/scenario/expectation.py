"""Expectations: what a metric must come out as, checked against what did."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from srs_twin.comparison.metrics import COMPARISON_UNITS, METRIC_UNITS

COMPARISON = "comparison"
_TALLY = {
    "met": "met",
    "missed": "missed",
    "known": "known to be missed",
    "holds": "met though known to be missed (take `known` out)",
}


@dataclass(frozen=True)
class Outcome:
    """An expectation and what came out.

    Attributes:
        metric: name of the metric.
        of: "analytical", "twin" or "comparison".
        value: what came out; None where there is no such number.
        allowed: in words, e.g. "0.1819 to 0.2461".
        met: whether the value is allowed; never so without a value.
        near: the value that was expected, None for one-sided bounds.
        source: where the expectation is from, None for our own.
        known: why it is missed, where the scenario says so.
    """

    metric: str
    of: str
    value: float | None
    allowed: str
    met: bool
    near: float | None
    source: str | None
    known: str | None = None

    @property
    def verdict(self) -> str:
        """As `verdict` has it."""
        return verdict(self.met, self.known)


def verdict(met: bool, known: str | None) -> str:
    """Return "met", "missed", "known" (missed, as the scenario says) or "holds" (met, though it says so)."""
    if known is None:
        return "met" if met else "missed"
    return "holds" if met else "known"


def tally(verdicts: Mapping[str, int]) -> str:
    """Return in words how many expectations came out how."""
    said = [f"{verdicts[each]} {words}" for each, words in _TALLY.items() if verdicts.get(each)]
    return ", ".join(said) or "none"


@dataclass(frozen=True)
class Expectation:
    """A range for one metric of one plant or of the comparison; both ends are allowed values.

    Attributes:
        metric: name of the metric.
        of: "analytical", "twin" or "comparison".
        low: −inf where there is no lower bound.
        high: inf where there is no upper bound.
        near: the middle of the range where it was given so.
        source: where it is from.
        known: why it is missed; None where it is to be met.
    """

    metric: str
    of: str
    low: float
    high: float
    near: float | None = None
    source: str | None = None
    known: str | None = None

    @property
    def allowed(self) -> str:
        """The range in words."""
        if math.isinf(self.low):
            return f"at most {self.high:.4g}"
        if math.isinf(self.high):
            return f"at least {self.low:.4g}"
        return f"{self.low:.4g} to {self.high:.4g}"

    def check(self, metrics: Mapping[str, Any]) -> Outcome:
        """Compare with what came out.

        Args:
            metrics: as in metrics.json: "plants" → plant → metric, and "comparison" → metric.
        """
        comparison = self.of == COMPARISON
        found = metrics.get(COMPARISON) if comparison else (metrics.get("plants") or {}).get(self.of)
        value = (found or {}).get(self.metric)
        met = value is not None and math.isfinite(value) and self.low <= value <= self.high
        return Outcome(self.metric, self.of, value, self.allowed, met, self.near, self.source, self.known)


def known_metrics(of: str | None = None) -> tuple[str, ...]:
    """Return what an expectation can name: of a plant, of the comparison, or (None) of either."""
    if of is None:
        return (*METRIC_UNITS, *COMPARISON_UNITS)
    return tuple(COMPARISON_UNITS if of == COMPARISON else METRIC_UNITS)
