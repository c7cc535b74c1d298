"""Gates: poses in narrow gaps from which a straight way leads through.

Random or gridded poses rarely hit a gap that is hardly wider than the body. Its middle is known: two things
are nearest to each other there, and nothing else is nearer to it. A tree that comes near tries a Dubins
path to such a pose, so early before the gap that the last change of offset has settled.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.planning.footprint import Footprint
from srs_twin.robot.world import World

NO_GATES = np.empty((0, 4))

_WIDEST = 2.0
"""Widths of the straight body from which on a gap is found without help."""
_BEFORE = 1e-3
"""How far from the gap's narrowest place the body begins to be straight, m."""
_BULGE = 0.3
"""Widths before that, too: round things are in the way before their narrowest place."""
_TIE = 1e-6
_APART = 0.1
"""Of the width: gates that are nearer to each other are one."""


def gates_of(world: World, body: Footprint) -> np.ndarray:
    """Return x, y, heading of where ways through gaps begin, and their lengths; m and rad, shape (n, 4)."""
    import shapely

    straight = body.at(0.0)
    width = straight.left + straight.right
    ends, radii = _features(world)
    if len(ends) < 2:
        return NO_GATES
    round_ = len(world.obstacles)  # a line without length has no distance
    lines = np.concatenate([shapely.points(ends[:round_, 0]), shapely.linestrings(ends[round_:])])
    tree, largest = shapely.STRtree(lines), float(radii.max(initial=0.0))
    one, other = tree.query(lines, predicate="dwithin", distance=_WIDEST * width + radii + largest)
    one, other = one[one < other], other[one < other]
    near = shapely.get_coordinates(shapely.shortest_line(lines[one], lines[other])).reshape(-1, 2, 2)
    way = near[:, 1] - near[:, 0]
    apart = np.hypot(*way.T)
    gap = apart - radii[one] - radii[other]
    kept = (gap >= width) & (gap <= _WIDEST * width) & (apart > 0)
    near, way, apart, gap = near[kept], way[kept], apart[kept], gap[kept]
    normal = way / apart[:, None]
    middle = near[:, 0] + normal * (radii[one[kept]] + gap / 2)[:, None]
    points = shapely.points(middle)
    at, thing = tree.query(points, predicate="dwithin", distance=gap / 2 + largest)
    nearer = shapely.distance(points[at], lines[thing]) - radii[thing] < gap[at] / 2 - _TIE
    solid = shapely.union_all([shapely.Polygon(p.corners) for p in world.polygons])
    open_ = ~(np.isin(np.arange(len(gap)), at[nearer]) | shapely.contains(solid, points))
    found = sorted(zip(gap[open_], middle[open_].tolist(), normal[open_].tolist(), strict=True))
    return _both_ways([(place, across) for _, place, across in found], body, _APART * width)


def _features(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Return ends of line segments, shape (n, 2, 2), and how thick they are to each side, shape (n,), m."""
    segments = [((c.x, c.y), (c.x, c.y)) for c in world.obstacles]
    for polygon in world.polygons:
        segments += zip(polygon.corners, polygon.corners[1:] + polygon.corners[:1], strict=True)
    if world.bounds is not None:
        (west, east), (south, north) = world.bounds.x, world.bounds.y
        corners = ((west, south), (east, south), (east, north), (west, north))
        segments += zip(corners, corners[1:] + corners[:1], strict=True)
    radii = np.zeros(len(segments))
    radii[: len(world.obstacles)] = [c.radius for c in world.obstacles]
    return np.array(segments, dtype=float).reshape(-1, 2, 2), radii


def _both_ways(found: list[tuple[list[float], list[float]]], body: Footprint, apart: float) -> np.ndarray:
    straight = body.at(0.0)
    settled = max((each.length for each in body.transients), default=0.0)
    width = straight.left + straight.right
    aside, ahead = (straight.right - straight.left) / 2, body.ahead + _BEFORE
    gates: list[tuple[float, float, float, float]] = []
    taken: list[tuple[float, float]] = []
    for (x, y), (across_x, across_y) in found:
        if any(math.hypot(x - a, y - b) < apart for a, b in taken):
            continue
        taken.append((x, y))
        for sign in (1.0, -1.0):
            heading = math.atan2(-sign * across_x, sign * across_y)
            c, s = math.cos(heading), math.sin(heading)
            for run_up in sorted({ahead, ahead + settled, ahead + settled + _BULGE * width}):
                begin_x, begin_y = x - run_up * c - aside * s, y - run_up * s + aside * c
                gates.append((begin_x, begin_y, heading, run_up + body.behind))
    return np.array(gates).reshape(-1, 4)
