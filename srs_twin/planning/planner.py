r"""The function `plan`, and `plan_with_transitions` for paths with transition arcs between curvatures.

Transition arcs replace jumps of the curvature by the measured response to a change of offset. After a change
from curvature κ_a to κ_b the path lags: it turns by Δκ δ less than after an instant change, and is displaced
by Δκ m/2 to the side (`Transient`: dheading = −Δκ δ, dy = Δκ m/2). To first order, one arc of length T and
curvature

$$ κ_t = κ_a + \Bigl(1 - \frac{δ}{T}\Bigr) Δκ, \qquad T = \frac{m}{δ}, $$

has the same effect. If it begins δ before the planned change, the heading of the plan is unchanged and the
path is displaced by Δκ (m − δ²)/2. The search therefore aims at a goal that is displaced to the other side. A
follower that sends each offset δ ahead keeps the body on the path.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.planning.best_first import best_first
from srs_twin.planning.collision import Checker, obstacle_at
from srs_twin.planning.footprint import Footprint, Transient, validate_footprint
from srs_twin.planning.path import Segment, path_from_arcs
from srs_twin.planning.problem import Plan, Problem, Settings
from srs_twin.planning.reference_planners import greedy, rrt_connect
from srs_twin.planning.touch import narrowed, plan_with_touch
from srs_twin.robot.world import Bounds, Circle, Goal, Polygon, Pose, World

PLANNERS: dict[str, Callable[[Problem, Settings], Plan]] = {
    "best_first": best_first,
    "greedy": lambda problem, _: greedy(problem),
    "ompl": rrt_connect,
}
"""Planners by name; `ompl` needs the extra of that name."""

_MAX_COORDINATE_M = 2000.0
"""Largest coordinate of start and goal, m; cell indices of the search are limited."""

_WIDTH_STEPS = (0.1, 0.2, 0.4, 0.8, 1.6)
"""Widths added to both edges to find paths with more clearance, in widths of the straight body."""
_MAX_WIDER_NODES = 4000
"""Largest number of nodes of the search for a wider body."""
_COST_SPACING_M = 0.02
"""Largest distance between the points at which the clearance of a path is evaluated, m."""

_AIM_ITERATIONS = 6
"""Largest number of corrections of the goal in `plan_with_transitions`."""
_SHAPING_MARGINS_M = (0.0, 0.01, 0.02, 0.03)
"""Widths added to both edges in turn, m; the path with transitions must be free with the original edges."""


def plan(problem: Problem, settings: Settings | None = None, *, planner: str = "best_first") -> Plan:
    """Find a collision-free path.

    Args:
        problem: start, goal, world and body.
        settings: budget and options of the search; ignored by `greedy`.
        planner: `best_first`; `greedy`, the planner of the dissertation; or `ompl`, RRT-Connect of the Open
            Motion Planning Library.

    Raises:
        InputError: start or goal is in an obstacle or outside the bounds, or a number is not allowed.
        UnknownNameError: the planner is unknown.
    """
    if planner not in PLANNERS:
        raise UnknownNameError("planner", planner, PLANNERS)
    touch = settings.touch_limits if settings else None
    if touch and planner != "best_first":
        raise InputError(f"planner '{planner}' keeps clear of obstacles; best_first can plan with touch")
    firm = narrowed(problem, touch, 1.0) if touch else problem
    _check_problem(firm)
    _compile()
    begun = time.perf_counter()
    if touch and settings:
        result = plan_with_touch(best_first, problem, settings)
    else:
        result = PLANNERS[planner](problem, settings or Settings())
    if result.found and settings and settings.clearance_weight > 0:
        result = _lowest_cost(result, problem, settings)
    return replace(result, seconds=time.perf_counter() - begun, problem=firm)


def _lowest_cost(first: Plan, problem: Problem, settings: Settings) -> Plan:
    """Return the plan with the lowest cost (`Settings.clearance_weight`) of those for wider bodies.

    Args:
        first: plan for the body itself.
        problem: the problem.
        settings: settings of the search.
    """
    straight = problem.footprint.at(0.0)
    width = straight.left + straight.right
    short, plans = replace(settings, nodes=min(settings.nodes, _MAX_WIDER_NODES)), [first]
    for share in _WIDTH_STEPS:
        wider = replace(problem, footprint=problem.footprint.reduced(margin=share * width))
        result = best_first(wider, short)
        if not result.found:
            break
        # Speeds and offsets are those of the body itself.
        arcs = [(segment.curvature, segment.length) for segment in result.segments]
        plans.append(replace(result, segments=path_from_arcs(problem.start, arcs, problem.footprint)))
    return min(plans, key=lambda result: _cost(result, problem, width, settings.clearance_weight))


def _cost(result: Plan, problem: Problem, width: float, weight: float) -> float:
    """Return the length of a path plus the cost of small clearances, m."""
    import shapely

    world, body = problem.world, problem.footprint
    poses, edges, steps = [], [], []
    for segment in result.segments:
        count = max(math.ceil(segment.length / _COST_SPACING_M), 1)
        row = body.at(segment.curvature)
        poses += [segment.pose((k + 0.5) / count * segment.length) for k in range(count)]
        edges += [max(row.left, row.right)] * count
        steps += [segment.length / count] * count
    points = shapely.points([(pose.x, pose.y) for pose in poses])
    distance = np.full(len(points), np.inf)
    for circle in world.obstacles:
        centre = shapely.Point(circle.x, circle.y)
        distance = np.minimum(distance, shapely.distance(points, centre) - circle.radius)
    for polygon in world.polygons:
        distance = np.minimum(distance, shapely.distance(points, shapely.Polygon(polygon.corners)))
    # Use the distance of the wider edge on both sides: a simple bound.
    clearance = np.maximum(distance - edges, 0.0)
    return float(np.dot(steps, 1 + weight * np.exp(-clearance / width)))


@functools.cache
def _compile() -> None:
    """Compile the kernels or load them from the cache, so that neither counts against a time limit."""
    # A problem with obstacles in the way and a transient, because a straight path would not compile all
    # kernels.
    circles = (Circle(0.6, 0.05, 0.1), Circle(1.7, 0.1, 0.1))
    square = Polygon(((1.1, -0.3), (1.2, -0.3), (1.2, 0.05), (1.1, 0.05)))
    world = World(circles, Bounds((-1.0, 4.0), (-2.0, 2.0)), polygons=(square,))
    change = Transient(-0.3, 0.3, left=0.01, right=0.01, length=0.05)
    body = replace(Footprint.box(0.06, 0.0, speed=0.1, curvature=2.0), transients=(change,))
    best_first(Problem(Pose(0.0, 0.0, 0.0), Goal(2.3, 0.0, 0.3, radius=0.05), world, body), Settings())


def _check_problem(problem: Problem) -> None:
    """Raise an error for a problem that cannot be solved as stated."""
    validate_footprint(problem.footprint)
    start, goal = problem.start, problem.goal
    _check_poses(start, goal)
    _check_world(problem.world)
    for name, x, y in (("start", start.x, start.y), ("goal", goal.x, goal.y)):
        if hit := obstacle_at(problem.world, x, y):
            relation = "outside" if hit.startswith("the bounds") else "inside"
            raise InputError(f"{name} ({x:g}, {y:g}) is {relation} {hit}")
    if hit := Checker(problem.world, problem.footprint).first_collision(start):
        verb = "leaves" if hit.startswith("the bounds") else "touches"
        raise InputError(f"start ({start.x:g}, {start.y:g}): the straight body's footprint {verb} {hit}")


def _check_poses(start: Pose, goal: Goal) -> None:
    angles = (start.heading, goal.heading or 0.0)
    if not all(math.isfinite(angle) and abs(angle) <= 100 for angle in angles):
        raise InputError(
            f"headings {angles[0]:g} and {angles[1]:g} rad: must be finite and between -100 and 100"
        )
    for name, x, y in (("start", start.x, start.y), ("goal", goal.x, goal.y)):
        if not (abs(x) <= _MAX_COORDINATE_M and abs(y) <= _MAX_COORDINATE_M):
            raise InputError(
                f"{name} ({x:g}, {y:g}) m: must be finite and between "
                f"-{_MAX_COORDINATE_M:g} and {_MAX_COORDINATE_M:g}"
            )
    if not (0 <= goal.radius < math.inf and 0 <= goal.heading_tolerance <= math.pi):
        raise InputError(
            f"goal: radius {goal.radius:g} m must not be below 0, heading_tolerance "
            f"{goal.heading_tolerance:g} rad must be between 0 and pi"
        )


def _check_world(world: World) -> None:
    import shapely

    for k, circle in enumerate(world.obstacles):
        if not (math.isfinite(circle.x) and math.isfinite(circle.y) and 0 < circle.radius < math.inf):
            raise InputError(f"obstacle {k + 1}: numbers must be finite and the radius above 0")
    for k, polygon in enumerate(world.polygons):
        finite = all(math.isfinite(value) for corner in polygon.corners for value in corner)
        if len(polygon.corners) < 3 or not finite or not shapely.Polygon(polygon.corners).is_valid:
            raise InputError(
                f"polygon {k + 1}: needs at least three finite corners and sides that do not cross"
            )
    if world.bounds and not all(low < high for low, high in (world.bounds.x, world.bounds.y)):
        raise InputError("bounds: the lower limit comes first and must be below the upper limit")


def with_transitions(segments: Sequence[Segment], footprint: Footprint) -> tuple[Segment, ...]:
    """Return a path with transition arcs; without room for an arc, a change remains a jump.

    Args:
        segments: arcs of the path.
        footprint: footprint with the transients; without any, the path is unchanged.
    """
    if not segments:
        return ()
    arcs: list[tuple[float, float]] = []
    remaining = segments[0].length
    for here, after in zip(segments, segments[1:], strict=False):
        # δ and T of the module docstring.
        delay, length = footprint.lag(here.offset, after.offset)
        if length == 0 or delay > remaining or length - delay > after.length:
            delay, length = 0.0, 0.0
        between = after.curvature + (here.curvature - after.curvature) * (delay / length if length else 0.0)
        arcs += [(here.curvature, remaining - delay), (between, length)]
        remaining = after.length - (length - delay)
    arcs.append((segments[-1].curvature, remaining))
    return path_from_arcs(segments[0].start, arcs, footprint)


def plan_with_transitions(problem: Problem, settings: Settings, begin: Sequence[Segment] = ()) -> Plan:
    """Plan a path with transition arcs.

    The path is free with its transients and ends within the goal's tolerances. If no such path is found, the
    plan is the one without transition arcs, and its reason says so.

    Args:
        problem: the problem; its start is the end of `begin`.
        settings: budget and options of each search.
        begin: fixed first segments of the path.

    Returns:
        The plan, with the total nodes and time of all searches.

    Raises:
        InputError: as `plan`.
    """
    plans: list[Plan] = []

    def search(problem: Problem, *, smooth: bool = True) -> Plan:
        plans.append(plan(problem, replace(settings, smooth=settings.smooth and smooth)))
        return plans[-1]

    result = _search_with_transitions(problem, search, begin)
    expanded, seconds = sum(p.expanded for p in plans), sum(p.seconds for p in plans)
    return replace(result, expanded=expanded, seconds=seconds)


def _search_with_transitions(problem: Problem, search: Callable[..., Plan], begin: Sequence[Segment]) -> Plan:
    """Return the first path with transition arcs that is free and arrives, trying wider bodies in turn."""
    body = problem.footprint
    first = search(problem)
    if not first.found:
        return first
    if not first.segments or not body.transients:
        return replace(first, segments=(*begin, *first.segments))
    checker = Checker(problem.world, body)
    # Paths that are not shortened stay farther from obstacles.
    for smooth, margin in product((True, False), _SHAPING_MARGINS_M):
        wide = replace(problem, footprint=body.reduced(margin=margin))
        aim = problem.goal
        for _ in range(_AIM_ITERATIONS):
            reuse = smooth and not margin and aim == problem.goal
            result = first if reuse else search(replace(wide, goal=aim), smooth=smooth)
            if not result.found or not result.segments:
                break
            path = with_transitions((*begin, *result.segments), body)
            end = path[-1].end
            if _is_within(end, problem.goal):
                if checker.is_path_free(path):
                    return replace(result, segments=path)
                break
            # Fixed-point iteration: displace the goal by the remaining error.
            aim = _corrected_aim(aim, problem.goal, end)
    reason = f"{first.reason}; without transition arcs, because no path with them was free"
    return replace(first, reason=reason, segments=(*begin, *first.segments))


def _is_within(end: Pose, goal: Goal) -> bool:
    """Return whether a pose is within a goal's tolerances."""
    near = math.hypot(end.x - goal.x, end.y - goal.y) <= goal.radius
    if goal.heading is None:
        return near
    return near and abs(math.remainder(end.heading - goal.heading, 2 * math.pi)) <= goal.heading_tolerance


def _corrected_aim(aim: Goal, goal: Goal, end: Pose) -> Goal:
    """Return the aim moved by the distance between the end of the path and the goal."""
    heading = None
    if goal.heading is not None and aim.heading is not None:
        heading = aim.heading - math.remainder(end.heading - goal.heading, 2 * math.pi)
    return replace(aim, x=aim.x + goal.x - end.x, y=aim.y + goal.y - end.y, heading=heading)
