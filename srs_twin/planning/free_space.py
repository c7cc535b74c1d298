"""Where a path may go, whatever its curvature: proofs that there is none, and the least length of any.

Let o be a point of an obstacle nearer to a smooth path than the clearance w, the least distance of an edge.
If the path's point nearest to o is none of its ends, o lies straight across the path from it, within the
edges: a collision. So it is an end, at most w from o, and whatever else of the path is within w of o is
within 2 w of that end. Hence a free path lies in what is left when obstacles grow by w and bounds shrink by
w, or in discs of 2 w about its ends. If no connected part of that holds start and goal, there is no path;
else the shortest line in it is a bound on the length of any.
"""

from __future__ import annotations

import heapq
import math
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.robot.world import Goal, Pose, World

if TYPE_CHECKING:
    import shapely

_FINE, _COARSE = 32, 4
"""A quarter of a circle is replaced by so many chords, inside it: gaps may only look wider than they are."""
_ROUNDING = 1e-9


def disconnected(start: Pose, goal: Goal, world: World, clearance: float) -> bool:
    """Say whether every path from start to goal comes nearer to something than the clearance.

    Args:
        start: where the path begins.
        goal: where it may end, within the goal's radius.
        world: obstacles and bounds.
        clearance: `Footprint.narrowest`, m.
    """
    return _part(start, goal, world, clearance, _FINE) is None


def least_length(start: Pose, goal: Goal, world: World, clearance: float) -> float:
    """Return a length that no path from start to goal is shorter than, m; infinite where there is none.

    Args:
        start: where the path begins.
        goal: where it may end, within the goal's radius.
        world: obstacles and bounds.
        clearance: `Footprint.narrowest`, m.
    """
    import shapely

    part = _part(start, goal, world, clearance, _COARSE)
    if part is None:
        return math.inf
    # Shortest lines bend at corners of the free space only. What sees what is asked at the last moment: where
    # a line that may be too short comes first in the queue.
    room = part.buffer(_ROUNDING, join_style="mitre")
    shapely.prepare(room)
    corners = np.array([(start.x, start.y), (goal.x, goal.y), *_corners(part)])
    straight = np.hypot(*(corners - corners[1]).T)
    done = np.zeros(len(corners), dtype=bool)
    queue = [(float(straight[0]), 0.0, 0, 0)]
    while queue:
        _, length, before, here = heapq.heappop(queue)
        if done[here] or not room.covers(shapely.linestrings([corners[before], corners[here]])):
            continue
        if here == 1:
            return max(length - goal.radius, 0.0)
        done[here] = True
        way = length + np.hypot(*(corners - corners[here]).T)
        for there in np.flatnonzero(~done).tolist():
            heapq.heappush(queue, (float(way[there] + straight[there]), float(way[there]), here, there))
    return math.inf


def _corners(part: shapely.Polygon) -> list[tuple[float, float]]:
    """Return the corners of a polygon that lines may bend at: with more than half of a turn inside."""
    import shapely

    found: list[tuple[float, float]] = []
    whole = shapely.geometry.polygon.orient(part)
    for ring in (whole.exterior, *whole.interiors):
        at = np.asarray(ring.coords)[:-1]
        before, after = at - np.roll(at, 1, axis=0), np.roll(at, -1, axis=0) - at
        found += at[before[:, 0] * after[:, 1] < before[:, 1] * after[:, 0]].tolist()
    return found


def _part(start: Pose, goal: Goal, world: World, clearance: float, chords: int) -> shapely.Polygon | None:
    """Return the connected part of where paths may be that holds start and goal, if there is one."""
    import shapely

    here, there = shapely.Point(start.x, start.y), shapely.Point(goal.x, goal.y)
    about = 1 / math.cos(math.pi / (4 * chords))
    ends = [
        here.buffer(2 * clearance * about, quad_segs=chords),
        there.buffer((2 * clearance + goal.radius) * about, quad_segs=chords),
    ]
    grown = [shapely.Point(c.x, c.y).buffer(c.radius + clearance, quad_segs=chords) for c in world.obstacles]
    grown += [shapely.Polygon(p.corners).buffer(clearance, quad_segs=chords) for p in world.polygons]
    blocked = shapely.union_all(grown)
    room = _room(world, shapely.union_all([blocked, *ends]).bounds, clearance)
    free = shapely.union_all([room.difference(blocked), *ends])
    parts = list(free.geoms) if free.geom_type == "MultiPolygon" else [free]
    return next((each for each in parts if each.intersects(here) and each.intersects(there)), None)


def _room(world: World, extent: tuple[float, float, float, float], clearance: float) -> shapely.Polygon:
    """Return the bounds less the clearance, or, where there are none, a way round everything."""
    import shapely

    if world.bounds is None:
        west, south, east, north = extent
        return shapely.box(west - clearance, south - clearance, east + clearance, north + clearance)
    (west, east), (south, north) = world.bounds.x, world.bounds.y
    west, east, south, north = west + clearance, east - clearance, south + clearance, north - clearance
    return shapely.box(west, south, east, north) if west < east and south < north else shapely.Polygon()
