"""Answer: what the best designs give, how sure that is, and what it is beside the scenario as it stands."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from srs_twin.robot.file import RobotFile
from srs_twin.robot.priors import Priors
from srs_twin.scenario.provenance import versions
from srs_twin.studies.optimization.loading import Study
from srs_twin.studies.optimization.runs import Runs, metric_of
from srs_twin.studies.optimization.search import Optimum, excesses
from srs_twin.studies.sweep.points import Changes
from srs_twin.studies.sweep.task import Row

RESULT, EVALUATIONS, REPORT = "study.json", "evaluations.parquet", "report.html"
PICTURES = ("convergence.png", "front.png", "parallel.png")
PRODUCTS = (RESULT, EVALUATIONS, REPORT, *PICTURES, "best/[0-9]*.yaml")
_SURVIVES = 0.01
"""A result that changes by more than this share as steps and hinges are refined is not one of the robot's."""
_FEWEST = 4  # runs whose order tells anything


@dataclass(frozen=True)
class Answer:
    """What came of a study.

    Attributes:
        study: what was asked.
        optimum: what the search found.
        begun: the scenario as it stands, with the fixed fields, on the twin.
        refined: of each best design, with half of the step and with twice the hinges.
        samples: the scenario as it stands, then each best design, with what is uncertain of the robot drawn:
            the same robots for all of them.
    """

    study: Study
    optimum: Optimum
    begun: Row
    refined: tuple[tuple[Row, Row], ...]
    samples: tuple[tuple[Row, ...], ...] = field(repr=False)

    @classmethod
    def of(cls, study: Study, optimum: Optimum, runs: Runs) -> Answer:
        """Run what an answer needs besides its optimum.

        Raises:
            InputError: a row cannot be kept.
        """
        settings = study.experiments["twin"].document({})["plants"]["twin"]
        finer: list[Changes] = [
            {"plants.twin.timestep_s": settings["timestep_s"] / 2},
            {"plants.twin.hinges_per_segment": 2 * settings["hinges_per_segment"]},
        ]
        designs = [study.space.changes(run.shares) for run in optimum.best]
        begun = runs.rows("twin", [{}])[0]
        rows = runs.rows("twin", [{**design, **more} for design in designs for more in finer])
        refined = tuple((rows[2 * k], rows[2 * k + 1]) for k in range(len(designs)))
        count, drawn = study.file.budget.uncertain, list[list[Row]]()
        if count:
            robots = _robots(study, count)
            every = [{**robot, **design} for design in ({}, *designs) for robot in robots]
            found = runs.rows("twin", every)
            drawn = [found[k * count : (k + 1) * count] for k in range(1 + len(designs))]
        answer = cls(study, optimum, begun, refined, tuple(map(tuple, drawn)))
        return answer if study.file.objectives[0].quantile is None else answer.robust()

    def robust(self) -> Answer:
        """Return it with the best designs in the order of the objective's quantile."""
        objective = self.study.file.objectives[0]
        sign = -1.0 if objective.goal == "maximize" else 1.0
        count = len(self.optimum.best)
        told = [
            np.nanquantile(self._drawn(k + 1, objective.metric), objective.quantile or 0.5)
            for k in range(count)
        ]
        order = np.argsort(sign * np.array(told))
        best = Optimum(tuple(self.optimum.best[k] for k in order), self.optimum.runs)
        samples = (self.samples[0], *(self.samples[k + 1] for k in order))
        return replace(self, optimum=best, refined=tuple(self.refined[k] for k in order), samples=samples)

    def document(self) -> dict[str, Any]:
        """Return plain data of it, as `--json` prints it."""
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
                    "refined": {name: self.change(k, name) for name in names},
                    "survives": self.survives(k),
                    "intervals": {name: self.interval(k, name) for name in names} if self.samples else None,
                    "beats_next": self.beats_next(k),
                    "gains": {o.metric: self.gain(k, o.metric) for o in study.file.objectives},
                }
            )  # fmt: skip
        return {
            "study": study.name, "title": study.title, "best": best, "evaluations": counts,
            "begun": {name: _number(metric_of(self.begun, "twin", name)) for name in names},
            "fidelities": {o.metric: self.likeness(o.metric) for o in study.file.objectives},
            "seed": study.file.seed, "versions": versions(),
        }  # fmt: skip

    def on_bound(self, k: int) -> dict[str, dict[str, Any]]:
        """Return the variables of a best design that lie on a bound.

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
        """Objectives, then what has to be kept."""
        file = self.study.file
        wanted = [each.metric for each in file.objectives]
        return tuple(dict.fromkeys([*wanted, *(each.metric for each in file.constraints)]))

    def change(self, k: int, name: str) -> float | None:
        """Return by which share a metric of a best design changes at most as it is refined."""
        value = self.optimum.best[k].metric(name)
        rows = [metric_of(row, "twin", name) for row in self.refined[k]]
        return _number(max(abs(each - value) for each in rows) / max(abs(value), 1e-12))

    def survives(self, k: int) -> bool:
        """Say whether no objective of a best design changes by more than 1 % as it is refined."""
        changes = [self.change(k, each.metric) for each in self.study.file.objectives]
        return all(each is not None and each <= _SURVIVES for each in changes)

    def interval(self, k: int, name: str) -> list[float | None]:
        """Return the ends of 95 % of a metric of a best design under what is uncertain of the robot."""
        return _ends(self._drawn(k + 1, name))

    def beats_next(self, k: int) -> float | None:
        """Return for which share of the drawn robots a design is better than the next; None: not known."""
        if not self.samples or len(self.study.file.objectives) > 1 or k + 2 >= len(self.samples):
            return None
        objective = self.study.file.objectives[0]
        mine, other = (self._drawn(which, objective.metric) for which in (k + 1, k + 2))
        return float(np.mean(mine > other if objective.goal == "maximize" else mine < other))

    def gain(self, k: int, name: str) -> dict[str, Any]:
        """Return by which share a best design is above the scenario as it stands, and 95 % of that."""
        value, before = self.optimum.best[k].metric(name), metric_of(self.begun, "twin", name)
        found: dict[str, Any] = {"share": _number(value / before - 1), "interval_95": None}
        if self.samples:
            found["interval_95"] = _ends(self._drawn(k + 1, name) / self._drawn(0, name) - 1)
        return found

    def likeness(self, name: str) -> dict[str, float | None] | None:
        """Return how both fidelities order designs that both have run: of all, and of the better half."""
        from scipy.stats import spearmanr

        cheap = {run.shares.tobytes(): run for run in self.optimum.runs if run.part == "compliant"}
        both = [
            (cheap[run.shares.tobytes()].metric(name), run.metric(name))
            for run in self.optimum.runs
            if run.part == "twin" and run.shares.tobytes() in cheap
        ]
        pairs = np.array([pair for pair in both if all(map(math.isfinite, pair))]).reshape(-1, 2)
        if len(pairs) < 2 * _FEWEST:
            return None
        goal = next(o.goal for o in self.study.file.objectives if o.metric == name)
        order = np.argsort(-pairs[:, 1] if goal == "maximize" else pairs[:, 1])
        near = pairs[order[: len(order) // 2]]
        return {
            what: _number(float(spearmanr(*each.T)[0])) for what, each in (("all", pairs), ("near", near))
        }

    @cached_property
    def table(self) -> Mapping[str, list[Any]]:
        """All runs in their order, a column each: part, variables, status, reason, metrics."""
        study, runs = self.study, self.optimum.runs
        columns: dict[str, list[Any]] = {"part": [run.part for run in runs]}
        values = [study.space.values(run.shares) for run in runs]
        columns |= {name: [float(row[i]) for row in values] for i, name in enumerate(study.space.variables)}
        columns |= {"status": [run.row.status for run in runs], "reason": [run.row.reason for run in runs]}
        names = dict.fromkeys(key.partition(".")[2] for run in runs for key in run.row.values)
        columns |= {name: [_number(run.metric(name)) for run in runs] for name in names}
        return columns

    def _drawn(self, which: int, name: str) -> np.ndarray:
        return np.array([metric_of(row, "twin", name) for row in self.samples[which]])


def _robots(study: Study, count: int) -> list[Changes]:
    """Return so many draws of what is uncertain of the robot, but for what the study chooses."""
    from scipy.stats import qmc

    robot = RobotFile.model_validate(study.experiments["twin"].base["robot"])
    chosen = [name.removeprefix("robot.") for name in study.space.changes(np.full(study.space.size, 0.5))]
    priors = Priors.of(robot, without=[each for each in Priors.of(robot).paths if each in chosen])
    shares = qmc.Sobol(len(priors.paths), rng=study.file.seed).random_base2(max(count - 1, 1).bit_length())
    return [
        {f"robot.{path}": float(value) for path, value in zip(priors.paths, row, strict=True)}
        for row in priors.at(shares[:count])
    ]


def _ends(values: np.ndarray) -> list[float | None]:
    known = values[np.isfinite(values)]
    return (
        [_number(float(each)) for each in np.quantile(known, (0.025, 0.975))] if len(known) else [None, None]
    )


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
