"""The study file as a strict model."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from srs_twin.scenario.expectation import Words
from srs_twin.scenario.fields import Line, PathOrName, Section, quantity
from srs_twin.studies.sweep.table import FieldName, Plain

SEGMENTS = "robot.segments"
"""Stands for all of a robot's numbers that go with how many segments it has."""


class VariableFile(Section):
    """Between which values a field may be chosen."""

    low: float = Field(ge=-1e12, le=1e12, description="Least value.")
    high: float = Field(ge=-1e12, le=1e12, description="Largest value.")
    scale: Literal["linear", "log"] = "linear"
    """How the search measures distances; log: by ratios."""
    whole: bool = False
    """Whole numbers only."""
    hold: list[Literal["total_length", "total_mass"]] | None = None
    """What stays as it is while the number of segments changes (robot.segments)."""
    bounds_source: Words | None = None
    """Physical reason for low and high, which the result repeats for designs on a bound."""

    @model_validator(mode="after")
    def _in_order(self) -> VariableFile:
        if not self.low < self.high:
            raise ValueError(f"low {self.low:g} is not below high {self.high:g}")
        if self.scale == "log" and self.low <= 0:
            raise ValueError(f"scale: log needs values above 0, but low is {self.low:g}")
        return self


class ObjectiveFile(Section):
    """What is to be as large or as small as can be."""

    metric: str
    """One of `srs-twin list --metrics`."""
    goal: Literal["maximize", "minimize"]
    """Which of both."""
    quantile: float | None = quantity(0.01, 0.99, None)
    """Of the designs that are told of, the one is best whose results under what is uncertain of the robot
    (budget.uncertain) have the best such quantile (default: the result of the robot as it stands counts)."""


class ConstraintFile(Section):
    """What a design has to keep."""

    metric: str
    """One of `srs-twin list --metrics`."""
    below: float | None = Field(None, ge=-1e12, le=1e12, description="It must not be above this.")
    above: float | None = Field(None, ge=-1e12, le=1e12, description="It must not be below this.")

    @model_validator(mode="after")
    def _says_something(self) -> ConstraintFile:
        if self.below is None and self.above is None:
            raise ValueError("give below or above")
        return self


class BudgetFile(Section):
    """How many runs a study may take."""

    compliant: int = quantity(8, 1_000_000, 400)
    """Of the analytical model compliant, where that can run the scenario."""
    twin: int = quantity(4, 1_000_000, 40)
    """Of the twin."""
    uncertain: int = quantity(0, 10_000, 0)
    """Of the twin, for each of the best designs, with what is uncertain of the robot; 0: none."""


class StudyFile(Section):
    """A question: which values of some fields are best."""

    title: Line | None = None
    """One line for people (default: the name)."""
    scenario: PathOrName
    """A shipped name or the path of a file."""
    fixed: dict[FieldName, Plain | list[Plain]] = Field(
        {}, description="Fields with another value than the scenario's."
    )
    variables: dict[FieldName, VariableFile] = Field(
        min_length=1, max_length=20, description="Fields that are chosen."
    )
    objectives: list[ObjectiveFile] = Field(
        min_length=1, max_length=2, description="One, or two whose Pareto front is sought."
    )
    constraints: list[ConstraintFile] = Field([], max_length=20, description="What has to be kept.")
    budget: BudgetFile = BudgetFile()
    seed: int = quantity(0, 2**32 - 1, 0)
    """Of the search."""

    @model_validator(mode="after")
    def _what_belongs_together(self) -> StudyFile:
        for name, variable in self.variables.items():
            if variable.hold and name != SEGMENTS:
                raise ValueError(f"hold belongs to {SEGMENTS}, not to {name}")
        robust = any(each.quantile is not None for each in self.objectives)
        if robust and not (self.budget.uncertain and len(self.objectives) == 1):
            raise ValueError("quantile takes one objective, and a budget of uncertain runs")
        return self


def study_json_schema() -> dict[str, Any]:
    """Return a schema (draft 2020-12) that knows every key with its title, description, unit and range."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | StudyFile.model_json_schema()
