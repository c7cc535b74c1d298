"""Consistency rules for the parameters of a robot.

The constructor of `RobotSpec` raises an error if a rule is violated. When a robot file
is loaded, each violation is reported at the key of the parameter.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from srs_twin.errors import InputError

WHEEL_FRACTION = 0.9
"""Maximum mass of a connector's two wheels, as a fraction of the connector mass."""

_MAX_GAP_DEG = 180.0 - 1e-6
"""Maximum angle between the directions of two neighbouring chambers, degrees."""


class Violation(NamedTuple):
    """Violation of a consistency rule by one parameter."""

    parameter: str
    reason: str


def raise_violations(violations: Iterable[Violation]) -> None:
    """Raise an `InputError` that lists all violations, if there are any."""
    if reasons := [violation.reason for violation in violations]:
        raise InputError("; ".join(reasons))


def spatial_refusal(robot: str, feature: str) -> str:
    """Return the error message for a feature that does not support a spatial robot."""
    return (
        f"{feature} does not support the spatial robot '{robot}' (with"
        " `chamber.directions_deg`); use a robot that bends only to the left and right"
    )


def kind_violations(
    *, is_spatial: bool, has_skin: bool, has_tail: bool, extends: bool
) -> Iterator[Violation]:
    """Yield a violation for each combination of features that is not supported."""
    if is_spatial and not has_skin:
        yield Violation(
            "directions",
            "a robot that bends in two directions needs the contact `skin`, because"
            " wheels would leave the floor",
        )
    if extends and not is_spatial:
        yield Violation(
            "extension",
            "the segments of a planar robot keep their length; remove this key, or"
            " make the robot spatial with `chamber.directions_deg`",
        )
    if has_skin and has_tail:
        yield Violation(
            "tail",
            "a robot with the contact `skin` has no axles; remove the section `tail`",
        )


def mass_violations(
    masses: Sequence[float], count: int, part: str
) -> Iterator[Violation]:
    """Yield a violation if the number of masses differs from the number of parts."""
    if len(masses) != count:
        yield Violation(
            part,
            f"{len(masses)} masses are given for {count} {part}; give {count} masses",
        )


def wheel_violations(wheel: float, connectors: Sequence[float]) -> Iterator[Violation]:
    """Yield a violation if two wheels are too heavy for the lightest connector.

    All masses are in kg.
    """
    lightest = min(connectors)
    if 2 * wheel > WHEEL_FRACTION * lightest:
        yield Violation(
            "wheel",
            f"two wheels of {wheel:g} kg are too heavy for the lightest connector"
            f" ({lightest:g} kg); the mass of a wheel must not exceed"
            f" {WHEEL_FRACTION * lightest / 2:g} kg",
        )


def tail_violations(com: float, axle: float) -> Iterator[Violation]:
    """Yield a violation if the tail's centre of mass is behind its second axle."""
    if com > axle:
        yield Violation(
            "com",
            f"the centre of mass at {com:g} m is behind the second axle at {axle:g} m,"
            " so the tail would tip over; move the centre of mass in front of this axle",
        )


def direction_violations(directions_deg: Sequence[float]) -> Iterator[Violation]:
    """Yield a violation if neighbouring chambers are 180° or more apart."""
    ordered = np.sort(np.mod(directions_deg, 360.0))
    largest = float(np.diff(ordered, append=ordered[0] + 360.0).max())
    if largest > _MAX_GAP_DEG:
        yield Violation(
            "directions",
            f"two neighbouring chambers are {largest:g} degrees apart; neighbouring"
            " chambers must be less than 180 degrees apart",
        )
