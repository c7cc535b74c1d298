r"""The text's planner (Section 5.2.1), as the historical reference: two trees of one branch each.

From the newest node of either side in turn, start first, all N arcs are looked at and the one with the least
score g + h is taken, for good: there is no open list, and no way back.

- g favours straight arcs: g = |i - (N+1)/2| (E8: the printed formula contradicts its sentence). The text
  gives g and h no common unit. Here a step of g counts as a millimetre, the unit of its figures, so that g
  decides between arcs that come equally near, as in the text's example, which is told by distances alone.
- h is the arc distance to the other side's newest node: the length of the arc that begins along the node's
  heading and passes through the other's place, d β / sin β at distance d and bearing β. It does not know the
  other's heading. Blocked arcs get 10000 in the text; here they are left out, and where all are, it is stuck.

The search ends when the arc distance falls below a threshold; the text gives none; here it is one step. "And
the difference between the rotation angles is π" is its other condition, but "or" the threshold alone makes
that idle. So where the branches meet the heading may jump (`Plan.kink`), and no snake drives such a plan as
it is. The joint is the arc whose length is the arc distance; it has to be free and no tighter than the
others.

The backward branch grows from the goal with the heading turned by π, on the mirrored footprint.
"""

from __future__ import annotations

import math
from dataclasses import replace

from srs_twin.errors import InputError
from srs_twin.planning.arcs import Primitives
from srs_twin.planning.collision import Checker
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.plan import Plan
from srs_twin.planning.problem import Outcome, Problem, Segment, segment
from srs_twin.robot.world import Pose

G_STEP = 0.001
"""What one step of the g score counts, m."""

_MOST = 200

Branch = list[tuple[Pose, float]]
"""Beginning and curvature (1/m) of each arc."""


def greedy(problem: Problem) -> Plan:
    """Plan as the text does.

    Raises:
        InputError: the problem has no primitives, or its goal no heading.
    """
    arcs = problem.primitives
    if arcs is None:
        raise InputError(
            "planner greedy needs primitives: their number N, alpha_max and the length of a step"
        )
    if problem.goal.heading is None:
        raise InputError("planner greedy needs a goal with a heading: its second branch grows from there")
    there = Checker(problem.world, problem.footprint)
    back = Checker(problem.world, mirrored(problem.footprint))
    tips = [problem.start, Pose(problem.goal.x, problem.goal.y, problem.goal.heading + math.pi)]
    branches: list[Branch] = [[], []]
    for turn in range(2 * _MOST):
        side = turn % 2
        joint = _joint(tips[0], tips[1], arcs, there)
        if joint is not None:
            path = _path(branches, joint, problem, arcs.length)
            return Plan(Outcome.FOUND, "the branches met", path, turn)
        taken = _best(tips[side], tips[1 - side], arcs, (there, back)[side])
        if taken is None:
            where = f"{turn // 2} arcs from the {('start', 'goal')[side]}"
            why = f"every arc is blocked {where}, and greedy does not go back; try best_first"
            return Plan(Outcome.STUCK, why, (), turn)
        branches[side].append((tips[side], taken[0]))
        tips[side] = taken[1]
    why = f"the branches did not meet in {_MOST} arcs each; try best_first"
    return Plan(Outcome.BUDGET_SPENT, why, (), 2 * _MOST)


def arc_to(pose: Pose, x: float, y: float) -> tuple[float, float]:
    """Return curvature (1/m) and length (m) of the arc that begins along a pose and passes through a point.

    A point straight behind has none: its length is infinite.
    """
    dx, dy = x - pose.x, y - pose.y
    distance = math.hypot(dx, dy)
    bearing = math.remainder(math.atan2(dy, dx) - pose.heading, 2 * math.pi)
    if distance < 1e-12 or abs(bearing) < 1e-9:
        return 0.0, distance
    sine = math.sin(bearing)
    return 2 * sine / distance, distance * bearing / sine if abs(sine) > 1e-9 else math.inf


def mirrored(footprint: Footprint) -> Footprint:
    """Return the footprint of one that goes the same paths from their end: turned by π, sides exchanged."""
    return replace(
        footprint,
        offsets=tuple(-value for value in reversed(footprint.offsets)),
        curvatures=tuple(-value for value in reversed(footprint.curvatures)),
        speeds=footprint.speeds[::-1],
        left=footprint.right[::-1],
        right=footprint.left[::-1],
        ahead=footprint.behind,
        behind=footprint.ahead,
        transients=(),
    )


def _best(tip: Pose, other: Pose, arcs: Primitives, checker: Checker) -> tuple[float, Pose] | None:
    """Return curvature and end of the child with the least score, None where all are blocked."""
    best, least = None, math.inf
    for i, (curvature, child) in enumerate(zip(arcs.curvatures, arcs.children(tip), strict=True)):
        score = G_STEP * abs(i - arcs.count // 2) + arc_to(child, other.x, other.y)[1]
        if score < least and checker.free(tip, float(curvature), arcs.length):
            best, least = (float(curvature), child), score
    return best


def _joint(here: Pose, there: Pose, arcs: Primitives, checker: Checker) -> tuple[float, float] | None:
    """Return the arc between the newest nodes if they are near enough and it can be followed and is free."""
    curvature, length = arc_to(here, there.x, there.y)
    near = length < arcs.length and abs(curvature) <= arcs.curvatures[-1]
    return (curvature, length) if near and checker.free(here, curvature, length) else None


def _path(
    branches: list[Branch], joint: tuple[float, float], problem: Problem, length: float
) -> tuple[Segment, ...]:
    body = problem.footprint
    path = [segment(pose, curvature, length, body) for pose, curvature in branches[0]]
    path.append(segment(path[-1].end if path else problem.start, *joint, body))
    for pose, curvature in reversed(branches[1]):
        end = segment(pose, curvature, length, body).end
        # The same arc from its other end: it turns the other way.
        path.append(segment(Pose(end.x, end.y, end.heading - math.pi), -curvature, length, body))
    return tuple(path)
