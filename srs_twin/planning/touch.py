r"""Plans in which the body leans on obstacles (`planner: {contact: allowed}`).

A footprint includes the lateral motion of the gait. If an edge of the footprint
overlaps an obstacle, the obstacle limits this motion, and the body presses against the
obstacle. The planner may therefore reduce the distance e of an edge from the path to

$$ e_{hard} = c + (1 - σ)(e - c), $$

where c is half the width of the body and σ is `TOUCH_FRACTION`. Since e_hard ≥ c, the
body itself never passes through an obstacle.

The contact force is estimated from the overlap δ of the edge and the obstacle. A
connector that is displaced by δ between two fixed neighbours bends both adjacent
segments by 2δ/L, where L is the distance between connectors. With a bending stiffness
k, the elastic energy of the two bends is 4kδ²/L², so the force is Kδ with K = 8k/L². If
this force exceeds the floor friction μ_n m g, the obstacle displaces the body. The
lateral wave of amplitude A = e − c reaches the obstacle during a fraction
arccos(1 − δ/A)/π of the gait period. The mean force on one side is therefore

$$ F = \frac1π \arccos\Bigl(1 - \frac{δ}{A}\Bigr) \min(Kδ,\, μ_n m g), $$

Each metre of path costs 1 + (F_l + F_r)/(μ_n m g) metres, where F_l and F_r are the
mean forces on the left and right. The edges include the margin of the plan, because the
body may deviate from its path by this margin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from srs_twin.planning.collision import obstacle_shapes
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.path import Segment, path_steps
from srs_twin.planning.problem import (
    Plan,
    PlannedContact,
    Problem,
    Settings,
    TouchLimits,
)
from srs_twin.robot.spec import GRAVITY, RobotSpec
from srs_twin.robot.world import Bounds

TOUCH_FRACTION = 0.5
"""Maximum fraction σ of the space between body and edge that may overlap an obstacle.

With both plants, a snake of generation 2 passes gaps of 0.75 footprint widths, but does
not reliably pass gaps of 0.6 footprint widths (docs/planning.md).
"""

_LEVELS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Overlaps as fractions of the maximum overlap, tried in this order."""
_MAX_NODES = 10_000
"""Maximum number of expanded nodes in each search below the maximum overlap."""
_SPACING_M = 0.01
"""Maximum distance between path points at which the overlap is evaluated, m."""
_MIN_DEPTH_M = 1e-4
"""Minimum overlap that is reported, m."""

Search = Callable[[Problem, Settings], Plan]


def touch_limits(spec: RobotSpec, footprint: Footprint) -> TouchLimits:
    """Return the limits for leaning on obstacles.

    The footprint must not contain a margin.
    """
    core = spec.geometry.width / 2
    hard_left, hard_right = (
        tuple(core + (1 - TOUCH_FRACTION) * max(edge - core, 0.0) for edge in edges)
        for edges in (footprint.left, footprint.right)
    )
    stiffness = 8 * spec.bending.stiffness / spec.geometry.pitch**2
    floor = spec.friction.mu_n * sum(spec.mass.connectors) * GRAVITY
    return TouchLimits(
        replace(footprint, left=hard_left, right=hard_right), core, stiffness, floor
    )


def narrowed(problem: Problem, limits: TouchLimits, level: float) -> Problem:
    """Return the problem with edges moved inward by a fraction of the maximum overlap.

    The bounds are reduced by the same distance, because the body cannot lean on them.
    """
    body = problem.footprint
    world = problem.world
    hard = [limits.hard.at(curvature) for curvature in body.curvatures]
    free = [edge - row.left for edge, row in zip(body.left, hard, strict=True)]
    free += [edge - row.right for edge, row in zip(body.right, hard, strict=True)]
    overlap = level * max(min(free), 0.0)
    if (old := world.bounds) is not None:
        x, y = ((low + overlap, high - overlap) for low, high in (old.x, old.y))
        world = replace(world, bounds=Bounds(x, y))
    return replace(problem, footprint=body.reduced(margin=-overlap), world=world)


def plan_with_touch(search: Search, problem: Problem, settings: Settings) -> Plan:
    """Plan with increasing overlaps, and return the plan with the lowest cost."""
    limits = settings.touch_limits
    assert limits is not None, "the caller plans with touch"
    best = None
    lowest = np.inf
    short = replace(settings, nodes=min(settings.nodes, _MAX_NODES))
    for level in _LEVELS:
        result = search(
            narrowed(problem, limits, level), short if level < 1 else settings
        )
        if result.found:
            result = result.with_edges_of(problem)
            overlaps = _overlaps(result.segments, problem, limits)
            cost = float(
                overlaps.steps @ (1 + overlaps.force.sum(axis=0) / limits.floor)
            )
            if cost < lowest:
                touches = overlaps.touches()
                if touches:
                    reason = "a path on which the body leans on obstacles"
                else:
                    reason = result.reason
                best = replace(result, touches=touches, reason=reason)
                lowest = cost
    # If no path is found, the reported reason comes from the search with the narrowest
    # edges.
    if best is None:
        return replace(result, touches=())
    return best


@dataclass(frozen=True)
class _Overlaps:
    """Overlaps of the footprint with obstacles along a path.

    Attributes:
        s: path position at the middle of each step, m, shape (steps,).
        steps: step lengths, m, shape (steps,).
        depth, force: overlap (m) and mean contact force (N) at each obstacle and step,
            shape (obstacles, steps).
    """

    names: list[str]
    s: np.ndarray
    steps: np.ndarray
    depth: np.ndarray
    force: np.ndarray

    def touches(self) -> tuple[PlannedContact, ...]:
        found = []
        for name, depth, force in zip(self.names, self.depth, self.force, strict=True):
            edges = np.flatnonzero(np.diff(np.r_[False, depth > _MIN_DEPTH_M, False]))
            for begin, end in edges.reshape(-1, 2).tolist():
                part = slice(begin, end)
                low, high = self.s[part][[0, -1]] + self.steps[part][[0, -1]] * (
                    -0.5,
                    0.5,
                )
                mean = float(np.average(force[part], weights=self.steps[part]))
                found.append(
                    PlannedContact(
                        name, float(low), float(high), float(depth[part].max()), mean
                    )
                )
        return tuple(sorted(found, key=lambda touch: touch.begin))


def _overlaps(
    segments: Sequence[Segment], problem: Problem, limits: TouchLimits
) -> _Overlaps:
    import shapely

    path = path_steps(segments, problem.footprint, _SPACING_M)
    shapes = obstacle_shapes(problem.world)
    x, y, heading = path.poses.T
    points = shapely.points(x, y)
    lengths = path.lengths
    depth, force = np.zeros((2, len(shapes), len(lengths)))
    for k, (_, core, radius) in enumerate(shapes):
        nearest = shapely.get_coordinates(shapely.shortest_line(points, core)).reshape(
            -1, 2, 2
        )[:, 1]
        dx = nearest[:, 0] - x
        dy = nearest[:, 1] - y
        edge = np.where(
            np.cos(heading) * dy > np.sin(heading) * dx, path.left, path.right
        )
        depth[k] = np.maximum(edge - (np.hypot(dx, dy) - radius), 0.0)
        fraction = (
            np.arccos(
                np.clip(1 - depth[k] / np.maximum(edge - limits.core, 1e-9), -1, 1)
            )
            / np.pi
        )
        force[k] = fraction * np.minimum(limits.stiffness * depth[k], limits.floor)
    names = [name for name, *_ in shapes]
    return _Overlaps(names, np.cumsum(lengths) - lengths / 2, lengths, depth, force)
