"""Errors of the twin's metrics with a given setting, relative to a much smaller time step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from srs_twin import Trajectory, rollout
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.scenario.loading import load_scenario

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
"""Headings of the errors, by metric."""
FINE_S = 0.0000625
Settings = Mapping[str, Any]
Metrics = Mapping[str, Any]


def run(name: str, settings: Settings) -> Trajectory:
    """Simulate a scenario with the twin."""
    scenario = load_scenario(name)
    plant = scenario.build_plant("twin", **settings)
    gait = scenario.build_controller()
    return rollout(plant, gait, max(8, math.ceil(5 / (gait.frequency or 1))))


def measured(name: str, settings: Settings) -> Metrics:
    """Return the metrics of a run and its final position (m)."""
    trajectory = run(name, settings)
    return plant_metrics(trajectory) | {"position": trajectory.com[-1]}


def error(metric: str, result: Metrics, reference: Metrics) -> float:
    """Return the error of a metric in the unit of `METRICS`; NaN for the radius of a straight gait."""
    if metric == "position":
        return float(
            100
            * np.linalg.norm(result[metric] - reference[metric])
            / reference["path_length_m"]
        )
    if metric == "yaw_rate_rad_s":
        return float(1e3 * (result[metric] - reference[metric]))
    if metric == "turning_radius_m" and abs(reference["yaw_rate_rad_s"]) < 0.01:
        return math.nan
    return float(100 * (result[metric] / reference[metric] - 1))


def errors(result: Sequence[Metrics], reference: Sequence[Metrics]) -> np.ndarray:
    """Return the errors, shape (metrics, scenarios)."""
    pairs = list(zip(result, reference, strict=True))
    return np.array([[error(metric, *pair) for pair in pairs] for metric in METRICS])
