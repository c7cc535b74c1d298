"""Combinations of robot, settings and world that a twin does not support."""

from __future__ import annotations

from collections.abc import Iterator

from srs_twin.plants.base import refusals
from srs_twin.plants.twin.mjcf.numerics import (
    MAX_STEP_RATIO,
    ModelSettings,
    PreloadedContact,
)
from srs_twin.pneumatics.base import Pneumatics
from srs_twin.robot.rules import Violation, raise_violations, spatial_refusal
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import World

ROUNDING = 1 + 1e-9
"""Factor that allows for rounding errors when two times are compared."""

LEAST_INERTIA = 1e-15
"""Minimum moment of inertia that MuJoCo accepts (mjMINVAL), kg·m².

The value is defined here, so that scenarios can be checked without importing MuJoCo.
"""


def check(spec: RobotSpec, settings: ModelSettings, world: World) -> None:
    """Check that a twin supports a robot with these settings in a world.

    Raises:
        InputError: the twin does not support the combination. The message lists all
            violations.
    """
    refused = refusals("contact", settings.contact.name, spec, world)
    raise_violations((*refused, *violations(spec, settings, world)))


def violations(
    spec: RobotSpec, settings: ModelSettings, world: World
) -> Iterator[Violation]:
    """Yield all violations of the twin's rules.

    The `parameter` of a violation is an argument of `TwinSnake` or a section of the
    world.
    """
    if world.objects and settings.base != "free":
        yield Violation(
            "objects",
            "movable objects are allowed only if the snake is free; remove the"
            " objects, or do not clamp the snake",
        )
    if world.objects and world.steps:
        yield Violation(
            "objects",
            "movable objects need a plane floor; remove the steps of the floor or the"
            " objects",
        )
    if spec.is_spatial and settings.numerics.constant_curvature:
        feature = "numerics 'constant_curvature'"
        yield Violation("numerics", spatial_refusal(spec.name, feature))
    if spec.actuator.extension and settings.hinges_per_segment < 2:
        yield Violation(
            "hinges_per_segment",
            "`hinges_per_segment` 1 is not allowed for segments that lengthen; use 2"
            " or more",
        )
    shortest = min(spec.bending.damping_time, spec.bending.out_of_plane_damping_time)
    if not settings.timestep < MAX_STEP_RATIO * shortest:
        yield Violation(
            "timestep",
            f"time step {settings.timestep:g} s is too long for segments with a"
            f" damping time c/k of {shortest:g} s. It must be below {MAX_STEP_RATIO:g}"
            " times this damping time (`bending.damping_time`,"
            " `bending.out_of_plane_damping_time`)",
        )
    smallest = _smallest_inertia(spec, settings)
    if not smallest > LEAST_INERTIA:
        yield Violation(
            "spec",
            f"the robot {spec.name} is too small for the twin, because the moment of"
            f" inertia of one of its bodies is {smallest:.2g} kg·m², but MuJoCo needs"
            f" more than {LEAST_INERTIA:g} kg·m²",
        )


def coupling_violations(timestep: float, chambers: Pneumatics) -> Iterator[Violation]:
    """Yield a violation if the time step (s) is too long for the chambers.

    Only chambers whose pressures depend on the bends limit the time step.
    """
    longest = chambers.coupling_step_s
    if chambers.depends_on_bend and timestep > longest * ROUNDING:
        yield Violation(
            "timestep",
            f"time step {timestep:g} s is too long for chambers whose pressures depend"
            f" on the bends; it must be {longest:g} s or less",
        )


def _smallest_inertia(spec: RobotSpec, settings: ModelSettings) -> float:
    if settings.hinges_per_segment > 1:
        lightest = settings.link_mass(spec)
    else:
        lightest = min(spec.mass.connectors)
    moment = spec.connector_gyration**2 * lightest
    contact = settings.contact
    has_wheels = isinstance(contact, PreloadedContact) and spec.skin is None
    if has_wheels and contact.rolling:
        wheel = spec.mass.wheel * spec.geometry.wheel_radius**2 / 4
        moment = min(moment, wheel)
    return moment
