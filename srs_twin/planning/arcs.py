r"""Arcs: motion primitives, the floor that one sweeps, and whether anything is in it; exact, in closed form.

Path coordinates about the middle of an arc of curvature κ: of a point u ahead and w to the left of the
middle,

$$ n = \frac{2w - κ(u^2 + w^2)}{1 + \sqrt{(κu)^2 + (1 - κw)^2}}, \qquad
   s = \frac{1}{κ}\,\mathrm{atan2}(κu, 1 - κw) $$

are the distance to the left of the arc and the place along it; both hold their accuracy down to κ = 0. The
region of a centre of mass that goes from -h to h along the arc is the annular sector |s| ≤ h, -r ≤ n ≤ l
(Fig. 52 and 58). The distance of a point from it is that in n where |s| ≤ h, else that from the nearer end, a
straight line of length l + r across the path. A circle is free of the region if the distance of its centre is
its radius or more.

A side of a polygon is cut where it crosses n = l, n = -r (quadratics) and s = ±h (lines); it is free if none
of its parts has its middle in the region. Whether a polygon contains the whole region is not asked: a plan's
regions hang together from a start that lies outside, so the first to enter would cross a side.

`MARGIN` is what everything is asked to be farther away than it must, which covers rounding.

Motion primitives are the arcs that a node's children are reached by. Section 5.2.1: N turns α from -α_max to
α_max, each held for one step of length v Δt. With θ' = θ + α and r = vΔt/α (Eq. 33 with its signs put right,
E7),

$$ x' = x + r(\sin θ' - \sin θ), \qquad y' = y - r(\cos θ' - \cos θ) $$
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from srs_twin.compute.compiled import compiled
from srs_twin.errors import InputError
from srs_twin.robot.world import Pose

MARGIN = 1e-7
"""Conservative by this much, m; rounding stays below 1e-11 m in worlds of a kilometre."""

_STRAIGHT = 1e-9


@compiled
def along(x, y, heading, curvature, length):  # type: ignore[no-untyped-def]
    """Return the pose after a length (m) along an arc: Eq. 33 corrected (E7), by chord and half turn."""
    half = curvature * length / 2
    chord = length * (np.sin(half) / half if abs(half) > _STRAIGHT else 1.0)
    return x + chord * np.cos(heading + half), y + chord * np.sin(heading + half), heading + 2 * half


@compiled
def blocked(x, y, heading, curvature, length, ahead, behind, left, right, around):  # type: ignore[no-untyped-def]  # noqa: D417
    """Say whether the region of an arc touches an obstacle or leaves the bounds.

    Args:
        x, y, heading: where the centre of mass begins, m and rad.
        curvature, length: of its arc, 1/m and m.
        ahead, behind: of the centre of mass along the arc, m.
        left, right: edges, m.
        around: circles, sides and bounds, as in `collision.Surroundings`.
    """
    bounds, corner = around[2], around[3]
    h = (length + ahead + behind) / 2 + MARGIN
    x, y, heading = along(x, y, heading, curvature, (length + ahead - behind) / 2)
    left, right = left + MARGIN, right + MARGIN
    reach = h + max(left, right)
    if x - reach < bounds[0] or x + reach > bounds[1] or y - reach < bounds[2] or y + reach > bounds[3]:
        if _outside(x, y, heading, curvature, h, left, right, bounds):
            return True
    # Long regions in pieces, which reach into fewer cells.
    count = max(1, int(np.ceil(h / max(corner[2], left + right))))
    part = h / count
    end = along(0.0, 0.0, 0.0, curvature, part)
    region = curvature, part, left, right, end[0], end[1], np.cos(end[2]), np.sin(end[2])
    for k in range(count):
        at_x, at_y, turned = along(x, y, heading, curvature, (2 * k + 1) * part - h)
        if _touches((at_x, at_y, np.cos(turned), np.sin(turned)), region, around):
            return True
    return False


@compiled
def _touches(middle, region, around):  # type: ignore[no-untyped-def]
    """Say whether the region about the middle of an arc touches a circle or a side.

    Args:
        middle: x, y, m, and the heading's cosine and sine.
        region: curvature, h, left and right edges, u, w and the direction's cosine and sine at its end.
        around: as for `blocked`.
    """
    circles, sides, _, corner, first, lists = around
    reach = region[1] + max(region[2], region[3]) + MARGIN
    columns = _cells_within(middle[0] - corner[0], reach, corner[2], first.shape[0])
    rows = _cells_within(middle[1] - corner[1], reach, corner[2], first.shape[1])
    for column in range(columns[0], columns[1]):
        for row in range(rows[0], rows[1]):
            for item in range(first[column, row, 0], first[column, row, 1]):
                if _thing_touches(lists[item], circles, sides, middle, region):
                    return True
    return False


@compiled
def _thing_touches(k, circles, sides, middle, region):  # type: ignore[no-untyped-def]
    """Say whether a circle touches a region, or a side: those are numbered after all circles."""
    x, y, c, s = middle
    reach = region[1] + max(region[2], region[3])
    if k < circles.shape[0]:
        dx, dy, radius = circles[k, 0] - x, circles[k, 1] - y, circles[k, 2] + MARGIN
        if dx * dx + dy * dy >= (reach + radius) * (reach + radius):
            return False
        # The region is its own mirror image across its middle, so u may be taken to be ahead.
        return _distance(abs(c * dx + s * dy), c * dy - s * dx, *region) < radius
    k -= circles.shape[0]
    ax, ay, bx, by = sides[k, 0] - x, sides[k, 1] - y, sides[k, 2] - x, sides[k, 3] - y
    if _from_origin(ax, ay, bx, by) >= reach:
        return False
    return _crosses(c * ax + s * ay, c * ay - s * ax, c * bx + s * by, c * by - s * bx, *region)


@compiled
def _cells_within(at, reach, cell, count):  # type: ignore[no-untyped-def]
    """Return the first cell of a row that a stretch about a place touches, and the one after the last."""
    first, last = np.floor((at - reach) / cell), np.floor((at + reach) / cell)
    return np.int64(min(max(first, 0), count)), np.int64(min(max(last + 1, 0), count))


@compiled
def place(u, w, curvature):  # type: ignore[no-untyped-def]
    """Return n and s of a point."""
    ku, kw = curvature * u, 1 - curvature * w
    n = (2 * w - curvature * (u * u + w * w)) / (1 + np.sqrt(ku * ku + kw * kw))
    return n, np.arctan2(ku, kw) / curvature if abs(curvature) > _STRAIGHT else u


@compiled
def _distance(u, w, curvature, h, left, right, end_u, end_w, ec, es):  # type: ignore[no-untyped-def]
    """Return the distance of a point (u not negative) from the region, 0 inside."""
    n, s = place(u, w, curvature)
    if abs(s) <= h:
        return max(n - left, -right - n, 0.0)
    beyond = ec * (u - end_u) + es * (w - end_w)
    across = ec * (w - end_w) - es * (u - end_u)
    aside = max(across - left, -right - across, 0.0)
    return np.sqrt(beyond * beyond + aside * aside)


@compiled
def _from_origin(ax, ay, bx, by):  # type: ignore[no-untyped-def]
    """Return the distance of a line segment from the origin."""
    dx, dy = bx - ax, by - ay
    t = min(1.0, max(0.0, -(ax * dx + ay * dy) / max(dx * dx + dy * dy, 1e-300)))
    px, py = ax + t * dx, ay + t * dy
    return np.sqrt(px * px + py * py)


@compiled
def _crosses(au, aw, bu, bw, curvature, h, left, right, end_u, end_w, ec, es):  # type: ignore[no-untyped-def]
    """Say whether a line segment has a part in the region."""
    du, dw = bu - au, bw - aw
    # n = e where κ(u² + w²) - 2w + 2e - κe² = 0, with u and w linear in t.
    a = curvature * (du * du + dw * dw)
    b = curvature * (au * du + aw * dw) - dw
    c = curvature * (au * au + aw * aw) - 2 * aw
    in_front = _ratio(ec * (end_u - au) + es * (end_w - aw), ec * du + es * dw)
    behind = _ratio(-ec * (end_u + au) - es * (end_w - aw), ec * du - es * dw)
    on_left = _roots(a, b, c + 2 * left - curvature * left * left)
    on_right = _roots(a, b, c - 2 * right - curvature * right * right)
    cuts = 0.0, in_front, behind, on_left[0], on_left[1], on_right[0], on_right[1]
    for first in cuts:
        last = 1.0
        for cut in cuts:
            if first < cut < last:
                last = cut
        t = (first + last) / 2
        n, s = place(au + t * du, aw + t * dw, curvature)
        if abs(s) <= h and -right <= n <= left:
            return True
    return False


@compiled
def _ratio(over, under):  # type: ignore[no-untyped-def]
    """Return a fraction as a place on a segment, 0 where it has none there."""
    t = over / under if under != 0 else 0.0
    return t if 0 < t < 1 else 0.0


@compiled
def _roots(a, b, c):  # type: ignore[no-untyped-def]
    """Return the roots of a t² + 2 b t + c between 0 and 1, 0 in place of others; a may vanish."""
    square = b * b - a * c
    if square < 0:
        return 0.0, 0.0
    q = -(b + np.sqrt(square)) if b >= 0 else -(b - np.sqrt(square))
    return _ratio(q, a), _ratio(c, q)


@compiled
def _outside(x, y, heading, curvature, h, left, right, bounds):  # type: ignore[no-untyped-def]
    """Say whether the region leaves the bounds: by a corner, or where an edge runs along an axis."""
    for k in range(6):
        s = h if k == 0 else -h
        if k >= 2:
            turn = (k - 2) * np.pi / 2 - heading
            s = (turn - 2 * np.pi * np.round(turn / (2 * np.pi))) / curvature if curvature != 0 else 2 * h + 1
        if abs(s) <= h:
            px, py, there = along(x, y, heading, curvature, s)
            for n in (left, -right):
                ex, ey = px - n * np.sin(there), py + n * np.cos(there)
                if ex < bounds[0] or ex > bounds[1] or ey < bounds[2] or ey > bounds[3]:
                    return True
    return False


@dataclass(frozen=True)
class Primitives:
    """Arcs of one length.

    Attributes:
        count: N, odd, so that the middle one is straight; 3 or more.
        turn: α_max, rad; below π.
        length: of each, v Δt, m.
    """

    count: int
    turn: float
    length: float

    def __post_init__(self) -> None:
        if self.count < 3 or self.count % 2 == 0:
            raise InputError(
                f"{self.count} primitives: the number must be odd, 3 or more (the middle one is straight)"
            )
        if not (0 < self.turn < math.pi and 0 < self.length < math.inf):
            raise InputError(
                f"primitives of {self.length:g} m that turn by {self.turn:g} rad: lengths are above 0, "
                "turns above 0 and below pi"
            )

    @cached_property
    def curvatures(self) -> np.ndarray:
        """From the tightest right turn to the tightest left turn, 1/m, shape (count,)."""
        return np.linspace(-self.turn, self.turn, self.count) / self.length

    def children(self, pose: Pose) -> list[Pose]:
        """Return where each arc ends, in the order of `curvatures`."""
        ends = (along(pose.x, pose.y, pose.heading, float(k), self.length) for k in self.curvatures)
        return [Pose(float(x), float(y), float(heading)) for x, y, heading in ends]
