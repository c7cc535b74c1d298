"""What moving costs: power of the segments and of the air they use, and the cost of transport."""

from __future__ import annotations

from typing import Any

import numpy as np

from srs_twin.comparison.gait_window import GaitWindow
from srs_twin.comparison.sampling import positive_number
from srs_twin.spec import GRAVITY
from srs_twin.trajectory import Trajectory

ENERGY_METRICS = (
    "mechanical_power_w", "cost_of_transport", "pneumatic_power_w", "pneumatic_cost_of_transport",
)  # fmt: skip


def energy_metrics(trajectory: Trajectory, window: GaitWindow, speed: float) -> dict[str, Any]:
    """Measure what a gait costs, over whole periods.

    - ``mechanical_power_w``: work of the segments on the body; what friction takes, on average.
    - ``cost_of_transport``: that over weight times speed.
    - ``pneumatic_power_w``: supply pressure times the volume of air drawn at that pressure.
    - ``pneumatic_cost_of_transport``: likewise.

    Each is None where the run did not record what it needs.

    Args:
        trajectory: one run.
        window: its gait periods.
        speed: mean speed, m/s.
    """
    mass = positive_number(trajectory, "mass_kg")
    metrics: dict[str, Any] = dict.fromkeys(ENERGY_METRICS)
    for source, power, cost in (
        ("work", "mechanical_power_w", "cost_of_transport"),
        ("air", "pneumatic_power_w", "pneumatic_cost_of_transport"),
    ):
        if trajectory.has(source):
            metrics[power] = _mean_rate(trajectory, window, source)
            if mass is not None and speed != 0:
                metrics[cost] = metrics[power] / (mass * GRAVITY * abs(speed))
    return metrics


def _mean_rate(trajectory: Trajectory, window: GaitWindow, name: str) -> float:
    """Return how fast a column that adds up grows over the window."""
    start, end = np.interp([window.start, window.end], trajectory.time, trajectory[name])
    return float((end - start) / (window.end - window.start))
