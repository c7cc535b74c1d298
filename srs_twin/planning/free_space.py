"""Proof that no path exists, and a lower bound on the path length.

The proof and the bound hold for smooth paths with arbitrary turns. Let the clearance w
be the minimum distance between the path and an edge of the footprint. Consider an
obstacle point o that is closer than w to a collision-free path. If the path point
nearest to o were not an end of the path, o would lie between the edges on the normal to
the path, which is a collision. The nearest path point is therefore an end of the path.
All path points within the distance w of o are within 2 w of this end.

To obtain the free space, the bounds are reduced by w, and the obstacles are enlarged by
w. Discs of radius 2 w around both ends of the path are then added. The free space
contains every collision-free path. If start and goal are in different connected
components of the free space, no path exists. Otherwise, the shortest line between them
in the free space is a lower bound on the path length.
"""

from __future__ import annotations

import heapq
import math
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.planning.collision import obstacle_shapes
from srs_twin.robot.world import Goal, Pose, World

if TYPE_CHECKING:
    import shapely

_FINE_CHORDS = 32
"""Number of chords that approximate a quarter circle in the proof.

The chords lie inside the circle, so the polygon underestimates the enlarged obstacle.
"""
_COARSE_CHORDS = 4
"""Number of chords that approximate a quarter circle in the length bound."""
_ROUNDING_M = 1e-9
"""Tolerance for lines along the boundary of the free space, m."""


def is_disconnected(start: Pose, goal: Goal, world: World, clearance: float) -> bool:
    """Return whether the free space does not connect start and goal.

    Args:
        start: start pose.
        goal: goal, within whose radius the path may end.
        world: obstacles and bounds.
        clearance: minimum distance between the path and an edge of the footprint, m.
    """
    return _free_component(start, goal, world, clearance, _FINE_CHORDS) is None


def min_path_length(start: Pose, goal: Goal, world: World, clearance: float) -> float:
    """Return a lower bound (m) on the length of any path, or infinity if none exists.

    Args:
        start: start pose.
        goal: goal, within whose radius the path may end.
        world: obstacles and bounds.
        clearance: minimum distance between the path and an edge of the footprint, m.
    """
    import shapely

    component = _free_component(start, goal, world, clearance, _COARSE_CHORDS)
    if component is None:
        return math.inf
    # The shortest line bends only at corners of the free space, so it is found with an
    # A* search on the visibility graph. The visibility of a line is tested only when
    # the line is taken from the queue.
    free = component.buffer(_ROUNDING_M, join_style="mitre")
    shapely.prepare(free)
    corners = np.array(
        [(start.x, start.y), (goal.x, goal.y), *_reflex_corners(component)]
    )
    straight = np.hypot(*(corners - corners[1]).T)
    done = np.zeros(len(corners), dtype=bool)
    queue = [(float(straight[0]), 0.0, 0, 0)]
    while queue:
        _, length, before, here = heapq.heappop(queue)
        if done[here] or not free.covers(
            shapely.linestrings([corners[before], corners[here]])
        ):
            continue
        if here == 1:
            return max(length - goal.radius, 0.0)
        done[here] = True
        lengths = length + np.hypot(*(corners - corners[here]).T)
        for there in np.flatnonzero(~done).tolist():
            heapq.heappush(
                queue,
                (
                    float(lengths[there] + straight[there]),
                    float(lengths[there]),
                    here,
                    there,
                ),
            )
    return math.inf


def _reflex_corners(polygon: shapely.Polygon) -> list[tuple[float, float]]:
    import shapely

    corners: list[tuple[float, float]] = []
    oriented = shapely.geometry.polygon.orient(polygon)
    for ring in (oriented.exterior, *oriented.interiors):
        at = np.asarray(ring.coords)[:-1]
        before = at - np.roll(at, 1, axis=0)
        after = np.roll(at, -1, axis=0) - at
        corners += at[before[:, 0] * after[:, 1] < before[:, 1] * after[:, 0]].tolist()
    return corners


def _free_component(
    start: Pose, goal: Goal, world: World, clearance: float, chords: int
) -> shapely.Polygon | None:
    import shapely

    here = shapely.Point(start.x, start.y)
    there = shapely.Point(goal.x, goal.y)
    # This factor enlarges the polygons so that they contain the discs around both ends.
    around = 1 / math.cos(math.pi / (4 * chords))
    ends = [
        here.buffer(2 * clearance * around, quad_segs=chords),
        there.buffer((2 * clearance + goal.radius) * around, quad_segs=chords),
    ]
    grown = [
        core.buffer(radius + clearance, quad_segs=chords)
        for _, core, radius in obstacle_shapes(world)
    ]
    blocked = shapely.union_all(grown)
    box = _reduced_bounds(world, shapely.union_all([blocked, *ends]).bounds, clearance)
    free = shapely.union_all([box.difference(blocked), *ends])
    if free.geom_type == "MultiPolygon":
        components = list(free.geoms)
    else:
        components = [free]
    return next(
        (
            part
            for part in components
            if part.intersects(here) and part.intersects(there)
        ),
        None,
    )


def _reduced_bounds(
    world: World, extent: tuple[float, float, float, float], clearance: float
) -> shapely.Polygon:
    import shapely

    if world.bounds is None:
        west, south, east, north = extent
        return shapely.box(
            west - clearance, south - clearance, east + clearance, north + clearance
        )
    (west, east), (south, north) = world.bounds.x, world.bounds.y
    west = west + clearance
    east = east - clearance
    south = south + clearance
    north = north - clearance
    if west < east and south < north:
        return shapely.box(west, south, east, north)
    return shapely.Polygon()
