"""Simulated motion-capture recordings of the analytical model, with the true motion."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from synthetic_takes import Take, write_motive

from srs_twin import AnalyticalSnake, Gait, Trajectory, load_robot, rollout
from srs_twin.recordings.recording import Recording, read_motion

SPEC = load_robot("gen2")
RATE = 100.0
NOISE = 2e-4  # m, the default of `Take`


@cache
def motion(
    seconds: float = 4.0, offset: float = 0.1, frequency: float = 2.0
) -> Trajectory:
    """Return a gait that starts from rest."""
    plant = AnalyticalSnake(SPEC, supply_pa=48e3)
    return rollout(plant, Gait(frequency, offset), seconds, record_hz=RATE)


def recorded(
    folder: Path, take: Take, truth: Trajectory | None = None, **options: object
) -> Recording:
    """Write a recording and read it back."""
    path = folder / "take.csv"
    write_motive(truth or motion(), take, path)
    return read_motion(path, SPEC, **options)


def true_at(trajectory: Trajectory, truth: Trajectory) -> Trajectory:
    """Return the true samples at the times of a recording."""
    rows = np.rint((trajectory.time + truth.time[0]) * RATE).astype(int)
    return Trajectory({name: column[rows] for name, column in truth.columns.items()})


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Return angles in [−π, π)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def csv_text(names: Sequence[str], rows: np.ndarray, digits: int = 9) -> str:
    """Return a table with a header as CSV text."""
    lines = [",".join(f"{value:.{digits}g}" for value in row) for row in rows]
    return "\n".join([",".join(names), *lines, ""])


def plain_csv(trajectory: Trajectory, unit: str = "m", scale: float = 1.0) -> str:
    """Return the connectors as a plain CSV file."""
    count = trajectory.position.shape[1]
    places = (f"{axis}_{i}_{unit}" for i in range(1, count + 1) for axis in "xy")
    values = np.column_stack(
        [trajectory.time, trajectory.position.reshape(len(trajectory), -1) * scale]
    )
    return csv_text(["time", *places], values)


def valve_csv(truth: Trajectory, start: float, stop: float, shift: float) -> str:
    """Return a valve log between two times, on a clock that is ahead by `shift`."""
    names = [
        f"valve_{side}_{j}"
        for j in range(1, SPEC.segments + 1)
        for side in ("plus", "minus")
    ]
    rows = (truth.time >= start - 1e-9) & (truth.time <= stop + 1e-9)
    values = np.column_stack(
        [truth.time[rows] + shift, *(truth[name][rows] for name in names)]
    )
    return csv_text(["time", *names], values)
