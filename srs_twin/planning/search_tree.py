"""Resumable best-first search from the start or from the goal."""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from srs_twin.planning.arcs import ArcSequence
from srs_twin.planning.dubins import shortest_path
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.search_kernels import (
    ARRIVED,
    CONNECTED,
    EXHAUSTED,
    EXPANDED,
    FULL,
    SearchSpec,
    Target,
    add_root,
    empty_frontier,
    enlarged,
    expand,
)
from srs_twin.robot.world import Goal, Pose

_INITIAL_CAPACITY = 4096

_BOUND_SLACK = 1e-6
"""Relative reduction of the turning radius for the lower bound.

Without the reduction, rounding errors could add a full turn to the Dubins path at the
end of a tightest turn.
"""

_GOAL_SPREAD = (0.0, -0.7, 0.7)
"""Start coordinates of backward searches, relative to the goal, in goal radii.

With the factor 0.7, the corners of this square pattern are within the radius.
"""


def make_target(goal: Goal, footprint: Footprint) -> Target:
    """Convert a goal to the form that the compiled kernels use."""
    right, left = footprint.tightest
    x, y, heading = Pose(goal.x, goal.y, goal.heading or 0.0)
    tolerances = float(goal.radius), float(goal.heading_tolerance)
    radii = (1 - _BOUND_SLACK) / max(right, left), 1 / min(right, left)
    return Target(x, y, heading, goal.heading is None, *tolerances, *radii)


class SearchTree:
    """Best-first search that can be paused and resumed."""

    def __init__(
        self, roots: list[Pose], spec: SearchSpec, *, backward: bool = False
    ) -> None:
        self.spec = spec
        self.backward = backward
        self.exhausted = False
        self.frontier = empty_frontier(max(_INITIAL_CAPACITY, 2 * len(roots)))
        for root in roots:
            add_root(self.frontier, *root, spec)

    @property
    def way(self) -> str:
        """Search direction as text."""
        if self.backward:
            return "back from the goal"
        return "on from the start"

    @property
    def expanded(self) -> int:
        """Number of expanded nodes."""
        return int(self.frontier.counts[EXPANDED])

    def grow(self, count: int, best: float) -> ArcSequence | None:
        """Expand up to `count` nodes and return a plan shorter than `best` (m), if any.

        The arcs of the plan lead from the start to the goal, even if the tree searches
        backward.
        """
        until = self.expanded + count
        while True:
            event, node = expand(self.frontier, self.spec, best, until - self.expanded)
            if event != FULL:
                break
            self.frontier = enlarged(self.frontier)
        self.exhausted = event == EXHAUSTED
        if event not in (CONNECTED, ARRIVED):
            return None
        arcs = self._path(int(node), connected=event == CONNECTED)
        if self.backward:
            # A left turn of the path is a right turn of the reversed path.
            return [(-curvature, length) for curvature, length in reversed(arcs)]
        return arcs

    def _path(self, node: int, *, connected: bool) -> ArcSequence:
        primitives = self.spec.primitives
        target = self.spec.target
        # The arcs are collected from the goal to the root.
        arcs: ArcSequence = []
        end = Pose(*map(float, self.frontier.nodes[node, :3]))
        if connected:
            heading = None if target.any_heading else target.heading
            # The kernel has already checked this Dubins path for collisions.
            arcs = shortest_path(
                end, target.x, target.y, heading, target.dubins_radius
            )[::-1]
        while (parent := int(self.frontier.links[node, 0])) >= 0:
            move = int(self.frontier.links[node, 1])
            if move >= 0:
                arcs.append((float(primitives.curvatures[move]), primitives.length))
            else:
                passage, factor = divmod(-1 - move, len(primitives.radius_factors))
                x, y, heading, through = map(float, self.spec.passages[passage])
                begin = Pose(*map(float, self.frontier.nodes[parent, :3]))
                entry = shortest_path(
                    begin,
                    x,
                    y,
                    heading,
                    target.dubins_radius * primitives.radius_factors[factor],
                )
                arcs += [(0.0, through), *entry[::-1]]
            node = parent
        return arcs[::-1]


def goal_poses(goal: Goal, sector: float) -> list[Pose]:
    """Return poses within the tolerances of a goal, beginning with the goal itself.

    If the heading of the goal is free, the poses have one heading per sector (rad).
    """
    if goal.heading is None:
        # A second heading in a sector would fall into an occupied cell.
        headings = list(np.arange(0.0, 2 * math.pi, sector))
    else:
        headings = [
            goal.heading + fraction * goal.heading_tolerance
            for fraction in (0.0, -1.0, 1.0)
        ]
    x, y = (
        [centre + fraction * goal.radius for fraction in _GOAL_SPREAD]
        for centre in (goal.x, goal.y)
    )
    return [
        Pose(*position, float(heading))
        for heading in headings
        for position in product(x, y)
    ]


def turned_around(pose: Pose) -> Pose:
    """Return a pose with the opposite heading."""
    return Pose(pose.x, pose.y, pose.heading + math.pi)
