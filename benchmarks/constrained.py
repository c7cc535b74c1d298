"""Error of constrained optima of the two-fidelity search, and its warnings.

uv run python benchmarks/constrained.py [--seeds 20] [--runs 30] [--out
runs/constrained]

Both fidelities run a grid of 25 frequencies and 19 phase steps of gen2_straight once.
The searches then read cubic splines through the grid instead of simulating, so that
many seeds cost little, and the optimum is that of the same splines at 400 x 400 points.
The constraint of each study is active at its optimum.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from grid import table
from scipy.interpolate import RectBivariateSpline

from srs_twin.compute.workers import TaskResult
from srs_twin.studies.optimization.loading import OptimizationStudy, load_study
from srs_twin.studies.optimization.runs import PLANTS, StudyRuns
from srs_twin.studies.optimization.search import (
    MAX_IMPROVEMENT,
    Optimum,
    excesses,
    search,
)
from srs_twin.studies.sweep.execution import local
from srs_twin.studies.sweep.points import Experiment, Point
from srs_twin.studies.sweep.task import DONE, Row

STUDY = """
title: Fastest gait within a limit
scenario: gen2_straight
fixed: {{duration_s: 5}}
variables:
  controller.frequency_hz: {{low: 1.0, high: 3.0}}
  controller.phase_step_rad: {{low: 0.4, high: 2.6}}
objectives: [{{metric: {objective}, goal: {goal}}}]
constraints: [{constraints}]
budget: {{compliant: 200, twin: {runs}}}
"""
METRICS = ("com_speed_m_s", "pneumatic_power_w", "mean_bend_amplitude_rad")


@dataclass(frozen=True)
class Limited:
    """Study with one constraint, which is active at its optimum."""

    objective: str
    goal: str
    metric: str
    side: str
    limit: float


STUDIES = (
    Limited("com_speed_m_s", "maximize", "pneumatic_power_w", "below", 23.5),
    Limited("com_speed_m_s", "maximize", "mean_bend_amplitude_rad", "above", 1.18),
    Limited("pneumatic_power_w", "minimize", "com_speed_m_s", "above", 0.25),
)
GRID = np.linspace(0, 1, 25), np.linspace(0, 1, 19)
FINE = np.linspace(0, 1, 400)
WITHIN = 0.02

Splines = dict[tuple[str, str], RectBivariateSpline]
"""(fidelity, metric) → spline of the metric over both variables, as fractions of their ranges."""


def loaded(folder: Path, runs: int, limited: Limited) -> OptimizationStudy:
    path = folder / "limited.yaml"
    constraint = f"{{metric: {limited.metric}, {limited.side}: {limited.limit}}}"
    text = STUDY.format(
        objective=limited.objective,
        goal=limited.goal,
        constraints=constraint,
        runs=runs,
    )
    path.write_text(text, "utf-8")
    return load_study(path)


def splines(study: OptimizationStudy, folder: Path) -> Splines:
    designs = np.array([(first, second) for first in GRID[0] for second in GRID[1]])
    found = {}
    with StudyRuns(study, folder, local(1)) as runs:
        for part in PLANTS:
            done = runs.run(part, designs)
            for name in METRICS:
                values = np.array([run.metric(name) for run in done]).reshape(25, 19)
                found[part, name] = RectBivariateSpline(*GRID, values)
    return found


class SplineEngine:
    """Engine that reads the metrics of designs from splines."""

    def __init__(self, study: OptimizationStudy, found: Splines) -> None:
        self._study = study
        self._found = found

    def __call__(
        self, experiment: Experiment, points: Sequence[Point]
    ) -> Iterator[TaskResult[Row]]:
        """Yield the rows of points."""
        (plant,) = experiment.plants
        part = {"analytical": "compliant"}.get(plant, plant)
        for number, point in enumerate(points):
            space = self._study.space
            fractions = space.fractions(
                [float(str(point.changes[name])) for name in space.variables]
            )
            values = {
                f"{plant}.{name}": float(self._found[part, name](*fractions)[0, 0])
                for name in METRICS
            }
            yield TaskResult(number, Row(point.key, DONE, values), None)


def searched(study: OptimizationStudy, seed: int, found: Splines) -> Optimum:
    seeded = replace(study, file=study.file.model_copy(update={"seed": seed}))
    with (
        TemporaryDirectory() as folder,
        StudyRuns(seeded, Path(folder), SplineEngine(seeded, found)) as runs,
    ):
        return search(seeded, runs)


def main() -> None:
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--seeds", type=int, default=20)
    words.add_argument("--first-seed", type=int, default=0)
    words.add_argument(
        "--runs", type=int, default=30, help="runs of the twin per search"
    )
    words.add_argument("--out", type=Path, default=Path("runs/constrained"))
    given = words.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    found = splines(loaded(given.out, given.runs, STUDIES[0]), given.out / "grid")
    fine = {key: spline(FINE, FINE) for key, spline in found.items()}
    rows = []
    for limited in STUDIES:
        gain = fine["twin", limited.objective] * (
            1 if limited.goal == "maximize" else -1
        )
        side = 1 if limited.side == "below" else -1
        optimum = np.where(
            side * (fine["twin", limited.metric] - limited.limit) <= 0, gain, -np.inf
        )
        best = optimum.max()
        place = np.unravel_index(optimum.argmax(), optimum.shape)
        excess = side * (fine["compliant", limited.metric][place] / limited.limit - 1)
        study = loaded(given.out, given.runs, limited)
        seeds = range(given.first_seed, given.first_seed + given.seeds)
        ends = [searched(study, seed, found) for seed in seeds]
        errors = np.array(
            [1 - end.best[0].metric(limited.objective) / abs(best) for end in ends]
        )
        errors *= 1 if limited.goal == "maximize" else -1
        errors = np.where(
            [(excesses(study, end.best[:1]) > 0).any() for end in ends], np.inf, errors
        )
        warned = np.array([(end.improvement or 0.0) > MAX_IMPROVEMENT for end in ends])
        good = errors <= WITHIN
        for seed, error, end in zip(seeds, errors, ends, strict=True):
            print(
                limited.metric,
                seed,
                f"{100 * error:.2f} %",
                end.improvement,
                flush=True,
            )
        rows.append(
            [
                (
                    f"{limited.objective}; {limited.metric} {limited.side}"
                    f" {limited.limit:g}"
                ),
                f"{abs(best):.4g}",
                f"{100 * excess:+.0f} %",
                f"{good.sum()} of {len(good)}",
                f"{100 * errors.max():.1f} %",
                f"{np.sum(warned & ~good)} of {np.sum(~good)}",
                f"{np.sum(warned & good)} of {good.sum()}",
            ]
        )
    heads = [
        "study",
        "optimum",
        "violation by compliant at the optimum",
        "within 2 %",
        "largest deviation",
    ]
    print(table([*heads, "warnings beyond 2 %", "warnings within 2 %"], rows))


if __name__ == "__main__":
    main()
