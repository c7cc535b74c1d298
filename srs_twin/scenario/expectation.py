"""Expected values of metrics, and the verdicts on them.

An expectation is met, missed, missed for a known reason, or not judged. It is not judged where the run leaves
its metric undefined, where its stored interval is for another run, or where the end of the interval is not
known well enough to decide.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from srs_twin.comparison.metrics import COMPARISON_UNITS, METRIC_UNITS, METRICS_LISTED
from srs_twin.comparison.undefined import Undefined
from srs_twin.errors import UnknownNameError
from srs_twin.robot.sourced import split_unit
from srs_twin.scenario.fields import Section, quantity
from srs_twin.scenario.interval_verdict import UNDECIDED_ERRORS, IntervalVerdict, interval_verdict

COMPARISON = "comparison"
_BOUND = 1e9
_MOVED = 0.01  # of an interval: a value that differs by more comes from other laws or another duration
_KEPT = 1e-5  # of a value: stored values have six digits
_SCATTER = 0.01  # of a published value: the second or third digit that is printed
_UNIT = "the metric's unit"
_TALLY = {
    "met": "met",
    "missed": "missed",
    "known": "known to be missed",
    "holds": "met though known to be missed (take `known` out)",
    "not_judged": "not judged",
}
_OUTSIDE = {"interval_50": 0.5, "interval_95": 0.05}
_INTERVALS = {"interval_50": "50 % interval", "interval_95": "95 % interval"}
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
"""Parameters of a robot whose keys do not say enough."""

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
    """Reason why it is missed, if known: `--check` lets it pass, `--strict` does not."""

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

    def check(self, metrics: Mapping[str, Any], undefined: Undefined | None = None) -> dict[str, Any]:
        """Compare with the results of a run.

        Args:
            metrics: as in metrics.json: "plants" → plant → metric, "comparison" → metric, and "intervals",
                the stored ones, as `experiment.kept_intervals` returns them.
            undefined: reason why the run leaves the metric without a value; None where it has one, or where
                the missing value is the outcome of the run.

        Returns:
            A row of the expectations of metrics.json: `metric`, `of`, the `value` or None, the values
            `allowed` in words, `state` ("met", "missed", "known" or "not_judged"), the `reason` why it is not
            judged, whether it is `met` (never without a value), `near`, `source`, `known`.
        """
        (low, high), subject = self.allowed, self.subject
        found = metrics.get(COMPARISON) if self.of else (metrics.get("plants") or {}).get(subject)
        value = (found or {}).get(self.metric)
        row: dict[str, Any] = {"metric": self.metric, "of": subject, "value": value}
        row |= {"allowed": _in_words(low, high), "met": False, "reason": None}
        if self.within is not None:
            within = f"published {self.published:.4g} within the {_INTERVALS[self.within]}"
            row |= {"allowed": within, "within": self.within}
        if value is None or not math.isfinite(value):
            limit = high if self.published is None else self.published
            if value is None and undefined is not None and undefined.beyond < limit:
                row["reason"] = undefined.reason
        elif self.within is None:
            row["met"] = low <= value <= high
        else:
            row |= self._judged(value, metrics.get("intervals") or {})
        missed = "missed" if self.known is None else "known"
        state = "not_judged" if row["reason"] is not None else "met" if row["met"] else missed
        stated = self.near if self.published is None else self.published
        return row | {"state": state, "near": stated, "source": self.source, "known": self.known}

    def _judged(self, value: float, kept: Mapping[str, Any]) -> dict[str, Any]:
        """Return the part of a row that a stored interval decides; a `reason` where it does not decide.

        The `verdict` is "within", "undecided" or "outside". It is undecided, and the expectation not judged,
        where the published value is within two standard errors of an end of the interval.
        The terms are those of ASME V&V 20: the `error` E = value − published, the standard uncertainties
        `u_num` of the time step, `u_input` of the robot's parameters and `u_d` of the published value, the
        name of the `largest`, and the `largest_parameter` of the robot; the `interval` and its `width` and,
        for published and interval of 95 %, the `score` (Gneiting and Raftery 2007), which is lower for narrow
        intervals that contain the published value.
        """
        assert self.within is not None and self.published is not None, "they go together"
        spread = ((kept.get("plants") or {}).get(self.subject) or {}).get(self.metric)
        if kept.get("stale") is not None or spread is None:
            missing = f"the stored intervals have no {self.metric} of the {self.subject} plant"
            return {"reason": kept.get("stale") or missing}
        low, high = spread[self.within]
        # Relative to the interval and to the stored digits: another processor changes neither verdict.
        if not abs(value - spread["value"]) <= max(_MOVED * (high - low), _KEPT * abs(spread["value"])):
            other = f"the stored interval is for {spread['value']:.4g} (other laws, duration or seed)"
            return {"reason": f"{other}; {kept['renew']} renews it"}
        scatter = _SCATTER * abs(self.published) if self.scatter is None else self.scatter
        terms = {"u_num": spread["u_num"] or 0.0, "u_input": spread["u_input"], "u_d": scatter}
        largest = max(terms, key=lambda name: terms[name])
        parameter = largest_parameter(spread.get("sensitivity") or {}) if largest == "u_input" else None
        off = max(low - self.published, self.published - high, 0.0)
        errors = spread.get(f"{self.within}_error")
        found = interval_verdict(self.published, (low, high), errors)
        undecided = found is IntervalVerdict.UNDECIDED
        cause = {"u_num": "the time step", "u_d": "the published value"}.get(largest, _parameter(parameter))
        lies = f"lies {'near an end of' if undecided else found.value} the {_INTERVALS[self.within]}"
        ends = _ends(low, high, self.published)
        return {
            "allowed": f"published {self.published:.4g} {lies} {ends} (largest uncertainty: {cause})",
            "met": found is IntervalVerdict.WITHIN,
            "reason": self._undecided((low, high), errors) if undecided else None,
            "verdict": found.value,
            "error": value - self.published,
            **terms,
            "largest": largest,
            "largest_parameter": parameter,
            "width": high - low,
            "score": high - low + 2 / _OUTSIDE[self.within] * off,
            "interval": [low, high],
            "interval_error": errors,
        }

    def _undecided(self, interval: Sequence[float], errors: Sequence[float]) -> str:
        """Return the reason why the ends of an interval do not decide."""
        assert self.published is not None, "only published values are compared with intervals"
        distance, error, end = min(
            (abs(self.published - end) / error if error else math.inf, error, end)
            for end, error in zip(interval, errors, strict=True)
        )
        return (
            f"undecided: published {self.published:.4g} is {distance:.2g} standard errors from the end "
            f"{end:.4g} (± {error:.2g}) of the interval; from {UNDECIDED_ERRORS:g} on it is decided "
            "(more --samples and --twin make the error smaller)"
        )


def largest_parameter(sensitivity: Mapping[str, Mapping[str, float]]) -> str | None:
    """Return the path of the parameter with the largest total index.

    None if another index is as large within the error of the largest.

    Args:
        sensitivity: path → `total` index and its `total_error`, half of its 95 % interval.
    """
    ranked = sorted(sensitivity, key=lambda path: -sensitivity[path]["total"])
    if not ranked:
        return None
    first, *others = (sensitivity[path] for path in ranked)
    floor = max([0.0, *(each["total"] for each in others)])
    return ranked[0] if first["total"] - first.get("total_error", 0.0) > floor else None


def _parameter(path: str | None) -> str:
    """Return the name of a parameter for people: "axial drag"."""
    if path is None:
        return "the robot's parameters"
    name = split_unit(path.rpartition(".")[2])[0].replace("_", " ")
    return _PARAMETERS.get(path, name)


def _ends(low: float, high: float, inside: float) -> str:
    """Return the ends of an interval with three digits, or more if a value would change sides by rounding."""
    within = low <= inside <= high
    texts = ([f"{end:.{digits}g}" for end in (low, high)] for digits in range(3, 18))
    return " to ".join(next(two for two in texts if (float(two[0]) <= inside <= float(two[1])) == within))


def _in_words(low: float, high: float) -> str:
    if math.isinf(low):
        return f"at most {high:.4g}"
    return f"at least {low:.4g}" if math.isinf(high) else f"{low:.4g} to {high:.4g}"


class ExpectationsFile(Section):
    """Expectations alone, for `srs-twin replay --expect`."""

    expect: Annotated[list[Expectation], Field(min_length=1, max_length=200)]
    """What must come out."""


def verdict(checked: Mapping[str, Any]) -> str:
    """Return the verdict on an expectation.

    Args:
        checked: as `Expectation.check` returns it; rows of earlier versions have no `state`.

    Returns:
        Its state, "met", "missed", "known" (missed, as the scenario says) or "not_judged"; or "holds" (met,
        though the scenario says that it is missed).
    """
    known = checked.get("known") is not None
    state = checked.get("state") or ("met" if checked["met"] else "known" if known else "missed")
    return "holds" if state == "met" and known else str(state)


def in_words(checked: Mapping[str, Any]) -> str:
    """Return the value of an expectation and the allowed values: "= 0.15, allowed 0.18 to 0.25"."""
    value, metric = checked["value"], checked["metric"]
    if not checked.get("within"):
        return f"= {'none' if value is None else f'{value:.4g}'}, allowed {checked['allowed']}"
    unit = (METRIC_UNITS | COMPARISON_UNITS).get(metric, "1")
    text = "none" if value is None else f"{value:.3g}" + (f" {unit}" if unit != "1" else "")
    return f"= {text}; {checked['allowed']}"


def tally(verdicts: Mapping[str, int]) -> str:
    """Return in words how many expectations came out how."""
    counted = [f"{verdicts[each]} {words}" for each, words in _TALLY.items() if verdicts.get(each)]
    return ", ".join(counted) or "none"
