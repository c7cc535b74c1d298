"""Collision checks of arcs and plans against a world, exact up to `swept.MARGIN`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from srs_twin.compiled import compiled
from srs_twin.planning.arcs import blocked
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.problem import Segment
from srs_twin.world import Bounds, Circle, Polygon, Pose, World

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
    sides = [
        (*a, *b)
        for p in world.polygons
        for a, b in zip(p.corners, p.corners[1:] + p.corners[:1], strict=True)
    ]
    bounds = world.bounds or _ANYWHERE
    return Surroundings(
        circles, np.array(sides, dtype=float).reshape(-1, 4), np.array([*bounds.x, *bounds.y], dtype=float)
    )


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
        return not blocked(
            pose.x,
            pose.y,
            pose.heading,
            curvature,
            length,
            body.ahead,
            body.behind,
            left,
            right,
            *self.surroundings,
        )

    def free_arcs(self, poses: np.ndarray, curvatures: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        """Say of many arcs whether each is free.

        Args:
            poses: x, y, heading of the beginnings, shape (n, 3).
            curvatures: 1/m, shape (n,).
            lengths: m, shape (n,).
        """
        table = self.footprint
        left = np.interp(curvatures, table.curvatures, table.left)
        right = np.interp(curvatures, table.curvatures, table.right)
        found: np.ndarray = _free_arcs(
            poses, curvatures, lengths, table.ahead, table.behind, left, right, self.surroundings
        )
        return found

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
        for name, world in _pieces(self.world):
            if blocked(
                pose.x, pose.y, pose.heading, 0.0, length, body.ahead, body.behind, motion.left, motion.right,
                *surroundings(world),
            ):  # fmt: skip
                return name
        return ""


def inside(world: World, x: float, y: float) -> str:
    """Return in words what a point lies in (or outside of), or an empty string."""
    import shapely

    point = shapely.Point(x, y)
    for name, each in _pieces(world):
        if each.bounds and not (
            each.bounds.x[0] <= x <= each.bounds.x[1] and each.bounds.y[0] <= y <= each.bounds.y[1]
        ):
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
        found.append(
            (f"the bounds (x {west:g} to {east:g} m, y {south:g} to {north:g} m)", World(bounds=bounds))
        )
    for k, circle in enumerate(world.obstacles):
        found.append((f"obstacle {k + 1} ({_circle(circle)})", World((circle,))))
    for k, polygon in enumerate(world.polygons):
        found.append((f"polygon {k + 1} ({_polygon(polygon)})", World(polygons=(polygon,))))
    return found


def _circle(circle: Circle) -> str:
    return f"radius {circle.radius:g} m at ({circle.x:g}, {circle.y:g})"


def _polygon(polygon: Polygon) -> str:
    return (
        f"{len(polygon.corners)} corners, the first at ({polygon.corners[0][0]:g}, {polygon.corners[0][1]:g})"
    )


@compiled
def _free_arcs(poses, curvatures, lengths, ahead, behind, left, right, around):  # type: ignore[no-untyped-def]
    found = np.empty(len(lengths), dtype=np.bool_)
    for i in range(len(lengths)):
        x, y, heading = poses[i, 0], poses[i, 1], poses[i, 2]
        found[i] = not blocked(
            x, y, heading, curvatures[i], lengths[i], ahead, behind, left[i], right[i],
            around.circles, around.sides, around.bounds,
        )  # fmt: skip
    return found
