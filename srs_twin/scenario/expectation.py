"""Expectations: what a metric must come out as, checked against what did."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from srs_twin.comparison.metrics import COMPARISON_UNITS, METRIC_UNITS, METRICS_LISTED
from srs_twin.errors import UnknownNameError
from srs_twin.scenario.fields import Section, quantity

COMPARISON = "comparison"
_BOUND = 1e9
_MOVED = 0.01  # of an interval: a value that differs by more comes from other laws
_SCATTER = 0.01  # of a published value: the second or third digit that is printed
_UNIT = "the metric's unit"
_TALLY = {
    "met": "met",
    "missed": "missed",
    "known": "known to be missed",
    "holds": "met though known to be missed (take `known` out)",
}

Words = Annotated[str, Field(min_length=1, max_length=1000)]


def known_metrics(of: str | None = None) -> tuple[str, ...]:
    """Return what an expectation can name: of a plant, of the comparison, or (None) of either."""
    if of is None:
        return (*METRIC_UNITS, *COMPARISON_UNITS)
    return tuple(COMPARISON_UNITS if of == COMPARISON else METRIC_UNITS)


class Expectation(Section):
    """What a metric must come out as: near a value (rel or abs), below or above one."""

    metric: Annotated[str, Field(json_schema_extra={"enum": list(known_metrics())})]
    """Name of the metric."""
    plant: Literal["analytical", "twin"] | None = None
    """Which plant's metric."""
    of: Literal["comparison"] | None = None
    """A metric of the comparison instead of a plant's."""
    near: float | None = quantity(-_BOUND, _BOUND, None, unit=_UNIT)
    """The expected value."""
    rel: float | None = quantity(1e-9, 100.0, None)
    """Relative tolerance of near."""
    abs: float | None = quantity(0.0, _BOUND, None, unit=_UNIT)
    """Absolute tolerance of near."""
    below: float | None = quantity(-_BOUND, _BOUND, None, unit=_UNIT)
    """Highest allowed value."""
    published: float | None = quantity(-_BOUND, _BOUND, None, unit=_UNIT)
    """A published value, which must lie within an interval of what the scenario predicts."""
    within: Literal["interval_50", "interval_95"] | None = None
    """That interval, which `srs-twin uncertainty SCENARIO --write` keeps."""
    scatter: float | None = quantity(0.0, _BOUND, None, unit=_UNIT)
    """Standard uncertainty of the published value (default: 1 % of it)."""
    above: float | None = quantity(-_BOUND, _BOUND, None, unit=_UNIT)
    """Lowest allowed value."""
    source: Words | None = None
    """Where the value is published; none for our own."""
    known: Words | None = None
    """Why it is missed, where that is known: `--check` lets it pass, `--strict` does not."""

    @field_validator("metric")
    @classmethod
    def _is_a_metric(cls, metric: str) -> str:
        if metric not in known_metrics():
            raise ValueError(str(UnknownNameError("metric", metric, known_metrics(), METRICS_LISTED)))
        return metric

    @model_validator(mode="after")
    def _one_of_each(self) -> Expectation:
        if (self.plant is None) == (self.of is None):
            raise ValueError("give either plant (analytical or twin) or of: comparison")
        if self.metric not in known_metrics(self.subject):
            right = "plant: analytical or plant: twin" if self.of else f"of: {COMPARISON}"
            raise ValueError(f"{self.metric} needs {right}")
        if sum(value is not None for value in (self.near, self.below, self.above, self.published)) != 1:
            raise ValueError("give exactly one of near, below, above and published")
        if (self.within is None) != (self.published is None):
            raise ValueError("published and within: interval_95 go together")
        if self.published is None and self.scatter is not None:
            raise ValueError("scatter is of a published value")
        if self.published is not None and self.of is not None:
            raise ValueError("published values are a plant's")
        tolerances = sum(value is not None for value in (self.rel, self.abs))
        if tolerances != (self.near is not None):
            raise ValueError("near needs either rel or abs; below and above take neither")
        if self.near == 0 and self.rel is not None:
            raise ValueError("a relative tolerance of 0 allows nothing else; use abs")
        return self

    @property
    def subject(self) -> str:
        """Whose metric: "analytical", "twin" or "comparison"."""
        return self.plant or COMPARISON

    @property
    def stated(self) -> float | None:
        """What was published of the metric; None where nothing was."""
        return self.published if self.published is not None else self.near if self.source else None

    @property
    def allowed(self) -> tuple[float, float]:
        """The lowest and the highest allowed value; infinite where there is none."""
        if self.near is None:
            low = -math.inf if self.above is None else self.above
            return low, math.inf if self.below is None else self.below
        tolerance = self.abs if self.abs is not None else (self.rel or 0.0) * math.fabs(self.near)
        return self.near - tolerance, self.near + tolerance

    def check(self, metrics: Mapping[str, Any]) -> dict[str, Any]:
        """Compare with what came out.

        Args:
            metrics: as in metrics.json: "plants" → plant → metric, "comparison" → metric, and "intervals",
                the kept ones, as `experiment.kept_intervals` returns them.

        Returns:
            A row of the expectations of metrics.json: `metric`, `of`, the `value` or None, what is `allowed`
            in words, whether it is `met` (never without a value), `near`, `source`, `known`.
        """
        (low, high), subject = self.allowed, self.subject
        found = metrics.get(COMPARISON) if self.of else (metrics.get("plants") or {}).get(subject)
        value = (found or {}).get(self.metric)
        if self.within is not None:
            return self._judged(value, metrics.get("intervals") or {})
        return {
            "metric": self.metric,
            "of": subject,
            "value": value,
            "allowed": _in_words(low, high),
            "met": value is not None and math.isfinite(value) and low <= value <= high,
            "near": self.near,
            "source": self.source,
            "known": self.known,
        }

    def _judged(self, value: float | None, kept: Mapping[str, Any]) -> dict[str, Any]:
        """Return the row of a published value and a kept interval.

        It has the terms of ASME V&V 20 besides: the `error` E = value − published, the standard uncertainties
        `u_num` of the time step, `u_input` of the robot's numbers and `u_d` of what was published, which of
        them is `largest`; the interval's `width` and, for published and interval of 95 %, the `score`
        (Gneiting and Raftery 2007), which is lower for narrow intervals that hold.
        """
        row: dict[str, Any] = {"metric": self.metric, "of": self.subject, "value": value}
        rest = {"near": self.published, "source": self.source, "known": self.known}
        spread = ((kept.get("plants") or {}).get(self.subject) or {}).get(self.metric)
        if kept.get("stale") is not None or spread is None or value is None or self.published is None:
            why = kept.get("stale") or f"the kept intervals have no {self.metric} of the {self.subject} plant"
            return row | {"allowed": why, "met": False} | rest
        low, high = spread[self.within]
        moved = abs(value - spread["value"]) / (high - low)
        if not moved <= _MOVED:
            why = f"stale: the value was {spread['value']:.6g}; {kept['renew']} renews the interval"
            return row | {"allowed": why, "met": False} | rest
        scatter = _SCATTER * abs(self.published) if self.scatter is None else self.scatter
        terms = {"u_num": spread["u_num"] or 0.0, "u_input": spread["u_input"], "u_d": scatter}
        largest = max(terms, key=lambda name: terms[name])
        off = max(low - self.published, self.published - high, 0.0)
        share = 0.05 if self.within == "interval_95" else 0.5
        judged = {"error": value - self.published, **terms, "largest": largest, "width": high - low}
        judged |= {"score": high - low + 2 / share * off, "interval": [low, high]}
        said = f"{self.published:.4g} published within {low:.4g} to {high:.4g}"
        allowed = f"{said}; {largest} {terms[largest]:.2g} is largest"
        return row | {"allowed": allowed, "met": low <= self.published <= high} | rest | judged


def _in_words(low: float, high: float) -> str:
    if math.isinf(low):
        return f"at most {high:.4g}"
    return f"at least {low:.4g}" if math.isinf(high) else f"{low:.4g} to {high:.4g}"


class ExpectationsFile(Section):
    """Expectations alone, for `srs-twin replay --expect`."""

    expect: Annotated[list[Expectation], Field(min_length=1, max_length=200)]
    """What must come out."""


def verdict(checked: Mapping[str, Any]) -> str:
    """Return what came of an expectation.

    Args:
        checked: as `Expectation.check` returns it.

    Returns:
        "met", "missed", "known" (missed, as the scenario says) or "holds" (met, though it says so).
    """
    if checked.get("known") is None:
        return "met" if checked["met"] else "missed"
    return "holds" if checked["met"] else "known"


def tally(verdicts: Mapping[str, int]) -> str:
    """Return in words how many expectations came out how."""
    counted = [f"{verdicts[each]} {words}" for each, words in _TALLY.items() if verdicts.get(each)]
    return ", ".join(counted) or "none"
