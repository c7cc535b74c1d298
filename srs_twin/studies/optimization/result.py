"""Result of an optimisation: best designs with their accuracy and gains."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypedDict

import numpy as np

from srs_twin.identification.priors import Priors
from srs_twin.io.files import STUDY_RESULT
from srs_twin.plants.twin.mjcf.numerics import stable_step
from srs_twin.robot.file import RobotFile
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.plants import TwinFile
from srs_twin.scenario.provenance import versions
from srs_twin.studies.optimization.loading import ObjectiveFile, OptimizationStudy
from srs_twin.studies.optimization.runs import Run, StudyRuns, metric_of
from srs_twin.studies.optimization.search import MAX_IMPROVEMENT, Optimum, excesses
from srs_twin.studies.sweep.points import Changes, Value, sobol_points
from srs_twin.studies.sweep.task import Row

EVALUATIONS = "evaluations.parquet"

REPORT = "report.html"

PICTURES = ("convergence.png", "front.png", "parallel.png")

PRODUCTS = (STUDY_RESULT, EVALUATIONS, REPORT, *PICTURES, "best/[0-9]*.yaml")

_MAX_REFINEMENT_CHANGE = 0.01
"""Maximum relative change of a converged result due to a refinement of the model."""

_MIN_RANKED = 4
"""Minimum number of designs for a rank correlation."""


class Gain(TypedDict):
    """Relative gain over the initial scenario, with its 95 % interval."""

    fraction: float | None
    interval_95: list[float | None] | None


class Bound(TypedDict):
    """Bound that a design variable reaches, with the physical reason for the bound."""

    bound: str
    value: float
    source: str | None


class DesignDocument(TypedDict):
    """JSON representation of one of the best designs."""

    variables: dict[str, float]
    metrics: dict[str, float | None]
    plant: str
    scenario: str
    keeps_constraints: bool
    on_bound: dict[str, Bound]
    refined: dict[str, float | None]
    survives: bool
    intervals: dict[str, list[float | None]] | None
    beats_next: float | None
    gains: dict[str, Gain]


class StudyDocument(TypedDict):
    """JSON representation of a study result."""

    study: str
    title: str
    best: list[DesignDocument]
    evaluations: dict[str, int]
    without_value: dict[str, int]
    begun: dict[str, float | None]
    expected_improvement: float | None
    warning: str | None
    fidelities: dict[str, dict[str, float | None] | None]
    seed: int
    versions: dict[str, str]


@dataclass(frozen=True)
class EvaluatedDesign:
    """Design with additional runs that quantify its accuracy and robustness.

    Attributes:
        refined: one run with half the time step and one with twice the number of
            hinges, or an empty tuple for the initial scenario.
        samples: runs with random robots, which are identical for all designs.
    """

    run: Run
    refined: tuple[Row, ...]
    samples: tuple[Row, ...] = field(repr=False)

    def sampled(self, name: str) -> np.ndarray:
        """Return a metric of the runs with random robots, shape (samples,)."""
        return np.array([metric_of(row, "twin", name) for row in self.samples])

    def refinement_change(self, name: str) -> float | None:
        """Return the larger relative change of a metric due to the two refinements."""
        value = self.run.metric(name)
        refined = [metric_of(row, "twin", name) for row in self.refined]
        return _number(
            max(abs(other - value) for other in refined) / max(abs(value), 1e-12)
        )


@dataclass(frozen=True)
class StudyResult:
    """Result of an optimisation study.

    Attributes:
        study: study that defines the optimisation.
        runs: all runs of the search.
        initial: initial scenario, including the fixed fields of the study.
        designs: best designs, sorted from best to worst, or designs on the Pareto
            front, sorted by the first objective.
        files: names of the written files.
        improvement: expected improvement from one more run (see `Optimum`).
    """

    study: OptimizationStudy
    runs: tuple[Run, ...]
    initial: EvaluatedDesign
    designs: tuple[EvaluatedDesign, ...]
    files: tuple[str, ...] = ()
    improvement: float | None = None

    @classmethod
    def evaluate(
        cls, study: OptimizationStudy, optimum: Optimum, runs: StudyRuns
    ) -> StudyResult:
        """Perform the additional runs for the initial scenario and the best designs.

        Raises:
            InputError: a result row cannot be stored.
        """
        settings = _twin_settings(study)
        refinements: list[Changes] = [
            {"plants.twin.timestep_s": settings.timestep_s / 2},
            {"plants.twin.hinges_per_segment": 2 * settings.hinges_per_segment},
        ]
        designs = [study.space.changes(run.fractions) for run in optimum.best]
        initial = Run("twin", np.zeros(0), runs.rows("twin", [{}])[0])
        refined = runs.rows(
            "twin", [{**design, **fine} for design in designs for fine in refinements]
        )
        robots = _draw_robots(study, study.file.budget.uncertain)
        sampled = runs.rows(
            "twin",
            [{**robot, **design} for design in ({}, *designs) for robot in robots],
        )
        first, *samples = _in_groups(sampled, len(robots), 1 + len(designs))
        fine = _in_groups(refined, len(refinements), len(designs))
        result = cls(
            study,
            optimum.runs,
            EvaluatedDesign(initial, (), first),
            tuple(map(EvaluatedDesign, optimum.best, fine, samples)),
            improvement=optimum.improvement,
        )
        return result.ranked_by_quantile()

    def ranked_by_quantile(self) -> StudyResult:
        """Return the result with the designs ranked by the quantile, if there is one."""
        objective = self.study.file.objectives[0]
        if objective.quantile is None:
            return self
        samples = [design.sampled(objective.metric) for design in self.designs]
        quantiles = np.nanquantile(samples, objective.quantile, axis=1)
        order = np.argsort(objective.sign * quantiles)
        return replace(self, designs=tuple(self.designs[k] for k in order))

    def document(self) -> StudyDocument:
        """Return the result as JSON-compatible data."""
        study = self.study
        parts = [run.part for run in self.runs]
        return {
            "study": study.name,
            "title": study.title,
            "best": [self._design_document(k) for k in range(len(self.designs))],
            "evaluations": {part: parts.count(part) for part in study.experiments},
            "without_value": {
                part: self._count_without_value(part) for part in study.experiments
            },
            "begun": {
                name: _number(self.initial.run.metric(name)) for name in self.metrics
            },
            "expected_improvement": self.improvement,
            "warning": self.warning,
            "fidelities": {
                objective.metric: self._fidelity_correlation(objective)
                for objective in study.file.objectives
            },
            "seed": study.file.seed,
            "versions": versions(),
        }

    def _count_without_value(self, part: str) -> int:
        """Return the number of runs that failed or lack a metric."""
        return sum(
            any(math.isnan(run.metric(name)) for name in self.metrics)
            for run in self.runs
            if run.part == part
        )

    @property
    def warning(self) -> str | None:
        """Warning that the search ended too early, or None."""
        budget = self.study.file.budget
        parts = [run.part for run in self.runs]
        if parts.count("twin") < budget.twin:
            text = (
                f"The search ended after {parts.count('twin')} of {budget.twin} runs of"
                " the twin, because no other design was found"
            )
            if parts.count("compliant") >= budget.compliant:
                text += " among those of the model compliant; raise budget.compliant"
            return f"{text}."
        if self.improvement is None or self.improvement <= MAX_IMPROVEMENT:
            return None
        gain = f"{100 * self.improvement:.1f} %"
        return (
            "The budget ended the search, although one more run of the twin is"
            f" expected to improve the best result by {gain}; raise budget.twin."
        )

    def _design_document(self, k: int) -> DesignDocument:
        study = self.study
        names = self.metrics
        design = self.designs[k]
        objectives = [objective.metric for objective in study.file.objectives]
        changes = {name: design.refinement_change(name) for name in names}
        values = study.space.values(design.run.fractions)
        intervals = None
        if design.samples:
            intervals = {name: _interval_95(design.sampled(name)) for name in names}
        return {
            "variables": dict(zip(study.space.variables, values, strict=True)),
            "metrics": {name: _number(design.run.metric(name)) for name in names},
            "plant": "twin",
            "scenario": f"best/{k + 1}.yaml",
            "keeps_constraints": bool((excesses(study, [design.run]) <= 0).all()),
            "on_bound": self._on_bound(design),
            "refined": changes,
            "survives": all(
                (change := changes[name]) is not None
                and change <= _MAX_REFINEMENT_CHANGE
                for name in objectives
            ),
            "intervals": intervals,
            "beats_next": self._beats_next(k),
            "gains": {name: self._gain(design, name) for name in objectives},
        }

    def _on_bound(self, design: EvaluatedDesign) -> dict[str, Bound]:
        variables = self.study.space.variables
        return {
            name: {
                "bound": bound,
                "value": getattr(variables[name], bound),
                "source": variables[name].bounds_source,
            }
            for name, bound in self.study.space.bounds(design.run.fractions).items()
        }

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the objective metrics, followed by the constrained metrics."""
        objectives = [objective.metric for objective in self.study.file.objectives]
        constraints = [constraint.metric for constraint in self.study.file.constraints]
        return tuple(dict.fromkeys([*objectives, *constraints]))

    def _beats_next(self, k: int) -> float | None:
        objective, *others = self.study.file.objectives
        if not self.designs[k].samples or others or k + 1 >= len(self.designs):
            return None
        this, following = (
            objective.sign * design.sampled(objective.metric)
            for design in self.designs[k : k + 2]
        )
        return float(np.mean(this < following))

    def _gain(self, design: EvaluatedDesign, name: str) -> Gain:
        fraction = design.run.metric(name) / self.initial.run.metric(name) - 1
        interval = None
        if design.samples:
            interval = _interval_95(
                design.sampled(name) / self.initial.sampled(name) - 1
            )
        return {"fraction": _number(fraction), "interval_95": interval}

    def _fidelity_correlation(
        self, objective: ObjectiveFile
    ) -> dict[str, float | None] | None:
        """Return the rank correlation of an objective between the two models.

        The key "all" refers to all designs, and "near" refers to the better half.
        """
        from scipy.stats import spearmanr

        values: dict[str, dict[bytes, float]] = {"compliant": {}, "twin": {}}
        for run in self.runs:
            values[run.part][run.fractions.tobytes()] = run.metric(objective.metric)
        pairs = np.array(
            [
                (values["compliant"].get(design, math.nan), value)
                for design, value in values["twin"].items()
            ]
        )
        pairs = pairs[np.isfinite(pairs).all(axis=1)]
        if len(pairs) < 2 * _MIN_RANKED:
            return None
        order = np.argsort(objective.sign * pairs[:, 1])
        better_half = pairs[order[: len(order) // 2]]
        return {
            key: _number(float(spearmanr(*sample.T)[0]))
            for key, sample in (("all", pairs), ("near", better_half))
        }

    @cached_property
    def table(self) -> Mapping[str, Sequence[object]]:
        """Columns of the run table, keyed by name."""
        space = self.study.space
        runs = self.runs
        columns: dict[str, Sequence[object]] = {"part": [run.part for run in runs]}
        values = np.array([space.values(run.fractions) for run in runs], dtype=float)
        columns |= dict(zip(space.variables, values.T.tolist(), strict=True))
        columns["status"] = [run.row.status for run in runs]
        columns["reason"] = [run.row.reason for run in runs]
        names = dict.fromkeys(
            key.partition(".")[2] for run in runs for key in run.row.values
        )
        columns |= {name: [_number(run.metric(name)) for run in runs] for name in names}
        return columns


def _in_groups(rows: list[Row], size: int, count: int) -> list[tuple[Row, ...]]:
    return [tuple(rows[k * size : (k + 1) * size]) for k in range(count)]


def _draw_robots(study: OptimizationStudy, count: int) -> list[dict[str, Value]]:
    if not count:
        return []
    robot = RobotFile.model_validate(study.experiments["twin"].base["robot"])
    middle = study.space.changes(np.full(study.space.size, 0.5))
    paths = Priors.from_robot(robot).paths
    chosen = [path for path in paths if f"robot.{path}" in middle]
    priors = Priors.from_robot(robot, exclude=chosen)
    values = priors.quantile(sobol_points(len(priors.paths), count, study.file.seed))
    names = [f"robot.{path}" for path in priors.paths]
    robots = [dict(zip(names, row, strict=True)) for row in values.tolist()]
    if (name := "robot.bending.damping_time_s") in names:
        step = _twin_settings(study).timestep_s
        for each in robots:
            each["plants.twin.timestep_s"] = stable_step(step, float(each[name]))
    return robots


def _twin_settings(study: OptimizationStudy) -> TwinFile:
    # A document with a preset does not contain the time step of the preset.
    scenario = parse_scenario(study.experiments["twin"].document({}), name="")
    assert scenario.file.plants.twin is not None
    return scenario.file.plants.twin


def _interval_95(values: np.ndarray) -> list[float | None]:
    known = values[np.isfinite(values)]
    if not len(known):
        return [None, None]
    return [_number(float(bound)) for bound in np.quantile(known, (0.025, 0.975))]


def _number(value: float) -> float | None:
    if math.isfinite(value):
        return float(value)
    return None
