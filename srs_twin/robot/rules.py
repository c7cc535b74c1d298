"""Consistency rules between the parameters of a robot.

A `RobotSpec` raises an error if a rule is violated. A robot file reports each violation
at the key of the parameter.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from srs_twin.errors import InputError

WHEEL_FRACTION = 0.9
"""Maximum mass of a connector's two wheels, as a fraction of the connector's mass."""

_MAX_GAP_DEG = 180.0 - 1e-6
"""Maximum angle between the directions of two neighbouring chambers, degrees."""


class Violation(NamedTuple):
    """Violation of a consistency rule by a parameter."""

    parameter: str
    reason: str


def raise_violations(violations: Iterable[Violation]) -> None:
    """Raise an `InputError` with the reasons of all violations, if there are any."""
    if reasons := [violation.reason for violation in violations]:
        raise InputError("; ".join(reasons))


def spatial_refusal(robot: str, feature: str) -> str:
    """Return a message that the feature is not available for a spatial robot."""
    return (
        f"{feature} does not support the spatial robot {robot}"
        " (chamber.directions_deg); use a robot whose chambers bend it to the left and"
        " right only"
    )


def kind_violations(
    *, is_spatial: bool, has_skin: bool, has_tail: bool, extends: bool
) -> Iterator[Violation]:
    """Yield contradictions between the kinds of chambers and of contact."""
    if is_spatial and not has_skin:
        yield Violation(
            "directions",
            "a robot that bends in two directions needs contact skin: its wheels would"
            " leave the floor",
        )
    if extends and not is_spatial:
        yield Violation(
            "extension",
            "segments of a planar robot keep their length; remove it, or give"
            " chamber.directions_deg",
        )
    if has_skin and has_tail:
        yield Violation(
            "tail", "a robot with contact skin has no axles; remove the tail"
        )


def mass_violations(
    masses: Sequence[float], count: int, part: str
) -> Iterator[Violation]:
    """Yield a violation if the number of masses differs from the number of parts."""
    if len(masses) != count:
        yield Violation(part, f"{len(masses)} masses for {count} {part}; give {count}")


def wheel_violations(wheel: float, connectors: Sequence[float]) -> Iterator[Violation]:
    """Yield a violation if the wheels are too heavy for the lightest connector (kg)."""
    lightest = min(connectors)
    if 2 * wheel > WHEEL_FRACTION * lightest:
        yield Violation(
            "wheel",
            f"two wheels of {wheel:g} kg are too much for the lightest connector,"
            f" {lightest:g} kg; {WHEEL_FRACTION * lightest / 2:g} kg each at most",
        )


def tail_violations(com: float, axle: float) -> Iterator[Violation]:
    """Yield a violation if the tail's centre of mass is not between its axles."""
    if com > axle:
        yield Violation(
            "com",
            f"{com:g} m is behind the second axle at {axle:g} m; the assembly would tip"
            " over",
        )


def direction_violations(directions_deg: Sequence[float]) -> Iterator[Violation]:
    """Yield a violation if neighbouring chambers are 180° or more apart."""
    ordered = np.sort(np.mod(directions_deg, 360.0))
    largest = float(np.diff(ordered, append=ordered[0] + 360.0).max())
    if largest > _MAX_GAP_DEG:
        yield Violation(
            "directions",
            f"no chamber within {largest:g} degrees; neighbours must be less than 180"
            " degrees apart",
        )
