r"""Arcs of constant curvature, and exact collision checks of the swept area.

Consider a point that lies a distance u ahead of the midpoint of an arc with curvature
κ, and a distance w to the left of the midpoint. The path coordinates of this point are

$$ n = \frac{2w - κ(u^2 + w^2)}{1 + \sqrt{(κu)^2 + (1 - κw)^2}}, \qquad
   s = \frac{1}{κ}\,\mathrm{atan2}(κu, 1 - κw) , $$

where n is the signed distance from the arc, positive to the left, and s is the position
along the arc, measured from the midpoint.

While the body moves along the arc, it sweeps the annular sector |s| ≤ h, -r ≤ n ≤ l
(Figs. 52 and 58). Here, l and r are the distances from the arc to the left and right
edges, and the length 2h includes the parts of the body ahead of and behind the centre
of mass. A point with |s| ≤ h is at a distance of max(n - l, -r - n, 0) from the sector.
For any other point, the distance is measured to the nearer end of the sector, which is
a straight line across the path. A circular obstacle does not overlap the sector if the
distance between its centre and the sector is at least its radius.

A polygon side is split where it crosses n = l or n = -r (quadratic equations) and where
it crosses s = ±h (linear equations). The side does not overlap the sector if no
resulting piece has its midpoint in the sector. A polygon that contains the whole sector
needs no check, because a path from outside crosses a side of the polygon in an earlier
sector.

The motion primitives of the search are N arcs of length v Δt with turning angles α from
-α_max to α_max (Section 5.2.1). With θ' = θ + α and r = vΔt/α, an arc ends at the
position (Eq. 33 with corrected signs, E7)

$$ x' = x + r(\sin θ' - \sin θ), \qquad y' = y - r(\cos θ' - \cos θ) $$
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled, kernel_only
from srs_twin.errors import InputError
from srs_twin.robot.world import Pose

ROUNDING_MARGIN = 1e-7
"""Distance added to the swept area and to circles in collision checks, m.

Rounding errors are below 1e-11 m in a world with a size of 1 km.
"""

ArcSequence = list[tuple[float, float]]
"""Consecutive arcs as pairs of curvature (1/m) and length (m)."""

_STRAIGHT = 1e-9
"""Curvature (1/m) or half turning angle (rad) below which an arc counts as straight."""


@compiled
def arc_end(x, y, heading, curvature, length):  # type: ignore[no-untyped-def]
    """Return the pose (m, rad) at the end of an arc (Eq. 33, corrected by E7)."""
    half = curvature * length / 2
    # The end is computed from the chord, because Eq. 33 is inaccurate at small
    # curvatures.
    chord = length
    if abs(half) > _STRAIGHT:
        chord = length * (np.sin(half) / half)
    return (
        x + chord * np.cos(heading + half),
        y + chord * np.sin(heading + half),
        heading + 2 * half,
    )


class Extent(NamedTuple):
    """Extent of the body around its centre of mass.

    Attributes:
        ahead, behind: distances from the centre of mass to the head and to the tail
            along the arc, m.
        left, right: distances from the path to the left and right edges of the
            footprint, m.
    """

    ahead: float
    behind: float
    left: float
    right: float


class PathFrame(NamedTuple):
    """Coordinate frame (m, rad) on an arc, with cosine and sine of the heading."""

    x: float
    y: float
    heading: float
    cosine: float
    sine: float


class Region(NamedTuple):
    """Area swept along an arc, described relative to the midpoint of the arc.

    Attributes:
        curvature: arc curvature, 1/m.
        half: half-length h of the area along the arc, m.
        left, right: distances from the arc to the left and right edges, m.
        reach: radius of a circle around the midpoint that encloses the area, m.
        end: frame at the front end of the area, with x and y measured ahead of the
            midpoint and to its left.
    """

    curvature: float
    half: float
    left: float
    right: float
    reach: float
    end: PathFrame


@kernel_only
def _frame(x, y, heading, curvature, s):  # type: ignore[no-untyped-def]
    x, y, heading = arc_end(x, y, heading, curvature, s)
    return PathFrame(x, y, heading, np.cos(heading), np.sin(heading))


@kernel_only
def _local(frame, x, y):  # type: ignore[no-untyped-def]
    dx = x - frame.x
    dy = y - frame.y
    return (
        frame.cosine * dx + frame.sine * dy,
        frame.cosine * dy - frame.sine * dx,
    )


@compiled
def arc_collides(pose, curvature, length, extent, grid):  # type: ignore[no-untyped-def]
    """Return whether the area swept along an arc hits an obstacle or leaves the bounds.

    The initial pose of the centre of mass is in m and rad, the curvature in 1/m, and
    the length in m.
    """
    h = (length + extent.ahead + extent.behind) / 2 + ROUNDING_MARGIN
    x, y, heading = arc_end(
        pose[0],
        pose[1],
        pose[2],
        curvature,
        (length + extent.ahead - extent.behind) / 2,
    )
    left = extent.left + ROUNDING_MARGIN
    right = extent.right + ROUNDING_MARGIN
    # A long area is divided into pieces, each of which overlaps only a few grid cells.
    count = max(1, int(np.ceil(h / max(grid.cell, left + right))))
    half = h / count
    end = _frame(0.0, 0.0, 0.0, curvature, half)
    region = Region(curvature, half, left, right, half + max(left, right), end)
    for k in range(count):
        middle = _frame(x, y, heading, curvature, (2 * k + 1) * half - h)
        if _leaves_bounds(middle, region, grid.bounds):
            return True
        if _touches_obstacle(middle, region, grid):
            return True
    return False


@kernel_only
def _touches_obstacle(middle, region, grid):  # type: ignore[no-untyped-def]
    reach = region.reach + ROUNDING_MARGIN
    columns, rows = grid.cell_ranges.shape[:2]
    first, last = _cell_range(middle.x - grid.west, reach, grid.cell, columns)
    low, high = _cell_range(middle.y - grid.south, reach, grid.cell, rows)
    circles = len(grid.circles)
    for column in range(first, last):
        for row in range(low, high):
            begin = grid.cell_ranges[column, row, 0]
            end = grid.cell_ranges[column, row, 1]
            for place in range(begin, end):
                item = grid.cell_items[place]
                if item < circles:
                    touches = _touches_circle(middle, region, grid.circles[item])
                else:
                    side = grid.sides[item - circles]
                    touches = _touches_side(middle, region, side)
                if touches:
                    return True
    return False


@kernel_only
def _cell_range(position, reach, cell, count):  # type: ignore[no-untyped-def]
    first = np.floor((position - reach) / cell)
    last = np.floor((position + reach) / cell)
    return np.int64(min(max(first, 0), count)), np.int64(min(max(last + 1, 0), count))


@kernel_only
def _touches_circle(middle, region, circle):  # type: ignore[no-untyped-def]
    radius = circle[2] + ROUNDING_MARGIN
    dx = circle[0] - middle.x
    dy = circle[1] - middle.y
    if dx * dx + dy * dy >= (region.reach + radius) * (region.reach + radius):
        return False
    u, w = _local(middle, circle[0], circle[1])
    # The sign of u is irrelevant, because the swept area is symmetric about u = 0.
    return _region_distance(abs(u), w, region) < radius


@kernel_only
def _touches_side(middle, region, side):  # type: ignore[no-untyped-def]
    distance = _distance_from_origin(
        side[0] - middle.x, side[1] - middle.y, side[2] - middle.x, side[3] - middle.y
    )
    if distance >= region.reach:
        return False
    au, aw = _local(middle, side[0], side[1])
    bu, bw = _local(middle, side[2], side[3])
    return _side_crosses(au, aw, bu, bw, region)


@kernel_only
def path_coordinates(u, w, curvature):  # type: ignore[no-untyped-def]
    """Return the path coordinates n and s (m) of a point near an arc.

    The point lies u (m) ahead and w (m) to the left of the arc point with s = 0.
    """
    ku = curvature * u
    kw = 1 - curvature * w
    n = (2 * w - curvature * (u * u + w * w)) / (1 + np.sqrt(ku * ku + kw * kw))
    if abs(curvature) > _STRAIGHT:
        return n, np.arctan2(ku, kw) / curvature
    return n, u


@kernel_only
def _region_distance(u, w, region):  # type: ignore[no-untyped-def]
    n, s = path_coordinates(u, w, region.curvature)
    if abs(s) <= region.half:
        return max(n - region.left, -region.right - n, 0.0)
    beyond, across = _local(region.end, u, w)
    outside = max(across - region.left, -region.right - across, 0.0)
    return np.sqrt(beyond * beyond + outside * outside)


@kernel_only
def _distance_from_origin(ax, ay, bx, by):  # type: ignore[no-untyped-def]
    dx = bx - ax
    dy = by - ay
    # The minimum of the denominator avoids 0/0 for a line of length 0.
    t = min(1.0, max(0.0, -(ax * dx + ay * dy) / max(dx * dx + dy * dy, 1e-300)))
    px = ax + t * dx
    py = ay + t * dy
    return np.sqrt(px * px + py * py)


@kernel_only
def _side_crosses(au, aw, bu, bw, region):  # type: ignore[no-untyped-def]
    curvature = region.curvature
    end = region.end
    du = bu - au
    dw = bw - aw
    # The edge n = e lies on the circle κ(u² + w²) - 2w + 2e - κe² = 0. Along a polygon
    # side, u and w are linear in t, so the side crosses the circle at the roots of a
    # quadratic polynomial a t² + 2 b t + c.
    a = curvature * (du * du + dw * dw)
    b = curvature * (au * du + aw * dw) - dw
    c = curvature * (au * au + aw * aw) - 2 * aw
    left = _roots(a, b, c + 2 * region.left - curvature * region.left * region.left)
    right = _roots(a, b, c - 2 * region.right - curvature * region.right * region.right)
    front = _fraction(
        end.cosine * (end.x - au) + end.sine * (end.y - aw),
        end.cosine * du + end.sine * dw,
    )
    back = _fraction(
        -end.cosine * (end.x + au) - end.sine * (end.y - aw),
        end.cosine * du - end.sine * dw,
    )
    cuts = (0.0, front, back, left[0], left[1], right[0], right[1])
    # The side touches the swept area if the midpoint between two neighbouring
    # intersections is in the area.
    for first in cuts:
        last = 1.0
        for cut in cuts:
            if first < cut < last:
                last = cut
        t = (first + last) / 2
        n, s = path_coordinates(au + t * du, aw + t * dw, curvature)
        if abs(s) <= region.half and -region.right <= n <= region.left:
            return True
    return False


@kernel_only
def _fraction(numerator, denominator):  # type: ignore[no-untyped-def]
    if denominator == 0:
        return 0.0
    t = numerator / denominator
    if 0 < t < 1:
        return t
    return 0.0


@kernel_only
def _roots(a, b, c):  # type: ignore[no-untyped-def]
    """Return the roots of a t² + 2 b t + c in (0, 1), with 0 for each missing root."""
    square = b * b - a * c
    if square < 0:
        return 0.0, 0.0
    # To avoid cancellation, the second root follows from the product c/a of both roots.
    if b >= 0:
        q = -(b + np.sqrt(square))
    else:
        q = -(b - np.sqrt(square))
    return _fraction(q, a), _fraction(c, q)


@kernel_only
def _leaves_bounds(middle, region, bounds):  # type: ignore[no-untyped-def]
    # A bounding square is tested first, because most swept areas are far from the
    # bounds.
    if (
        bounds.west <= middle.x - region.reach
        and middle.x + region.reach <= bounds.east
        and bounds.south <= middle.y - region.reach
        and middle.y + region.reach <= bounds.north
    ):
        return False
    for s in (-region.half, region.half):
        if _edge_is_outside(middle, region, s, bounds):
            return True
    if region.curvature == 0:
        return False
    # A curved edge reaches its extreme x or y where it is parallel to an axis.
    for quarter in range(4):
        turn = quarter * np.pi / 2 - middle.heading
        turn -= 2 * np.pi * np.round(turn / (2 * np.pi))
        s = turn / region.curvature
        if abs(s) <= region.half and _edge_is_outside(middle, region, s, bounds):
            return True
    return False


@kernel_only
def _edge_is_outside(middle, region, s, bounds):  # type: ignore[no-untyped-def]
    at = _frame(middle.x, middle.y, middle.heading, region.curvature, s)
    for n in (region.left, -region.right):
        x = at.x - n * at.sine
        y = at.y + n * at.cosine
        if not (bounds.west <= x <= bounds.east and bounds.south <= y <= bounds.north):
            return True
    return False


@dataclass(frozen=True)
class Primitives:
    """Motion primitives, which are arcs of equal length and evenly spaced curvatures.

    Attributes:
        count: number N of arcs, odd and at least 3, so that the middle arc is straight.
        turn: maximum turning angle α_max of an arc, between 0 and π, rad.
        length: length v Δt of each arc, m.
    """

    count: int
    turn: float
    length: float

    def __post_init__(self) -> None:
        if self.count < 3 or self.count % 2 == 0:
            raise InputError(
                f"the number of primitives {self.count} is not allowed; it must be odd"
                " and at least 3, because the middle primitive is straight and both"
                " sides have the same number"
            )
        if not (0 < self.turn < math.pi and 0 < self.length < math.inf):
            raise InputError(
                f"primitives of {self.length:g} m with turns of up to {self.turn:g}"
                " rad are not allowed; the length must be above 0, and the turn must"
                " be between 0 and pi"
            )

    @cached_property
    def curvatures(self) -> np.ndarray:
        """Curvatures from the tightest right turn to the tightest left turn, 1/m."""
        return np.linspace(-self.turn, self.turn, self.count) / self.length

    def children(self, pose: Pose) -> list[Pose]:
        """Return the end poses of all arcs from a pose, ordered by curvature."""
        ends = (
            arc_end(pose.x, pose.y, pose.heading, float(k), self.length)
            for k in self.curvatures
        )
        return [Pose(float(x), float(y), float(heading)) for x, y, heading in ends]
