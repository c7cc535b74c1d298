"""The dissertation's claims: one row a statement, the runs that produce it, and the rule by which it is met.

The file of claims as a strict model: one statement an entry; a table's entry holds its numbers.

Claims: what the dissertation states, one row a statement, each with the rule by which it is met.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from srs_twin.errors import UnknownNameError
from srs_twin.io.documents import Document, Loc, load_yaml
from srs_twin.io.files import data_root, shipped_names
from srs_twin.io.validation import validate
from srs_twin.reproduction.computations import COMPUTATIONS
from srs_twin.reproduction.traces import TRACES
from srs_twin.scenario.fields import Section, quantity, section

Plain = bool | int | float | Annotated[str, Field(max_length=200)]
Set = Plain | Annotated[list[float], Field(min_length=1, max_length=100)]
Fields = dict[Annotated[str, Field(max_length=200)], Plain]
Changes = dict[Annotated[str, Field(max_length=200)], Set]
Name = Annotated[str, Field(min_length=1, max_length=200)]
Column = Literal["analytical", "twin", "alone"]
Rule = Literal["near", "below", "above", "ordering"]
Use = Literal["fit", "holdout", "law", "shape"]
Take = Literal["most", "least", "mean", "spread"]
Combine = Literal["value", "ratio", "excess", "difference", "unevenness"]

_BOUND = 1e9


class MeasureFile(Section):
    """A number that a run, the runs of a sweep or a computation give."""

    scenario: Name | None = section("Shipped scenario that is run.", None)
    sweep: Name | None = section("Shipped sweep whose points are run.", None)
    law: Name | None = section("Computation that takes the place of runs.", None)
    metric: Name = section(
        "Metric, `comparison.…`, `trace.…` (of the trajectory), or what a computation names."
    )
    set: Changes = section("Fields of the scenario or arguments of the computation that are otherwise.", {})
    periods: float | None = quantity("Simulated time in periods", 3.0, 1000.0, None)
    where: Fields = section("Points of the sweep that count: varied field and its value.", {})
    take: Take | None = section("What is taken of the values of a sweep's points.", None)
    plant: Literal["analytical", "twin"] | None = section("Whose, whatever column is asked for.", None)
    size: bool = section("Whether the sign is left out.", False)

    @model_validator(mode="after")
    def _one_origin(self) -> MeasureFile:
        if sum(each is not None for each in (self.scenario, self.sweep, self.law)) != 1:
            raise ValueError("give exactly one of scenario, sweep and law")
        if self.where and self.sweep is None:
            raise ValueError("where belongs to a sweep")
        if self.periods is not None and self.scenario is None:
            raise ValueError("periods belongs to a scenario")
        return self


class CauseFile(Section):
    """Why a row is missed: shown by a switch or by a section of the documents, or supposed without either."""

    says: Name = section("In words.")
    columns: list[Column] = section("Which columns it explains.", ["analytical", "twin"])
    docs: Name | None = section(
        "Section of the documents that shows it (docs/models.md#why-they-differ).", None
    )
    switch: Name | None = section("Name of the assumption that is switched.", None)
    set: Changes = section("Fields of the scenario that switch it: with them the row must be met.", {})

    @model_validator(mode="after")
    def _one_proof(self) -> CauseFile:
        if (self.docs and self.switch) or bool(self.set) != (self.switch is not None):
            raise ValueError("give docs, or switch with set, or neither where the cause is only supposed")
        return self


class TableFile(Section):
    """How the numbers of a table become rows of their own."""

    at: Name = section("Key of a row of the table that says where.")
    field: Name = section("Field of the sweep that has this value there.")
    sweep: Name = section("Sweep that has a point a row.")
    columns: dict[Name, Name] = section("Key of a row of the table → metric.")
    signed: list[Name] = section("Columns printed without the sign that they have where `at` is below 0.", [])
    fit: list[Name] = section("Columns that may be used to calibrate.", [])
    fit_at: list[float] = section("Where they may be.", [])


class ClaimFile(Section):
    """One statement of the dissertation, and how it is checked."""

    id: Annotated[str, Field(pattern=r"^[a-z0-9]+([.-][a-z0-9]+)*$", max_length=80)] = section(
        "Name of the row."
    )
    source: Name = section("Section, figure, table, errata.")
    robot: Literal["gen1", "gen2", "gen3", "gen4"] | None = section("Generation that it is about.", None)
    says: Annotated[str, Field(min_length=1, max_length=600)] = section("The statement.")
    use: Use = section("fit, holdout, law or shape.")
    value: float | None = quantity("Published value", -_BOUND, _BOUND, None, unit="the unit")
    unit: Name | None = section("Unit of the value.", None)
    tol: float | None = quantity("Relative tolerance", 0.0, 100.0, None)
    abs: float | None = quantity("Absolute tolerance", 0.0, _BOUND, None, unit="the unit")
    rule: Rule | None = section("near, below, above, or ordering: each measure larger than the next.", None)
    measure: MeasureFile | None = section("What is held against the value.", None)
    measures: list[MeasureFile] = section("What is combined, or put in order.", [])
    combine: Combine = section("How measures become one number.", "value")
    columns: list[Column] = section("What is judged.", ["analytical", "twin"])
    quick: bool = section("Whether --quick runs it.", False)
    cause: list[CauseFile] = section("Why it is missed, as far as known.", [])
    table: TableFile | None = section("How `rows` become rows.", None)
    rows: list[dict[Name, float]] = section("Numbers of a table.", [])
    note: Annotated[str, Field(max_length=1000)] | None = section("What a reader must know.", None)

    @model_validator(mode="after")
    def _what_belongs_together(self) -> ClaimFile:
        if self.table is not None:
            if not self.rows or self.tol is None or self.rule is not None:
                raise ValueError("a table needs rows and tol, and its rows are held near their values")
            return self
        if self.rule is None:
            raise ValueError("a rule is needed: near, below, above or ordering")
        if (self.measure is None) == (not self.measures):
            raise ValueError("give either measure or measures")
        if self.rule == "ordering":
            if len(self.measures) < 2 or self.value is not None or self.combine != "value":
                raise ValueError("ordering takes two measures or more, and no value")
            return self
        if self.value is None:
            raise ValueError(f"{self.rule} needs a value")
        if self.measures and (self.combine == "value" or len(self.measures) != 2):
            raise ValueError("two measures need combine: ratio, excess, difference or unevenness")
        if self.rule == "near" and (self.tol is None) == (self.abs is None):
            raise ValueError("near needs either tol or abs")
        return self


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
        file.id,
        file.source,
        file.robot,
        file.says,
        file.use,
        file.rule,
        measures,
        file.combine,
        file.value,
        file.unit or "1",
        low,
        high,
        tuple(file.columns),
        file.quick,
        tuple(map(_cause, file.cause)),
    )


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
                f"{file.id}.{column}.{_place(at)}",
                file.source,
                file.robot,
                says,
                use,
                "near",
                (measure,),
                "value",
                value,
                _unit(metric),
                low,
                high,
                tuple(file.columns),
                file.quick,
                tuple(map(_cause, file.cause)),
            )


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
        kind,
        getattr(file, kind),
        file.metric,
        file.set,
        file.periods,
        file.where,
        file.take,
        file.plant,
        file.size,
    )


def _cause(file: CauseFile) -> Cause:
    return Cause(file.says, tuple(file.columns), file.docs, file.switch, file.set)
