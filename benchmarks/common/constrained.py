"""Searches with one constraint, whose optimum is known from interpolated gaits.

Frequency and phase of the gait of gen2_straight are varied. Both plants simulate a
regular grid of these gaits, and cubic splines interpolate their metrics. The searches
get their runs from the splines, so that a search takes seconds, and the true optimum
is the best of 1,000 by 1,000 gaits of the same splines.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from common.grid import table
from scipy.interpolate import RectBivariateSpline

from srs_twin.compute.workers import TaskResult
from srs_twin.studies.optimization.loading import OptimizationStudy, load_study
from srs_twin.studies.optimization.runs import PLANTS, Run, StudyRuns, metric_of
from srs_twin.studies.optimization.search import (
    MAX_IMPROVEMENT,
    costs,
    excesses,
    search,
)
from srs_twin.studies.sweep.execution import local
from srs_twin.studies.sweep.points import Experiment, Point
from srs_twin.studies.sweep.task import DONE, Row

FREQUENCY = "controller.frequency_hz"
PHASE = "controller.phase_step_rad"
LOW = np.array([0.5, 0.4])
HIGH = np.array([3.0, 2.6])
SPEED = "com_speed_m_s"
POWER = "pneumatic_power_w"
AMPLITUDE = "mean_bend_amplitude_rad"
FASTEST = f"{{metric: {SPEED}, goal: maximize}}"
LEAST_POWER = f"{{metric: {POWER}, goal: minimize}}"

STUDY = f"""
title: Search with one constraint
scenario: gen2_straight
fixed: {{duration_s: 8}}
variables:
  {FREQUENCY}: {{low: {LOW[0]}, high: {HIGH[0]}}}
  {PHASE}: {{low: {LOW[1]}, high: {HIGH[1]}}}
objectives: [OBJECTIVE]
constraints: [CONSTRAINT]
budget: {{compliant: 200, twin: RUNS}}
"""


@dataclass(frozen=True)
class Question:
    """A study with one constraint."""

    name: str
    objective: str
    constraint: str

    def study(self, folder: Path, runs: int) -> OptimizationStudy:
        """Return the study with a number of twin runs."""
        text = STUDY.replace("OBJECTIVE", self.objective)
        text = text.replace("CONSTRAINT", self.constraint).replace("RUNS", str(runs))
        path = folder / "constrained.yaml"
        path.write_text(text, "utf-8")
        return load_study(path)


QUESTIONS = (
    Question("fastest below 22 W", FASTEST, f"{{metric: {POWER}, below: 22}}"),
    Question("fastest below 23.5 W", FASTEST, f"{{metric: {POWER}, below: 23.5}}"),
    Question("fastest below 26 W", FASTEST, f"{{metric: {POWER}, below: 26}}"),
    Question(
        "fastest with bends above 1.18 rad",
        FASTEST,
        f"{{metric: {AMPLITUDE}, above: 1.18}}",
    ),
    Question(
        "least power above 0.25 m/s", LEAST_POWER, f"{{metric: {SPEED}, above: 0.25}}"
    ),
)


class Gaits:
    """Interpolated metrics of both plants; called as the engine of a study."""

    def __init__(self, study: OptimizationStudy, points: int, out: Path) -> None:
        frequencies = np.linspace(LOW[0], HIGH[0], points)
        phases = np.linspace(LOW[1], HIGH[1], points)
        changes = [{FREQUENCY: f, PHASE: p} for f in frequencies for p in phases]
        self._splines: dict[tuple[str, str], RectBivariateSpline] = {}
        with StudyRuns(study, out, local()) as runs:
            for part in PLANTS:
                rows = runs.rows(part, changes)
                for metric in (SPEED, POWER, AMPLITUDE):
                    values = np.array([metric_of(row, part, metric) for row in rows])
                    self._splines[part, metric] = RectBivariateSpline(
                        frequencies, phases, values.reshape(points, points)
                    )

    def row(self, part: str, key: str, frequency: float, phase: float) -> Row:
        """Return the interpolated metrics of a gait as the result of a run."""
        values = {
            f"{PLANTS[part]}.{metric}": float(spline(frequency, phase)[0, 0])
            for (known, metric), spline in self._splines.items()
            if known == part
        }
        return Row(key, DONE, values)

    def __call__(
        self, experiment: Experiment, points: Sequence[Point]
    ) -> Iterator[TaskResult[Row]]:
        """Yield the results of the points."""
        (plant,) = experiment.plants
        part = "twin" if plant == "twin" else "compliant"
        for number, point in enumerate(points):
            changes = point.changes
            row = self.row(part, point.key, changes[FREQUENCY], changes[PHASE])
            yield TaskResult(number, row, None)

    def optimum(self, study: OptimizationStudy) -> float:
        """Return the smallest cost of the twin among 1,000 by 1,000 gaits."""
        frequencies = np.linspace(LOW[0], HIGH[0], 1000)
        phases = np.linspace(LOW[1], HIGH[1], 1000)
        goal = study.file.objectives[0]
        cost = goal.sign * self._splines["twin", goal.metric](frequencies, phases)
        limit = study.file.constraints[0]
        values = self._splines["twin", limit.metric](frequencies, phases)
        feasible = np.ones_like(values, dtype=bool)
        if limit.below is not None:
            feasible &= values <= limit.below
        if limit.above is not None:
            feasible &= values >= limit.above
        return float(cost[feasible].min())


def best_cost(study: OptimizationStudy, best: Run) -> float:
    """Return the cost of the best run, or infinity if it violates the constraint."""
    if excesses(study, [best]).max() > 0:
        return np.inf
    return float(costs(study, [best])[0, 0])


@dataclass(frozen=True)
class Searched:
    """Result of one search.

    Attributes:
        error: difference between the best cost and the optimum, relative to the
            optimum; negative if the best run lies between the 1,000 by 1,000 gaits.
        improvement: expected improvement that the search states.
    """

    error: float
    improvement: float | None

    @property
    def warned(self) -> bool:
        """Whether the search warned, or had no feasible run."""
        return self.improvement is None or self.improvement > MAX_IMPROVEMENT


def searched(gaits: Gaits, question: Question, runs: int, seed: int) -> Searched:
    """Search once."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        study = question.study(folder, runs)
        study = replace(study, file=study.file.model_copy(update={"seed": seed}))
        with StudyRuns(study, folder / "runs", gaits) as stored:
            found = search(study, stored)
    truth = gaits.optimum(study)
    error = (best_cost(study, found.best[0]) - truth) / abs(truth)
    return Searched(error, found.improvement)


def compared(question: Question, optimum: float, results: list[Searched]) -> list[str]:
    """Return a row of the table."""
    near = [result for result in results if result.error <= 0.02]
    far = [result for result in results if result.error > 0.02]
    return [
        question.name,
        f"{abs(optimum):.4g}",
        f"{len(near)} of {len(results)}",
        f"{100 * max(result.error for result in results):.1f} %",
        str(sum(result.warned for result in near)),
        str(sum(not result.warned for result in far)),
    ]


def constrained_searches(seeds: range, points: int, runs: int, out: Path) -> str:
    """Search with each seed and each constraint, and return a Markdown table.

    Args:
        seeds: seeds of the searches.
        points: number of simulated gaits per variable.
        runs: number of twin runs per search.
        out: folder of the simulations.
    """
    with tempfile.TemporaryDirectory() as name:
        studies = [question.study(Path(name), runs) for question in QUESTIONS]
    gaits = Gaits(studies[0], points, out)
    rows = []
    with ProcessPoolExecutor(max_workers=os.cpu_count()) as pool:
        for question, study in zip(QUESTIONS, studies, strict=True):
            results = list(pool.map(partial(searched, gaits, question, runs), seeds))
            for seed, result in zip(seeds, results, strict=True):
                print(f"{question.name} {seed} {100 * result.error:.2f} %", flush=True)
            rows.append(compared(question, gaits.optimum(study), results))
    head = [
        "constrained search",
        "optimum",
        "within 2 %",
        "largest error",
        "warnings of these",
        "others without a warning",
    ]
    return table(head, rows)
