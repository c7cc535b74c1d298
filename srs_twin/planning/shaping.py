r"""Shaping: the way that a change of offset takes, as it was measured, in place of a jump of the curvature.

After a change from curvature κ_a to κ_b the path is late: it turns by Δκ δ less than an instant change would
have it, and ends up Δκ m/2 beside (`Transient`: dheading = −Δκ δ, dy = Δκ m/2). One arc between the two does
the same to first order,

.. math:: κ_t = κ_a + \Bigl(1 - \frac{δ}{T}\Bigr) Δκ, \qquad T = \frac{m}{δ},

begun where the command takes effect. Put so that it begins δ before the planned change, it leaves the
heading of the plan as it is and the path Δκ (m − δ²)/2 beside; hence a plan is made to a goal that lies as
much to the other side. An offset that a follower sends ahead by δ then has the body on the path.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from srs_twin.planning.collision import Checker
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.planner import plan
from srs_twin.planning.problem import Plan, Problem, Segment, path_of
from srs_twin.planning.settings import Settings
from srs_twin.world import Goal, Pose

_AIMS = 6
"""How often a goal is aimed at anew."""
_ROOM = (0.0, 0.01, 0.02, 0.03)
"""What edges are wider by, m, to plan with: the shaped path has to be free with the footprint's own."""


def shaped(segments: Sequence[Segment], footprint: Footprint) -> tuple[Segment, ...]:
    """Return a path with the way of each change of offset in it; changes without room for theirs stay jumps.

    Args:
        segments: of the path.
        footprint: whose transients they are; without any the path is returned as it is.
    """
    if not segments:
        return ()
    pieces: list[tuple[float, float]] = []
    left = segments[0].length
    for here, after in zip(segments, segments[1:], strict=False):
        late, long = footprint.lag(here.offset, after.offset)
        if long == 0 or late > left or long - late > after.length:
            late, long = 0.0, 0.0
        between = after.curvature + (here.curvature - after.curvature) * (late / long if long else 0.0)
        pieces += [(here.curvature, left - late), (between, long)]
        left = after.length - (long - late)
    pieces.append((segments[-1].curvature, left))
    return path_of(segments[0].start, pieces, footprint)


def plan_shaped(problem: Problem, settings: Settings, begin: Sequence[Segment] = ()) -> Plan:
    """Plan, with the way of each change of offset in the path.

    The path is free, transients included, and ends within the goal's tolerances. Where none such is found,
    the plan is that without shapes, and its reason says so.

    Args:
        problem: where it is begun; its start is the end of `begin`.
        settings: how hard to try, each time that a goal is aimed at.
        begin: what of the path is fixed.

    Returns:
        The plan, with the nodes and the time of all that were made for it.

    Raises:
        InputError: as `plan`.
    """
    made: list[Plan] = []

    def planned(asked: Problem) -> Plan:
        made.append(plan(asked, settings))
        return made[-1]

    found = _shaped_plan(problem, planned, begin)
    return replace(
        found, expanded=sum(each.expanded for each in made), seconds=sum(each.seconds for each in made)
    )


def _shaped_plan(problem: Problem, planned: Callable[[Problem], Plan], begin: Sequence[Segment]) -> Plan:
    body = problem.footprint
    first = planned(problem)
    if not first.found:
        return first
    if not first.segments or not body.transients:
        return replace(first, segments=(*begin, *first.segments))
    checker = Checker(problem.world, body)
    for room in _ROOM:
        wide = replace(problem, footprint=body.reduced(margin=room))
        aimed = problem.goal
        for _ in range(_AIMS):
            found = planned(replace(wide, goal=aimed)) if room or aimed != problem.goal else first
            if not found.found or not found.segments:
                break
            path = shaped((*begin, *found.segments), body)
            end = path[-1].end
            if _arrived(end, problem.goal):
                if checker.free_path(path):
                    return replace(found, segments=path)
                break
            aimed = _aimed_anew(aimed, problem.goal, end)
    why = f"{first.reason}; changes of offset are jumps in it, for none was free with the way that they take"
    return replace(first, reason=why, segments=(*begin, *first.segments))


def _arrived(end: Pose, goal: Goal) -> bool:
    near = math.hypot(end.x - goal.x, end.y - goal.y) <= goal.radius
    if goal.heading is None:
        return near
    return near and abs(math.remainder(end.heading - goal.heading, 2 * math.pi)) <= goal.heading_tolerance


def _aimed_anew(aimed: Goal, goal: Goal, end: Pose) -> Goal:
    """Return the goal moved by what the path misses the real one by."""
    turned = None
    if goal.heading is not None and aimed.heading is not None:
        turned = aimed.heading - math.remainder(end.heading - goal.heading, 2 * math.pi)
    return replace(aimed, x=aimed.x + goal.x - end.x, y=aimed.y + goal.y - end.y, heading=turned)
