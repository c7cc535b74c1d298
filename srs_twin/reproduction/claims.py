"""Claims: what the dissertation states, one row a statement, each with the rule by which it is met.

The file is read into strict models; a table's entry holds its numbers, which become a row each.
"""

from __future__ import annotations

import inspect
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import AfterValidator, Field, model_validator

import srs_twin.reproduction.computations as computations
import srs_twin.reproduction.traces as traces
from srs_twin.errors import UnknownNameError
from srs_twin.io.documents import Document, Loc, load_yaml
from srs_twin.io.files import data_root, shipped_names
from srs_twin.io.validation import Model, validate
from srs_twin.scenario.fields import Section, quantity


def _functions(module: ModuleType) -> dict[str, Callable[..., Any]]:
    """Return the public functions that a module defines, by name."""
    found = inspect.getmembers(module, inspect.isfunction)
    return {name: each for name, each in found if each.__module__ == module.__name__ and name[0] != "_"}


COMPUTATIONS = _functions(computations)
"""What a file names as `law`: each takes what is set, and returns ``<column>.<metric>`` → number."""
TRACES = _functions(traces)
"""What a file names as `trace.…`: each takes a trajectory, and returns a number or None."""

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
Tolerance = Literal["dissertation", "measurement", "ours"]
Limitation = Literal["fitted_robot", "tuned_controller", "chosen_obstacles", "between_models"]
Group = Literal["headline", "own_tolerance"] | Limitation
Category = Group | Literal["shape", "by_construction", "law", "fit"]


def _check_answer(text: str) -> str:
    if not text.startswith(("Yes: ", "No: ")):
        raise ValueError("could_fail must begin with 'Yes: ' or 'No: '")
    return text


Falsifiability = Annotated[str, Field(max_length=500), AfterValidator(_check_answer)]
"""Whether a row could have been missed, in a sentence."""

_BOUND = 1e9
CLAIMS_BYTES = 128 * 1024
"""Largest file of claims: 166 rows, with the reason for each, take 72 kB."""


class RunRequest(Section):
    """A scenario, points of a sweep or a computation that are run."""

    scenario: Name | None = None
    """Shipped scenario that is run."""
    sweep: Name | None = None
    """Shipped sweep whose points are run."""
    law: Name | None = None
    """Computation that takes the place of runs."""
    set: Changes = {}
    """Fields of the scenario or arguments of the computation that are otherwise."""
    periods: float | None = quantity(3.0, 1000.0, None)
    """Simulated time in periods."""
    where: Fields = {}
    """Points of the sweep that count: varied field and its value."""

    @model_validator(mode="after")
    def _one_origin(self) -> Self:
        if sum(each is not None for each in (self.scenario, self.sweep, self.law)) != 1:
            raise ValueError("give exactly one of scenario, sweep and law")
        if self.where and self.sweep is None:
            raise ValueError("where belongs to a sweep")
        if self.periods is not None and self.scenario is None:
            raise ValueError("periods belongs to a scenario")
        return self

    @property
    def kind(self) -> str:
        """What it is: "scenario", "sweep" or "law"."""
        return next(kind for kind in ("scenario", "sweep", "law") if getattr(self, kind) is not None)

    @property
    def name(self) -> str:
        """Name of the scenario, sweep or computation."""
        return str(getattr(self, self.kind))

    def check_names(self, document: Document, loc: Loc) -> None:
        """Report a scenario, a sweep or a computation that there is not."""
        names = COMPUTATIONS if self.kind == "law" else shipped_names(self.kind)
        if self.name not in names:
            document.report((*loc, self.kind), str(UnknownNameError(self.kind, self.name, names)))


class Measure(RunRequest):
    """A number that a run, the runs of a sweep or a computation give."""

    metric: Name
    """Metric, `comparison.…`, `trace.…` (of the trajectory), or what a computation names."""
    take: Take | None = None
    """What is taken of the values of a sweep's points."""
    plant: Literal["analytical", "twin"] | None = None
    """Whose, whatever column is asked for."""
    size: bool = False
    """Whether the sign is left out."""

    def check_names(self, document: Document, loc: Loc) -> None:
        """Report a trace that there is not, besides what is run."""
        super().check_names(document, loc)
        prefix, _, trace = self.metric.partition(".")
        if prefix == "trace" and trace not in TRACES:
            document.report((*loc, "metric"), str(UnknownNameError("trace", trace, TRACES)))


class Cause(Section):
    """Cause of a miss: shown by a switch or by a section of the documentation, or presumed without either."""

    says: Name
    """In words."""
    columns: list[Column] = ["analytical", "twin"]
    """Which columns it explains."""
    docs: Name | None = None
    """Section of the documents that shows it (docs/models.md#why-they-differ)."""
    switch: Name | None = None
    """Name of the assumption that is switched."""
    set: Changes = {}
    """Fields of the scenario that switch it: with them the row must be met."""

    @model_validator(mode="after")
    def _one_proof(self) -> Cause:
        if (self.docs and self.switch) or bool(self.set) != (self.switch is not None):
            raise ValueError("give docs, or switch with set, or neither for a presumed cause")
        return self


class TableRows(Section):
    """How the numbers of a table become rows of their own."""

    at: Name
    """Key of a row of the table that says where."""
    field: Name
    """Field of the sweep that has this value there."""
    sweep: Name
    """Sweep that has a point a row."""
    columns: dict[Name, Name]
    """Key of a row of the table → metric."""
    signed: list[Name] = []
    """Columns printed without a sign: that of `at`; at 0 the sign is unknown, and sizes are compared."""
    fit: list[Name] = []
    """Columns that may be used to calibrate."""
    fit_at: list[float] = []
    """Where they may be."""
    could_fail: dict[Name, Falsifiability]
    """Column → whether its rows could have been missed."""
    could_fail_fit: Falsifiability
    """The same of the rows that may be used to calibrate."""
    cause: dict[Name, list[Cause]] = {}
    """Column → why its rows are missed, as far as known."""

    @model_validator(mode="after")
    def _every_column_could_fail(self) -> Self:
        if self.could_fail.keys() != self.columns.keys():
            raise ValueError("could_fail needs a sentence for each of the columns, and no other")
        if not self.cause.keys() <= self.columns.keys():
            raise ValueError("cause must name columns of the table")
        return self

    def is_fitted(self, column: str, at: float, rows: Sequence[Mapping[str, float]]) -> bool:
        """Return whether a number may be used to calibrate, or repeats one that may, in the same column."""
        if column not in self.fit:
            return False
        this = next(row for row in rows if row[self.at] == at)
        return this[column] in {row[column] for row in rows if row[self.at] in self.fit_at}


class Claim(Section):
    """One statement of the dissertation, and how it is checked."""

    id: Annotated[str, Field(pattern=r"^[a-z0-9]+([.-][a-z0-9]+)*$", max_length=80)]
    """Name of the row."""
    source: Name
    """Section, figure, table, errata."""
    robot: Literal["gen1", "gen2", "gen3", "gen4"] | None = None
    """Generation that it is about."""
    says: Annotated[str, Field(min_length=1, max_length=600)]
    """The statement."""
    use: Use
    """fit, holdout, law or shape."""
    could_fail: Falsifiability | None = None
    """Outcome that misses and origin of the tolerance ("Yes: …"), or why no outcome can miss ("No: …")."""
    tolerance: Tolerance | None = None
    """Origin of a prediction's tolerance: the dissertation's statement, its measurement error, or ours."""
    limitation: Limitation | None = None
    """Why a prediction is no headline, whatever its tolerance."""
    value: float | None = quantity(-_BOUND, _BOUND, None, unit="the unit")
    """Published value."""
    unit: Name = "1"
    """Unit of the value."""
    tol: float | None = quantity(0.0, 100.0, None)
    """Relative tolerance."""
    abs: float | None = quantity(0.0, _BOUND, None, unit="the unit")
    """Absolute tolerance."""
    rule: Rule | None = None
    """near, below, above, or ordering: each measure larger than the next."""
    measure: Measure | None = None
    """What is held against the value."""
    measures: list[Measure] = []
    """What is combined, or put in order."""
    combine: Combine = "value"
    """How measures become one number."""
    columns: list[Column] = ["analytical", "twin"]
    """What is judged."""
    quick: bool = False
    """Whether --quick runs it."""
    cause: list[Cause] = []
    """Why it is missed, as far as known."""
    table: TableRows | None = None
    """How `rows` become rows."""
    rows: list[dict[Name, float]] = []
    """Numbers of a table."""
    note: Annotated[str, Field(max_length=1000)] | None = None
    """What a reader must know."""

    @model_validator(mode="after")
    def _evidence(self) -> Self:
        if (self.could_fail is None) == (self.table is None):
            raise ValueError("could_fail is needed: 'Yes: …' or 'No: …'; a table has it in `table`")
        if (self.tolerance is None) == (self.use == "holdout"):
            raise ValueError("tolerance belongs to every holdout, and to no other use")
        if self.limitation is not None and self.use != "holdout":
            raise ValueError("limitation belongs to a holdout")
        if self.group == "headline" and not self.falsifiable:
            raise ValueError("a headline prediction must be able to fail: could_fail must begin with Yes")
        return self

    @model_validator(mode="after")
    def _what_belongs_together(self) -> Claim:
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

    @property
    def fitted(self) -> bool:
        """Whether it may be used to calibrate, so that it is no prediction."""
        return self.use == "fit"

    @property
    def falsifiable(self) -> bool:
        """Whether the row could have been missed."""
        return self.could_fail is None or self.could_fail.startswith("Yes")

    @property
    def group(self) -> Group | None:
        """Group in which a prediction is counted; None for rows of another use."""
        if self.use != "holdout":
            return None
        return self.limitation or ("own_tolerance" if self.tolerance == "ours" else "headline")

    @property
    def category(self) -> Category:
        """Heading under which the row is counted: the group of a prediction, else the use."""
        if self.group is not None:
            return self.group
        if self.use == "shape" and not self.falsifiable:
            return "by_construction"
        return self.use  # type: ignore[return-value]  # holdouts have a group

    @property
    def taken(self) -> list[Measure]:
        """What is measured."""
        return [self.measure] if self.measure else self.measures

    def switched(self, cause: Cause) -> Claim:
        """Return the claim of scenarios whose fields are as a cause sets them."""
        changed = [each.model_copy(update={"set": {**each.set, **cause.set}}) for each in self.taken]
        return self.model_copy(update={"measure": None, "measures": changed})

    @property
    def low(self) -> float:
        """Least value that is allowed; a tolerance widens a bound outward."""
        return self._bound("above", -1)

    @property
    def high(self) -> float:
        """Greatest value that is allowed."""
        return self._bound("below", 1)

    def _bound(self, rule: Rule, side: int) -> float:
        if self.value is None or self.rule not in ("near", rule):
            return side * math.inf
        width = self.abs if self.abs is not None else (self.tol or 0.0) * math.fabs(self.value)
        return self.value + side * width

    @property
    def allowed(self) -> str:
        """What is allowed, in words."""
        if self.rule == "ordering":
            return "each above the next"
        if math.isinf(self.low):
            return f"at most {self.high:.4g}"
        return f"at least {self.low:.4g}" if math.isinf(self.high) else f"{self.low:.4g} to {self.high:.4g}"


COLUMNS = get_args(Column)
"""Who can meet a row: a plant, or a computation that needs none."""


def claims_file() -> Path:
    """Return the path of the shipped claims."""
    return data_root() / "calibration/published/claims.yaml"


def load_claims(path: Path | None = None) -> tuple[Claim, ...]:
    """Load the rows of a file of claims, the shipped one by default; a table's numbers are a row each.

    Raises:
        InputError: not readable.
        InputFileError: everything that is wrong with it, one line each.
    """
    document, claims = load_list(path or claims_file(), Claim, "claims")
    rows: list[Claim] = []
    for i, claim in claims:
        places: list[Loc] = (
            [(i, "measure")] if claim.measure else [(i, "measures", k) for k in range(len(claim.measures))]
        )
        for loc, measure in zip(places, claim.taken, strict=True):
            measure.check_names(document, loc)
        rows += _rows(claim)
    for name, count in Counter(row.id for row in rows).items():
        if count > 1:
            document.report((), f"the row {name} is there {count} times")
    document.finish()
    return tuple(rows)


def load_list(path: Path, model: type[Model], what: str) -> tuple[Document, list[tuple[int, Model]]]:
    """Read a list of sections; return the document with its problems, and index and section of what is right.

    Args:
        path: of the file.
        model: of each section.
        what: what it is a list of, in words.

    Raises:
        InputError: not readable.
    """
    document = load_yaml(path, limit=CLAIMS_BYTES)
    given = document.data if isinstance(document.data, list) else []
    if not given:
        document.report((), f"must be a list of {what}")
    found = [(i, validate(model, document, each, prefix=(i,))) for i, each in enumerate(given)]
    return document, [(i, each) for i, each in found if each is not None]


def chosen(claims: tuple[Claim, ...], only: tuple[str, ...], *, quick: bool) -> tuple[Claim, ...]:
    """Return the rows with these names, or whose names begin with one of them and a dot; laws first.

    Args:
        claims: all of them.
        only: names; empty: all.
        quick: leave out what is not in the quick subset.

    Raises:
        UnknownNameError: a name that no row has.
    """
    named = {name: [c for c in claims if f"{c.id}.".startswith(f"{name}.")] for name in only}
    for name in only:
        if not named[name]:
            raise UnknownNameError("claim", name, (claim.id for claim in claims), "docs/reproduction.md")
    wanted = {claim.id for found in named.values() for claim in found}
    found = [each for each in claims if (not only or each.id in wanted) and (each.quick or not quick)]
    return tuple(sorted(found, key=lambda claim: claim.use != "law"))


def _rows(claim: Claim) -> Iterator[Claim]:
    """Yield a claim itself, of a table a row for each number."""
    table = claim.table
    if table is None:
        yield claim
        return
    for row in claim.rows:
        at = row[table.at]
        for column, metric in table.columns.items():
            value = -row[column] if column in table.signed and at < 0 else row[column]
            use: Use = "fit" if table.is_fitted(column, at, claim.rows) else claim.use
            prediction = use == "holdout"
            size = column in table.signed and at == 0
            unit = "m/s" if metric.endswith("_m_s") else "m"
            yield claim.model_copy(
                update={
                    "id": f"{claim.id}.{column}.{_place(at)}",
                    "says": f"{column} {value:g} {unit} at {table.at} {at:g}",
                    "use": use,
                    "cause": table.cause.get(column, []),
                    "could_fail": table.could_fail[column] if prediction else table.could_fail_fit,
                    "tolerance": claim.tolerance if prediction else None,
                    "limitation": claim.limitation if prediction else None,
                    "rule": "near",
                    "value": value,
                    "unit": unit,
                    "measure": Measure(sweep=table.sweep, metric=metric, where={table.field: at}, size=size),
                    "table": None,
                    "rows": [],
                }
            )


def _place(at: float) -> str:
    """Return a number as part of a row's name: 0.3 is p03, −0.3 is m03."""
    sign = "m" if at < 0 else "p"
    return f"{sign}{abs(at):g}".replace(".", "") if at else "0"
