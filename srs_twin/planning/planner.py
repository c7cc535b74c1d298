r"""Planning of collision-free paths, with or without transition arcs.

A change of curvature from κ_a to κ_b = κ_a + Δκ is not instantaneous, because the body
responds gradually to a change of offset. Compared with an instantaneous change, the
path turns by Δκ δ less (`Transient.dheading` = −Δκ δ). The path is also displaced to
the left by `Transient.dy` = Δκ m/2. To first order, a single transition arc has this
effect if its curvature κ_t and its length T are

$$ κ_t = κ_a + \Bigl(1 - \frac{δ}{T}\Bigr) Δκ, \qquad T = \frac{m}{δ}. $$

If the transition arc begins a distance δ before the planned change, the final heading
is unchanged, but the path is displaced by Δκ (m − δ²)/2. The search therefore uses a
goal that is displaced in the opposite direction. To keep the body on the path, a
follower sends each offset a distance δ before the planned change.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise, product

import numpy as np

from srs_twin.io.arguments import checked
from srs_twin.planning.best_first import best_first
from srs_twin.planning.collision import Checker, obstacle_shapes
from srs_twin.planning.footprint import Footprint, Transient
from srs_twin.planning.path import Segment, path_from_arcs, path_steps
from srs_twin.planning.problem import Plan, Problem, Settings, check_problem
from srs_twin.planning.touch import narrowed, plan_with_touch
from srs_twin.robot.world import Bounds, Circle, Goal, Polygon, Pose, World

_WIDTH_STEPS = (0.1, 0.2, 0.4, 0.8, 1.6)
"""Outward shifts of the edges in searches for paths with more clearance, relative to
the width of the straight footprint.
"""
_MAX_WIDER_NODES = 4000
"""Maximum number of expanded nodes in each search with a wider footprint."""
_COST_SPACING_M = 0.02
"""Maximum distance between path points at which the clearance is evaluated, m."""

_AIM_ITERATIONS = 6
"""Maximum number of goal poses that `plan_with_transitions` tries for each margin."""
_SHAPING_MARGINS_M = (0.0, 0.01, 0.02, 0.03)
"""Margins for the search in `plan_with_transitions`, tried in this order, m.

The path with transition arcs must be collision-free without this margin.
"""


@checked
def plan(problem: Problem, settings: Settings | None = None) -> Plan:
    """Find a collision-free path.

    Args:
        problem: planning problem.
        settings: search settings, or None for the default settings.

    Raises:
        InputError: the start or the goal is in an obstacle or outside the bounds, or a
            value is not allowed.
    """
    settings = settings or Settings()
    touch = settings.touch_limits
    firm = narrowed(problem, touch, 1.0) if touch else problem
    check_problem(firm)
    _compile()
    begun = time.perf_counter()
    if touch:
        result = plan_with_touch(best_first, problem, settings)
    else:
        result = best_first(problem, settings)
    if result.found and settings.clearance_weight > 0:
        result = _lowest_cost(result, problem, settings)
    return replace(result, seconds=time.perf_counter() - begun, problem=firm)


def _lowest_cost(first: Plan, problem: Problem, settings: Settings) -> Plan:
    straight = problem.footprint.at(0.0)
    width = straight.left + straight.right
    short = replace(settings, nodes=min(settings.nodes, _MAX_WIDER_NODES))
    plans = [first]
    for fraction in _WIDTH_STEPS:
        wider = replace(
            problem, footprint=problem.footprint.reduced(margin=fraction * width)
        )
        result = best_first(wider, short)
        if not result.found:
            break
        plans.append(result.with_edges_of(problem))
    return min(
        plans,
        key=lambda result: _cost(result, problem, width, settings.clearance_weight),
    )


def _cost(result: Plan, problem: Problem, width: float, weight: float) -> float:
    import shapely

    steps = path_steps(result.segments, problem.footprint, _COST_SPACING_M)
    points = shapely.points(steps.poses[:, :2])
    distance = np.full(len(points), np.inf)
    for _, core, radius in obstacle_shapes(problem.world):
        distance = np.minimum(distance, shapely.distance(points, core) - radius)
    # The larger of the two edge distances is used on both sides, which yields an upper
    # bound of the cost.
    clearance = np.maximum(distance - np.maximum(steps.left, steps.right), 0.0)
    return float(np.dot(steps.lengths, 1 + weight * np.exp(-clearance / width)))


@functools.cache
def _compile() -> None:
    """Compile the kernels or load them from the cache before the time limit starts."""
    # This problem uses all kernels, because it contains obstacles and a transient.
    circles = (Circle(0.6, 0.05, 0.1), Circle(1.7, 0.1, 0.1))
    square = Polygon(((1.1, -0.3), (1.2, -0.3), (1.2, 0.05), (1.1, 0.05)))
    world = World(circles, Bounds((-1.0, 4.0), (-2.0, 2.0)), polygons=(square,))
    change = Transient(-0.3, 0.3, left=0.01, right=0.01, length=0.05)
    body = replace(
        Footprint.box(0.06, 0.0, speed=0.1, curvature=2.0), transients=(change,)
    )
    start = Pose(0.0, 0.0, 0.0)
    goal = Goal(2.3, 0.0, 0.3, radius=0.05)
    best_first(Problem(start, goal, world, body), Settings())


def with_transitions(
    segments: Sequence[Segment], footprint: Footprint
) -> tuple[Segment, ...]:
    """Insert transition arcs into a path.

    Where there is no space for a transition arc, the curvature still jumps. If the
    footprint has no transients, the path is returned unchanged.
    """
    if not segments:
        return ()
    arcs: list[tuple[float, float]] = []
    remaining = segments[0].length
    for here, after in pairwise(segments):
        delay, length = footprint.lag(here.offset, after.offset)
        if length == 0 or delay > remaining or length - delay > after.length:
            delay = 0.0
            length = 0.0
        between = after.curvature + (here.curvature - after.curvature) * (
            delay / length if length else 0.0
        )
        arcs += [(here.curvature, remaining - delay), (between, length)]
        remaining = after.length - (length - delay)
    arcs.append((segments[-1].curvature, remaining))
    return path_from_arcs(segments[0].start, arcs, footprint)


def plan_with_transitions(
    problem: Problem, settings: Settings, begin: Sequence[Segment] = ()
) -> Plan:
    """Plan a path with transition arcs.

    The path, including its transients, is collision-free and ends within the goal's
    tolerances. If no such path is found, the plan contains no transition arcs, and its
    `reason` states this.

    Args:
        problem: problem that starts at the end of `begin`.
        settings: search settings.
        begin: fixed segments at the start of the path.

    Returns:
        Plan, with the number of nodes and the wall time summed over all searches.
    """
    plans: list[Plan] = []

    def search(problem: Problem, *, smooth: bool = True) -> Plan:
        plans.append(
            plan(problem, replace(settings, smooth=settings.smooth and smooth))
        )
        return plans[-1]

    result = _search_with_transitions(problem, search, begin)
    expanded = sum(p.expanded for p in plans)
    seconds = sum(p.seconds for p in plans)
    return replace(result, expanded=expanded, seconds=seconds)


def _search_with_transitions(
    problem: Problem, search: Callable[..., Plan], begin: Sequence[Segment]
) -> Plan:
    body = problem.footprint
    first = search(problem)
    if not first.found:
        return first
    if not first.segments or not body.transients:
        return replace(first, segments=(*begin, *first.segments))
    checker = Checker(problem.world, body)
    # Paths without shortening keep larger distances from obstacles and are tried last.
    for smooth, margin in product((True, False), _SHAPING_MARGINS_M):
        wide = replace(problem, footprint=body.reduced(margin=margin))
        aim = problem.goal
        for _ in range(_AIM_ITERATIONS):
            reuse = smooth and not margin and aim == problem.goal
            if reuse:
                result = first
            else:
                result = search(replace(wide, goal=aim), smooth=smooth)
            if not result.found or not result.segments:
                break
            path = with_transitions((*begin, *result.segments), body)
            end = path[-1].end
            if _is_within(end, problem.goal):
                if checker.is_path_free(path):
                    return replace(result, segments=path)
                break
            # The goal of the search is displaced by the remaining error until the path
            # ends at the original goal.
            aim = _corrected_aim(aim, problem.goal, end)
    reason = (
        f"{first.reason}; without transition arcs, because no path with them was free"
    )
    return replace(first, reason=reason, segments=(*begin, *first.segments))


def _is_within(end: Pose, goal: Goal) -> bool:
    near = math.hypot(end.x - goal.x, end.y - goal.y) <= goal.radius
    if goal.heading is None:
        return near
    return (
        near
        and abs(math.remainder(end.heading - goal.heading, 2 * math.pi))
        <= goal.heading_tolerance
    )


def _corrected_aim(aim: Goal, goal: Goal, end: Pose) -> Goal:
    heading = None
    if goal.heading is not None and aim.heading is not None:
        heading = aim.heading - math.remainder(end.heading - goal.heading, 2 * math.pi)
    return replace(
        aim, x=aim.x + goal.x - end.x, y=aim.y + goal.y - end.y, heading=heading
    )
