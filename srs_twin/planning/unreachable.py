"""Proof that there is no path: obstacles so close together that start and goal lie in different rooms."""

from __future__ import annotations

import math

from srs_twin.world import Goal, Pose, World

_PIECES = 32
"""A quarter of a circle is replaced by so many chords, inside it: gaps may only look wider than they are."""


def disconnected(start: Pose, goal: Goal, world: World, clearance: float) -> bool:
    """Say whether every path from start to goal comes nearer to something than the clearance.

    Let o be a point of an obstacle nearer to a smooth path than the clearance w. If the path's point nearest
    to o is none of its ends, o lies straight across the path from it, within the edges: a collision. So it is
    an end, at most w from o, and whatever else of the path is within w of o is within 2 w of that end. Hence
    a free path lies in what is left when obstacles grow by w and bounds shrink by w, or in discs of 2 w about
    its ends. If no connected part of that holds start and goal, there is no path, whatever its curvature.

    Args:
        start: where the path begins.
        goal: where it may end, within the goal's radius.
        world: obstacles and bounds.
        clearance: `Footprint.narrowest`, m.
    """
    import shapely

    here, there = shapely.Point(start.x, start.y), shapely.Point(goal.x, goal.y)
    about = 1 / math.cos(math.pi / (4 * _PIECES))
    ends = [
        here.buffer(2 * clearance * about, quad_segs=_PIECES),
        there.buffer((2 * clearance + goal.radius) * about, quad_segs=_PIECES),
    ]
    grown = [shapely.Point(c.x, c.y).buffer(c.radius + clearance, quad_segs=_PIECES) for c in world.obstacles]
    grown += [shapely.Polygon(p.corners).buffer(clearance, quad_segs=_PIECES) for p in world.polygons]
    if not grown and world.bounds is None:
        return False
    blocked = shapely.union_all(grown)
    room = _room(world, shapely.union_all([blocked, *ends]).bounds, clearance)
    free = shapely.union_all([room.difference(blocked), *ends])
    rooms = list(free.geoms) if free.geom_type == "MultiPolygon" else [free]
    return not any(each.intersects(here) and each.intersects(there) for each in rooms)


def _room(world: World, extent: tuple[float, float, float, float], clearance: float):  # type: ignore[no-untyped-def]
    """Return the bounds less the clearance, or, where there are none, a way round everything."""
    import shapely

    if world.bounds is None:
        west, south, east, north = extent
        return shapely.box(west - clearance, south - clearance, east + clearance, north + clearance)
    (west, east), (south, north) = world.bounds.x, world.bounds.y
    west, east, south, north = west + clearance, east - clearance, south + clearance, north - clearance
    return shapely.box(west, south, east, north) if west < east and south < north else shapely.Polygon()
