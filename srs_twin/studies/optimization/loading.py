"""Loading of study files, which reports all problems in a file at once."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from srs_twin.comparison.metrics import METRICS_LISTED, metric_units
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.io.documents import (
    Document,
    Loc,
    Override,
    Overrides,
    format_path,
    load_yaml,
)
from srs_twin.io.files import StrPath, find_file, results_name
from srs_twin.io.validation import validate
from srs_twin.scenario.expectation import MetricName, Words
from srs_twin.scenario.fields import Line, PathOrName, Section, quantity
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.modified import Changes as ChangedFields, changed_fields, marked
from srs_twin.scenario.scenario import Scenario
from srs_twin.studies.sweep.loading import (
    base_scenario,
    changed_base,
    locate_files,
    problems_at,
    refuse_changes,
    with_suggestion,
)
from srs_twin.studies.sweep.points import (
    Changes,
    Experiment,
    FieldName,
    Plain,
    Value,
    leaf_names,
    value_at,
)
from srs_twin.studies.uncertainty.study import compliant_scenario, on_plant

SEGMENTS = "robot.segments"
"""Name of the variable for the number of segments, which sets the connector count."""


class VariableFile(Section):
    """Range of a scenario field to optimise."""

    low: float = Field(ge=-1e12, le=1e12, description="Minimum value of the field.")
    high: float = Field(ge=-1e12, le=1e12, description="Maximum value of the field.")
    scale: Literal["linear", "log"] = "linear"
    """Scale of the variable in the search. With `log`, equal ratios correspond to equal
    distances.
    """
    whole: bool = False
    """Whether values are rounded to integers."""
    hold: list[Literal["total_length", "total_mass"]] | None = None
    """Quantities to keep constant when the number of segments (`robot.segments`)
    changes.
    """
    bounds_source: Words | None = None
    """Physical reason for `low` and `high`, which the result quotes for designs on a
    bound.
    """

    def value_at(self, fraction: float) -> float | int:
        """Return the rounded value at a fraction of the range."""
        value = value_at(fraction, self.low, self.high, self.scale)
        # Because of the rounding, designs that differ only by rounding errors share a
        # stored run.
        return round(value) if self.whole else float(f"{value:.6g}")

    def fraction_of(self, value: float) -> float:
        """Return the position of a value in the range as a fraction."""
        if self.scale == "log":
            return float(np.log(value / self.low) / np.log(self.high / self.low))
        return (value - self.low) / (self.high - self.low)

    @model_validator(mode="after")
    def _in_order(self) -> VariableFile:
        if not self.low < self.high:
            raise ValueError(f"`low` {self.low:g} must be below `high` {self.high:g}")
        if self.scale == "log" and self.low <= 0:
            raise ValueError(
                "with `scale: log`, all values must be above 0, but `low` is"
                f" {self.low:g}"
            )
        return self


class ObjectiveFile(Section):
    """Metric to maximise or minimise."""

    metric: MetricName
    """Metric to optimise, as listed by `srs-twin list --metrics`."""
    goal: Literal["maximize", "minimize"]
    """Direction of the optimisation."""
    quantile: float | None = quantity(0.01, 0.99, None)
    """Quantile over random robots (`budget.uncertain`) by which the reported designs
    are ranked (default: rank by the result with the nominal robot).
    """

    @property
    def sign(self) -> float:
        """Factor that converts the metric into a cost."""
        return -1.0 if self.goal == "maximize" else 1.0


class ConstraintFile(Section):
    """Constraint on a metric."""

    metric: MetricName
    """Constrained metric, as listed by `srs-twin list --metrics`."""
    below: float | None = Field(
        None, ge=-1e12, le=1e12, description="Maximum allowed value."
    )
    above: float | None = Field(
        None, ge=-1e12, le=1e12, description="Minimum allowed value."
    )

    @model_validator(mode="after")
    def _has_limit(self) -> ConstraintFile:
        if self.below is None and self.above is None:
            raise ValueError(
                "the constraint has no limit; give `below`, `above` or both"
            )
        return self


class BudgetFile(Section):
    """Budget of simulation runs for a study."""

    compliant: int = quantity(8, 1_000_000, 400)
    """Number of runs with the analytical model `compliant`, if it can simulate the
    scenario.
    """
    twin: int = quantity(4, 1_000_000, 40)
    """Number of twin runs during the search."""
    uncertain: int = quantity(0, 10_000, 0)
    """Number of robots with random parameters with which the twin simulates the initial
    scenario and each best design.
    """


class StudyFile(Section):
    """Optimisation study for selected scenario fields."""

    title: Line | None = None
    """Title on one line (default: the name of the study)."""
    scenario: PathOrName
    """Name of a shipped scenario or path of a scenario file."""
    fixed: dict[FieldName, Plain | list[Plain]] = Field(
        {}, description="Fields whose value differs from the scenario."
    )
    variables: dict[FieldName, VariableFile] = Field(
        min_length=1, max_length=20, description="Fields to optimise."
    )
    objectives: list[ObjectiveFile] = Field(
        min_length=1,
        max_length=2,
        description="One objective, or two objectives for a Pareto front.",
    )
    constraints: list[ConstraintFile] = Field(
        [], max_length=20, description="Constraints on metrics."
    )
    budget: BudgetFile = BudgetFile()
    seed: int = quantity(0, 2**32 - 1, 0)
    """Random seed of the search."""

    @model_validator(mode="after")
    def _check_combinations(self) -> StudyFile:
        for name, variable in self.variables.items():
            if variable.hold and name != SEGMENTS:
                raise ValueError(
                    f"`hold` is allowed only for {SEGMENTS}; remove it from {name}"
                )
        robust = any(objective.quantile is not None for objective in self.objectives)
        if robust and not (self.budget.uncertain and len(self.objectives) == 1):
            raise ValueError(
                "`quantile` needs a single objective and a number of robots"
                " `budget.uncertain` above 0"
            )
        return self


def study_json_schema() -> dict[str, object]:
    """Return the JSON Schema (draft 2020-12) of study files."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema"
    } | StudyFile.model_json_schema()


ON_BOUND = 0.01
"""Distance from a bound at which a variable counts as being on the bound, as a fraction
of its range.
"""


@dataclass(frozen=True)
class DesignSpace:
    """Variables of a study with their ranges.

    Attributes:
        variables: range of each variable, keyed by dotted name.
        robot: robot parameters of the scenario as plain data, from which the quantities
            under `hold` are computed.
    """

    variables: Mapping[str, VariableFile]
    robot: Mapping[str, Any]

    @property
    def size(self) -> int:
        """Number of variables."""
        return len(self.variables)

    def values(self, fractions: np.ndarray) -> tuple[float | int, ...]:
        """Convert a design from fractions of the ranges, shape (d,), to values."""
        ranges = zip(self.variables.values(), np.clip(fractions, 0.0, 1.0), strict=True)
        return tuple(variable.value_at(fraction) for variable, fraction in ranges)

    def fractions(self, values: Sequence[float]) -> np.ndarray:
        """Convert the values of a design to fractions of the ranges, shape (d,)."""
        ranges = zip(self.variables.values(), values, strict=True)
        return np.array([variable.fraction_of(value) for variable, value in ranges])

    def bounds(self, fractions: np.ndarray) -> dict[str, str]:
        """Return "low" or "high" for each variable that lies on that bound."""
        snapped = self.fractions(self.values(fractions))
        return {
            name: "low" if fraction < ON_BOUND else "high"
            for name, fraction in zip(self.variables, snapped, strict=True)
            if not ON_BOUND <= fraction <= 1 - ON_BOUND
        }

    def snapped(self, fractions: np.ndarray) -> np.ndarray:
        """Round the values of designs, given as fractions, shape (designs, d)."""
        return np.array(
            [self.fractions(self.values(fraction)) for fraction in fractions]
        )

    def changes(self, fractions: np.ndarray) -> Changes:
        """Return the scenario fields that a design changes, with their new values."""
        changes: dict[str, Value] = {}
        for (name, variable), value in zip(
            self.variables.items(), self.values(fractions), strict=True
        ):
            if name == SEGMENTS:
                changes |= self._segment_changes(int(value), variable.hold or [])
            else:
                changes[name] = value
        return changes

    def _segment_changes(self, count: int, hold: Sequence[str]) -> Changes:
        geometry = self.robot["geometry"]
        mass = self.robot["mass"]
        before = geometry["connectors"]["value"]
        changes: dict[str, Value] = {"robot.geometry.connectors": count + 1}
        if "total_length" in hold:
            length = geometry["segment_length_m"]["value"]
            gap = geometry["rigid_gap_m"]["value"]
            changes["robot.geometry.segment_length_m"] = (before - 1) * (
                length + gap
            ) / count - gap
        if "total_mass" in hold:
            changes["robot.mass.connectors_kg"] = (
                before * mass["connectors_kg"]["value"] / (count + 1)
            )
        return changes


@dataclass(frozen=True)
class OptimizationStudy:
    """Loaded and validated study.

    Attributes:
        name: name of the study and of its default output folder.
        experiments: experiments, keyed by fidelity ("twin" and, if possible,
            "compliant").
        changes: fields that differ from the study file.
    """

    name: str
    file: StudyFile
    scenario: Scenario
    space: DesignSpace
    experiments: Mapping[str, Experiment]
    document: Mapping[str, object] = field(repr=False)
    changes: ChangedFields = ()

    @property
    def title(self) -> str:
        """Title on one line, including the changed fields."""
        return marked(self.file.title or self.name, self.changes)


def load_study(
    study: StrPath | OptimizationStudy,
    *,
    set: Overrides = (),
) -> OptimizationStudy:
    """Load a shipped study by name (gen2_speed), or a study file by path.

    Args:
        study: name or path of the study, or a loaded study, which is returned
            unchanged.
        set: values of scenario fields, keyed by dotted path, which extend or replace
            the fixed fields in the file. The key `seed` sets the random seed of the
            study.
    """
    if isinstance(study, OptimizationStudy):
        refuse_changes("study", set)
        return study
    path = find_file("study", study)
    overrides = Override.list_of(set)
    document = load_yaml(path)
    written = copy.deepcopy(document.data)
    for change in overrides:
        loc = change.loc
        if loc != ("seed",):
            loc = ("fixed", format_path(loc))
        document.apply(replace(change, loc=loc))
    complete = locate_files(document)
    file = validate(StudyFile, document, document.data)
    if file is None and document.existing_prefix(("budget",)):
        # A wrong budget must not hide problems of the fields.
        file = validate(StudyFile, Document(""), {**document.data, "budget": {}})
    scenario, scenario_errors = base_scenario(document) if file else (None, ())
    loaded = None
    if complete and file is not None and scenario is not None:
        _check_metrics(document, file)
        _check_conflicts(document, file)
        loaded = _study(results_name(path), document, file, scenario)
        _check_range_ends(document, loaded)
    document.raise_problems(scenario_errors)
    assert loaded is not None, "a document without problems gives a study"
    return replace(
        loaded, changes=_changes(loaded, written, [change.loc for change in overrides])
    )


def _changes(
    study: OptimizationStudy, written: Mapping[str, object], locs: Sequence[Loc]
) -> ChangedFields:
    fields = [loc for loc in locs if loc != ("seed",)]
    changes = changed_base(study.experiments["twin"], study.scenario, written, fields)
    seed: dict[str, object] = {"seed": 0, **written}
    return changes + changed_fields(seed, study.document, set(locs) - set(fields))


def _study(
    name: str, document: Document, file: StudyFile, scenario: Scenario
) -> OptimizationStudy:
    base = Experiment(on_plant(scenario.document, "twin"), ("twin",)).with_fixed(
        file.fixed
    )
    experiments = {}
    try:
        compliant = compliant_scenario(parse_scenario(base, name=scenario.name))
        if compliant is not None:
            experiments["compliant"] = Experiment(compliant, ("analytical",))
    except InputError as error:
        document.report(("fixed",), str(error))
    experiments["twin"] = Experiment(base, ("twin",))
    space = DesignSpace(file.variables, base["robot"])
    return OptimizationStudy(name, file, scenario, space, experiments, document.data)


def _check_metrics(document: Document, file: StudyFile) -> None:
    known = metric_units()
    for section in ("objectives", "constraints"):
        for i, entry in enumerate(getattr(file, section)):
            if entry.metric not in known:
                error = UnknownNameError("metric", entry.metric, known, METRICS_LISTED)
                document.report((section, i, "metric"), str(error))


def _check_conflicts(document: Document, file: StudyFile) -> None:
    problem = "this field is also fixed, in `fixed` or with --set; remove one of them"
    for name in file.variables:
        if name in file.fixed:
            document.report(("variables", name), problem, at_key=True)
    metrics = [objective.metric for objective in file.objectives]
    if len(metrics) > len(set(metrics)):
        problem = f"both objectives have the metric {metrics[0]}; remove one of them"
        document.report(("objectives", 1, "metric"), problem)
    allowed: dict[str, tuple[float, float]] = {}
    for i, constraint in enumerate(file.constraints):
        low, high = allowed.get(constraint.metric, (-math.inf, math.inf))
        if constraint.above is not None:
            low = max(low, constraint.above)
        if constraint.below is not None:
            high = min(high, constraint.below)
        if low > high:
            problem = (
                f"the minimum of {constraint.metric}, {low}, exceeds its maximum,"
                f" {high}"
            )
            document.report(("constraints", i), problem)
            continue
        allowed[constraint.metric] = low, high


def _check_range_ends(document: Document, study: OptimizationStudy) -> None:
    points: list[tuple[Loc, Experiment, Changes]] = []
    for i, name in enumerate(study.file.variables):
        for end, fraction in (("low", 0.0), ("high", 1.0)):
            fractions = np.full(study.space.size, 0.5)
            fractions[i] = fraction
            changes = study.space.changes(fractions)
            for experiment in study.experiments.values():
                points.append((("variables", name, end), experiment, changes))
    known = [SEGMENTS, *leaf_names(study.experiments["twin"].base)]
    for loc, problem in problems_at(points):
        document.report(loc, with_suggestion(problem, str(loc[1]), known))
