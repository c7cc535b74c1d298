"""Guide round obstacles: for every place, the way of a point to the goal over a grid.

It serves a tree that looks for some path where the shortest takes long to find. It is no bound: steps along
the grid are up to 8 % longer than straight lines, and gaps narrower than its cells may be missing or too
wide.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled
from srs_twin.robot.world import Bounds, Goal, Pose, World

_CELLS = 160
"""Along the longer side."""


class Guide(NamedTuple):
    """Length of the way to the goal from each cell.

    Attributes:
        way: m, infinite where there is none, shape (columns, rows), x first; none: no guide.
        west: of the grid's edge, m.
        south: of the grid's edge, m.
        cell: side of a cell, m.
    """

    way: np.ndarray
    west: float
    south: float
    cell: float


NO_GUIDE = Guide(np.empty((0, 0)), 0.0, 0.0, 1.0)


@compiled
def way_from(guide, x, y):  # type: ignore[no-untyped-def]
    """Return the length of the way from a place, m; 0 where the guide knows none."""
    column, row = int(np.floor((x - guide.west) / guide.cell)), int(np.floor((y - guide.south) / guide.cell))
    if 0 <= column < guide.way.shape[0] and 0 <= row < guide.way.shape[1]:
        way = guide.way[column, row]
        return way if way < np.inf else 0.0
    return 0.0


def guide_to(goal: Goal, start: Pose, world: World, clearance: float, margin: float) -> Guide:
    """Return the guide to a goal for points that keep a clearance.

    Args:
        goal: where all ways lead.
        start: lies on the grid.
        world: obstacles and bounds.
        clearance: m.
        margin: of the grid about everything where there are no bounds, m.
    """
    from scipy.sparse.csgraph import dijkstra

    bounds = world.bounds or _extent(goal, start, world, margin)
    (west, east), (south, north) = bounds.x, bounds.y
    cell = max(east - west, north - south) / _CELLS
    x = np.arange(west + cell / 2, east + cell / 2, cell)
    y = np.arange(south + cell / 2, north + cell / 2, cell)
    free = _free(x, y, cell, world, clearance)
    column, row = int((goal.x - west) / cell), int((goal.y - south) / cell)
    column, row = min(column, len(x) - 1), min(row, len(y) - 1)
    way = dijkstra(_steps(free, cell), directed=False, indices=column * len(y) + row)
    return Guide(way.reshape(free.shape), west, south, cell)


def _extent(goal: Goal, start: Pose, world: World, margin: float) -> Bounds:
    """Return a rectangle about everything."""
    corners = [corner for p in world.polygons for corner in p.corners]
    for c in world.obstacles:
        corners += [(c.x - c.radius, c.y - c.radius), (c.x + c.radius, c.y + c.radius)]
    x, y = zip((goal.x, goal.y), (start.x, start.y), *corners, strict=True)
    return Bounds((min(x) - margin, max(x) + margin), (min(y) - margin, max(y) + margin))


def _free(x: np.ndarray, y: np.ndarray, cell: float, world: World, clearance: float) -> np.ndarray:
    """Return which cells have a clear middle, shape (columns, rows)."""
    import shapely

    free = np.ones((len(x), len(y)), dtype=bool)
    for circle in world.obstacles:
        reach = circle.radius + clearance
        columns, rows = _window(x, circle.x, reach, cell), _window(y, circle.y, reach, cell)
        far = np.hypot(x[columns, None] - circle.x, y[None, rows] - circle.y) >= reach
        free[columns, rows] &= far
    for polygon in world.polygons:
        grown = shapely.Polygon(polygon.corners).buffer(clearance)
        west, south, east, north = grown.bounds
        columns = _window(x, (west + east) / 2, (east - west) / 2, cell)
        rows = _window(y, (south + north) / 2, (north - south) / 2, cell)
        free[columns, rows] &= ~shapely.contains_xy(grown, *np.meshgrid(x[columns], y[rows], indexing="ij"))
    return free


def _window(places: np.ndarray, middle: float, reach: float, cell: float) -> slice:
    first = math.floor((middle - reach - places[0]) / cell)
    return slice(max(0, first), max(0, first + 2 + math.ceil(2 * reach / cell)))


def _steps(free: np.ndarray, cell: float):  # type: ignore[no-untyped-def]
    """Return the graph of steps between free neighbours, diagonal ones too."""
    from scipy.sparse import coo_array

    number = np.arange(free.size).reshape(free.shape)
    ends: list[tuple[np.ndarray, np.ndarray, float]] = []
    for here, there, length in (
        (np.s_[:-1, :], np.s_[1:, :], 1.0),
        (np.s_[:, :-1], np.s_[:, 1:], 1.0),
        (np.s_[:-1, :-1], np.s_[1:, 1:], math.sqrt(2)),
        (np.s_[:-1, 1:], np.s_[1:, :-1], math.sqrt(2)),
    ):
        both = free[here] & free[there]
        ends.append((number[here][both], number[there][both], length * cell))
    lengths = np.concatenate([np.full(len(a), length) for a, _, length in ends])
    places = (np.concatenate([a for a, _, _ in ends]), np.concatenate([b for _, b, _ in ends]))
    return coo_array((lengths, places), shape=(free.size, free.size)).tocsr()
