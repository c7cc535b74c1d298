"""Collision checks of arcs and plans against a world, exact up to `arcs.MARGIN`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from srs_twin.planning.arcs import blocked
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.problem import Segment
from srs_twin.robot.world import Bounds, Pose, World

MOST_CLEARANCE = 1.0
"""What is farther away is not looked for, m."""
FINENESS = 1e-4
"""Error of `Checker.clearance`, m."""
_MOST_CELLS = 256
"""Along a side of the grid of things."""
_ANYWHERE = Bounds((-math.inf, math.inf), (-math.inf, math.inf))


class Surroundings(NamedTuple):
    """A world as the kernels take it.

    Attributes:
        circles: x, y, radius of each, m, shape (n, 3).
        sides: x, y of both ends of each polygon's sides, m, shape (n, 4).
        bounds: lowest x, highest x, lowest y, highest y, m, shape (4,); infinite where there are none.
        corner: of a grid about all of them, x and y, m, and the side of its cells, m, shape (3,).
        first: where the list of each cell begins in `lists`, and where it ends, shape (columns, rows, 2).
        lists: of each cell what reaches into it: circles by their number, sides by theirs after all circles.
    """

    circles: np.ndarray
    sides: np.ndarray
    bounds: np.ndarray
    corner: np.ndarray
    first: np.ndarray
    lists: np.ndarray


def surroundings(world: World) -> Surroundings:
    """Return a world as arrays."""
    circles = np.array([(c.x, c.y, c.radius) for c in world.obstacles], dtype=float).reshape(-1, 3)
    rings = [(*p.corners, p.corners[0]) for p in world.polygons]
    sides = [(*a, *b) for ring in rings for a, b in pairwise(ring)]
    bounds = world.bounds or _ANYWHERE
    limits = np.array([*bounds.x, *bounds.y], dtype=float)
    lines = np.array(sides, dtype=float).reshape(-1, 4)
    return Surroundings(circles, lines, limits, *in_cells(circles, lines))


def in_cells(circles: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a grid and what reaches into each of its cells, see `Surroundings`."""
    x, y, radius = circles.T
    low = np.vstack([np.column_stack([x - radius, y - radius]), np.minimum(sides[:, :2], sides[:, 2:])])
    high = np.vstack([np.column_stack([x + radius, y + radius]), np.maximum(sides[:, :2], sides[:, 2:])])
    count = len(low)
    if count == 0:
        return np.array([0.0, 0.0, 1.0]), np.zeros((0, 0, 2), dtype=np.int64), np.zeros(0, dtype=np.int64)
    corner, extent = low.min(axis=0), np.ptp(np.vstack([low, high]), axis=0)
    cell = max(float(extent.max()) / min(max(math.isqrt(count // 4), 1), _MOST_CELLS), 1e-9)
    columns, rows = (int(each / cell) + 1 for each in extent)
    begin, end = ((each - corner) // cell for each in (low, high))
    listed: list[list[int]] = [[] for _ in range(columns * rows)]
    for k, (west, south, east, north) in enumerate(np.hstack([begin, end]).astype(int).tolist()):
        for column in range(west, east + 1):
            for row in range(south, north + 1):
                listed[column * rows + row].append(k)
    ends = np.cumsum([len(each) for each in listed])
    first = np.stack([np.r_[0, ends[:-1]], ends], axis=-1).reshape(columns, rows, 2)
    return np.array([*corner, cell]), first, np.array([k for each in listed for k in each], dtype=np.int64)


@dataclass(frozen=True)
class Checker:
    """A footprint in a world.

    Attributes:
        world: obstacles and bounds.
        footprint: what the body sweeps.
    """

    world: World
    footprint: Footprint

    @cached_property
    def surroundings(self) -> Surroundings:
        """The world as arrays."""
        return surroundings(self.world)

    def free(
        self, pose: Pose, curvature: float, length: float, wider: tuple[float, float] = (0.0, 0.0)
    ) -> bool:
        """Say whether an arc is free: the body swept along it touches nothing and stays within the bounds.

        Args:
            pose: where the centre of mass begins; it lies outside of the polygons.
            curvature: 1/m.
            length: m.
            wider: what is added to the left and right edges, m.
        """
        body, motion = self.footprint, self.footprint.at(curvature)
        left, right = motion.left + wider[0], motion.right + wider[1]
        reach = body.ahead, body.behind
        return not blocked(*pose, curvature, length, *reach, left, right, self.surroundings)

    def free_path(self, segments: Sequence[Segment]) -> bool:
        """Say whether a path is free, wider by the transients where its changes of offset still last."""
        wider, lasting, none = (0.0, 0.0), 0.0, (0.0, 0.0)
        for before, segment in zip((None, *segments), segments, strict=False):
            if before is not None:
                left, right, length = self.footprint.transient(before.offset, segment.offset)
                old = wider if lasting > 0 else none
                wider, lasting = (max(left, old[0]), max(right, old[1])), max(length, lasting)
            first = min(lasting, segment.length)
            if first > 0 and not self.free(segment.start, segment.curvature, first, wider):
                return False
            rest = segment.length - first
            if rest > 0 and not self.free(segment.pose(first), segment.curvature, rest):
                return False
            lasting -= first
        return True

    def clearance(self, segments: Sequence[Segment]) -> float:
        """Return how much wider both edges could be on a free path, m, at most `MOST_CLEARANCE`."""
        free, touching = 0.0, MOST_CLEARANCE
        while touching - free > FINENESS:
            middle = (free + touching) / 2
            if Checker(self.world, self.footprint.reduced(margin=middle)).free_path(segments):
                free = middle
            else:
                touching = middle
        return free

    def blocker(self, pose: Pose, length: float = 0.0, wider: float = 0.0) -> str:
        """Return in words what the body touches that goes straight from a pose (length in m), or nothing."""
        body, motion = self.footprint, self.footprint.at(0.0)
        edges = body.ahead, body.behind, motion.left + wider, motion.right + wider
        if not blocked(*pose, 0.0, length, *edges, self.surroundings):
            return ""
        for name, world in _pieces(self.world):
            if blocked(*pose, 0.0, length, *edges, surroundings(world)):
                return name
        return ""


def inside(world: World, x: float, y: float) -> str:
    """Return in words what a point lies in (or outside of), or an empty string."""
    import shapely

    point = shapely.Point(x, y)
    for name, each in _pieces(world):
        if (b := each.bounds) and not (b.x[0] <= x <= b.x[1] and b.y[0] <= y <= b.y[1]):
            return name
        if any(math.hypot(x - c.x, y - c.y) <= c.radius for c in each.obstacles):
            return name
        if any(shapely.Polygon(p.corners).intersects(point) for p in each.polygons):
            return name
    return ""


def nearest(world: World, x: float, y: float) -> str:
    """Return what is nearest to a point: "bounds", "obstacle 2", "polygon 1"; empty where nothing is."""
    import shapely

    point, found = shapely.Point(x, y), [(math.inf, "")]
    if world.bounds is not None:
        (west, east), (south, north) = world.bounds.x, world.bounds.y
        found.append((min(x - west, east - x, y - south, north - y), "bounds"))
    for k, circle in enumerate(world.obstacles, start=1):
        found.append((math.hypot(x - circle.x, y - circle.y) - circle.radius, f"obstacle {k}"))
    for k, polygon in enumerate(world.polygons, start=1):
        found.append((shapely.distance(point, shapely.Polygon(polygon.corners)), f"polygon {k}"))
    return min(found)[1]


def _pieces(world: World) -> list[tuple[str, World]]:
    """Return each thing of a world with its name, in a world of its own."""
    found: list[tuple[str, World]] = []
    if (bounds := world.bounds) is not None:
        (west, east), (south, north) = bounds.x, bounds.y
        name = f"the bounds (x {west:g} to {east:g} m, y {south:g} to {north:g} m)"
        found.append((name, World(bounds=bounds)))
    for k, circle in enumerate(world.obstacles, start=1):
        name = f"obstacle {k} (radius {circle.radius:g} m at ({circle.x:g}, {circle.y:g}))"
        found.append((name, World((circle,))))
    for k, polygon in enumerate(world.polygons, start=1):
        (x, y), count = polygon.corners[0], len(polygon.corners)
        name = f"polygon {k} ({count} corners, the first at ({x:g}, {y:g}))"
        found.append((name, World(polygons=(polygon,))))
    return found
