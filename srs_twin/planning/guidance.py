"""Grid distances and narrow passages, which guide the search in cluttered worlds.

In the first round, the search uses the length of Dubins paths as its heuristic, which
ignores obstacles. If no path is found, a guided search tree uses two further sources of
information.

The first source is the distance to the goal on a grid, measured around obstacles. This
grid distance is not a lower bound. Grid paths are up to 8 % longer than straight lines,
and passages narrower than a cell may be missing or too wide. The guided tree therefore
finds a path quickly, but not necessarily the shortest path.

The second source is a list of entry poses, from which a straight path leads through a
narrow passage. Arcs of fixed length rarely end at such a pose, so the guided tree tries
Dubins paths to the entry poses. The centre of a passage is the midpoint of the shortest
line between two obstacles. No third obstacle may be closer to this midpoint. The entry
poses lie at several distances before the centre, with or without space for the last
transient.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled
from srs_twin.planning.footprint import Footprint
from srs_twin.robot.world import Bounds, Goal, Pose, World

_GRID_CELLS = 160
"""Number of cells along the longer side of the grid."""

NO_PASSAGES = np.empty((0, 4))

_MAX_WIDTH = 2.0
"""Maximum width of a narrow passage, relative to the straight footprint's width.

The search finds wider passages without guidance.
"""

_ENTRY_CLEARANCE_M = 1e-3
"""Distance between the head at the entry pose and the narrowest point, m."""

_ROUND_CLEARANCE = 0.3
"""Additional distance of the farthest entry pose, relative to the footprint width.

Round obstacles also narrow the approach to a passage.
"""

_DISTANCE_TOLERANCE_M = 1e-6
"""Difference below which two distances are considered equal, m."""

_MIN_SPACING = 0.1
"""Distance below which two passages are considered identical, relative to the
footprint width.
"""


class GridHeuristic(NamedTuple):
    """Distances to the goal on a grid.

    Attributes:
        distance: distance from each cell to the goal, or infinity if the goal cannot be
            reached, m, shape (columns, rows).
        west, south: x of the left edge and y of the lower edge of the grid, m.
        cell: cell size, m.
    """

    distance: np.ndarray
    west: float
    south: float
    cell: float


NO_HEURISTIC = GridHeuristic(np.empty((0, 0)), 0.0, 0.0, 1.0)
"""Heuristic without a grid, which is 0 at every position."""


@compiled
def grid_distance(heuristic, x, y):  # type: ignore[no-untyped-def]
    """Return the grid distance (m) from a position to the goal, or 0 if unknown."""
    column = int(np.floor((x - heuristic.west) / heuristic.cell))
    row = int(np.floor((y - heuristic.south) / heuristic.cell))
    if (
        0 <= column < heuristic.distance.shape[0]
        and 0 <= row < heuristic.distance.shape[1]
    ):
        distance = heuristic.distance[column, row]
        if distance < np.inf:
            return distance
    return 0.0


def grid_heuristic(
    goal: Goal, start: Pose, world: World, clearance: float, margin: float
) -> GridHeuristic:
    """Return the grid distances to a goal around the obstacles.

    Args:
        goal: goal of the path.
        start: start of the path, which the grid contains.
        world: obstacles and bounds.
        clearance: minimum distance from obstacles, m.
        margin: distance by which the grid of an unbounded world extends beyond
            obstacles, start and goal, m.
    """
    from scipy.sparse.csgraph import dijkstra

    bounds = world.bounds or _bounding_box(goal, start, world, margin)
    (west, east), (south, north) = bounds.x, bounds.y
    cell = max(east - west, north - south) / _GRID_CELLS
    x = np.arange(west + cell / 2, east + cell / 2, cell)
    y = np.arange(south + cell / 2, north + cell / 2, cell)
    free = _free_cells(x, y, cell, world, clearance)
    column = min(int((goal.x - west) / cell), len(x) - 1)
    row = min(int((goal.y - south) / cell), len(y) - 1)
    # Dijkstra's algorithm starts at the goal, so one run computes the distances from
    # all cells.
    distance = dijkstra(
        _grid_graph(free, cell), directed=False, indices=column * len(y) + row
    )
    return GridHeuristic(distance.reshape(free.shape), west, south, cell)


def _bounding_box(goal: Goal, start: Pose, world: World, margin: float) -> Bounds:
    corners = [corner for p in world.polygons for corner in p.corners]
    for c in world.obstacles:
        corners += [(c.x - c.radius, c.y - c.radius), (c.x + c.radius, c.y + c.radius)]
    x, y = zip((goal.x, goal.y), (start.x, start.y), *corners, strict=True)
    return Bounds(
        (min(x) - margin, max(x) + margin), (min(y) - margin, max(y) + margin)
    )


def _free_cells(
    x: np.ndarray, y: np.ndarray, cell: float, world: World, clearance: float
) -> np.ndarray:
    import shapely

    free = np.ones((len(x), len(y)), dtype=bool)
    for circle in world.obstacles:
        reach = circle.radius + clearance
        columns = _cell_window(x, circle.x, reach, cell)
        rows = _cell_window(y, circle.y, reach, cell)
        outside = (
            np.hypot(x[columns, None] - circle.x, y[None, rows] - circle.y) >= reach
        )
        free[columns, rows] &= outside
    for polygon in world.polygons:
        grown = shapely.Polygon(polygon.corners).buffer(clearance)
        west, south, east, north = grown.bounds
        columns = _cell_window(x, (west + east) / 2, (east - west) / 2, cell)
        rows = _cell_window(y, (south + north) / 2, (north - south) / 2, cell)
        free[columns, rows] &= ~shapely.contains_xy(
            grown, *np.meshgrid(x[columns], y[rows], indexing="ij")
        )
    return free


def _cell_window(
    centres: np.ndarray, middle: float, reach: float, cell: float
) -> slice:
    first = math.floor((middle - reach - centres[0]) / cell)
    return slice(max(0, first), max(0, first + 2 + math.ceil(2 * reach / cell)))


def _grid_graph(free: np.ndarray, cell: float):  # type: ignore[no-untyped-def]
    from scipy.sparse import coo_array

    number = np.arange(free.size).reshape(free.shape)
    edges: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for here, there, length in (
        (np.s_[:-1, :], np.s_[1:, :], 1.0),
        (np.s_[:, :-1], np.s_[:, 1:], 1.0),
        (np.s_[:-1, :-1], np.s_[1:, 1:], math.sqrt(2)),
        (np.s_[:-1, 1:], np.s_[1:, :-1], math.sqrt(2)),
    ):
        both = free[here] & free[there]
        begin = number[here][both]
        edges.append((begin, number[there][both], np.full(len(begin), length * cell)))
    begins, ends, lengths = map(np.concatenate, zip(*edges, strict=True))
    shape = (free.size, free.size)
    return coo_array((lengths, (begins, ends)), shape=shape).tocsr()


def find_passages(world: World, body: Footprint) -> np.ndarray:
    """Return the entry poses of narrow passages, for both directions of travel.

    Returns:
        Array of shape (n, 4). Each row contains x, y (m) and heading (rad) of an entry
        pose, and the length (m) of the straight path through the passage.
    """
    straight = body.at(0.0)
    width = straight.left + straight.right
    return _entry_poses(_gap_centres(world, width), body)


def _gap_centres(world: World, width: float) -> list[tuple[list[float], list[float]]]:
    """Return the centre of each narrow gap and the direction across the gap."""
    import shapely

    ends, radii = _thick_lines(world)
    if len(ends) < 2:
        return []
    # Circles are represented by points, because shapely computes no distance from a
    # line of length 0.
    circles = len(world.obstacles)
    lines = np.concatenate(
        [shapely.points(ends[:circles, 0]), shapely.linestrings(ends[circles:])]
    )
    tree = shapely.STRtree(lines)
    largest = float(radii.max(initial=0.0))
    one, other = tree.query(
        lines, predicate="dwithin", distance=_MAX_WIDTH * width + radii + largest
    )
    # The query returns each pair of obstacles twice.
    one, other = one[one < other], other[one < other]
    near = shapely.get_coordinates(
        shapely.shortest_line(lines[one], lines[other])
    ).reshape(-1, 2, 2)
    across = near[:, 1] - near[:, 0]
    distance = np.hypot(*across.T)
    gap = distance - radii[one] - radii[other]
    kept = (gap >= width) & (gap <= _MAX_WIDTH * width) & (distance > 0)
    near = near[kept]
    across = across[kept]
    distance = distance[kept]
    gap = gap[kept]
    normal = across / distance[:, None]
    centre = near[:, 0] + normal * (radii[one[kept]] + gap / 2)[:, None]
    points = shapely.points(centre)
    # A gap is dropped if another obstacle is nearer to the centre of the gap, or if the
    # centre is inside a polygon.
    at, obstacle = tree.query(points, predicate="dwithin", distance=gap / 2 + largest)
    nearer = (
        shapely.distance(points[at], lines[obstacle]) - radii[obstacle]
        < gap[at] / 2 - _DISTANCE_TOLERANCE_M
    )
    solid = shapely.union_all([shapely.Polygon(p.corners) for p in world.polygons])
    is_open = ~(
        np.isin(np.arange(len(gap)), at[nearer]) | shapely.contains(solid, points)
    )
    # The gaps are sorted by width, because only the narrowest of several nearby gaps is
    # kept.
    ordered = sorted(
        zip(
            gap[is_open],
            centre[is_open].tolist(),
            normal[is_open].tolist(),
            strict=True,
        )
    )
    return [(point, direction) for _, point, direction in ordered]


def _thick_lines(world: World) -> tuple[np.ndarray, np.ndarray]:
    segments = [((c.x, c.y), (c.x, c.y)) for c in world.obstacles]
    rings = [polygon.corners for polygon in world.polygons]
    if world.bounds is not None:
        (west, east), (south, north) = world.bounds.x, world.bounds.y
        rings.append(((west, south), (east, south), (east, north), (west, north)))
    for corners in rings:
        segments += zip(corners, corners[1:] + corners[:1], strict=True)
    radii = np.zeros(len(segments))
    radii[: len(world.obstacles)] = [c.radius for c in world.obstacles]
    return np.array(segments, dtype=float).reshape(-1, 2, 2), radii


def _entry_poses(
    centres: list[tuple[list[float], list[float]]], body: Footprint
) -> np.ndarray:
    straight = body.at(0.0)
    transient = max((change.length for change in body.transients), default=0.0)
    width = straight.left + straight.right
    # The midline of the footprint, instead of the centre of mass, passes through the
    # centre of the passage.
    lateral = (straight.right - straight.left) / 2
    ahead = body.ahead + _ENTRY_CLEARANCE_M
    passages: list[tuple[float, float, float, float]] = []
    kept: list[tuple[float, float]] = []
    for (x, y), (across_x, across_y) in centres:
        if any(math.hypot(x - a, y - b) < _MIN_SPACING * width for a, b in kept):
            continue
        kept.append((x, y))
        for sign in (1.0, -1.0):
            # The snake may pass in either direction, perpendicular to the shortest line
            # between the obstacles.
            heading = math.atan2(-sign * across_x, sign * across_y)
            c = math.cos(heading)
            s = math.sin(heading)
            lead_ins = {
                ahead,
                ahead + transient,
                ahead + transient + _ROUND_CLEARANCE * width,
            }
            for lead_in in sorted(lead_ins):
                entry_x = x - lead_in * c - lateral * s
                entry_y = y - lead_in * s + lateral * c
                passages.append((entry_x, entry_y, heading, lead_in + body.behind))
    return np.array(passages).reshape(-1, 4)
