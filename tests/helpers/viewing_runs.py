"""Runs for tests of pictures: the synthetic snake with pressures, and a robot of the same dimensions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation
from snakes import chain
from synthetic import Snake, numbered, with_columns

from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory

SUPPLY_PA = 48_300.0


def robot(connectors: int = 5) -> RobotSpec:
    """Return generation 2, whose segments are those of the synthetic snake."""
    return chain((0.03,) * connectors)


def run(plant: str, snake: Snake) -> Trajectory:
    """The snake with chambers that lead its bends."""
    recorded = snake.trajectory(plant)
    fill = np.clip(0.5 + 0.8 * snake.bends(recorded.time + 0.1), 0, 1)
    return with_columns(
        recorded,
        **numbered("pressure_plus", SUPPLY_PA * fill),
        **numbered("pressure_minus", SUPPLY_PA * (1 - fill)),
        **numbered("valve_plus", np.sign(fill - 0.5)),
        **numbered("valve_minus", -np.sign(fill - 0.5)),
    )


def pair(**changes: object) -> dict[str, Trajectory]:
    """Both plants over ten seconds; the twin bends less, is slower and turns a little."""
    snake = replace(Snake(speed=0.22, amplitude=1.2, duration=10.0), **changes)
    twin = replace(
        snake, speed=0.91 * snake.speed, amplitude=0.9 * snake.amplitude, yaw_rate=-0.02
    )
    return {"analytical": run("analytical", snake), "twin": run("twin", twin)}


def read_back(path: Path) -> dict[str, dict[str, tuple[np.ndarray, pa.Array]]]:
    """Return entity path → component → (seconds, column) of what changes with time."""
    found: dict[str, dict[str, tuple[np.ndarray, pa.Array]]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        if not chunk.is_static:
            batch = chunk.to_record_batch()
            time = batch.column("sim_time").to_numpy(zero_copy_only=False)
            for name in batch.schema.names[2:]:
                signals = found.setdefault(chunk.entity_path, {})
                signals[name] = time.astype(float) * 1e-9, batch.column(name)
    return found


def flat(column: pa.Array) -> np.ndarray:
    """Return the numbers of a column of lists."""
    while pa.types.is_nested(column.type):
        column = column.flatten()
    return column.to_numpy(zero_copy_only=False)


def directions(quaternions: pa.Array, axis: list[float]) -> np.ndarray:
    """Return an axis of each rotated shape, shape (n, 3)."""
    return Rotation.from_quat(flat(quaternions).reshape(-1, 4)).apply(axis)
