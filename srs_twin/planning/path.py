"""Paths that consist of arcs, and path coordinates of points.

The coordinate s (m) is the position along the path, measured from the start of the
path. The coordinate n (m) is the distance to the left of the path (see `arcs`).
Straight lines extend the path at both ends, because the body extends beyond its centre
of mass.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import allocating, compiled
from srs_twin.planning.arcs import ArcSequence, arc_end, path_coordinates
from srs_twin.planning.footprint import Footprint
from srs_twin.robot.world import Pose

EXTENSION_M = 2.0
"""Length of each straight extension, which is longer than any body, m."""


@dataclass(frozen=True)
class Segment:
    """Arc of a plan.

    Attributes:
        start: initial pose of the centre of mass.
        curvature: path curvature, positive to the left, 1/m.
        length: arc length, m.
        offset: gait offset that produces the curvature.
        speed: speed of the centre of mass, m/s.
    """

    start: Pose
    curvature: float
    length: float
    offset: float
    speed: float

    def pose(self, length: float) -> Pose:
        """Return the pose at a distance (m) from the start of the segment."""
        return Pose(*map(float, arc_end(*self.start, self.curvature, length)))

    @property
    def end(self) -> Pose:
        """Pose at the end of the segment."""
        return self.pose(self.length)


def make_segment(
    start: Pose, curvature: float, length: float, footprint: Footprint
) -> Segment:
    """Return a segment with the footprint's offset and speed at its curvature (1/m)."""
    row = footprint.at(curvature)
    return Segment(start, curvature, length, row.offset, row.speed)


def path_from_arcs(
    start: Pose, arcs: ArcSequence, footprint: Footprint
) -> tuple[Segment, ...]:
    """Build a path from consecutive arcs, and merge adjacent arcs of equal curvature.

    Args:
        start: start pose.
        arcs: curvature (1/m) and length (m) of each arc. Arcs of length 0 are dropped.
        footprint: footprint from which offsets and speeds are interpolated.
    """
    merged: list[list[float]] = []
    for curvature, length in arcs:
        if length <= 0:
            continue
        if merged and math.isclose(merged[-1][0], curvature, abs_tol=1e-12):
            merged[-1][1] += length
        else:
            merged.append([curvature, length])
    segments: list[Segment] = []
    for curvature, length in merged:
        segments.append(make_segment(start, curvature, length, footprint))
        start = segments[-1].end
    return tuple(segments)


class PathSteps(NamedTuple):
    """Path divided into short steps, for integrals over the path length.

    Attributes:
        poses: x, y (m) and heading (rad) at the midpoint of each step, shape (n, 3).
        lengths: step lengths, m, shape (n,).
        left, right: distances from the path to the left and right edges, m, shape (n,).
    """

    poses: np.ndarray
    lengths: np.ndarray
    left: np.ndarray
    right: np.ndarray


def path_steps(
    segments: Sequence[Segment], footprint: Footprint, spacing: float
) -> PathSteps:
    """Divide a path into steps of at most `spacing` (m)."""
    rows: list[tuple[float, ...]] = []
    for segment in segments:
        count = max(math.ceil(segment.length / spacing), 1)
        row = footprint.at(segment.curvature)
        middles = ((k + 0.5) / count for k in range(count))
        rows += [
            (
                *segment.pose(fraction * segment.length),
                segment.length / count,
                row.left,
                row.right,
            )
            for fraction in middles
        ]
    table = np.array(rows, dtype=float).reshape(-1, 6)
    return PathSteps(table[:, :3], *table[:, 3:].T)


class PathPoint(NamedTuple):
    """Path coordinates of a point, with properties of the nearest path point.

    Attributes:
        s, n: path coordinates, m.
        heading, curvature: heading (rad) and curvature (1/m) of the path.
    """

    s: float
    n: float
    heading: float
    curvature: float


class ReferencePath:
    """Path of a plan, for conversions between positions and path coordinates.

    Attributes:
        length: path length, m.
        arcs: x, y, heading, curvature, initial s and length of each arc and extension,
            shape (n, 6).
    """

    def __init__(self, segments: Sequence[Segment]) -> None:
        """Build the path from a sequence of at least one segment."""
        first = segments[0].start
        before = (
            first.x - EXTENSION_M * math.cos(first.heading),
            first.y - EXTENSION_M * math.sin(first.heading),
        )
        rows = [(*before, first.heading, 0.0, -EXTENSION_M, EXTENSION_M)]
        begin = 0.0
        for segment in segments:
            rows.append((*segment.start, segment.curvature, begin, segment.length))
            begin += segment.length
        rows.append((*segments[-1].end, 0.0, begin, EXTENSION_M))
        self.length = begin
        self.arcs = np.array(rows)

    def nearest(
        self, x: float, y: float, low: float = -EXTENSION_M, high: float = math.inf
    ) -> PathPoint:
        """Return the path coordinates of a point (m), with s in [low, high] (m)."""
        return PathPoint(*map(float, _nearest(x, y, self.arcs, low, high)))

    def coordinates(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return s and n (m), each of shape (k,), for points (m) of shape (k, 2)."""
        rows = _nearest_of_all(np.ascontiguousarray(points, dtype=float), self.arcs)
        return rows[:, 0], rows[:, 1]

    def curvature(self, s: float) -> float:
        """Return the path curvature (1/m) at s (m), which is 0 on the extensions."""
        return float(self.arcs[self._arc_index(s), 3])

    def pose(self, s: float) -> Pose:
        """Return the pose of the path at s (m)."""
        x, y, heading, curvature, begin, _ = self.arcs[self._arc_index(s)]
        return Pose(*map(float, arc_end(x, y, heading, curvature, s - begin)))

    def _arc_index(self, s: float) -> int:
        return max(0, int(np.searchsorted(self.arcs[:, 4], s, side="right")) - 1)


@compiled
def _nearest(x, y, arcs, low, high):  # type: ignore[no-untyped-def]
    best = np.inf
    s_best = 0.0
    n_best = 0.0
    heading_best = 0.0
    curvature_best = 0.0
    for k in range(len(arcs)):
        begin = arcs[k, 4]
        length = arcs[k, 5]
        curvature = arcs[k, 3]
        first = max(0.0, low - begin)
        last = min(length, high - begin)
        if first > last:
            continue
        c = np.cos(arcs[k, 2])
        sn = np.sin(arcs[k, 2])
        dx = x - arcs[k, 0]
        dy = y - arcs[k, 1]
        n, s = path_coordinates(c * dx + sn * dy, c * dy - sn * dx, curvature)
        # `path_coordinates` returns s between -π/|κ| and π/|κ|, so a full turn may be
        # missing.
        if s < 0 and curvature != 0 and s + 2 * np.pi / abs(curvature) <= last:
            s += 2 * np.pi / abs(curvature)
        s = min(max(s, first), last)
        px, py, heading = arc_end(arcs[k, 0], arcs[k, 1], arcs[k, 2], curvature, s)
        distance = np.hypot(x - px, y - py)
        if distance < best:
            best = distance
            lateral = np.cos(heading) * (y - py) - np.sin(heading) * (x - px)
            s_best = begin + s
            n_best = lateral
            heading_best = heading
            curvature_best = curvature
    return s_best, n_best, heading_best, curvature_best


@allocating
def _nearest_of_all(points, arcs):  # type: ignore[no-untyped-def]
    rows = np.empty((len(points), 2))
    for k in range(len(points)):
        s, n, _, _ = _nearest(points[k, 0], points[k, 1], arcs, -np.inf, np.inf)
        rows[k, 0] = s
        rows[k, 1] = n
    return rows
