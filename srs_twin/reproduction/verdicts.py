"""Verdicts: what came of a row in a column, met or missed and why, and whether that is what was committed."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import BeforeValidator, PlainSerializer, SerializationInfo, TypeAdapter

from srs_twin.errors import InputError
from srs_twin.io.files import data_root, shown, write_text
from srs_twin.io.json_files import read_json
from srs_twin.reproduction.claims import TRACES, Cause, Claim, Measure
from srs_twin.reproduction.runs import Job, Started, Store
from srs_twin.scenario.provenance import versions

MET: Final = "met"
EXPLAINED: Final = "explained"
MISSED: Final = "missed"

_NOTHING = 1e-12
"""Numbers below are none to divide by."""


def _json(value: float, info: SerializationInfo) -> float | None:
    if not math.isfinite(value):
        return None
    digits = (info.context or {}).get("digits")
    return value if digits is None else float(f"{value:.{digits}g}")


Number = Annotated[
    float, BeforeValidator(lambda given: math.nan if given is None else given), PlainSerializer(_json)
]
"""A number that JSON has as null where it is none."""


@dataclass(frozen=True)
class Outcome:
    """What came of a row in one column.

    Attributes:
        verdict: "met"; "missed"; "explained", which is missed with a cause that is shown, and not met.
        values: of the measures, in the row's unit; NaN where there is none.
        value: what is held against the published one; NaN of an ordering, and where there is none.
        error: (value − published)/|published|; NaN where there is no such number.
        why: the cause, or why there is no value; empty where nothing is known.
    """

    verdict: Literal["met", "explained", "missed"]
    values: tuple[Number, ...]
    value: Number
    error: Number
    why: str = ""


@dataclass(frozen=True)
class Judged:
    """A row and what came of it.

    Attributes:
        claim: the row.
        outcomes: column → what came of it there.
    """

    claim: Claim
    outcomes: Mapping[str, Outcome] = field(default_factory=dict)


def judged(store: Store, claim: Claim, column: str) -> Outcome:
    """Return what came of a row in a column, from the runs that are there.

    Args:
        store: what was run.
        claim: the row.
        column: "analytical", "twin" or "alone".
    """
    values = tuple(_number(store, measure, column) for measure in claim.taken)
    if any(math.isnan(value) for value in values):
        return Outcome(MISSED, values, math.nan, math.nan, _reason(store, claim))
    if claim.rule == "ordering":
        met = all(a > b for a, b in zip(values, values[1:], strict=False))
        return Outcome(MET if met else MISSED, values, math.nan, math.nan)
    value = combined(claim.combine, values)
    assert claim.value is not None, "checked by the file's model"
    error = (value - claim.value) / abs(claim.value) if claim.value else math.nan
    met = claim.low <= value <= claim.high
    return Outcome(MET if met else MISSED, values, value, error)


def _number(store: Store, measure: Measure, column: str) -> float:
    owner = measure.plant or column
    values = np.array([_value(store, job, owner, measure.metric) for job in store.jobs(measure)])
    if measure.size:
        values = np.abs(values)
    if not len(values) or (measure.take is None and len(values) > 1):
        return math.nan
    return float(taken(measure.take, values))


def _value(store: Store, job: Job, owner: str, metric: str) -> float:
    row = store.row(job.key)
    if row is None:
        return math.nan
    kind, _, name = metric.partition(".")
    if kind == "trace":
        trajectory = store.trajectory(job.key, owner)
        found = None if trajectory is None else TRACES[name](trajectory)
    else:
        found = row.values.get(metric if kind == "comparison" else f"{owner}.{metric}")
    return math.nan if found is None else float(found)


def _reason(store: Store, claim: Claim) -> str:
    """Say why there is no number."""
    failed = (store.failure(job.key) for measure in claim.taken for job in store.jobs(measure))
    said = next(filter(None, failed), "there is no such number in the run")
    return f"no value: {said}"


def combined(how: str, values: tuple[float, ...]) -> float:
    """Return one number of one measure or two; NaN where it would divide by nothing.

    Args:
        how: "value", "ratio" a/b, "excess" a/b − 1, "difference" a − b, or "unevenness" |a + b|/|a|.
        values: of the measures.
    """
    a, b = values[0], values[-1]
    if how == "difference":
        return a - b
    if how == "unevenness":
        return abs(a + b) / abs(a) if abs(a) > _NOTHING else math.nan
    if how in ("ratio", "excess"):
        ratio = a / b if abs(b) > _NOTHING else math.nan
        return ratio - 1 if how == "excess" else ratio
    return a


def taken(how: str | None, values: np.ndarray) -> float:
    """Return what is taken of the values of several runs; NaN as soon as one of them has none."""
    if how == "most":
        return float(values.max())
    if how == "least":
        return float(values.min())
    if how == "spread":
        return float(np.ptp(values) / abs(values.mean())) if abs(values.mean()) > _NOTHING else math.nan
    return float(values.mean())


_OUTCOMES = TypeAdapter(Mapping[str, Mapping[str, Outcome]])
"""Row → column → outcome."""


@dataclass(frozen=True)
class Baseline:
    """What came of each row when the baseline was written.

    Attributes:
        outcomes: row → column → outcome.
        versions: package → version that it was written with.
    """

    outcomes: Mapping[str, Mapping[str, Outcome]]
    versions: Mapping[str, str]

    def changes(self, rows: Sequence[Judged]) -> list[str]:
        """Return a line for each verdict that is not the one it was; a row that is new has no change.

        A better verdict is a change as well: a tolerance may have been widened.

        Args:
            rows: judged now.
        """
        found = []
        for row in rows:
            for column, outcome in row.outcomes.items():
                before = self.outcomes.get(row.claim.id, {}).get(column)
                if before is not None and outcome.verdict != before.verdict:
                    found.append(f"{row.claim.id}, {column}: {outcome.verdict}, was {before.verdict}")
        return found


def baseline_file() -> Path:
    """Return the path of the shipped baseline."""
    return data_root() / "calibration/published/baseline.json"


def load_baseline(path: Path | None = None) -> Baseline:
    """Load a baseline, the shipped one by default.

    Raises:
        InputError: it is not there, or none of ours.
    """
    place = path or baseline_file()
    try:
        given = read_json(place)
        return Baseline(_OUTCOMES.validate_python(given["rows"]), dict(given["versions"]))
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{shown(place)}: not a baseline; --write-baseline writes one") from error


def write_baseline(rows: Sequence[Judged], path: Path | None = None) -> Path:
    """Write the outcomes of rows as the baseline, whole or not at all; return where.

    Raises:
        InputError: it cannot be written.
    """
    place = path or baseline_file()
    document = {"versions": versions(), "rows": outcomes_document(rows, digits=4)}
    write_text(place, json.dumps(document, indent=1, ensure_ascii=False) + "\n")
    return place


def outcomes_document(rows: Sequence[Judged], *, digits: int | None = None) -> dict[str, Any]:
    """Return outcomes as JSON values: row → column → verdict, values, value, error, why.

    Args:
        rows: judged.
        digits: significant ones that are kept; None: all.
    """
    found = {row.claim.id: row.outcomes for row in rows}
    return _OUTCOMES.dump_python(found, mode="json", context={"digits": digits})


def judge(
    claims: Sequence[Claim], store: Store, *, workers: int | None = None, started: Started | None = None
) -> tuple[Judged, ...]:
    """Run what rows need and is not there yet, and judge them; then run what may explain those missed.

    Args:
        claims: the rows.
        store: what was run before, and where new runs are kept.
        workers: how many processes; default one a processor.
        started: called with the number of runs that are due, before each round; returns what is called with
            every run that is finished.

    Raises:
        InputError: a scenario or sweep cannot be used, or results cannot be kept.
    """

    def run(wanted: Iterable[Claim]) -> None:
        jobs = [job for claim in wanted for measure in claim.taken for job in store.jobs(measure)]
        store.run(jobs, workers=workers, started=started)

    run(claims)
    rows = [Judged(each, {name: judged(store, each, name) for name in each.columns}) for each in claims]
    run(row.claim.switched(cause) for row in rows for cause in _to_be_shown(row))
    return tuple(
        replace(row, outcomes={k: _explained(store, row.claim, k, each) for k, each in row.outcomes.items()})
        for row in rows
    )


def _to_be_shown(row: Judged) -> list[Cause]:
    """Return the causes that runs must show, of the columns that are missed."""
    missed = {name for name, outcome in row.outcomes.items() if outcome.verdict != MET}
    return [cause for cause in row.claim.cause if cause.switch is not None and missed & set(cause.columns)]


def _explained(store: Store, claim: Claim, column: str, outcome: Outcome) -> Outcome:
    """Return a missed outcome with the first cause that is shown, or with the presumed cause."""
    causes = [cause for cause in claim.cause if column in cause.columns]
    if outcome.verdict == MET or not causes:
        return outcome
    for cause in causes:
        if cause.docs is not None:
            return replace(outcome, verdict=EXPLAINED, why=f"{cause.says} ({cause.docs})")
        if cause.switch is None:
            return replace(outcome, why=f"presumed cause: {cause.says}")
        switched = judged(store, claim.switched(cause), column)
        if switched.verdict == MET:
            why = f"{cause.switch}: {cause.says}; met with this assumption switched"
            return replace(outcome, verdict=EXPLAINED, why=why)
    tried = ", ".join(f"{cause.switch}" for cause in causes)
    return replace(outcome, why=outcome.why or f"not met either with {tried} switched")
