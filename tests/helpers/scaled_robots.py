"""Robots that are scaled so that they make the same motion, and the plants that show it."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import fields, replace
from typing import Any

import numpy as np

from srs_twin import (
    AnalyticalSnake,
    Gait,
    LoadedContact,
    Plant,
    PreloadedContact,
    RobotSpec,
    TwinSnake,
    rollout,
)

FREQUENCY_HZ = 2.0
OFFSET = 0.2
PERIODS = 3
MEASURED_PERIODS = 2
TICK_S = 0.02
SETTINGS = ("timestep", "tolerance", "slip_speed", "slip_time", "axle_time")
"""Numerical settings of the plants that can be given."""

Builder = Callable[[RobotSpec, float, Collection[str]], Plant]


def scaled(spec: RobotSpec, s: float) -> RobotSpec:
    """Return a robot whose lengths are multiplied by s and that makes the same motion.

    Masses and the axial drag are multiplied by s³, stiffness by s⁴ and times by √s.
    Bends per pressure stay.
    """
    time = math.sqrt(s)

    def changed(
        section: Any, factor: Callable[[str], float], skip: tuple[str, ...] = ()
    ) -> Any:
        """Return a section with each number multiplied by the factor of its name."""
        numbers = {}
        for field in fields(section):
            value = getattr(section, field.name)
            if field.name in skip or value is None:
                continue
            many = isinstance(value, tuple)
            numbers[field.name] = (
                tuple(factor(field.name) * number for number in value)
                if many
                else factor(field.name) * value
            )
        return replace(section, **numbers)

    return replace(
        spec,
        geometry=changed(spec.geometry, lambda name: s, skip=("connectors",)),
        mass=changed(spec.mass, lambda name: s if "gyration" in name else s**3),
        friction=replace(spec.friction, drag=s**3 * spec.friction.drag),
        bending=changed(spec.bending, lambda name: time if "time" in name else s**4),
        actuator=changed(
            spec.actuator, lambda name: time if name.startswith("tau") else 1.0
        ),
        chamber=changed(spec.chamber, lambda name: s**3),
    )


def _analytical(**options: Any) -> Builder:
    def build(spec: RobotSpec, s: float, explicit: Collection[str]) -> Plant:
        time = math.sqrt(s)
        numerics = {"timestep": 0.002, "tolerance": 0.0002, "slip_speed": 0.00025}
        chosen = {
            name: value * time for name, value in numerics.items() if name in explicit
        }
        return AnalyticalSnake(spec, tick=TICK_S * time, **options, **chosen)

    return build


def _twin(contact: type[LoadedContact] | type[PreloadedContact], kind: Any) -> Builder:
    def build(spec: RobotSpec, s: float, explicit: Collection[str]) -> Plant:
        time = math.sqrt(s)
        numerics = {"slip_speed": 0.001, "timestep": 0.001}
        if contact is PreloadedContact:
            numerics |= {"slip_time": 0.0003, "axle_time": 0.002}
        chosen = {
            name: value * time for name, value in numerics.items() if name in explicit
        }
        steps = {"timestep": chosen.pop("timestep")} if "timestep" in chosen else {}
        return TwinSnake(
            spec, contact=contact(kind, **chosen), tick=TICK_S * time, **steps
        )

    return build


PLANTS: dict[str, Builder] = {
    "simplified, axis": _analytical(model="simplified"),
    "complete, axis": _analytical(),
    "complete, wheel, instantaneous": _analytical(
        friction="wheel", load="instantaneous"
    ),
    "compliant, ellipse": _analytical(
        model="compliant", friction="ellipse", inertia="connector"
    ),
    "twin, loaded, wheel": _twin(LoadedContact, "wheel"),
    "twin, loaded, ellipse": _twin(LoadedContact, "ellipse"),
    "twin, preloaded, rolling": _twin(PreloadedContact, "rolling"),
    "twin, preloaded, skid": _twin(PreloadedContact, "skid"),
}
"""Constructors of the plants, from the robot, its scale, and the names of the settings that scale with it."""


def motion(plant: Plant, s: float) -> np.ndarray:
    """Return the speed over √s and the yaw rate times √s of a turning gait over its last periods, (2,)."""
    time = math.sqrt(s)
    end = PERIODS / FREQUENCY_HZ
    run = rollout(
        plant, Gait(FREQUENCY_HZ / time, OFFSET), end * time, record_hz=50 / time
    )
    first = int(
        np.searchsorted(run.time, (end - MEASURED_PERIODS / FREQUENCY_HZ - 1e-6) * time)
    )
    span = (run.time[-1] - run.time[first]) / time
    way = run.com[-1] - run.com[first]
    return (
        np.array([math.hypot(*way) / s, run["heading"][-1] - run["heading"][first]])
        / span
    )


def deviations(
    name: str,
    spec: RobotSpec,
    s: float,
    explicit: Collection[str],
    reference: np.ndarray,
) -> np.ndarray:
    """Return the relative deviations of speed and yaw rate of a scaled robot from a reference, shape (2,)."""
    difference: np.ndarray = (
        motion(PLANTS[name](scaled(spec, s), s, explicit), s) / reference - 1
    )
    return difference
