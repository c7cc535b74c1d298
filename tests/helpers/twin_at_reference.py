"""The twin at the points of the reference simulation (`load_reference`)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from load_reference import POINTS, Result, measured, numbers

from srs_twin import Gait, TwinSnake, load_robot, rollout
from srs_twin.robot.spec import GRAVITY, Tail


def crawled(
    name: str, periods: int | None = None, timestep: float = 0.001, **options: Any
) -> Result:
    """Return the result of the twin at a point of the reference, measured as `load_reference.simulate` does.

    Args:
        name: name of the point.
        periods: number of gait periods; None: those of the point.
        timestep: time step, s.
        options: options of the twin.
    """
    point = POINTS[name]
    spec = load_robot(POINTS[name].robot)
    damping_time = numbers(point)["damping_time_s"]
    spec = replace(spec, bending=replace(spec.bending, damping_time=damping_time))
    if point.stiffness is not None:
        spec = replace(spec, bending=replace(spec.bending, stiffness=point.stiffness))
    if point.tail is not None:
        spec = replace(spec, tail=Tail(*point.tail))
    period, tick = (
        point.period_s,
        max(timestep, 0.001),
    )  # a multiple of step and valve slots
    kpa = numbers(point)["nominal_kpa"] if point.kpa is None else point.kpa
    plant = TwinSnake(
        spec, supply_pa=1000 * kpa, timestep=timestep, tick=tick, **options
    )
    feet: list[np.ndarray] = []
    run = rollout(
        plant,
        Gait(1 / period, point.offset),
        (point.periods if periods is None else periods) * period,
        record_hz=1 / tick,
        observers=[lambda _: feet.append(plant.physics.wheel_loads().ravel())],
    )
    com = np.stack([run["com_x"], run["com_y"]], axis=1)[1:]
    rest = np.repeat([axle.mass * GRAVITY / 2 for axle in spec.axles], 2)
    ticks = round(period / tick)
    return measured(
        com,
        run.stack("connector_heading")[1:],
        np.array(feet)[-len(com) :],
        rest,
        ticks,
        tick,
    )
