"""Expected values of metrics and their evaluation after a run.

An expectation is met, missed, missed for a known reason, or not judged. An expectation
is not judged in three cases:

- the metric is undefined for the run;
- no stored interval applies to the run;
- the published value lies within two standard errors of an interval bound.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Annotated, Any, Literal, NamedTuple, TypedDict

from pydantic import (
    AfterValidator,
    Field,
    PlainSerializer,
    field_validator,
    model_validator,
)

from srs_twin.comparison.metrics import (
    COMPARISON_UNITS,
    METRIC_UNITS,
    METRICS_LISTED,
    is_yes_no,
    metric_name,
    metric_units,
    tidy,
    written_name,
)
from srs_twin.comparison.undefined import Undefined
from srs_twin.errors import UnknownNameError
from srs_twin.extensions import PART_PATTERN, READING
from srs_twin.robot.sourced import split_unit
from srs_twin.scenario.fields import Section, quantity

COMPARISON = "comparison"
"""Subject of expectations that compare the two plants."""
_BOUND = 1e9
"""Maximum absolute value in an expectation, which is far larger than any metric."""
_INTERVAL_TOLERANCE = 0.01
"""Maximum difference between the metric value in a run and the metric value stored with
an interval, as a fraction of the interval width."""
_STORAGE_TOLERANCE = 1e-5
"""Relative tolerance of stored values, which are rounded to six digits."""
_PUBLISHED_STD = 0.01
"""Default relative standard uncertainty of a published value, which has two or three
digits."""
_UNIT = "the metric's unit"
_TALLY = {
    "met": "met",
    "missed": "missed",
    "expected_failure": "known to be missed",
    "holds": "met though known to be missed (take `expected_failure` out)",
    "not_judged": "not judged",
}
_OUTSIDE_PROBABILITY = {"interval_50": 0.5, "interval_95": 0.05}
"""Probability α that a value lies outside each interval, for the interval score."""
_INTERVALS = {"interval_50": "50 % interval", "interval_95": "95 % interval"}
_CAUSES = {"u_num": "the time step", "u_d": "the published value"}
"""Names of uncertainty causes in messages, except for `u_input`."""
_PARAMETERS = {
    "friction.mu_t": "rolling friction",
    "friction.mu_n": "sideways friction",
    "friction.drag_n": "axial drag",
    "bending.stiffness_nm_per_rad": "bending stiffness",
    "bending.damping_time_s": "damping time of the bends",
    "actuator.bend_rad": "bend of a free module",
    "actuator.tau_fill_s": "filling time of the chambers",
    "actuator.tau_vent_s": "venting time of the chambers",
    "mass.connectors_kg": "mass of the connectors",
}
"""Names of robot parameters in messages."""

Words = Annotated[str, Field(min_length=1, max_length=1000)]


MetricName = Annotated[
    str,
    Field(min_length=1, max_length=200),
    AfterValidator(metric_name),
    PlainSerializer(written_name, when_used="json"),
]
"""Name of a metric, which has the form ``module:Name`` for plug-in metrics."""

_METRIC_SCHEMAS: list[Any] = [
    {"enum": [*METRIC_UNITS, *COMPARISON_UNITS]},
    {"pattern": f"^{PART_PATTERN}$"},
]


def known_metrics(subject: str | None = None) -> tuple[str, ...]:
    """Return the metric names of a subject.

    Args:
        subject: plant name, "comparison", or None for all metrics.
    """
    if subject is None:
        return (*metric_units(), *COMPARISON_UNITS)
    if subject == COMPARISON:
        return tuple(COMPARISON_UNITS)
    return tuple(metric_units())


class ExpectationRow(TypedDict, total=False):
    """Result of an expectation for a run, stored as a row in metrics.json.

    The attributes from `verdict` to `interval_error` exist only if the published value
    was compared with an interval.

    Attributes:
        metric: name of the metric.
        of: subject of the metric, which is "analytical", "twin" or "comparison".
        value: value of the metric, or None if there is none.
        allowed: allowed values as text.
        met: whether the metric has an allowed value.
        state: "met", "missed", "expected_failure" (missed for a known reason) or
            "not_judged". Rows written by earlier versions have no state.
        reason: reason why the expectation is not judged, or None.
        near: expected or published value.
        source: publication or measurement that states the value.
        expected_failure: known reason why the expectation is missed.
        within: name of the interval that must contain the published value.
        verdict: position of the published value relative to the interval, which is
            "within", "undecided" or "outside".
        error: metric value minus published value, called E in ASME V&V 20.
        u_num: standard uncertainty due to the time step.
        u_input: standard uncertainty due to the robot's parameters.
        u_d: standard uncertainty of the published value.
        largest: name of the largest uncertainty.
        largest_parameter: parameter that contributes most to `u_input`, if `u_input` is
            the largest uncertainty.
        width: difference between the upper and the lower interval bound.
        score: interval score (Gneiting and Raftery 2007), which is low for narrow
            intervals that contain the published value.
        interval: lower and upper interval bound.
        interval_error: standard errors of the lower and upper bound.
    """

    metric: str
    of: str
    value: float | None
    allowed: str
    met: bool
    state: str
    reason: str | None
    near: float | None
    source: str | None
    expected_failure: str | None
    within: str
    verdict: str
    error: float
    u_num: float
    u_input: float
    u_d: float
    largest: str
    largest_parameter: str | None
    width: float
    score: float
    interval: list[float]
    interval_error: list[float] | None


class AllowedRange(NamedTuple):
    """Range of allowed values, which may be unbounded on either side."""

    low: float = -math.inf
    high: float = math.inf

    @classmethod
    def near(
        cls, value: float, relative: float | None, absolute: float | None
    ) -> AllowedRange:
        """Return the range around a value. An absolute tolerance takes precedence."""
        tolerance = absolute
        if tolerance is None:
            tolerance = (relative or 0.0) * math.fabs(value)
        return cls(value - tolerance, value + tolerance)

    def holds(self, value: float) -> bool:
        """Return whether the range contains a value."""
        return self.low <= value <= self.high

    @property
    def text(self) -> str:
        """Range in words, for example "at most 0.2"."""
        if self.low == self.high:
            return f"{self.low:.4g}"
        if math.isinf(self.low):
            return f"at most {self.high:.4g}"
        if math.isinf(self.high):
            return f"at least {self.low:.4g}"
        return f"{self.low:.4g} to {self.high:.4g}"


class Expectation(Section):
    """Expected value of a metric, stated as a number, a bound or an interval."""

    metric: Annotated[MetricName, Field(json_schema_extra={"anyOf": _METRIC_SCHEMAS})]
    """Name of the metric."""
    plant: Literal["analytical", "twin"] | None = None
    """Plant that the metric describes."""
    of: Literal["comparison"] | None = None
    """Subject of a metric that compares both plants."""
    near: float | None = quantity(-_BOUND, _BOUND, None, unit=_UNIT)
    """Expected value."""
    rel: float | None = quantity(1e-9, 100.0, None)
    """Relative tolerance of the expected value."""
    abs: float | None = quantity(0.0, _BOUND, None, unit=_UNIT)
    """Absolute tolerance of the expected value."""
    below: float | None = quantity(-_BOUND, _BOUND, None, unit=_UNIT)
    """Maximum allowed value."""
    published: float | None = quantity(-_BOUND, _BOUND, None, unit=_UNIT)
    """Published value (the predicted interval named by `within` must contain it)."""
    within: Literal["interval_50", "interval_95"] | None = None
    """Interval that must contain the published value; the command `srs-twin uncertainty
    SCENARIO --write` stores this interval."""
    scatter: float | None = quantity(0.0, _BOUND, None, unit=_UNIT)
    """Standard uncertainty of the published value (default: 1 % of the value)."""
    above: float | None = quantity(-_BOUND, _BOUND, None, unit=_UNIT)
    """Minimum allowed value."""
    source: Words | None = None
    """Source of a published value; omit this key for bounds that you chose yourself."""
    expected_failure: Words | None = None
    """Known reason why the expectation is missed; `--check` accepts a miss with a known
    reason, but `--strict` does not."""

    @field_validator("metric")
    @classmethod
    def _is_a_metric(cls, metric: str) -> str:
        if metric not in known_metrics() and not READING.get():
            raise ValueError(
                str(UnknownNameError("metric", metric, known_metrics(), METRICS_LISTED))
            )
        return metric

    @model_validator(mode="after")
    def _is_consistent(self) -> Expectation:
        if (self.plant is None) == (self.of is None):
            raise ValueError(
                "an expectation concerns one plant or the comparison; give either"
                " `plant: analytical`, `plant: twin` or `of: comparison`"
            )
        expected = self.metric in known_metrics(self.subject)
        if not expected and self.metric in known_metrics():
            required = f"`of: {COMPARISON}`"
            if self.of:
                required = "`plant: analytical` or `plant: twin`"
            raise ValueError(f"the metric `{self.metric}` needs {required}")
        values = (self.near, self.below, self.above, self.published)
        if values.count(None) != len(values) - 1:
            raise ValueError(
                "an expectation needs exactly one of the keys `near`, `below`,"
                " `above` and `published`"
            )
        if (self.within is None) != (self.published is None):
            raise ValueError(
                "`published` and `within` must be given together, for example"
                " `published: 0.1` with `within: interval_95`"
            )
        if self.published is None and self.scatter is not None:
            raise ValueError(
                "`scatter` is allowed only together with `published`; remove `scatter`"
            )
        if self.published is not None and self.of is not None:
            raise ValueError(
                "a published value is compared with one plant; give `plant: analytical`"
                " or `plant: twin` instead of `of`"
            )
        tolerances = 2 - (self.rel, self.abs).count(None)
        if tolerances != (self.near is not None):
            raise ValueError(
                "`near` needs a tolerance, and the other keys allow none; give `rel`"
                " or `abs` with `near`, and neither of them with `below`, `above` or"
                " `published`"
            )
        if self.near == 0 and self.rel is not None:
            raise ValueError(
                "`near: 0` cannot have a relative tolerance; give `abs` instead of `rel`"
            )
        return self

    @property
    def subject(self) -> str:
        """Subject of the metric: "analytical", "twin" or "comparison"."""
        return self.plant or COMPARISON

    @property
    def stated(self) -> float | None:
        """Published value of the metric, or None if the expectation has none."""
        if self.published is not None:
            return self.published
        if self.source:
            return self.near
        return None

    @property
    def allowed(self) -> AllowedRange:
        """Range of allowed values, which is unbounded if `within` is set."""
        if self.near is not None:
            return AllowedRange.near(self.near, self.rel, self.abs)
        low, high = AllowedRange()
        if self.above is not None:
            low = self.above
        if self.below is not None:
            high = self.below
        return AllowedRange(low, high)

    def check(
        self, metrics: Mapping[str, Any], undefined: Undefined | None = None
    ) -> ExpectationRow:
        """Judge a run by the expectation.

        Args:
            metrics: contents of metrics.json. The entry "intervals" is the result of
                `experiment.stored_intervals`.
            undefined: reason why the metric is undefined, or None if the metric has a
                value or a missing value is itself a result of the run.
        """
        allowed = self.allowed
        if self.of:
            values = metrics.get(COMPARISON)
        else:
            values = (metrics.get("plants") or {}).get(self.subject)
        value = (values or {}).get(self.metric)
        row: ExpectationRow = {
            "metric": self.metric,
            "of": self.subject,
            "value": value,
            "allowed": allowed.text,
            "met": False,
            "reason": None,
        }
        if self.within is not None:
            row["allowed"] = (
                f"published {self.published:.4g} within the {_INTERVALS[self.within]}"
            )
            row["within"] = self.within
        if value is None or not math.isfinite(value):
            limit = allowed.high if self.published is None else self.published
            if value is None and undefined is not None and undefined.beyond < limit:
                row["reason"] = undefined.reason
        elif self.within is None:
            row["met"] = allowed.holds(value)
        else:
            row |= self._judge_interval(value, metrics.get("intervals") or {})
        row["state"] = "missed" if self.expected_failure is None else "expected_failure"
        if row["reason"] is not None:
            row["state"] = "not_judged"
        elif row["met"]:
            row["state"] = "met"
        row["near"] = self.near if self.published is None else self.published
        row["source"] = self.source
        row["expected_failure"] = self.expected_failure
        return row

    def _judge_interval(
        self, value: float, stored: Mapping[str, Any]
    ) -> ExpectationRow:
        """Return the entries of a row that depend on a stored interval.

        If no verdict is possible, the entry `reason` explains why.
        """
        published = self.published
        assert self.within is not None and published is not None, "see _is_consistent()"
        plants = stored.get("plants") or {}
        spread: Any = (plants.get(self.subject) or {}).get(self.metric)
        reason = stored.get("stale") or self._mismatch(value, spread, stored)
        if reason is not None:
            return {"reason": reason}
        low, high = spread[self.within]
        errors = spread.get(f"{self.within}_error")
        verdict = interval_verdict(published, (low, high), errors)
        position = verdict.value
        if verdict is IntervalVerdict.UNDECIDED:
            position = "near an end of"
            reason = self._undecided_reason((low, high), errors)
        terms = self._uncertainties(spread)
        cause = _CAUSES.get(terms["largest"], _parameter(terms["largest_parameter"]))
        distance = max(low - published, published - high, 0.0)
        return {
            "allowed": (
                f"the published value {published:.4g} lies {position} the"
                f" {_INTERVALS[self.within]} {_ends(low, high, published)} (largest"
                f" uncertainty: {cause})"
            ),
            "met": verdict is IntervalVerdict.WITHIN,
            "reason": reason,
            "verdict": verdict.value,
            "error": value - published,
            **terms,
            "width": high - low,
            "score": high - low + 2 / _OUTSIDE_PROBABILITY[self.within] * distance,
            "interval": [low, high],
            "interval_error": errors,
        }

    def _uncertainties(self, spread: Mapping[str, Any]) -> ExpectationRow:
        """Return the standard uncertainties of ASME V&V 20 and name the largest one."""
        u_d = self.scatter
        if u_d is None:
            u_d = _PUBLISHED_STD * abs(self.published or 0.0)
        terms: ExpectationRow = {
            "u_num": spread["u_num"] or 0.0,
            "u_input": spread["u_input"],
            "u_d": u_d,
        }
        largest = max(terms, key=lambda name: terms[name])  # type: ignore[literal-required]
        parameter = None
        if largest == "u_input":
            parameter = largest_parameter(spread.get("sensitivity") or {})
        return {**terms, "largest": largest, "largest_parameter": parameter}

    def _mismatch(
        self, value: float, spread: Mapping[str, Any] | None, stored: Mapping[str, Any]
    ) -> str | None:
        if spread is None:
            return (
                f"the stored intervals do not contain the metric `{self.metric}` of"
                f" the {self.subject} plant"
            )
        low, high = spread[str(self.within)]
        tolerance = max(
            _INTERVAL_TOLERANCE * (high - low),
            # The last digits of a result depend on the processor.
            _STORAGE_TOLERANCE * abs(spread["value"]),
        )
        if abs(value - spread["value"]) <= tolerance:
            return None
        return (
            f"the stored interval was computed for the value {spread['value']:.4g}"
            " (with a different friction law, duration or seed); run"
            f" {stored['renew']} to compute a new interval"
        )

    def _undecided_reason(
        self, interval: Sequence[float], errors: Sequence[float]
    ) -> str:
        assert self.published is not None, (
            "only published values are compared with intervals"
        )
        distance, error, end = min(
            (abs(self.published - end) / error, error, end)
            for end, error in zip(interval, errors, strict=True)
            if error
        )
        return (
            f"undecided, because the published value {self.published:.4g} is only"
            f" {distance:.2g} standard errors from the end {end:.4g} (± {error:.2g})"
            f" of the interval, but {UNDECIDED_ERRORS:g} are needed; use more"
            " --samples and --twin to reduce the error"
        )


def largest_parameter(sensitivity: Mapping[str, Mapping[str, float]]) -> str | None:
    """Return the path of the parameter with the largest total Sobol index.

    The result is None if the largest index exceeds the second largest by less than its
    error.

    Args:
        sensitivity: mapping from parameter paths to Sobol indices. In each entry,
            `total` is the Sobol index, and `total_error` is half the width of its 95 %
            interval.
    """
    ranked = sorted(sensitivity, key=lambda path: -sensitivity[path]["total"])
    if not ranked:
        return None
    first, *others = (sensitivity[path] for path in ranked)
    floor = max([0.0, *(index["total"] for index in others)])
    if first["total"] - first.get("total_error", 0.0) > floor:
        return ranked[0]
    return None


def _parameter(path: str | None) -> str:
    if path is None:
        return "the robot's parameters"
    name = split_unit(path.rpartition(".")[2])[0].replace("_", " ")
    return _PARAMETERS.get(path, name)


def _ends(low: float, high: float, inside: float) -> str:
    """Format interval bounds, with digits that show whether they enclose `inside`."""
    within = low <= inside <= high
    texts = ([f"{end:.{digits}g}" for end in (low, high)] for digits in range(3, 18))
    return " to ".join(
        next(
            two for two in texts if (float(two[0]) <= inside <= float(two[1])) == within
        )
    )


class ExpectationsFile(Section):
    """File of expectations for `srs-twin replay --expect`."""

    expect: Annotated[list[Expectation], Field(min_length=1, max_length=200)]
    """Expected values of metrics."""


def verdict(checked: ExpectationRow) -> str:
    """Return the state of an expectation, or "holds" if it is met unexpectedly.

    If `expected_failure` is set, the expectation is not expected to be met.
    """
    expected_failure = checked.get("expected_failure") is not None
    state = checked.get("state")
    if state is None:
        missed = "expected_failure" if expected_failure else "missed"
        state = "met" if checked["met"] else missed
    if state == "met" and expected_failure:
        return "holds"
    return state


def remarks(checked: ExpectationRow) -> dict[str, str]:
    """Return the reason and the known cause of failure, if there are any."""
    texts = {
        "reason": checked.get("reason"),
        "expected failure": checked.get("expected_failure"),
    }
    return {key: text for key, text in texts.items() if text}


def result_text(checked: ExpectationRow) -> str:
    """Return a result as text, such as "= 0.15, allowed 0.18 to 0.25"."""
    metric = checked["metric"]
    allowed = allowed_text(checked)
    value = tidy(metric, checked["value"])
    if allowed in ("yes", "no"):
        return f"= {value or 'none'}, required {allowed}"
    if not checked.get("within"):
        text = "none" if value is None else f"{value:.4g}"
        return f"= {text}, allowed {allowed}"
    unit = (metric_units() | COMPARISON_UNITS).get(metric, "1")
    text = "none" if value is None else f"{value:.3g} {unit}"
    return f"= {text.removesuffix(' 1')}; {checked['allowed']}"


def allowed_text(checked: ExpectationRow) -> str:
    """Return the allowed values as text, such as a range, a number, "yes" or "no"."""
    metric = checked["metric"]
    allowed = str(checked["allowed"])
    if is_yes_no(metric) and allowed in ("0", "1"):
        return str(tidy(metric, int(allowed)))
    return allowed


def tally(verdicts: Mapping[str, int]) -> str:
    """Format the number of expectations for each verdict."""
    counted = [
        f"{verdicts[name]} {text}"
        for name, text in _TALLY.items()
        if verdicts.get(name)
    ]
    return ", ".join(counted) or "none"


UNDECIDED_ERRORS = 2.0
"""Minimum distance between a published value and an interval bound for a verdict, in
standard errors of the bound."""


class IntervalVerdict(Enum):
    """Position of a published value relative to an interval."""

    WITHIN = "within"
    UNDECIDED = "undecided"
    OUTSIDE = "outside"


def interval_verdict(
    published: float, interval: Sequence[float], errors: Sequence[float] | None = None
) -> IntervalVerdict:
    """Return the position of a published value relative to an interval.

    Args:
        published: published value.
        interval: lower and upper interval bound.
        errors: standard errors of the two bounds, by default zero.
    """
    low, high = interval
    for end, error in zip(interval, errors or (0.0, 0.0), strict=True):
        if abs(published - end) < UNDECIDED_ERRORS * error:
            return IntervalVerdict.UNDECIDED
    if low <= published <= high:
        return IntervalVerdict.WITHIN
    return IntervalVerdict.OUTSIDE
