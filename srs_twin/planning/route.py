"""Route: places along the path of a plan and beside it.

Path coordinates as in `swept`: s along the path from its start, n to the left of it, m. Beyond its ends the
path goes on straight, so that a body whose centre of mass is at one of them has a place as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import allocating, compiled
from srs_twin.planning.arcs import along, place
from srs_twin.planning.problem import Segment
from srs_twin.robot.world import Pose

BEYOND = 2.0
"""Length of the straight ends, m."""


class PathPoint(NamedTuple):
    """A point's place on a route: s and n, m; the path's heading and curvature there, rad and 1/m."""

    s: float
    n: float
    heading: float
    curvature: float


class Route:
    """The path of a plan, to be looked up.

    Attributes:
        length: of the path, m.
        arcs: x, y, heading, curvature, begin (s), length of each, the straight ends included, shape (n, 6).
    """

    def __init__(self, segments: Sequence[Segment]) -> None:
        """Make it.

        Args:
            segments: of a plan, one at least.
        """
        first, last = segments[0].start, segments[-1].end
        before = first.x - BEYOND * math.cos(first.heading), first.y - BEYOND * math.sin(first.heading)
        rows = [(*before, first.heading, 0.0, -BEYOND, BEYOND)]
        begin = 0.0
        for each in segments:
            start = each.start
            rows.append((start.x, start.y, start.heading, each.curvature, begin, each.length))
            begin += each.length
        rows.append((last.x, last.y, last.heading, 0.0, begin, BEYOND))
        self.length = begin
        self.arcs = np.array(rows)

    def nearest(self, x: float, y: float, low: float = -BEYOND, high: float = math.inf) -> PathPoint:
        """Return the place of the path's point nearest to a point, of those from `low` to `high` (s, m)."""
        return PathPoint(*map(float, _nearest(x, y, self.arcs, low, high)))

    def places(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return s and n of points, shape (k, 2); shape (k,) each."""
        found = _all_nearest(np.ascontiguousarray(points, dtype=float), self.arcs)
        return found[:, 0], found[:, 1]

    def curvature(self, s: float) -> float:
        """Return the curvature at a place, 1/m; 0 beyond the ends."""
        return float(self.arcs[self._arc(s), 3])

    def pose(self, s: float) -> Pose:
        """Return the pose at a place."""
        x, y, heading, curvature, begin, _ = self.arcs[self._arc(s)]
        return Pose(*map(float, along(x, y, heading, curvature, s - begin)))

    def _arc(self, s: float) -> int:
        return max(0, int(np.searchsorted(self.arcs[:, 4], s, side="right")) - 1)


@compiled
def _nearest(x, y, arcs, low, high):  # type: ignore[no-untyped-def]
    """Return s, n, heading and curvature of the nearest point."""
    best = np.inf
    s_best, n_best, heading_best, curvature_best = 0.0, 0.0, 0.0, 0.0
    for k in range(len(arcs)):
        begin, length, curvature = arcs[k, 4], arcs[k, 5], arcs[k, 3]
        first, last = max(0.0, low - begin), min(length, high - begin)
        if first > last:
            continue
        c, sn = np.cos(arcs[k, 2]), np.sin(arcs[k, 2])
        dx, dy = x - arcs[k, 0], y - arcs[k, 1]
        n, s = place(c * dx + sn * dy, c * dy - sn * dx, curvature)
        if s < 0 and curvature != 0 and s + 2 * np.pi / abs(curvature) <= last:
            s += 2 * np.pi / abs(curvature)
        s = min(max(s, first), last)
        px, py, heading = along(arcs[k, 0], arcs[k, 1], arcs[k, 2], curvature, s)
        away = np.hypot(x - px, y - py)
        if away < best:
            best = away
            aside = np.cos(heading) * (y - py) - np.sin(heading) * (x - px)
            s_best, n_best, heading_best, curvature_best = begin + s, aside, heading, curvature
    return s_best, n_best, heading_best, curvature_best


@allocating
def _all_nearest(points, arcs):  # type: ignore[no-untyped-def]
    """Return s and n of each point, shape (k, 2)."""
    found = np.empty((len(points), 2))
    for k in range(len(points)):
        s, n, _, _ = _nearest(points[k, 0], points[k, 1], arcs, -np.inf, np.inf)
        found[k, 0], found[k, 1] = s, n
    return found
