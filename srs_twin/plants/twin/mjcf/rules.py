"""Combinations of robot, settings and world that a twin does not support."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco

from srs_twin.plants.twin.mjcf.numerics import (
    MAX_STEP_RATIO,
    LoadedContact,
    ModelSettings,
    PreloadedContact,
)
from srs_twin.robot.rules import Violation, raise_violations, spatial_refusal
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import World


def check(spec: RobotSpec, settings: ModelSettings, world: World) -> None:
    """Raise all violations of `violations` together.

    Raises:
        InputError: there is a violation.
    """
    raise_violations(violations(spec, settings, world))


def violations(
    spec: RobotSpec, settings: ModelSettings, world: World
) -> Iterator[Violation]:
    """Yield all violations; parameters are the arguments of `TwinSnake`."""
    if not isinstance(settings.contact, LoadedContact):
        yield from _preload_violations(spec, world)
    if world.objects and not settings.loaded:
        yield Violation("contact", "objects need contact 'loaded' and a free snake")
    if world.objects and world.steps:
        yield Violation(
            "world",
            "objects need a plane floor; remove the steps of the floor or the objects",
        )
    if spec.is_spatial:
        if settings.numerics.constant_curvature:
            feature = "numerics 'constant_curvature'"
            yield Violation("numerics", spatial_refusal(spec.name, feature))
        if world.is_solid or world.uneven:
            feature = "a world with obstacles, objects or an uneven floor"
            yield Violation("world", spatial_refusal(spec.name, feature))
    if spec.actuator.extension and settings.hinges_per_segment < 2:
        yield Violation(
            "hinges_per_segment",
            "hinges_per_segment: 1 is not allowed for segments that lengthen; use 2 or"
            " more",
        )
    shortest = min(spec.bending.damping_time, spec.bending.out_of_plane_damping_time)
    if not settings.timestep < MAX_STEP_RATIO * shortest:
        yield Violation(
            "timestep",
            f"time step {settings.timestep:g} s is too long for segments with a damping"
            f" time c/k of {shortest:g} s; it must be below {MAX_STEP_RATIO:g} times"
            " that",
        )
    smallest = _smallest_inertia(spec, settings)
    if not smallest > mujoco.mjMINVAL:
        yield Violation(
            "spec",
            f"a body of {spec.name} has a moment of inertia of {smallest:.2g} kg·m²;"
            f" MuJoCo needs more than {mujoco.mjMINVAL:g} kg·m², so the robot is too"
            " small for the twin",
        )


def _preload_violations(spec: RobotSpec, world: World) -> Iterator[Violation]:
    if spec.tail is not None:
        yield Violation(
            "contact",
            "a tail on two axles needs contact 'loaded', because a preload would keep"
            " it down",
        )
    if spec.skin is not None:
        yield Violation(
            "contact",
            "a robot with skin needs contact 'loaded'; a preload presses on wheels or"
            " skids",
        )
    if world.uneven:
        yield Violation(
            "contact", "a floor that slopes or has steps needs contact 'loaded'"
        )


def _smallest_inertia(spec: RobotSpec, settings: ModelSettings) -> float:
    """Return the smallest moment of inertia of a body, kg·m²."""
    if settings.hinges_per_segment > 1:
        lightest = settings.link_mass(spec)
    else:
        lightest = min(spec.mass.connectors)
    moment = spec.connector_gyration**2 * lightest
    if isinstance(settings.contact, PreloadedContact) and settings.contact.rolling:
        wheel = spec.mass.wheel * spec.geometry.wheel_radius**2 / 4
        moment = min(moment, wheel)
    return moment
