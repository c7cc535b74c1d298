"""What a faster twin costs in accuracy: candidates for its presets, and the error of each metric.

    uv run python benchmarks/presets.py

The shipped gait scenarios, 8 s or five periods each, are held against a time step of 0.0625 ms with two
hinges a segment and the same contact. The cost is processor time over that of the default: the least
of the rounds, all settings in turns. Steps above 2 ms are refused: segments have a damping time c/k of
2.14 ms.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from typing import Any

import numpy as np
from grid import table
from timing import ROUNDS

from srs_twin import Trajectory, rollout
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.plants.twin.mjcf.numerics import PRESETS, ModelSettings
from srs_twin.scenario.loading import load_scenario

SCENARIOS = "gen1_straight gen2_straight gen2_turn gen3_straight gen3_turn gen4_straight gen4_turn".split()
METRICS = {
    "com_speed_m_s": "speed, %",
    "yaw_rate_rad_s": "yaw rate, mrad/s",
    "turning_radius_m": "turning radius, %",
    "mean_bend_amplitude_rad": "bends, %",
    "mechanical_power_w": "mechanical power, %",
    "cost_of_transport": "cost of transport, %",
    "pneumatic_power_w": "pneumatic power, %",
    "position": "final position, % of the path",
}
"""Metric → its error and unit."""
FINE_S = 0.0000625
STEPS_S = {"loaded": (0.001, 0.00025, 0.0005, 0.00125, 0.002), "preloaded": (0.001, 0.002)}
Settings = Mapping[str, Any]
Metrics = Mapping[str, Any]


def run(name: str, settings: Settings) -> Trajectory:
    """Return what the twin does in a scenario."""
    scenario = load_scenario(name)
    plant, gait = scenario.build_plant("twin", **settings), scenario.build_controller()
    return rollout(plant, gait, max(8, math.ceil(5 / (gait.frequency or 1))))


def measured(name: str, settings: Settings) -> Metrics:
    """Return the metrics of a run, and where it ended (m)."""
    trajectory = run(name, settings)
    return plant_metrics(trajectory) | {"position": trajectory.com[-1]}


def error(metric: str, found: Metrics, reference: Metrics) -> float:
    """Return the error of a metric in the unit of `METRICS`; NaN of the radius of a straight gait."""
    if metric == "position":
        return float(100 * np.linalg.norm(found[metric] - reference[metric]) / reference["path_length_m"])
    if metric == "yaw_rate_rad_s":
        return float(1e3 * (found[metric] - reference[metric]))
    if metric == "turning_radius_m" and abs(reference["yaw_rate_rad_s"]) < 0.01:
        return math.nan
    return float(100 * (found[metric] / reference[metric] - 1))


def errors(found: Sequence[Metrics], reference: Sequence[Metrics]) -> np.ndarray:
    """Return the errors, shape (metrics, scenarios)."""
    pairs = list(zip(found, reference, strict=True))
    return np.array([[error(metric, *pair) for pair in pairs] for metric in METRICS])


def costs(settings: Sequence[Settings]) -> np.ndarray:
    """Return the processor time of each over that of the first."""
    scenario = load_scenario("gen2_turn")
    plants = [scenario.build_plant("twin", **each) for each in settings]
    taken = np.zeros((ROUNDS + 1, len(plants)))
    for turn, (k, plant) in product(range(ROUNDS + 1), enumerate(plants)):
        begun = time.process_time()
        rollout(plant, scenario.build_controller(), 8.0)
        taken[turn, k] = time.process_time() - begun
    least = taken[1:].min(axis=0)  # the first round compiles and loads
    return np.asarray(least / least[0])


def main() -> None:
    """Print a table of the candidates, and one of the default and the presets, metric by metric."""
    candidates: list[dict[str, Any]] = [
        {"contact": contact, "timestep": step, "hinges_per_segment": hinges}
        for contact, steps in STEPS_S.items()
        for step, hinges in product(steps, (2, 1))
    ]
    fine = [{"contact": contact, "timestep": FINE_S, "hinges_per_segment": 2} for contact in STEPS_S]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        futures = [[pool.submit(measured, name, each) for name in SCENARIOS] for each in candidates + fine]
        results = [[future.result() for future in row] for row in futures]
    converged = dict(zip(STEPS_S, results[-len(fine) :], strict=True))
    apart = [
        errors(found, converged[each["contact"]]) for found, each in zip(results, candidates, strict=False)
    ]
    rows = []
    for each, error, cost in zip(candidates, apart, costs(candidates), strict=True):
        contact, step, hinges = each.values()
        numbers = [1e3 * step, hinges, cost, *np.nanmax(np.abs(error), axis=1)]
        rows.append([contact, *(f"{float(f'{number:.3g}'):g}" for number in numbers)])
    print(table(["contact", "step, ms", "hinges", "cost", *METRICS.values()], rows), flush=True)
    named = {"default": ModelSettings.timestep} | {name: each["timestep"] for name, each in PRESETS.items()}
    steps = [each["timestep"] for each in candidates if each["contact"] == "loaded"]
    shown = [apart[steps.index(step)] for step in named.values()]
    rows = [
        [title, *(f"{np.nanmax(np.abs(e[i])):.2g} ({np.sqrt(np.nanmean(e[i] ** 2)):.2g})" for e in shown)]
        for i, title in enumerate(METRICS.values())
    ]
    print("", table(["largest (RMS) error", *named], rows), sep="\n")


if __name__ == "__main__":
    main()
