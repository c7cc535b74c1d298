r"""Dubins paths, the shortest forward paths with a minimum turning radius.

The shortest path with a minimum turning radius r has three pieces (Dubins 1957). Each
piece is an arc of radius r to the left (L) or to the right (R), or a straight line (S).
The six possible sequences of pieces are LSL, LSR, LRL and their mirror images. In the
following equations, all lengths are divided by r. The distance between the two poses is
d, and the length of the middle piece is p. The headings a and b of the poses are
measured from the line between the poses:

$$ LSL: p^2 = 2 + d^2 - 2\cos(a-b) + 2d(\sin a - \sin b) \qquad
   LSR: p^2 = d^2 - 2 + 2\cos(a-b) + 2d(\sin a + \sin b) $$

For LRL, cos p = (6 - d² + 2 cos(a-b) + 2d(sin b - sin a))/8 with p > π.

If the final heading is free, the shortest path consists of an arc and a straight line
(Bui et al., 1994). If the end point is inside a turning circle, the path consists of
two arcs.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled, kernel_only
from srs_twin.planning.arcs import ArcSequence
from srs_twin.robot.world import Pose

_FULL_TURN = 2 * math.pi

_ROUNDING = 1e-9
"""Tolerance for rounding errors in distances (turning radii) and angles (rad)."""


class DubinsPath(NamedTuple):
    """Dubins path of three pieces.

    Attributes:
        turns: direction of each piece (1 for left, 0 for straight, -1 for right).
        lengths: length of each piece, m.
        length: path length, m.
    """

    turns: tuple[float, float, float]
    lengths: tuple[float, float, float]
    length: float


def shortest_path(
    start: Pose, x: float, y: float, heading: float | None, radius: float
) -> ArcSequence:
    """Return the shortest path as three arcs, some of which may have length 0.

    Args:
        start: start pose.
        x: x coordinate of the end, m.
        y: y coordinate of the end, m.
        heading: final heading, rad, or None for any heading.
        radius: turning radius, m.
    """
    path = dubins_path(
        *start, *Pose(x, y, heading or 0.0), heading is None, float(radius)
    )
    pieces = zip(path.turns, path.lengths, strict=True)
    return [(turn / radius, length) for turn, length in pieces]


@compiled
def dubins_path(x, y, heading, to_x, to_y, to_heading, any_heading, radius):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the shortest Dubins path between two poses (m, rad).

    If `any_heading` is true, the final heading is free, and `to_heading` is ignored.
    """
    dx = (to_x - x) / radius
    dy = (to_y - y) / radius
    nothing = (0.0, 0.0, 0.0)
    best = DubinsPath(nothing, nothing, np.inf)
    if any_heading:
        c = np.cos(heading)
        s = np.sin(heading)
        u = c * dx + s * dy
        w = c * dy - s * dx
        if np.sqrt(u * u + w * w) < _ROUNDING:
            best = DubinsPath(nothing, nothing, 0.0)
        for side in (1.0, -1.0):
            best = _shortest_to_point(best, side, u, side * w)
    else:
        d = np.sqrt(dx * dx + dy * dy)
        line = np.arctan2(dy, dx)
        if d < _ROUNDING:
            # The line between coinciding points has no direction, so rounding errors
            # could add a full turn.
            d = 0.0
            line = heading
        for side in (1.0, -1.0):
            best = _shortest_to_pose(
                best, side, d, side * (heading - line), side * (to_heading - line)
            )
    t, p, q = best.lengths
    lengths = (radius * t, radius * p, radius * q)
    return DubinsPath(best.turns, lengths, lengths[0] + lengths[1] + lengths[2])


@kernel_only
def _shortest_to_pose(best, side, d, a, b):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the shortest path among `best` and the sequences that begin with L or R.

    The sequences begin with L if `side` is 1, and with R if `side` is -1. The headings
    a and b are relative to the line between the poses, and mirrored if `side` is -1.
    """
    sa = np.sin(a)
    sb = np.sin(b)
    ca = np.cos(a)
    cb = np.cos(b)
    cab = np.cos(a - b)
    # In LSL, the straight line is an outer tangent of both turning circles.
    square = 2 + d * d - 2 * cab + 2 * d * (sa - sb)
    turn = np.arctan2(cb - ca, d + sa - sb)
    if np.sqrt((d + sa - sb) ** 2 + (cb - ca) ** 2) < _ROUNDING:
        # If the turning circles coincide, the straight line has no direction, and the
        # path is a single arc.
        square = 0.0
        turn = b
    p = np.sqrt(max(square, 0.0))
    lengths = (_wrapped(turn - a), p, _wrapped(b - turn))
    best = _shorter(best, (side, 0.0, side), lengths)
    # In LSR, the straight line is an inner tangent, which exists only if the turning
    # circles do not overlap.
    square = d * d - 2 + 2 * cab + 2 * d * (sa + sb)
    if square >= 0:
        p = np.sqrt(square)
        turn = np.arctan2(-ca - cb, d + sa + sb) - np.arctan2(-2.0, p)
        lengths = (_wrapped(turn - a), p, _wrapped(turn - b))
        best = _shorter(best, (side, 0.0, -side), lengths)
    # LRL exists only if a third circle of equal radius can touch both turning circles.
    cosine = (6 - d * d + 2 * cab + 2 * d * (sb - sa)) / 8
    if abs(cosine) <= 1:
        p = _FULL_TURN - np.arccos(cosine)
        t = _wrapped(p / 2 - a - np.arctan2(ca - cb, d + sa - sb))
        lengths = (t, p, _wrapped(b - a - t + p))
        best = _shorter(best, (side, -side, side), lengths)
    return best


@kernel_only
def _shortest_to_point(best, side, u, w):  # type: ignore[no-untyped-def]
    """Return the shortest path among `best` and one sequence that leads to a point.

    If `side` is 1, the point is u ahead of the start and w to the left. The sequence is
    LS, or RL if the point is inside the left turning circle. If `side` is -1, left and
    right are exchanged.
    """
    away = u * u + (w - 1) * (w - 1)
    if away >= 1:
        tangent = np.arctan2(u, 1 - w) - np.arccos(1 / np.sqrt(away))
        lengths = (_wrapped(tangent), np.sqrt(away - 1), 0.0)
        return _shorter(best, (side, 0.0, 0.0), lengths)
    # To a point inside the left turning circle, the path first turns right about the
    # point (0, -1) and then left on a tangent circle.
    far = np.sqrt(u * u + (w + 1) * (w + 1))
    opening = np.arccos(min(1.0, (3 + far * far) / (4 * far)))
    for sign in (1.0, -1.0):
        t = _wrapped(np.arctan2(u, w + 1) + sign * opening)
        cx = 2 * np.sin(t)
        cy = 2 * np.cos(t) - 1
        q = _wrapped(np.arctan2(w - cy, u - cx) - np.arctan2(-np.cos(t), -np.sin(t)))
        best = _shorter(best, (-side, side, 0.0), (t, q, 0.0))
    return best


@kernel_only
def _shorter(best, turns, lengths):  # type: ignore[no-untyped-def]
    length = lengths[0] + lengths[1] + lengths[2]
    if length < best.length:
        return DubinsPath(turns, lengths, length)
    return best


@kernel_only
def _wrapped(angle):  # type: ignore[no-untyped-def]
    """Wrap an angle to [0, 2π), and return 0 for almost a full turn."""
    angle = angle - _FULL_TURN * np.floor(angle / _FULL_TURN)
    if angle < _FULL_TURN - _ROUNDING:
        return max(angle, 0.0)
    return 0.0
