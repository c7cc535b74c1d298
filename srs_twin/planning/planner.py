r"""plan(problem) -> Plan: the one verb of this package, also with the way of each change of offset in it.

Shaping puts the way that a change of offset takes, as it was measured, in place of a jump of the curvature.
After a change from curvature κ_a to κ_b the path is late: it turns by Δκ δ less than an instant change would
have it, and ends up Δκ m/2 beside (`Transient`: dheading = −Δκ δ, dy = Δκ m/2). One arc between the two does
the same to first order,

$$ κ_t = κ_a + \Bigl(1 - \frac{δ}{T}\Bigr) Δκ, \qquad T = \frac{m}{δ}, $$

begun where the command takes effect. Put so that it begins δ before the planned change, it leaves the
heading of the plan as it is and the path Δκ (m − δ²)/2 beside; hence a plan is made to a goal that lies as
much to the other side. An offset that a follower sends ahead by δ then has the body on the path.
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
from srs_twin.planning.collision import Checker, inside
from srs_twin.planning.footprint import Footprint, Transient, checked
from srs_twin.planning.greedy import greedy
from srs_twin.planning.ompl_baseline import rrt_connect
from srs_twin.planning.plan import Plan
from srs_twin.planning.problem import Problem, Segment, Settings, path_of
from srs_twin.planning.search import best_first
from srs_twin.robot.world import Bounds, Circle, Goal, Polygon, Pose, World

PLANNERS: dict[str, Callable[[Problem, Settings], Plan]] = {
    "best_first": best_first,
    "greedy": lambda problem, _: greedy(problem),
    "ompl": rrt_connect,
}
"""Name → planner; `ompl` needs the extra of that name."""

_FAR = 2000.0
"""Places are at most so far from the origin, m; cells are counted within."""


def plan(problem: Problem, settings: Settings | None = None, *, planner: str = "best_first") -> Plan:
    """Find a free path.

    Args:
        problem: from where to where, among what, with which body.
        settings: how hard to try; `greedy` has nothing to set.
        planner: `best_first`; `greedy`, the text's; `ompl`, RRT-Connect of the Open Motion Planning Library.

    Raises:
        InputError: start or goal is in an obstacle or out of bounds, or a number cannot be meant.
        UnknownNameError: no such planner.
    """
    if planner not in PLANNERS:
        raise UnknownNameError("planner", planner, PLANNERS)
    _refuse(problem)
    _compile()
    begun = time.perf_counter()
    answer = PLANNERS[planner](problem, settings or Settings())
    if answer.found and settings and settings.clearance_weight > 0:
        answer = _roomiest(answer, problem, settings)
    return replace(answer, seconds=time.perf_counter() - begun, problem=problem)


_WIDER = (0.1, 0.2, 0.4, 0.8, 1.6)
"""Widths of the straight body that edges are moved by in search of a way with more room."""
_BRIEF = 4000
_SPACING = 0.02


def _roomiest(first: Plan, problem: Problem, settings: Settings) -> Plan:
    """Return the plan of least cost, see `Settings.clearance_weight`, for the body and for wider ones."""
    straight = problem.footprint.at(0.0)
    width = straight.left + straight.right
    brief, found = replace(settings, nodes=min(settings.nodes, _BRIEF)), [first]
    for share in _WIDER:
        wider = replace(problem, footprint=problem.footprint.reduced(margin=share * width))
        answer = best_first(wider, brief)
        if not answer.found:
            break
        # The wider body's edges are no edges of this one.
        pieces = [(each.curvature, each.length) for each in answer.segments]
        found.append(replace(answer, segments=path_of(problem.start, pieces, problem.footprint)))
    return min(found, key=lambda each: _cost(each, problem, width, settings.clearance_weight))


def _cost(found: Plan, problem: Problem, width: float, weight: float) -> float:
    """Return the length of a path, the nearer it comes to something the more, m."""
    import shapely

    world, body = problem.world, problem.footprint
    places, edges, steps = [], [], []
    for each in found.segments:
        count = max(math.ceil(each.length / _SPACING), 1)
        row = body.at(each.curvature)
        places += [each.pose((k + 0.5) / count * each.length) for k in range(count)]
        edges += [max(row.left, row.right)] * count
        steps += [each.length / count] * count
    points = shapely.points([(pose.x, pose.y) for pose in places])
    apart = np.full(len(points), np.inf)
    for circle in world.obstacles:
        apart = np.minimum(apart, shapely.distance(points, shapely.Point(circle.x, circle.y)) - circle.radius)
    for polygon in world.polygons:
        apart = np.minimum(apart, shapely.distance(points, shapely.Polygon(polygon.corners)))
    room = np.maximum(apart - edges, 0.0)
    return float(np.dot(steps, 1 + weight * np.exp(-room / width)))


@functools.cache
def _compile() -> None:
    """Compile the kernels, or load them: neither is planning, and no limit in seconds may run out by it."""
    # With obstacles in the way and changes that cost width: a straight way would leave kernels out.
    circles = (Circle(0.6, 0.05, 0.1), Circle(1.7, 0.1, 0.1))
    square = Polygon(((1.1, -0.3), (1.2, -0.3), (1.2, 0.05), (1.1, 0.05)))
    world = World(circles, Bounds((-1.0, 4.0), (-2.0, 2.0)), polygons=(square,))
    change = Transient(-0.3, 0.3, left=0.01, right=0.01, length=0.05)
    body = replace(Footprint.box(0.06, 0.0, speed=0.1, curvature=2.0), transients=(change,))
    best_first(Problem(Pose(0.0, 0.0, 0.0), Goal(2.3, 0.0, 0.3, radius=0.05), world, body), Settings())


def _refuse(problem: Problem) -> None:
    """Raise what is wrong with a problem before anything is tried."""
    checked(problem.footprint)
    start, goal = problem.start, problem.goal
    _refuse_numbers(start, goal)
    _refuse_world(problem.world)
    for name, x, y in (("start", start.x, start.y), ("goal", goal.x, goal.y)):
        if hit := inside(problem.world, x, y):
            relation = "outside of" if hit.startswith("the bounds") else "inside"
            raise InputError(f"{name} ({x:g}, {y:g}) lies {relation} {hit}")
    if hit := Checker(problem.world, problem.footprint).blocker(start):
        verb = "leaves" if hit.startswith("the bounds") else "touches"
        raise InputError(f"start ({start.x:g}, {start.y:g}): the straight body's footprint {verb} {hit}")


def _refuse_numbers(start: Pose, goal: Goal) -> None:
    angles = (start.heading, goal.heading or 0.0)
    if not all(math.isfinite(angle) and abs(angle) <= 100 for angle in angles):
        raise InputError(f"headings {angles[0]:g} and {angles[1]:g} rad: must be finite, -100 to 100")
    for name, x, y in (("start", start.x, start.y), ("goal", goal.x, goal.y)):
        if not (abs(x) <= _FAR and abs(y) <= _FAR):
            raise InputError(f"{name} ({x:g}, {y:g}) m: must be finite, -{_FAR:g} to {_FAR:g}")
    if not (0 <= goal.radius < math.inf and 0 <= goal.heading_tolerance <= math.pi):
        raise InputError(
            f"goal: radius {goal.radius:g} m must not be below 0, heading_tolerance "
            f"{goal.heading_tolerance:g} rad must be from 0 to pi"
        )


def _refuse_world(world: World) -> None:
    import shapely

    for k, circle in enumerate(world.obstacles):
        if not (math.isfinite(circle.x) and math.isfinite(circle.y) and 0 < circle.radius < math.inf):
            raise InputError(f"obstacle {k + 1}: numbers must be finite, the radius above 0")
    for k, polygon in enumerate(world.polygons):
        finite = all(math.isfinite(value) for corner in polygon.corners for value in corner)
        if len(polygon.corners) < 3 or not finite or not shapely.Polygon(polygon.corners).is_valid:
            raise InputError(
                f"polygon {k + 1}: needs three finite corners or more, and sides that do not cross"
            )
    if world.bounds and not all(low < high for low, high in (world.bounds.x, world.bounds.y)):
        raise InputError("bounds: the lowest comes first, and must be below the highest")


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

    def planned(asked: Problem, *, smooth: bool = True) -> Plan:
        made.append(plan(asked, replace(settings, smooth=settings.smooth and smooth)))
        return made[-1]

    found = _shaped_plan(problem, planned, begin)
    return replace(
        found, expanded=sum(each.expanded for each in made), seconds=sum(each.seconds for each in made)
    )


def _shaped_plan(problem: Problem, planned: Callable[..., Plan], begin: Sequence[Segment]) -> Plan:
    body = problem.footprint
    first = planned(problem)
    if not first.found:
        return first
    if not first.segments or not body.transients:
        return replace(first, segments=(*begin, *first.segments))
    checker = Checker(problem.world, body)
    # Ways that were not shortened keep farther away from things.
    for smooth, room in product((True, False), _ROOM):
        wide = replace(problem, footprint=body.reduced(margin=room))
        aimed = problem.goal
        for _ in range(_AIMS):
            own = smooth and not room and aimed == problem.goal
            found = first if own else planned(replace(wide, goal=aimed), smooth=smooth)
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
