"""Rules for parameters of a robot that must fit together.

`spec` raises their violations, and a robot file reports them at its keys.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from srs_twin.errors import InputError

WHEEL_SHARE = 0.9
"""Largest fraction of the mass of a connector that its two wheels may have."""

_MAX_GAP_DEG = 180.0 - 1e-6
"""Largest angle between the directions of two neighbouring chambers."""


class Violation(NamedTuple):
    """Violation of a rule.

    Attributes:
        parameter: parameter to change.
        reason: what was given, and what is allowed.
    """

    parameter: str
    reason: str


def raise_violations(violations: Iterable[Violation]) -> None:
    """Raise the reasons of all violations together.

    Raises:
        InputError: there is a violation.
    """
    if reasons := [violation.reason for violation in violations]:
        raise InputError("; ".join(reasons))


def spatial_refusal(robot: str, feature: str) -> str:
    """Return the reason why a feature does not support a robot that bends in two directions."""
    return (
        f"{feature} does not support the spatial robot {robot}"
        " (chamber.directions_deg); use a robot whose chambers bend it to the left and"
        " right only"
    )


def kind_violations(
    *, is_spatial: bool, has_skin: bool, has_tail: bool, extends: bool
) -> Iterator[Violation]:
    """Yield violations between the kinds of chambers and of contact.

    Args:
        is_spatial: whether the segments bend in two directions.
        has_skin: whether the body slides on its belly, without wheels.
        has_tail: whether the last connector has a second axle.
        extends: whether pressure lengthens the segments.
    """
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
    """Yield a number of masses that differs from the number of connectors or segments."""
    if len(masses) != count:
        yield Violation(part, f"{len(masses)} masses for {count} {part}; give {count}")


def wheel_violations(wheel: float, connectors: Sequence[float]) -> Iterator[Violation]:
    """Yield wheels that are too heavy for the lightest connector; masses in kg."""
    lightest = min(connectors)
    if 2 * wheel > WHEEL_SHARE * lightest:
        yield Violation(
            "wheel",
            f"two wheels of {wheel:g} kg are too much for the lightest connector,"
            f" {lightest:g} kg; {WHEEL_SHARE * lightest / 2:g} kg each at most",
        )


def tail_violations(com: float, axle: float) -> Iterator[Violation]:
    """Yield a centre of mass that is not between the two axles of a tail, m."""
    if com > axle:
        yield Violation(
            "com",
            f"{com:g} m is behind the second axle at {axle:g} m; the assembly would tip"
            " over",
        )


def direction_violations(directions_deg: Sequence[float]) -> Iterator[Violation]:
    """Yield directions of chambers that leave a side of the segment without a chamber."""
    ordered = np.sort(np.mod(directions_deg, 360.0))
    largest = float(np.diff(ordered, append=ordered[0] + 360.0).max())
    if largest > _MAX_GAP_DEG:
        yield Violation(
            "directions",
            f"no chamber within {largest:g} degrees; neighbours must be less than 180"
            " degrees apart",
        )
