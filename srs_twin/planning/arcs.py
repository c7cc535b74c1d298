r"""Arcs of constant curvature: poses along them, and exact collision checks of the area that the body sweeps.

Path coordinates relative to the middle of an arc of curvature κ: for a point at
distance u ahead of the middle and w to its left,

$$ n = \frac{2w - κ(u^2 + w^2)}{1 + \sqrt{(κu)^2 + (1 - κw)^2}}, \qquad
   s = \frac{1}{κ}\,\mathrm{atan2}(κu, 1 - κw) $$

are the signed distance from the arc, positive to the left, and the position along it.
Both formulas stay accurate as κ approaches 0. While the centre of mass moves along the
arc from -h to h, the body sweeps the annular sector |s| ≤ h, -r ≤ n ≤ l (Fig. 52 and
58). The distance of a point from this region is its distance in n if |s| ≤ h, otherwise
its distance from the nearer end, a straight line of length l + r across the path. A
circle is free of the region if the distance of its centre is at least its radius.

A side of a polygon is cut where it crosses n = l, n = -r (quadratic equations) and s =
±h (linear equations). It is free if no midpoint of its pieces is in the region. A
polygon that contains the whole region is not detected: the regions of a plan are
connected and start outside all polygons, so the first region inside one would cross a
side.

Motion primitives are the arcs from a search node to its children. Section 5.2.1: N
turns α from -α_max to α_max, each over one step of length v Δt. With θ' = θ + α and r =
vΔt/α (Eq. 33 with corrected signs, E7),

$$ x' = x + r(\sin θ' - \sin θ), \qquad y' = y - r(\cos θ' - \cos θ) $$
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from srs_twin.compute.compiled import compiled, kernel_only
from srs_twin.errors import InputError
from srs_twin.robot.world import Pose

ROUNDING_MARGIN = 1e-7
"""Distance added to all checks, m; rounding errors are below 1e-11 m in worlds of a kilometre."""

ArcSequence = list[tuple[float, float]]
"""Consecutive arcs: curvature, 1/m, and length, m."""

_STRAIGHT = 1e-9
"""Curvature (1/m) or half turn (rad) below which an arc is treated as straight, to avoid 0/0."""


@compiled
def arc_end(x, y, heading, curvature, length):  # type: ignore[no-untyped-def]
    """Return the pose after a length (m) along an arc: corrected Eq. 33 (E7) by chord and half turn."""
    half = curvature * length / 2
    # Chord and half turn avoid the cancellation of Eq. 33 for small curvatures.
    chord = length * (np.sin(half) / half if abs(half) > _STRAIGHT else 1.0)
    return (
        x + chord * np.cos(heading + half),
        y + chord * np.sin(heading + half),
        heading + 2 * half,
    )


@compiled
def arc_collides(pose, curvature, length, extent, grid):  # type: ignore[no-untyped-def]
    """Return whether the swept region of an arc touches an obstacle or leaves the bounds.

    Args:
        pose: x, y and heading of the centre of mass at the start, m and rad.
        curvature: curvature of the arc, 1/m.
        length: length of the arc, m.
        extent: extent of the body ahead of and behind the centre of mass along the arc,
            and distances of the footprint's left and right edge from the path, m.
        grid: obstacles and bounds, see `collision.ObstacleGrid`.
    """
    ahead, behind, left, right = extent
    bounds = grid[2]
    origin = grid[3]
    h = (length + ahead + behind) / 2 + ROUNDING_MARGIN
    x, y, heading = arc_end(
        pose[0], pose[1], pose[2], curvature, (length + ahead - behind) / 2
    )
    left = left + ROUNDING_MARGIN
    right = right + ROUNDING_MARGIN
    # Test a bounding square first: most regions are far from the bounds.
    reach = h + max(left, right)
    if (
        x - reach < bounds[0]
        or x + reach > bounds[1]
        or y - reach < bounds[2]
        or y + reach > bounds[3]
    ):
        if _leaves_bounds(x, y, heading, curvature, h, left, right, bounds):
            return True
    # A long region is divided, so that each piece overlaps few cells of the grid.
    count = max(1, int(np.ceil(h / max(origin[2], left + right))))
    half_length = h / count
    end = arc_end(0.0, 0.0, 0.0, curvature, half_length)
    region = (
        curvature,
        half_length,
        left,
        right,
        end[0],
        end[1],
        np.cos(end[2]),
        np.sin(end[2]),
    )
    for k in range(count):
        mid_x, mid_y, mid_heading = arc_end(
            x, y, heading, curvature, (2 * k + 1) * half_length - h
        )
        if _region_collides(
            (mid_x, mid_y, np.cos(mid_heading), np.sin(mid_heading)), region, grid
        ):
            return True
    return False


@kernel_only
def _region_collides(middle, region, grid):  # type: ignore[no-untyped-def]
    """Return whether a region touches a circle or a polygon side.

    Args:
        middle: x and y of the middle of the arc, m, and cosine and sine of its heading
            there.
        region: curvature, h, left and right edge, u and w of the end, cosine and sine
            of the heading there.
        grid: see `arc_collides`.
    """
    circles, sides, _, origin, cell_ranges, cell_items = grid
    reach = region[1] + max(region[2], region[3]) + ROUNDING_MARGIN
    columns = _cell_range(middle[0] - origin[0], reach, origin[2], cell_ranges.shape[0])
    rows = _cell_range(middle[1] - origin[1], reach, origin[2], cell_ranges.shape[1])
    for column in range(columns[0], columns[1]):
        for row in range(rows[0], rows[1]):
            for item in range(cell_ranges[column, row, 0], cell_ranges[column, row, 1]):
                if _item_collides(cell_items[item], circles, sides, middle, region):
                    return True
    return False


@kernel_only
def _item_collides(k, circles, sides, middle, region):  # type: ignore[no-untyped-def]
    """Return whether item k touches a region; the items are first all circles, then all polygon sides."""
    x, y, c, s = middle
    reach = region[1] + max(region[2], region[3])
    if k < circles.shape[0]:
        dx = circles[k, 0] - x
        dy = circles[k, 1] - y
        radius = circles[k, 2] + ROUNDING_MARGIN
        # Test bounding circles first: they are cheap and exclude most items.
        if dx * dx + dy * dy >= (reach + radius) * (reach + radius):
            return False
        # The region is symmetric about the line across its middle, so u can be taken as
        # positive.
        return _region_distance(abs(c * dx + s * dy), c * dy - s * dx, region) < radius
    k -= circles.shape[0]
    ax = sides[k, 0] - x
    ay = sides[k, 1] - y
    bx = sides[k, 2] - x
    by = sides[k, 3] - y
    if _distance_from_origin(ax, ay, bx, by) >= reach:
        return False
    return _side_crosses(
        c * ax + s * ay, c * ay - s * ax, c * bx + s * by, c * by - s * bx, region
    )


@kernel_only
def _cell_range(position, reach, cell, count):  # type: ignore[no-untyped-def]
    """Return the range of cells (end exclusive) along an axis within `reach` of a position."""
    first = np.floor((position - reach) / cell)
    last = np.floor((position + reach) / cell)
    return np.int64(min(max(first, 0), count)), np.int64(min(max(last + 1, 0), count))


@kernel_only
def path_coordinates(u, w, curvature):  # type: ignore[no-untyped-def]
    """Return n and s of a point u ahead and w to the left of a point on an arc, m (module docstring)."""
    ku = curvature * u
    kw = 1 - curvature * w
    n = (2 * w - curvature * (u * u + w * w)) / (1 + np.sqrt(ku * ku + kw * kw))
    return n, np.arctan2(ku, kw) / curvature if abs(curvature) > _STRAIGHT else u


@kernel_only
def _region_distance(u, w, region):  # type: ignore[no-untyped-def]
    """Return the distance of a point (u ≥ 0) from the region, m; 0 inside."""
    curvature, h, left, right, end_u, end_w, ec, es = region
    n, s = path_coordinates(u, w, curvature)
    if abs(s) <= h:
        return max(n - left, -right - n, 0.0)
    # Coordinates relative to the end line, along and across the heading there.
    beyond = ec * (u - end_u) + es * (w - end_w)
    across = ec * (w - end_w) - es * (u - end_u)
    outside = max(across - left, -right - across, 0.0)
    return np.sqrt(beyond * beyond + outside * outside)


@kernel_only
def _distance_from_origin(ax, ay, bx, by):  # type: ignore[no-untyped-def]
    """Return the distance of a line segment from the origin, m."""
    dx = bx - ax
    dy = by - ay
    # The lower limit avoids 0/0 for a segment without length.
    t = min(1.0, max(0.0, -(ax * dx + ay * dy) / max(dx * dx + dy * dy, 1e-300)))
    px = ax + t * dx
    py = ay + t * dy
    return np.sqrt(px * px + py * py)


@kernel_only
def _side_crosses(au, aw, bu, bw, region):  # type: ignore[no-untyped-def]
    """Return whether a line segment from (au, aw) to (bu, bw) enters the region."""
    curvature, h, left, right, end_u, end_w, ec, es = region
    du = bu - au
    dw = bw - aw
    # n = e where κ(u² + w²) - 2w + 2e - κe² = 0, with u and w linear in t.
    a = curvature * (du * du + dw * dw)
    b = curvature * (au * du + aw * dw) - dw
    c = curvature * (au * au + aw * aw) - 2 * aw
    front = _fraction(ec * (end_u - au) + es * (end_w - aw), ec * du + es * dw)
    back = _fraction(-ec * (end_u + au) - es * (end_w - aw), ec * du - es * dw)
    on_left = _roots(a, b, c + 2 * left - curvature * left * left)
    on_right = _roots(a, b, c - 2 * right - curvature * right * right)
    cuts = 0.0, front, back, on_left[0], on_left[1], on_right[0], on_right[1]
    # Test the midpoint of each piece between neighbouring cuts.
    for first in cuts:
        last = 1.0
        for cut in cuts:
            if first < cut < last:
                last = cut
        t = (first + last) / 2
        n, s = path_coordinates(au + t * du, aw + t * dw, curvature)
        if abs(s) <= h and -right <= n <= left:
            return True
    return False


@kernel_only
def _fraction(numerator, denominator):  # type: ignore[no-untyped-def]
    """Return a quotient if it is between 0 and 1, otherwise 0."""
    t = numerator / denominator if denominator != 0 else 0.0
    if 0 < t < 1:
        return t
    return 0.0


@kernel_only
def _roots(a, b, c):  # type: ignore[no-untyped-def]
    """Return the roots of a t² + 2 b t + c between 0 and 1, and 0 instead of other roots; a may be 0."""
    square = b * b - a * c
    if square < 0:
        return 0.0, 0.0
    # Add terms of equal sign, which avoids cancellation, and get the other root from
    # the product of both.
    q = -(b + np.sqrt(square)) if b >= 0 else -(b - np.sqrt(square))
    return _fraction(q, a), _fraction(c, q)


@kernel_only
def _leaves_bounds(x, y, heading, curvature, h, left, right, bounds):  # type: ignore[no-untyped-def]
    """Return whether the region leaves the bounds, at a corner or where an edge is parallel to an axis."""
    for k in range(6):
        s = h if k == 0 else -h
        if k >= 2:
            turn = (k - 2) * np.pi / 2 - heading
            if curvature != 0:
                s = (turn - 2 * np.pi * np.round(turn / (2 * np.pi))) / curvature
            else:
                s = 2 * h + 1
        if abs(s) <= h:
            px, py, direction = arc_end(x, y, heading, curvature, s)
            for n in (left, -right):
                ex = px - n * np.sin(direction)
                ey = py + n * np.cos(direction)
                if ex < bounds[0] or ex > bounds[1] or ey < bounds[2] or ey > bounds[3]:
                    return True
    return False


@dataclass(frozen=True)
class Primitives:
    """Motion primitives: arcs of equal length with evenly spaced curvatures.

    Attributes:
        count: number N of arcs, odd, so that the middle one is straight; at least 3.
        turn: α_max, largest turn of one arc, rad; below π.
        length: length v Δt of each arc, m.
    """

    count: int
    turn: float
    length: float

    def __post_init__(self) -> None:
        if self.count < 3 or self.count % 2 == 0:
            raise InputError(
                f"{self.count} primitives: the number must be odd and at least 3 (the"
                " middle arc is straight)"
            )
        if not (0 < self.turn < math.pi and 0 < self.length < math.inf):
            raise InputError(
                f"primitives of {self.length:g} m with turns up to {self.turn:g} rad:"
                " the length must be above 0, the turn above 0 and below pi"
            )

    @cached_property
    def curvatures(self) -> np.ndarray:
        """Curvatures from the tightest right turn to the tightest left turn, 1/m, shape (count,)."""
        return np.linspace(-self.turn, self.turn, self.count) / self.length

    def children(self, pose: Pose) -> list[Pose]:
        """Return the pose at the end of each arc, in the order of `curvatures`."""
        ends = (
            arc_end(pose.x, pose.y, pose.heading, float(k), self.length)
            for k in self.curvatures
        )
        return [Pose(float(x), float(y), float(heading)) for x, y, heading in ends]
