"""Model of the study file, which validates it strictly."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from srs_twin.scenario.expectation import Words
from srs_twin.scenario.fields import Line, PathOrName, Section, quantity
from srs_twin.studies.sweep.table import FieldName, Plain

SEGMENTS = "robot.segments"
"""Variable for the number of segments; it changes all parameters of the robot that depend on it."""


class VariableFile(Section):
    """Range of a field that the study optimises."""

    low: float = Field(ge=-1e12, le=1e12, description="Smallest value.")
    high: float = Field(ge=-1e12, le=1e12, description="Largest value.")
    scale: Literal["linear", "log"] = "linear"
    """Scale on which the search measures distances; log: ratios."""
    whole: bool = False
    """Whether only integers are allowed."""
    hold: list[Literal["total_length", "total_mass"]] | None = None
    """Quantities that stay constant when the number of segments changes (robot.segments)."""
    bounds_source: Words | None = None
    """Physical reason for low and high, repeated in the result for designs on a bound."""

    @model_validator(mode="after")
    def _in_order(self) -> VariableFile:
        if not self.low < self.high:
            raise ValueError(f"low {self.low:g} must be below high {self.high:g}")
        if self.scale == "log" and self.low <= 0:
            raise ValueError(f"scale: log needs values above 0, but low is {self.low:g}")
        return self


class ObjectiveFile(Section):
    """Metric to maximise or minimise."""

    metric: str
    """One of `srs-twin list --metrics`."""
    goal: Literal["maximize", "minimize"]
    """Direction of the optimisation."""
    quantile: float | None = quantity(0.01, 0.99, None)
    """Quantile over the robot's uncertain parameters (budget.uncertain) by which the reported designs are
    ranked (default: by the result of the nominal robot)."""


class ConstraintFile(Section):
    """Limit of a metric that a design must satisfy."""

    metric: str
    """One of `srs-twin list --metrics`."""
    below: float | None = Field(None, ge=-1e12, le=1e12, description="Largest allowed value.")
    above: float | None = Field(None, ge=-1e12, le=1e12, description="Smallest allowed value.")

    @model_validator(mode="after")
    def _has_limit(self) -> ConstraintFile:
        if self.below is None and self.above is None:
            raise ValueError("give below or above")
        return self


class BudgetFile(Section):
    """Numbers of runs of a study."""

    compliant: int = quantity(8, 1_000_000, 400)
    """Runs of the analytical model compliant, if it can run the scenario."""
    twin: int = quantity(4, 1_000_000, 40)
    """Runs of the twin."""
    uncertain: int = quantity(0, 10_000, 0)
    """Runs of the twin per best design, with draws of the robot's uncertain parameters; 0: none."""


class StudyFile(Section):
    """Optimisation of some fields of a scenario."""

    title: Line | None = None
    """Title, one line (default: the name)."""
    scenario: PathOrName
    """Scenario, a shipped name or the path of a file."""
    fixed: dict[FieldName, Plain | list[Plain]] = Field(
        {}, description="Fields with a different value than in the scenario."
    )
    variables: dict[FieldName, VariableFile] = Field(
        min_length=1, max_length=20, description="Fields to optimise."
    )
    objectives: list[ObjectiveFile] = Field(
        min_length=1, max_length=2, description="One objective, or two for a Pareto front."
    )
    constraints: list[ConstraintFile] = Field([], max_length=20, description="Constraints on metrics.")
    budget: BudgetFile = BudgetFile()
    seed: int = quantity(0, 2**32 - 1, 0)
    """Random seed of the search."""

    @model_validator(mode="after")
    def _check_combinations(self) -> StudyFile:
        for name, variable in self.variables.items():
            if variable.hold and name != SEGMENTS:
                raise ValueError(f"hold is only for {SEGMENTS}; remove it from {name}")
        robust = any(objective.quantile is not None for objective in self.objectives)
        if robust and not (self.budget.uncertain and len(self.objectives) == 1):
            raise ValueError("quantile needs a single objective and budget.uncertain above 0")
        return self


def study_json_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of study files."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | StudyFile.model_json_schema()
