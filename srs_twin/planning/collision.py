"""Collision checks for arcs and paths, exact except for a small rounding margin."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from srs_twin.planning.arcs import Extent, arc_collides
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.path import Segment
from srs_twin.robot.world import Pose, World

if TYPE_CHECKING:
    import shapely

MAX_CLEARANCE_M = 1.0
"""Maximum clearance that `Checker.clearance` returns, m."""
CLEARANCE_ERROR_M = 1e-4
"""Width of the bisection interval at which `Checker.clearance` stops, m."""

_MAX_GRID_CELLS = 256
"""Maximum number of grid cells along each side, which limits memory to about 1 MB."""

_MIN_CELL_M = 1e-9
"""Minimum size of a grid cell, used if the obstacles have zero extent, m."""


class Box(NamedTuple):
    """Bounds of a world, which are infinite by default, m."""

    west: float = -math.inf
    east: float = math.inf
    south: float = -math.inf
    north: float = math.inf


class ObstacleGrid(NamedTuple):
    """Obstacles and bounds of a world, with a uniform grid for fast lookup.

    Attributes:
        circles: x, y and radius of each circle, m, shape (n, 3).
        sides: x and y of the two ends of each polygon side, m, shape (m, 4).
        west, south: x of the left edge and y of the lower edge of the grid, m.
        cell: cell size, m.
        cell_ranges: start and stop indices in `cell_items` for each grid cell, shape
            (columns, rows, 2).
        cell_items: indices of the circles and then of the polygon sides in each cell,
            shape (k,).
    """

    circles: np.ndarray
    sides: np.ndarray
    bounds: Box
    west: float
    south: float
    cell: float
    cell_ranges: np.ndarray
    cell_items: np.ndarray


def obstacle_grid(world: World) -> ObstacleGrid:
    """Convert the obstacles and bounds of a world to arrays for compiled kernels."""
    circles = [(c.x, c.y, c.radius) for c in world.obstacles]
    rings = [(*p.corners, p.corners[0]) for p in world.polygons]
    sides = [(*a, *b) for ring in rings for a, b in pairwise(ring)]
    bounds = Box()
    if world.bounds:
        bounds = Box(*map(float, (*world.bounds.x, *world.bounds.y)))
    return build_grid(
        np.array(circles, dtype=float).reshape(-1, 3),
        np.array(sides, dtype=float).reshape(-1, 4),
        bounds,
    )


def build_grid(circles: np.ndarray, sides: np.ndarray, bounds: Box) -> ObstacleGrid:
    """Return a grid that lists the circles and polygon sides in each cell."""
    radius = circles[:, 2:]
    ends = sides.reshape(-1, 2, 2)
    low = np.vstack([circles[:, :2] - radius, ends.min(axis=1)])
    high = np.vstack([circles[:, :2] + radius, ends.max(axis=1)])
    count = len(low)
    if count == 0:
        no_cells = np.zeros((0, 0, 2), dtype=np.int64)
        no_items = np.zeros(0, dtype=np.int64)
        return ObstacleGrid(circles, sides, bounds, 0.0, 0.0, 1.0, no_cells, no_items)
    corner = low.min(axis=0)
    extent = np.ptp(np.vstack([low, high]), axis=0)
    # With about four obstacles per cell, the lists are short and the grid is small.
    divisions = min(max(math.isqrt(count // 4), 1), _MAX_GRID_CELLS)
    cell = max(float(extent.max()) / divisions, _MIN_CELL_M)
    columns, rows = (int(side / cell) + 1 for side in extent)
    begin = (low - corner) // cell
    end = (high - corner) // cell
    items: list[list[int]] = [[] for _ in range(columns * rows)]
    for k, (west, south, east, north) in enumerate(
        np.hstack([begin, end]).astype(int).tolist()
    ):
        for column in range(west, east + 1):
            for row in range(south, north + 1):
                items[column * rows + row].append(k)
    ends_of_cells = np.cumsum([len(cell_list) for cell_list in items])
    ranges = np.stack([np.r_[0, ends_of_cells[:-1]], ends_of_cells], axis=-1)
    return ObstacleGrid(
        circles,
        sides,
        bounds,
        float(corner[0]),
        float(corner[1]),
        cell,
        ranges.reshape(columns, rows, 2),
        np.array(list(chain.from_iterable(items)), dtype=np.int64),
    )


@dataclass(frozen=True)
class Checker:
    """Collision checker for a footprint in a world."""

    world: World
    footprint: Footprint

    @cached_property
    def grid(self) -> ObstacleGrid:
        """Grid of the obstacles and bounds in the world."""
        return obstacle_grid(self.world)

    def is_arc_free(
        self,
        pose: Pose,
        curvature: float,
        length: float,
        wider: tuple[float, float] = (0.0, 0.0),
    ) -> bool:
        """Return whether the body is free of collisions on an arc.

        Args:
            pose: initial pose of the centre of mass, outside all polygons.
            curvature: arc curvature, 1/m.
            length: arc length, m.
            wider: outward shifts of the left and right edges of the footprint, m.
        """
        body = self.footprint
        motion = self.footprint.at(curvature)
        left = motion.left + wider[0]
        right = motion.right + wider[1]
        extent = Extent(body.ahead, body.behind, left, right)
        return not arc_collides(tuple(pose), curvature, length, extent, self.grid)

    def is_path_free(self, segments: Sequence[Segment]) -> bool:
        """Return whether the body is free of collisions on a path with transients."""
        wider = (0.0, 0.0)
        lasting = 0.0
        none = (0.0, 0.0)
        for before, segment in zip((None, *segments), segments, strict=False):
            # If transients overlap, the larger shifts of the edges and the longer
            # remaining length apply.
            if before is not None:
                left, right, length = self.footprint.transient(
                    before.offset, segment.offset
                )
                old = wider if lasting > 0 else none
                wider = (max(left, old[0]), max(right, old[1]))
                lasting = max(length, lasting)
            widened = min(lasting, segment.length)
            if widened > 0 and not self.is_arc_free(
                segment.start, segment.curvature, widened, wider
            ):
                return False
            rest = segment.length - widened
            if rest > 0 and not self.is_arc_free(
                segment.pose(widened), segment.curvature, rest
            ):
                return False
            lasting -= widened
        return True

    def clearance(self, segments: Sequence[Segment]) -> float:
        """Return how far both edges can be moved outward without a collision, m."""
        free, touching = (0.0, MAX_CLEARANCE_M)
        while touching - free > CLEARANCE_ERROR_M:
            middle = (free + touching) / 2
            if Checker(self.world, self.footprint.reduced(margin=middle)).is_path_free(
                segments
            ):
                free = middle
            else:
                touching = middle
        return free

    def first_collision(
        self, pose: Pose, length: float = 0.0, wider: float = 0.0
    ) -> str:
        """Describe an obstacle or bound that the body touches on a straight path.

        Args:
            pose: initial pose of the centre of mass.
            length: path length, m.
            wider: outward shift of both edges of the footprint, m.

        Returns:
            Description, or an empty string if the body touches nothing.
        """
        both = (wider, wider)
        # Single obstacles are tested only after a collision, to find the obstacle that
        # the body touches.
        if self.is_arc_free(pose, 0.0, length, both):
            return ""
        for name, world in _named_obstacles(self.world):
            alone = Checker(world, self.footprint)
            if not alone.is_arc_free(pose, 0.0, length, both):
                return name
        return ""


def obstacle_shapes(world: World) -> list[tuple[str, shapely.Geometry, float]]:
    """Return the name, shape and radius (m) of each obstacle.

    An obstacle consists of the shape and of all points within the radius around it.
    """
    import shapely

    shapes: list[tuple[str, shapely.Geometry, float]] = [
        (f"obstacle {k}", shapely.Point(c.x, c.y), c.radius)
        for k, c in enumerate(world.obstacles, start=1)
    ]
    polygons = (shapely.Polygon(polygon.corners) for polygon in world.polygons)
    return shapes + [
        (f"polygon {k}", polygon, 0.0) for k, polygon in enumerate(polygons, start=1)
    ]


def obstacle_at(world: World, x: float, y: float) -> str:
    """Describe what a point collides with, or return an empty string."""
    import shapely

    point = shapely.Point(x, y)
    for name, part in _named_obstacles(world):
        if (b := part.bounds) and not (b.x[0] <= x <= b.x[1] and b.y[0] <= y <= b.y[1]):
            return name
        if any(
            shapely.distance(point, core) <= radius
            for _, core, radius in obstacle_shapes(part)
        ):
            return name
    return ""


def _named_obstacles(world: World) -> list[tuple[str, World]]:
    named: list[tuple[str, World]] = []
    if (bounds := world.bounds) is not None:
        (west, east), (south, north) = bounds.x, bounds.y
        name = f"the bounds (x {west:g} to {east:g} m, y {south:g} to {north:g} m)"
        named.append((name, World(bounds=bounds)))
    for k, circle in enumerate(world.obstacles, start=1):
        name = (
            f"obstacle {k} (radius {circle.radius:g} m at ({circle.x:g}, {circle.y:g}))"
        )
        named.append((name, World((circle,))))
    for k, polygon in enumerate(world.polygons, start=1):
        (x, y), count = polygon.corners[0], len(polygon.corners)
        name = f"polygon {k} ({count} corners, the first at ({x:g}, {y:g}))"
        named.append((name, World(polygons=(polygon,))))
    return named
