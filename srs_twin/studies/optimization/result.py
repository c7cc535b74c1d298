"""Result of a study: best designs, their accuracy and robustness, gains over the initial scenario."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from srs_twin.identification.priors import Priors
from srs_twin.robot.file import RobotFile
from srs_twin.scenario.provenance import versions
from srs_twin.studies.optimization.loading import OptimizationStudy
from srs_twin.studies.optimization.runs import StudyRuns, metric_of
from srs_twin.studies.optimization.search import Optimum, excesses
from srs_twin.studies.sweep.points import Changes
from srs_twin.studies.sweep.task import Row

RESULT, EVALUATIONS, REPORT = "study.json", "evaluations.parquet", "report.html"
PICTURES = ("convergence.png", "front.png", "parallel.png")
PRODUCTS = (RESULT, EVALUATIONS, REPORT, *PICTURES, "best/[0-9]*.yaml")

_MAX_REFINEMENT_CHANGE = 0.01
"""Largest relative change due to a refinement of the twin at which a result counts as converged."""

_MIN_RANKED = 4
"""Smallest number of runs for a rank correlation."""


@dataclass(frozen=True)
class StudyResult:
    """Result of a study.

    Attributes:
        study: study.
        optimum: result of the search.
        initial: unmodified scenario with the fixed fields, on the twin.
        refined: each best design with half the time step, and with twice the hinges.
        samples: the unmodified scenario, then each best design, with the same draws of the robot's uncertain
            parameters.
    """

    study: OptimizationStudy
    optimum: Optimum
    initial: Row
    refined: tuple[tuple[Row, Row], ...]
    samples: tuple[tuple[Row, ...], ...] = field(repr=False)

    @classmethod
    def evaluate(cls, study: OptimizationStudy, optimum: Optimum, runs: StudyRuns) -> StudyResult:
        """Run the initial scenario, refinements and samples of the best designs.

        Raises:
            InputError: a row cannot be written.
        """
        settings = study.experiments["twin"].document({})["plants"]["twin"]
        refinements: list[Changes] = [
            {"plants.twin.timestep_s": settings["timestep_s"] / 2},
            {"plants.twin.hinges_per_segment": 2 * settings["hinges_per_segment"]},
        ]
        designs = [study.space.changes(run.shares) for run in optimum.best]
        initial = runs.rows("twin", [{}])[0]
        rows = runs.rows("twin", [{**design, **fine} for design in designs for fine in refinements])
        refined = tuple((rows[2 * k], rows[2 * k + 1]) for k in range(len(designs)))
        count, samples = study.file.budget.uncertain, list[list[Row]]()
        if count:
            robots = _draw_robots(study, count)
            changes = [{**robot, **design} for design in ({}, *designs) for robot in robots]
            rows = runs.rows("twin", changes)
            samples = [rows[k * count : (k + 1) * count] for k in range(1 + len(designs))]
        result = cls(study, optimum, initial, refined, tuple(map(tuple, samples)))
        return result if study.file.objectives[0].quantile is None else result.ranked_by_quantile()

    def ranked_by_quantile(self) -> StudyResult:
        """Return the result with the best designs ranked by the objective's quantile over the samples."""
        objective = self.study.file.objectives[0]
        sign = -1.0 if objective.goal == "maximize" else 1.0
        count = len(self.optimum.best)
        quantiles = [
            np.nanquantile(self._samples(k + 1, objective.metric), objective.quantile or 0.5)
            for k in range(count)
        ]
        order = np.argsort(sign * np.array(quantiles))
        best = Optimum(tuple(self.optimum.best[k] for k in order), self.optimum.runs)
        samples = (self.samples[0], *(self.samples[k + 1] for k in order))
        return replace(self, optimum=best, refined=tuple(self.refined[k] for k in order), samples=samples)

    def document(self) -> dict[str, Any]:
        """Return the result as JSON values, as `--json` prints it."""
        study, names = self.study, self.metrics
        counts = {part: sum(run.part == part for run in self.optimum.runs) for part in study.experiments}
        best = []
        for k, run in enumerate(self.optimum.best):
            metrics = {name: _number(run.metric(name)) for name in names}
            values = study.space.values(run.shares)
            best.append(
                {
                    "variables": dict(zip(study.space.variables, values, strict=True)),
                    "metrics": metrics, "plant": "twin", "scenario": f"best/{k + 1}.yaml",
                    "keeps_constraints": bool((excesses(study, [run]) <= 0).all()),
                    "on_bound": self.on_bound(k),
                    "refined": {name: self.refinement_change(k, name) for name in names},
                    "survives": self.is_converged(k),
                    "intervals": {name: self.interval(k, name) for name in names} if self.samples else None,
                    "beats_next": self.beats_next(k),
                    "gains": {o.metric: self.gain(k, o.metric) for o in study.file.objectives},
                }
            )  # fmt: skip
        return {
            "study": study.name, "title": study.title, "best": best, "evaluations": counts,
            "begun": {name: _number(metric_of(self.initial, "twin", name)) for name in names},
            "fidelities": {o.metric: self.fidelity_correlation(o.metric) for o in study.file.objectives},
            "seed": study.file.seed, "versions": versions(),
        }  # fmt: skip

    def on_bound(self, k: int) -> dict[str, dict[str, object]]:
        """Return the variables of a best design that are on a bound.

        Returns:
            Variable → `bound` ("low" or "high"), its `value`, and the `source` of the bounds or None.
        """
        variables = self.study.file.variables
        return {
            name: {
                "bound": bound,
                "value": getattr(variables[name], bound),
                "source": variables[name].bounds_source,
            }
            for name, bound in self.study.space.bounds(self.optimum.best[k].shares).items()
        }

    @property
    def metrics(self) -> tuple[str, ...]:
        """Metrics of the objectives, then of the constraints."""
        file = self.study.file
        objectives = [objective.metric for objective in file.objectives]
        return tuple(dict.fromkeys([*objectives, *(constraint.metric for constraint in file.constraints)]))

    def refinement_change(self, k: int, name: str) -> float | None:
        """Return the largest relative change of a best design's metric by a refinement of the twin."""
        value = self.optimum.best[k].metric(name)
        refined = [metric_of(row, "twin", name) for row in self.refined[k]]
        return _number(max(abs(other - value) for other in refined) / max(abs(value), 1e-12))

    def is_converged(self, k: int) -> bool:
        """Return whether no objective of a best design changes by more than 1 % by a refinement."""
        changes = [self.refinement_change(k, objective.metric) for objective in self.study.file.objectives]
        return all(change is not None and change <= _MAX_REFINEMENT_CHANGE for change in changes)

    def interval(self, k: int, name: str) -> list[float | None]:
        """Return the 95 % interval of a best design's metric over the robot's uncertain parameters."""
        return _interval_95(self._samples(k + 1, name))

    def beats_next(self, k: int) -> float | None:
        """Return the fraction of drawn robots for which a design is better than the next; None if unknown."""
        if not self.samples or len(self.study.file.objectives) > 1 or k + 2 >= len(self.samples):
            return None
        objective = self.study.file.objectives[0]
        this, following = (self._samples(index, objective.metric) for index in (k + 1, k + 2))
        return float(np.mean(this > following if objective.goal == "maximize" else this < following))

    def gain(self, k: int, name: str) -> dict[str, object]:
        """Return the relative gain of a best design over the initial scenario, and its 95 % interval."""
        value, before = self.optimum.best[k].metric(name), metric_of(self.initial, "twin", name)
        gain: dict[str, object] = {"share": _number(value / before - 1), "interval_95": None}
        if self.samples:
            gain["interval_95"] = _interval_95(self._samples(k + 1, name) / self._samples(0, name) - 1)
        return gain

    def fidelity_correlation(self, name: str) -> dict[str, float | None] | None:
        """Return the rank correlations of a metric between the fidelities, for all and the better designs.

        It is None if too few designs were run at both fidelities.
        """
        from scipy.stats import spearmanr

        compliant = {run.shares.tobytes(): run for run in self.optimum.runs if run.part == "compliant"}
        both = [
            (compliant[run.shares.tobytes()].metric(name), run.metric(name))
            for run in self.optimum.runs
            if run.part == "twin" and run.shares.tobytes() in compliant
        ]
        pairs = np.array([pair for pair in both if all(map(math.isfinite, pair))]).reshape(-1, 2)
        if len(pairs) < 2 * _MIN_RANKED:
            return None
        goal = next(o.goal for o in self.study.file.objectives if o.metric == name)
        order = np.argsort(-pairs[:, 1] if goal == "maximize" else pairs[:, 1])
        better_half = pairs[order[: len(order) // 2]]
        return {
            key: _number(float(spearmanr(*sample.T)[0]))
            for key, sample in (("all", pairs), ("near", better_half))
        }

    @cached_property
    def table(self) -> Mapping[str, list[Any]]:
        """All runs in order, as columns: part, variables, status, reason, metrics."""
        study, runs = self.study, self.optimum.runs
        columns: dict[str, list[Any]] = {"part": [run.part for run in runs]}
        values = [study.space.values(run.shares) for run in runs]
        columns |= {name: [float(row[i]) for row in values] for i, name in enumerate(study.space.variables)}
        columns |= {"status": [run.row.status for run in runs], "reason": [run.row.reason for run in runs]}
        names = dict.fromkeys(key.partition(".")[2] for run in runs for key in run.row.values)
        columns |= {name: [_number(run.metric(name)) for run in runs] for name in names}
        return columns

    def _samples(self, index: int, name: str) -> np.ndarray:
        return np.array([metric_of(row, "twin", name) for row in self.samples[index]])


def _draw_robots(study: OptimizationStudy, count: int) -> list[Changes]:
    """Draw the robot's uncertain parameters, except those that are variables of the study."""
    from scipy.stats import qmc

    robot = RobotFile.model_validate(study.experiments["twin"].base["robot"])
    chosen = [name.removeprefix("robot.") for name in study.space.changes(np.full(study.space.size, 0.5))]
    priors = Priors.from_robot(
        robot, without=[path for path in Priors.from_robot(robot).paths if path in chosen]
    )
    shares = qmc.Sobol(len(priors.paths), rng=study.file.seed).random_base2(max(count - 1, 1).bit_length())
    return [
        {f"robot.{path}": float(value) for path, value in zip(priors.paths, row, strict=True)}
        for row in priors.quantile(shares[:count])
    ]


def _interval_95(values: np.ndarray) -> list[float | None]:
    known = values[np.isfinite(values)]
    if not len(known):
        return [None, None]
    return [_number(float(bound)) for bound in np.quantile(known, (0.025, 0.975))]


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
