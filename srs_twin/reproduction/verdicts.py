"""Verdicts on claims, reasons for missed claims, and comparison with a baseline."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import BeforeValidator, PlainSerializer, SerializationInfo, TypeAdapter

from srs_twin.errors import InputError
from srs_twin.io.files import data_root, display_path, write_text
from srs_twin.io.untrusted import read_json
from srs_twin.reproduction.claims import TRACES, Cause, Claim, Measure
from srs_twin.reproduction.runs import ReproductionJob, RunStore
from srs_twin.scenario.provenance import versions
from srs_twin.studies.sweep.execution import Progress, quiet

MET: Final = "met"
EXPLAINED: Final = "explained"
MISSED: Final = "missed"

_NOTHING = 1e-12
"""Absolute value below which a denominator counts as zero."""


def _json(value: float, info: SerializationInfo) -> float | None:
    if not math.isfinite(value):
        return None
    digits = (info.context or {}).get("digits")
    if digits is None:
        return value
    return float(f"{value:.{digits}g}")


Number = Annotated[
    float,
    BeforeValidator(lambda value: math.nan if value is None else value),
    PlainSerializer(_json),
]
"""Number that is written to JSON files as null if it is not finite."""


@dataclass(frozen=True)
class ClaimOutcome:
    """Outcome of a claim in one column of results.

    Attributes:
        verdict: "met", "missed", or "explained" if the reason for a miss is
            demonstrated.
        values: values of the measures in the unit of the claim, or NaN for missing
            values.
        value: number that is compared with the published value. The number is NaN for
            an ordering or if a measure is missing.
        error: relative error (value − published)/|published|, or NaN if it is
            undefined.
        why: known reason for a miss or a missing value, or an empty string.
    """

    verdict: Literal["met", "explained", "missed"]
    values: tuple[Number, ...]
    value: Number
    error: Number
    why: str = ""


@dataclass(frozen=True)
class JudgedClaim:
    """Claim with its outcomes, keyed by column of results."""

    claim: Claim
    outcomes: Mapping[str, ClaimOutcome] = field(default_factory=dict)


def judge_column(store: RunStore, claim: Claim, column: str) -> ClaimOutcome:
    """Return the outcome of a claim in one column, computed from finished runs."""
    values = tuple(_number(store, measure, column) for measure in claim.all_measures)
    if any(math.isnan(value) for value in values):
        return ClaimOutcome(
            MISSED, values, math.nan, math.nan, _missing_reason(store, claim)
        )
    value = error = math.nan
    if claim.rule == "ordering":
        is_met = all(a > b for a, b in pairwise(values))
    else:
        value = combine(claim.combine, values)
        assert claim.value is not None, "checked by the file's model"
        error = _ratio(value - claim.value, abs(claim.value))
        is_met = claim.allowed.holds(value)
    return ClaimOutcome(MET if is_met else MISSED, values, value, error)


def _number(store: RunStore, measure: Measure, column: str) -> float:
    owner = measure.plant or column
    values = np.array(
        [_value(store, job, owner, measure.metric) for job in store.jobs(measure)]
    )
    if measure.size:
        values = np.abs(values)
    if not len(values) or (measure.take is None and len(values) > 1):
        return math.nan
    return float(aggregate(measure.take, values))


def _value(store: RunStore, job: ReproductionJob, owner: str, metric: str) -> float:
    row = store.row(job.key)
    if row is None:
        return math.nan
    kind, _, name = metric.partition(".")
    if kind == "trace":
        trajectory = store.trajectory(job.key, owner)
        value = None if trajectory is None else TRACES[name](trajectory)
    else:
        column = metric if kind == "comparison" else f"{owner}.{metric}"
        value = row.values.get(column)
    if value is None:
        return math.nan
    return float(value)


def _missing_reason(store: RunStore, claim: Claim) -> str:
    failures = (
        store.failure(job.key)
        for measure in claim.all_measures
        for job in store.jobs(measure)
    )
    reason = next(filter(None, failures), "the run does not provide this value")
    return f"no value: {reason}"


def combine(combination: str, values: tuple[float, ...]) -> float:
    """Combine one or two measured values, or return NaN for a division by zero.

    Args:
        combination: "value", "ratio" a/b, "excess" a/b − 1, "difference" a − b, or
            "unevenness" |a + b|/|a|.
        values: measured values a and b, or a single value.
    """
    a = values[0]
    b = values[-1]
    match combination:
        case "value":
            return a
        case "difference":
            return a - b
        case "ratio":
            return _ratio(a, b)
        case "excess":
            return _ratio(a, b) - 1
    return _ratio(abs(a + b), abs(a))


def _ratio(numerator: float, denominator: float) -> float:
    if abs(denominator) > _NOTHING:
        return numerator / denominator
    return math.nan


def aggregate(name: str | None, values: np.ndarray) -> float:
    """Return the maximum ("most"), minimum ("least"), range/mean ("spread") or mean."""
    if name == "most":
        return float(values.max())
    if name == "least":
        return float(values.min())
    if name == "spread":
        return _ratio(float(np.ptp(values)), abs(float(values.mean())))
    return float(values.mean())


_OUTCOMES = TypeAdapter(Mapping[str, Mapping[str, ClaimOutcome]])


@dataclass(frozen=True)
class Baseline:
    """Stored outcomes with which later reproductions are compared."""

    outcomes: Mapping[str, Mapping[str, ClaimOutcome]]

    def changes(self, rows: Sequence[JudgedClaim]) -> list[str]:
        """Return one line for each verdict that differs from the baseline.

        Improved verdicts are included, because an improvement may be due to a larger
        tolerance. Claims that the baseline does not contain are ignored.
        """
        lines = []
        for row in rows:
            name = row.claim.id
            for column, outcome in row.outcomes.items():
                before = self.outcomes.get(name, {}).get(column)
                if before is not None and outcome.verdict != before.verdict:
                    change = f"{outcome.verdict}, was {before.verdict}"
                    lines.append(f"{name}, {column}: {change}")
        return lines


def baseline_file() -> Path:
    """Return the path of the shipped baseline file."""
    return data_root() / "calibration/published/baseline.json"


def load_baseline(path: Path | None = None) -> Baseline:
    """Load a baseline, by default the shipped baseline.

    Raises:
        InputError: the file does not exist or is not a baseline.
    """
    file = path or baseline_file()
    try:
        document = read_json(file)
        return Baseline(_OUTCOMES.validate_python(document["rows"]))
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{display_path(file)}: the file is not a baseline; --write-baseline"
            " writes one"
        ) from error


def write_baseline(rows: Sequence[JudgedClaim], path: Path | None = None) -> Path:
    """Write the new baseline to a file atomically, and return the path.

    Raises:
        InputError: the file cannot be written.
    """
    file = path or baseline_file()
    document = {"versions": versions(), "rows": outcomes_document(rows, digits=4)}
    write_text(file, json.dumps(document, indent=1, ensure_ascii=False) + "\n")
    return file


def outcomes_document(
    rows: Sequence[JudgedClaim], *, digits: int | None = None
) -> dict[str, object]:
    """Return outcomes as JSON values, keyed by claim and column."""
    outcomes = {row.claim.id: row.outcomes for row in rows}
    document: dict[str, object] = _OUTCOMES.dump_python(
        outcomes, mode="json", context={"digits": digits}
    )
    return document


def judge(
    claims: Sequence[Claim],
    store: RunStore,
    *,
    workers: int | None = None,
    progress: Progress = quiet,
) -> tuple[JudgedClaim, ...]:
    """Run and judge claims, and find the reasons for missed claims.

    If a missed claim has a cause with a changed assumption, the claim is judged again
    with this change.

    Raises:
        InputError: a scenario or sweep is invalid, or a result cannot be stored.
    """

    def run(selected: Iterable[Claim]) -> None:
        jobs = [
            job
            for claim in selected
            for measure in claim.all_measures
            for job in store.jobs(measure)
        ]
        store.run(jobs, workers=workers, progress=progress)

    run(claims)
    rows = [
        JudgedClaim(
            claim,
            {column: judge_column(store, claim, column) for column in claim.columns},
        )
        for claim in claims
    ]
    run(
        row.claim.with_switch(cause)
        for row in rows
        for cause in _switchable_causes(row)
    )
    return tuple(_explained(store, row) for row in rows)


def _switchable_causes(row: JudgedClaim) -> list[Cause]:
    missed = {name for name, outcome in row.outcomes.items() if outcome.verdict != MET}
    return [
        cause
        for cause in row.claim.cause
        if cause.switch is not None and missed & set(cause.columns)
    ]


def _explained(store: RunStore, row: JudgedClaim) -> JudgedClaim:
    outcomes = {
        name: _explain(store, row.claim, name, outcome)
        for name, outcome in row.outcomes.items()
    }
    return replace(row, outcomes=outcomes)


def _explain(
    store: RunStore, claim: Claim, column: str, outcome: ClaimOutcome
) -> ClaimOutcome:
    causes = [cause for cause in claim.cause if column in cause.columns]
    if outcome.verdict == MET or not causes:
        return outcome
    for cause in causes:
        if cause.docs is not None:
            return replace(
                outcome, verdict=EXPLAINED, why=f"{cause.says} ({cause.docs})"
            )
        if cause.switch is None:
            return replace(outcome, why=f"presumed cause: {cause.says}")
        switched = judge_column(store, claim.with_switch(cause), column)
        if switched.verdict == MET:
            why = f"{cause.switch}: {cause.says}; met with this assumption switched"
            return replace(outcome, verdict=EXPLAINED, why=why)
    switches = ", ".join(str(cause.switch) for cause in causes)
    why = outcome.why or f"not met either with {switches} switched"
    return replace(outcome, why=why)
