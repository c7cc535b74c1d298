"""Robots with other stiffness, friction or masses, and a function that sets a velocity."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from srs_twin import (
    AnalyticalSnake,
    LoadedContact,
    Plant,
    RobotSpec,
    TwinSnake,
    load_robot,
)
from srs_twin.plants.analytical import kernels
from srs_twin.plants.twin.mjcf.belly import root_connector

GRAVITY = 9.81
shipped = cache(load_robot)


def robot(
    name: str = "gen2", *, stiffness: float | None = None, **friction: float
) -> RobotSpec:
    """Return a shipped robot with another bending stiffness (N·m/rad) or other friction coefficients."""
    spec = shipped(name)
    if stiffness is not None:
        spec = replace(spec, bending=replace(spec.bending, stiffness=stiffness))
    return replace(spec, friction=replace(spec.friction, **friction))


def chain(
    masses: tuple[float, ...],
    *,
    length: float = 0.037,
    gap: float = 0.018,
    **friction: float,
) -> RobotSpec:
    """Return gen2 with other connector masses (kg) and lengths (m); the masses set the number."""
    spec = robot(**friction)
    geometry = replace(
        spec.geometry, connectors=len(masses), segment_length=length, rigid_gap=gap
    )
    return replace(spec, geometry=geometry, mass=replace(spec.mass, connectors=masses))


def vented(spec: RobotSpec) -> np.ndarray:
    """Return valve commands that vent every chamber, shape (segments, 2)."""
    return np.full((spec.segments, 2), -1, dtype=np.int8)


def throw(
    plant: Plant,
    velocity: tuple[float, float],
    *,
    spin: float = 0.0,
    heading: float = 0.0,
) -> None:
    """Place a straight plant at the origin with a velocity (m/s, world) and yaw rate (rad/s).

    The twin is first simulated until it rests on its wheels; the wheels then roll
    without slip.
    """
    plant.reset(pose=(0.0, 0.0, heading))
    if isinstance(plant, AnalyticalSnake):
        _throw_analytical(plant, velocity, spin, heading)
    elif isinstance(plant, TwinSnake):
        _throw_twin(plant, velocity, spin)


def _throw_analytical(
    plant: AnalyticalSnake, velocity: tuple[float, float], spin: float, heading: float
) -> None:
    spec = plant.spec
    stations = -spec.geometry.pitch * np.arange(spec.geometry.connectors)
    mass = spec.mass.array()
    inertia = (mass * (stations - mass @ stations / mass.sum()) ** 2).sum()
    inertia += plant.body.solid.inertia.sum()
    plant.body.state[kernels.STATE_VX : kernels.STATE_VY + 1] = velocity
    plant.body.state[kernels.MOMENT] = inertia * spin
    c = np.cos(heading)
    s = np.sin(heading)
    plant.body.velocity[:3] = (
        c * velocity[0] + s * velocity[1],
        c * velocity[1] - s * velocity[0],
        spin,
    )


def _throw_twin(plant: TwinSnake, velocity: tuple[float, float], spin: float) -> None:
    for _ in range(round(0.2 / plant.tick)):
        plant.step(vented(plant.spec))
    physics = plant.physics
    g = plant.spec.geometry
    centre = physics.center_of_mass()[:2]
    headings = physics.connector_headings()
    places = physics.connector_positions()[:, :2]

    def at(place: np.ndarray) -> np.ndarray:
        arm = place - centre
        return np.asarray(velocity) + spin * np.array([-arm[1], arm[0]])

    physics.data.qvel[:] = 0.0
    physics.data.qvel[:2] = at(places[root_connector(plant.spec) - 1])
    physics.data.qvel[5] = spin
    contact = plant.contact
    if (
        contact.law == "ellipse"
        if isinstance(contact, LoadedContact)
        else not contact.rolling
    ):
        return
    for i, (place, heading) in enumerate(zip(places, headings, strict=True), start=1):
        along = at(place) @ [np.cos(heading), np.sin(heading)]
        for side, sign in (("left", 1), ("right", -1)):
            rolling = along - sign * g.half_track * spin
            if physics.stepper is not None:
                physics.stepper.contact_state.rim_speed[
                    2 * i - 2 + (side == "right")
                ] = rolling
                continue
            physics.data.joint(f"axle_{side}_{i}").qvel = rolling / g.wheel_radius


def shortened(spec: RobotSpec, connectors: int) -> RobotSpec:
    """Return a robot with skin and fewer segments, which simulates faster."""
    mass = replace(
        spec.mass,
        connectors=spec.mass.connectors[: connectors - 1] + spec.mass.connectors[-1:],
        segments=spec.mass.segments[: connectors - 1],
    )
    geometry = replace(spec.geometry, connectors=connectors)
    return replace(spec, geometry=geometry, mass=mass)
