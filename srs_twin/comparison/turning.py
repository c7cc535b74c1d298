"""The circle on which each gait period carries a snake, and what counts as straight."""

from __future__ import annotations

import math

# Straight is what turns on a circle of more body lengths than this (for gen 2 some 20 m, where a path of
# 2 m leaves its tangent by 0.1 m), or by less than this angle in a gait period (0.06°, what contact creep
# does to a snake that does not get anywhere).
STRAIGHT_BODY_LENGTHS = 100.0
STRAIGHT_TURN_RAD = 1e-3


def turning_radius(speed: float, yaw_rate: float, period: float, length: float) -> float | None:
    """Return the signed radius (m), positive where its centre lies on the left; None when straight.

    In one period the body is carried speed · period along a chord and turns by yaw_rate · period; the chord
    of that angle has this radius. (Speed over yaw rate would be that of the averaged path, which the
    averaging draws inwards: by 1 % where a period turns by half a radian.)

    Args:
        speed: along the heading, m/s.
        yaw_rate: rad/s.
        period: of the gait, s.
        length: of the body, m.
    """
    turn = yaw_rate * period
    if abs(turn) < STRAIGHT_TURN_RAD:
        return None
    radius = speed * period / (2 * math.sin(turn / 2))
    return radius if abs(radius) <= STRAIGHT_BODY_LENGTHS * length else None


def path_curvature(chord: float, turn: float) -> float:
    """Return the curvature of the circle with a chord (m, not 0) over which the body turns (rad), 1/m."""
    return 2 * math.sin(turn / 2) / chord
