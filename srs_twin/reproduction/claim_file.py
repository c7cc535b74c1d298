"""The file of claims as a strict model: one statement an entry; a table's entry holds its numbers."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from srs_twin.scenario.fields import quantity, section
from srs_twin.validation import Strict

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


class MeasureFile(Strict):
    """A number that a run, the runs of a sweep or a computation give."""

    scenario: Name | None = section("Shipped scenario that is run.", None)
    sweep: Name | None = section("Shipped sweep whose points are run.", None)
    law: Name | None = section("Computation that takes the place of runs.", None)
    metric: Name = section(
        "Metric, `comparison.…`, `trace.…` (of the trajectory), or what a computation names."
    )
    set: Changes = section("Fields of the scenario or arguments of the computation that are otherwise.", {})
    periods: float | None = quantity("Simulated time in periods", "", 3.0, 1000.0, None)
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


class CauseFile(Strict):
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


class TableFile(Strict):
    """How the numbers of a table become rows of their own."""

    at: Name = section("Key of a row of the table that says where.")
    field: Name = section("Field of the sweep that has this value there.")
    sweep: Name = section("Sweep that has a point a row.")
    columns: dict[Name, Name] = section("Key of a row of the table → metric.")
    signed: list[Name] = section("Columns printed without the sign that they have where `at` is below 0.", [])
    fit: list[Name] = section("Columns that may be used to calibrate.", [])
    fit_at: list[float] = section("Where they may be.", [])


class ClaimFile(Strict):
    """One statement of the dissertation, and how it is checked."""

    id: Annotated[str, Field(pattern=r"^[a-z0-9]+([.-][a-z0-9]+)*$", max_length=80)] = section(
        "Name of the row."
    )
    source: Name = section("Section, figure, table, errata.")
    robot: Literal["gen1", "gen2", "gen3", "gen4"] | None = section("Generation that it is about.", None)
    says: Annotated[str, Field(min_length=1, max_length=600)] = section("The statement.")
    use: Use = section("fit, holdout, law or shape.")
    value: float | None = quantity("Published value", "the unit", -_BOUND, _BOUND, None)
    unit: Name | None = section("Unit of the value.", None)
    tol: float | None = quantity("Relative tolerance", "", 0.0, 100.0, None)
    abs: float | None = quantity("Absolute tolerance", "the unit", 0.0, _BOUND, None)
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
