"""Runs for tests of pictures: the synthetic snake with pressures, and a robot of the same dimensions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from synthetic import Snake, numbered, with_columns

from srs_twin.robot.spec import (
    Actuator,
    Bending,
    Chamber,
    Friction,
    Geometry,
    Mass,
    RobotSpec,
    Supply,
)
from srs_twin.trajectory import Trajectory

SUPPLY_PA = 48_300.0


def robot(connectors: int = 5) -> RobotSpec:
    return RobotSpec(
        name="synthetic",
        title="Synthetic snake",
        geometry=Geometry(connectors, 0.037, 0.018, 0.03, 0.012, 0.02, 0.036),
        mass=Mass((0.03,) * connectors, 0.003),
        friction=Friction(0.043, 0.57),
        bending=Bending(0.1, 0.002, 0.1, 0.1, 0.01),
        actuator=Actuator(0.1, 0.1, 0.002, 3e-5),
        chamber=Chamber(1e-5, 3e-5),
        supply=Supply(48_000.0, 69_000.0, 69_000.0, "test"),
        phase_step=2 * np.pi / (connectors - 1),
    )


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
