r"""Dubins paths: the shortest way between two poses for a snake that only goes ahead and turns so tightly.

Dubins (1957): with a least radius r it consists of three pieces, arcs of radius r (L, R) and straights (S),
in one of the six words LSL, LSR, LRL and their mirror images. Below, lengths are in radii, angles from the
line between the poses: with distance d, headings a and b, for the words that begin with L,

$$ LSL: p^2 = 2 + d^2 - 2\cos(a-b) + 2d(\sin a - \sin b) \qquad
   LSR: p^2 = d^2 - 2 + 2\cos(a-b) + 2d(\sin a + \sin b) $$

and LRL with cos p = (6 - d² + 2 cos(a-b) + 2d(sin b - sin a))/8, p > π. Where any arrival heading will do,
the shortest is an arc and a straight, or, to a point inside a turning circle, two arcs (Bui et al., 1994).

The packages that offer this (`dubins`, wrappers of one C file) have had no release for years and no wheels.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.compute.compiled import compiled
from srs_twin.robot.world import Pose

_FULL = 2 * math.pi
_ROUNDING = 1e-9


Pieces = list[tuple[float, float]]
"""(curvature in 1/m, length in m) of arcs laid end to end."""


def shortest(start: Pose, x: float, y: float, heading: float | None, radius: float) -> Pieces:
    """Return the three pieces of the shortest path from a pose to a pose, or to a point; some may be empty.

    Args:
        start: where it begins.
        x: of the end, m.
        y: of the end, m.
        heading: at the end, rad; None where any will do.
        radius: least turning radius, m.
    """
    path = word(*start, x, y, heading or 0.0, heading is None, radius)
    return [(turn / radius, length) for turn, length in zip(path[:3], path[3:], strict=True)]


@compiled
def word(x, y, heading, to_x, to_y, to_heading, free, radius):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return turns (+1 left, 0 straight, -1 right) and lengths (m) of the three pieces of a shortest path.

    Args:
        x, y, heading: where it begins, m and rad.
        to_x, to_y, to_heading: where it ends; the heading counts unless `free`.
        radius: of the turns, m.
    """
    dx, dy = (to_x - x) / radius, (to_y - y) / radius
    best = (0.0, 0.0, 0.0, np.inf, np.inf, np.inf)
    if free:
        c, s = np.cos(heading), np.sin(heading)
        u, w = c * dx + s * dy, c * dy - s * dx
        if np.sqrt(u * u + w * w) < _ROUNDING:  # it is there already
            best = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        for side in (1.0, -1.0):
            best = _to_point(best, side, u, side * w)
    else:
        d, line = np.sqrt(dx * dx + dy * dy), np.arctan2(dy, dx)
        if d < _ROUNDING:  # at one place a line has no direction, and rounding must not ask for a full turn
            d, line = 0.0, heading
        for side in (1.0, -1.0):
            best = _to_pose(best, side, d, side * (heading - line), side * (to_heading - line))
    first, middle, last, t, p, q = best
    return first, middle, last, radius * t, radius * p, radius * q


@compiled
def _to_pose(best, side, d, a, b):  # type: ignore[no-untyped-def]
    """Return the shortest of `best` and the words that begin with L; `side` -1: of their mirror images."""
    sa, sb, ca, cb, cab = np.sin(a), np.sin(b), np.cos(a), np.cos(b), np.cos(a - b)
    square = 2 + d * d - 2 * cab + 2 * d * (sa - sb)
    turn = np.arctan2(cb - ca, d + sa - sb)
    if np.sqrt((d + sa - sb) ** 2 + (cb - ca) ** 2) < _ROUNDING:
        # The circles coincide: a straight of no length has no direction, and the first arc turns all the way.
        square, turn = 0.0, b
    best = _shorter(best, side, 0.0, side, _turn(turn - a), np.sqrt(max(square, 0.0)), _turn(b - turn))
    square = d * d - 2 + 2 * cab + 2 * d * (sa + sb)
    if square >= 0:
        p = np.sqrt(square)
        turn = np.arctan2(-ca - cb, d + sa + sb) - np.arctan2(-2.0, p)
        best = _shorter(best, side, 0.0, -side, _turn(turn - a), p, _turn(turn - b))
    cosine = (6 - d * d + 2 * cab + 2 * d * (sb - sa)) / 8
    if abs(cosine) <= 1:
        p = _FULL - np.arccos(cosine)
        t = _turn(p / 2 - a - np.arctan2(ca - cb, d + sa - sb))
        best = _shorter(best, side, -side, side, t, p, _turn(b - a - t + p))
    return best


@compiled
def _to_point(best, side, u, w):  # type: ignore[no-untyped-def]
    """Return the shortest of `best`, LS and RL to a point u ahead and w to the left; `side` -1: mirrored."""
    away = u * u + (w - 1) * (w - 1)
    if away >= 1:
        tangent = np.arctan2(u, 1 - w) - np.arccos(1 / np.sqrt(away))
        return _shorter(best, side, 0.0, 0.0, _turn(tangent), np.sqrt(away - 1), 0.0)
    # Inside the left circle: right first, about (0, -1), then left on a circle that touches both.
    far = np.sqrt(u * u + (w + 1) * (w + 1))
    opening = np.arccos(min(1.0, (3 + far * far) / (4 * far)))
    for sign in (1.0, -1.0):
        t = _turn(np.arctan2(u, w + 1) + sign * opening)
        cx, cy = 2 * np.sin(t), 2 * np.cos(t) - 1
        q = _turn(np.arctan2(w - cy, u - cx) - np.arctan2(-np.cos(t), -np.sin(t)))
        best = _shorter(best, -side, side, 0.0, t, q, 0.0)
    return best


@compiled
def _shorter(best, first, middle, last, t, p, q):  # type: ignore[no-untyped-def]
    if t + p + q < best[3] + best[4] + best[5]:
        return first, middle, last, t, p, q
    return best


@compiled
def _turn(angle):  # type: ignore[no-untyped-def]
    """Return an angle in [0, 2 pi); what rounding puts just below a full turn is none."""
    angle = angle - _FULL * np.floor(angle / _FULL)
    return max(angle, 0.0) if angle < _FULL - _ROUNDING else 0.0
