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
from srs_twin.world import Bounds, Pose, World

_ANYWHERE = Bounds((-math.inf, math.inf), (-math.inf, math.inf))


class Surroundings(NamedTuple):
    """A world as the kernels take it.

    Attributes:
        circles: x, y, radius of each, m, shape (n, 3).
        sides: x, y of both ends of each polygon's sides, m, shape (n, 4).
        bounds: lowest x, highest x, lowest y, highest y, m, shape (4,); infinite where there are none.
    """

    circles: np.ndarray
    sides: np.ndarray
    bounds: np.ndarray


def surroundings(world: World) -> Surroundings:
    """Return a world as arrays."""
    circles = np.array([(c.x, c.y, c.radius) for c in world.obstacles], dtype=float).reshape(-1, 3)
    rings = [(*p.corners, p.corners[0]) for p in world.polygons]
    sides = [(*a, *b) for ring in rings for a, b in pairwise(ring)]
    bounds = world.bounds or _ANYWHERE
    limits = np.array([*bounds.x, *bounds.y], dtype=float)
    return Surroundings(circles, np.array(sides, dtype=float).reshape(-1, 4), limits)


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

    def blocker(self, pose: Pose, length: float = 0.0) -> str:
        """Return in words what the body touches that goes straight from a pose (length in m), or nothing."""
        body, motion = self.footprint, self.footprint.at(0.0)
        edges = body.ahead, body.behind, motion.left, motion.right
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
