"""Claims: what the dissertation states, one row a statement, each with the rule by which it is met."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from srs_twin.documents import Document, Loc, load_yaml
from srs_twin.errors import UnknownNameError
from srs_twin.files import data_root, shipped_names
from srs_twin.reproduction.claim_file import CauseFile, ClaimFile, MeasureFile
from srs_twin.reproduction.computations import COMPUTATIONS
from srs_twin.reproduction.traces import TRACES
from srs_twin.validation import validate

COLUMNS = ("analytical", "twin", "alone")
"""Who can meet a row: a plant, or a computation that needs none."""

Value = bool | int | float | str
Setting = Value | list[float]


@dataclass(frozen=True)
class Measure:
    """A number that a run, the runs of a sweep or a computation give.

    Attributes:
        kind: "scenario", "sweep" or "law".
        name: of the scenario, sweep or computation.
        metric: of the plant; "comparison.…"; "trace.…", of the trajectory; of a computation its own name.
        changes: fields of the scenario, or arguments of the computation.
        periods: simulated time in periods of the gait; None: the scenario's own.
        where: varied field → value of the points of the sweep that count.
        take: what is taken of several points: "most", "least", "mean" or "spread" (greatest less least, over
            the mean); None: there is one.
        plant: whose number it is; None: the column's.
        size: whether the sign is left out.
    """

    kind: str
    name: str
    metric: str
    changes: Mapping[str, Setting] = field(default_factory=dict)
    periods: float | None = None
    where: Mapping[str, Value] = field(default_factory=dict)
    take: str | None = None
    plant: str | None = None
    size: bool = False


@dataclass(frozen=True)
class Cause:
    """Why a row is missed.

    Attributes:
        says: in words.
        columns: which columns it explains.
        docs: page and section of the documents that show it; None where they do not.
        switch: name of the assumption that is switched; without it and without docs the cause is supposed.
        changes: fields of the scenario that switch it; with them the row must be met.
    """

    says: str
    columns: tuple[str, ...]
    docs: str | None = None
    switch: str | None = None
    changes: Mapping[str, Setting] = field(default_factory=dict)


@dataclass(frozen=True)
class Claim:
    """One statement and how it is checked.

    Attributes:
        id: name of the row.
        source: section, figure, table, errata.
        robot: generation, None where it is about none.
        says: the statement.
        use: "fit" (may be used to calibrate: no prediction), "holdout" (never is), "law" or "shape" (an order
            or a trend).
        rule: "near", "below", "above" or "ordering" (each measure larger than the next).
        measures: what is measured.
        combine: how two measures a and b become one number: "value" (there is one), "ratio" a/b, "excess"
            a/b − 1, "difference" a − b, "unevenness" |a + b|/|a|, 0 for mirror images.
        value: published; None of an ordering.
        unit: of the value.
        low: least value that is allowed.
        high: greatest value that is allowed.
        columns: what is judged.
        quick: whether it is in the quick subset.
        causes: why it is missed, as far as known.
    """

    id: str
    source: str
    robot: str | None
    says: str
    use: str
    rule: str
    measures: tuple[Measure, ...]
    combine: str
    value: float | None
    unit: str
    low: float
    high: float
    columns: tuple[str, ...]
    quick: bool
    causes: tuple[Cause, ...]

    @property
    def allowed(self) -> str:
        """What is allowed, in words."""
        if self.rule == "ordering":
            return "each above the next"
        if math.isinf(self.low):
            return f"at most {self.high:.4g}"
        return f"at least {self.low:.4g}" if math.isinf(self.high) else f"{self.low:.4g} to {self.high:.4g}"


def claims_file() -> Path:
    """Return the path of the shipped claims."""
    return data_root() / "calibration/published/claims.yaml"


def load_claims(path: Path | None = None) -> tuple[Claim, ...]:
    """Load the rows of a file of claims, the shipped one by default; a table's numbers are a row each.

    Raises:
        InputError: not readable.
        InputFileError: everything that is wrong with it, one line each.
    """
    document = load_yaml(path or claims_file())
    given = document.data if isinstance(document.data, list) else []
    if not given:
        document.report((), "must be a list of claims")
    files = [(i, validate(ClaimFile, document, each, prefix=(i,))) for i, each in enumerate(given)]
    rows: list[Claim] = []
    for i, file in files:
        if file is not None:
            _check_names(document, i, file)
            rows += _rows(file)
    for name, count in Counter(row.id for row in rows).items():
        if count > 1:
            document.report((), f"the row {name} is there {count} times")
    document.finish()
    return tuple(rows)


def chosen(claims: tuple[Claim, ...], only: tuple[str, ...], *, quick: bool) -> tuple[Claim, ...]:
    """Return the rows with these names, or whose names begin with one of them and a dot; laws first.

    Args:
        claims: all of them.
        only: names; empty: all.
        quick: leave out what is not in the quick subset.

    Raises:
        UnknownNameError: a name that no row has.
    """
    for name in only:
        if not any(_named(claim, name) for claim in claims):
            raise UnknownNameError("claim", name, (claim.id for claim in claims), "docs/reproduction.md")
    found = [
        claim
        for claim in claims
        if (not only or any(_named(claim, name) for name in only)) and (claim.quick or not quick)
    ]
    return tuple(sorted(found, key=lambda claim: claim.use != "law"))


def _named(claim: Claim, name: str) -> bool:
    return claim.id == name or claim.id.startswith(f"{name}.")


def _check_names(document: Document, i: int, file: ClaimFile) -> None:
    """Report scenarios, sweeps, computations and traces that there are not."""
    given: list[tuple[Loc, MeasureFile]] = [((i, "measure"), file.measure)] if file.measure else []
    given += [((i, "measures", k), each) for k, each in enumerate(file.measures)]
    for loc, each in given:
        known = {"scenario": shipped_names("scenario"), "sweep": shipped_names("sweep"), "law": COMPUTATIONS}
        for kind, names in known.items():
            name = getattr(each, kind)
            if name is not None and name not in names:
                document.report((*loc, kind), str(UnknownNameError(kind, name, names)))
        prefix, _, trace = each.metric.partition(".")
        if prefix == "trace" and trace not in TRACES:
            document.report((*loc, "metric"), str(UnknownNameError("trace", trace, TRACES)))


def _rows(file: ClaimFile) -> Iterator[Claim]:
    if file.table is not None:
        yield from _table_rows(file)
        return
    assert file.rule is not None, "checked by the file's model"
    measures = tuple(map(_measure, [file.measure] if file.measure else file.measures))
    low, high = _range(file.rule, file.value, file.tol, file.abs)
    yield Claim(
        file.id, file.source, file.robot, file.says, file.use, file.rule, measures, file.combine, file.value,
        file.unit or "1", low, high, tuple(file.columns), file.quick, tuple(map(_cause, file.cause)),
    )  # fmt: skip


def _table_rows(file: ClaimFile) -> Iterator[Claim]:
    """Yield a row for each number of a table."""
    table = file.table
    assert table is not None, "asked for"
    for row in file.rows:
        at = row[table.at]
        for column, metric in table.columns.items():
            value = -row[column] if column in table.signed and at < 0 else row[column]
            low, high = _range("near", value, file.tol, None)
            measure = Measure("sweep", table.sweep, metric, where={table.field: at})
            use = "fit" if column in table.fit and at in table.fit_at else file.use
            says = f"{column} {value:g} {file.unit or _unit(metric)} at {table.at} {at:g}"
            yield Claim(
                f"{file.id}.{column}.{_place(at)}", file.source, file.robot, says, use, "near", (measure,),
                "value", value, _unit(metric), low, high, tuple(file.columns), file.quick,
                tuple(map(_cause, file.cause)),
            )  # fmt: skip


def _place(at: float) -> str:
    """Return a number as part of a row's name: 0.3 is p03, −0.3 is m03."""
    sign = "m" if at < 0 else "p"
    return f"{sign}{abs(at):g}".replace(".", "") if at else "0"


def _unit(metric: str) -> str:
    return "m/s" if metric.endswith("_m_s") else "m"


def _range(rule: str, value: float | None, tol: float | None, near: float | None) -> tuple[float, float]:
    """Return the least and the greatest value that are allowed; a tolerance widens a bound outward."""
    if value is None:
        return -math.inf, math.inf
    margin = near if near is not None else (tol or 0.0) * abs(value)
    low = value - margin if rule in ("near", "above") else -math.inf
    return low, value + margin if rule in ("near", "below") else math.inf


def _measure(file: MeasureFile) -> Measure:
    kind = next(kind for kind in ("scenario", "sweep", "law") if getattr(file, kind) is not None)
    return Measure(
        kind, getattr(file, kind), file.metric, file.set, file.periods, file.where, file.take, file.plant,
        file.size,
    )  # fmt: skip


def _cause(file: CauseFile) -> Cause:
    return Cause(file.says, tuple(file.columns), file.docs, file.switch, file.set)
