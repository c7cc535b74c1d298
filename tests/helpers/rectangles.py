"""Walls for tests of the planner, and worlds turned by right angles."""

from srs_twin.robot.world import Bounds, Circle, Polygon, World


def rectangle(west: float, east: float, south: float, north: float) -> Polygon:
    """Return a rectangle along the axes, all limits in m."""
    return Polygon(((west, south), (east, south), (east, north), (west, north)))


def turned(world: World, quarters: int) -> World:
    """Return a world with bounds after quarter turns to the left about the origin."""
    if quarters == 0:
        return world
    (west, east), (south, north) = world.bounds.x, world.bounds.y
    circles = tuple(Circle(-c.y, c.x, c.radius) for c in world.obstacles)
    polygons = tuple(
        Polygon(tuple((-y, x) for x, y in p.corners)) for p in world.polygons
    )
    return turned(
        World(circles, Bounds((-north, -south), (west, east)), None, polygons),
        quarters - 1,
    )
