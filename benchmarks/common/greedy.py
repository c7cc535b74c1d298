r"""The planner of the dissertation, as a baseline for the planner.

`greedy`, Section 5.2.1, grows two trees of one branch each, from the start and from the
goal. At the newest node of each side in turn, start first, all N arcs are scored and
the one with the lowest score g + h is taken. There is no open list and no backtracking.

- g favours straight arcs: g = |i - (N+1)/2| (E8: the printed formula contradicts its
  sentence). The dissertation gives g and h no common unit. Here a step of g counts as a
  millimetre, the unit of the dissertation's figures. Then g decides only between arcs
  that come equally close, as in the dissertation's example.
- h is the arc distance to the newest node of the other side: the length d β / sin β of
  the arc that begins along the node's heading and passes through the other node, at
  distance d and bearing β. It ignores the other node's heading. In the dissertation,
  blocked arcs have a score of 10000; here they are excluded, and if all arcs are
  blocked the planner is stuck.

The search ends when the arc distance falls below a threshold. The dissertation gives no
value; here it is the length of one arc. Its second condition, "and the difference
between the rotation angles is π", is joined by "or" and has no effect. The heading may
therefore jump where the branches meet (`Plan.max_heading_jump`), and no snake can follow such a
plan exactly. The joint is the arc whose length is the arc distance; it must be free and
no tighter than the primitives.

The backward branch grows from the goal with the heading turned by π and the reversed
footprint.
"""

from __future__ import annotations

import math

from srs_twin.errors import InputError
from srs_twin.planning.arcs import Primitives
from srs_twin.planning.collision import Checker
from srs_twin.planning.path import Segment, make_segment
from srs_twin.planning.problem import Plan, PlanOutcome, Problem, Settings
from srs_twin.robot.world import Pose

G_STEP_M = 0.001
"""Cost of one step of the g score, m; see the module docstring."""

_MAX_BRANCH_ARCS = 200
"""Arcs per branch after which the search ends: 40 m with the primitives of Section 5.2.
"""

Branch = list[tuple[Pose, float]]
"""Start pose and curvature (1/m) of each arc."""


def greedy(problem: Problem, settings: Settings) -> Plan:
    """Plan as the dissertation does; the settings are not used.

    Raises:
        InputError: the problem has no primitives, or its goal no heading.
    """
    arcs = problem.primitives
    if arcs is None:
        raise InputError(
            "greedy needs primitives: their number, largest turn and length"
        )
    if problem.goal.heading is None:
        raise InputError(
            "greedy needs a goal with a heading: its second branch starts there"
        )
    forward = Checker(problem.world, problem.footprint)
    backward = Checker(problem.world, problem.footprint.backward)
    tips = [
        problem.start,
        Pose(problem.goal.x, problem.goal.y, problem.goal.heading + math.pi),
    ]
    branches: list[Branch] = [[], []]
    for turn in range(2 * _MAX_BRANCH_ARCS):
        side = turn % 2
        # The joint is tried before each new arc, with the forward footprint.
        joint = _joint(tips[0], tips[1], arcs, forward)
        if joint is not None:
            path = _joined_path(branches, joint, problem, arcs.length)
            return Plan(PlanOutcome.FOUND, "the branches met", path, turn)
        child = _best_child(tips[side], tips[1 - side], arcs, (forward, backward)[side])
        if child is None:
            where = f"{turn // 2} arcs from the {('start', 'goal')[side]}"
            reason = (
                f"every arc is blocked {where}, and greedy does not go back; try"
                " best_first"
            )
            return Plan(PlanOutcome.NOT_FOUND, reason, (), turn)
        curvature, end = child
        branches[side].append((tips[side], curvature))
        tips[side] = end
    reason = (
        f"the branches did not meet within {_MAX_BRANCH_ARCS} arcs each; try best_first"
    )
    return Plan(PlanOutcome.NOT_FOUND, reason, (), 2 * _MAX_BRANCH_ARCS)


def arc_through(pose: Pose, x: float, y: float) -> tuple[float, float]:
    """Return curvature (1/m) and length (m) of the arc that begins at a pose and passes through a point.

    The length is infinite for a point straight behind the pose.
    """
    dx = x - pose.x
    dy = y - pose.y
    distance = math.hypot(dx, dy)
    bearing = math.remainder(math.atan2(dy, dx) - pose.heading, 2 * math.pi)
    if distance < 1e-12 or abs(bearing) < 1e-9:
        return 0.0, distance
    sine = math.sin(bearing)
    return 2 * sine / distance, (
        distance * bearing / sine if abs(sine) > 1e-9 else math.inf
    )


def _best_child(
    tip: Pose, other: Pose, arcs: Primitives, checker: Checker
) -> tuple[float, Pose] | None:
    """Return curvature and end of the free arc with the lowest score; None if all are blocked."""
    best = None
    lowest = math.inf
    for i, (curvature, child) in enumerate(
        zip(arcs.curvatures, arcs.children(tip), strict=True)
    ):
        score = (
            G_STEP_M * abs(i - arcs.count // 2)
            + arc_through(child, other.x, other.y)[1]
        )
        if score < lowest and checker.is_arc_free(tip, float(curvature), arcs.length):
            best = (float(curvature), child)
            lowest = score
    return best


def _joint(
    here: Pose, there: Pose, arcs: Primitives, checker: Checker
) -> tuple[float, float] | None:
    """Return curvature and length of the arc between the newest nodes if it is short, free and possible."""
    curvature, length = arc_through(here, there.x, there.y)
    near = length < arcs.length and abs(curvature) <= arcs.curvatures[-1]
    if near and checker.is_arc_free(here, curvature, length):
        return (curvature, length)
    return None


def _joined_path(
    branches: list[Branch], joint: tuple[float, float], problem: Problem, length: float
) -> tuple[Segment, ...]:
    """Return the forward branch, the joint and the reversed backward branch."""
    body = problem.footprint
    path = [
        make_segment(pose, curvature, length, body) for pose, curvature in branches[0]
    ]
    path.append(make_segment(path[-1].end if path else problem.start, *joint, body))
    for pose, curvature in reversed(branches[1]):
        end = make_segment(pose, curvature, length, body).end
        # The same arc from its other end turns to the other side.
        path.append(
            make_segment(
                Pose(end.x, end.y, end.heading - math.pi), -curvature, length, body
            )
        )
    return tuple(path)
