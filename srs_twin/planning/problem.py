"""Planning problem, search settings and plan."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from itertools import pairwise
from typing import ClassVar

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.arguments import check_types
from srs_twin.planning.arcs import Primitives
from srs_twin.planning.collision import Checker, obstacle_at
from srs_twin.planning.footprint import Footprint, validate_footprint
from srs_twin.planning.free_space import min_path_length
from srs_twin.planning.path import Segment, path_from_arcs
from srs_twin.robot.world import Goal, Pose, World
from srs_twin.trajectory import HtmlResult

_MAX_LEVELS = 5
"""Finest level, at which arcs are 16 times shorter than at the first level."""

_MAX_COORDINATE_M = 2000.0
"""Maximum absolute coordinate of start and goal, which limits the cell indices, m."""

_KINK_ROUNDING = 1e-6
"""Maximum heading jump that is attributed to rounding errors, rad."""


@dataclass(frozen=True)
class TouchLimits:
    """Limits and cost parameters for leaning on obstacles (see `touch`).

    Attributes:
        hard: narrowed footprint, whose edges must never overlap obstacles.
        core: half the width of the body, m.
        stiffness: contact force per displacement of one connector, N/m.
        floor: maximum lateral friction force between the body and the floor, N.
    """

    hard: Footprint
    core: float
    stiffness: float
    floor: float


@dataclass(frozen=True)
class PlannedContact:
    """Part of a path on which the footprint overlaps an obstacle.

    Attributes:
        obstacle: name of the obstacle, such as "obstacle 2".
        begin, end: path positions at the start and the end of the contact, m.
        depth: maximum overlap, m.
        force: estimated mean contact force, N.
    """

    obstacle: str
    begin: float
    end: float
    depth: float
    force: float


@dataclass(frozen=True)
class Settings:
    """Budget and options of a search.

    Attributes:
        nodes: maximum number of expanded nodes.
        seconds: wall-time limit, s, or None for no limit. The limit is checked at least
            every 16,000 nodes. With a limit, the result depends on the machine.
        weight: weight w of the lower bound on the remaining length, at least 1. With a
            larger weight, the search expands fewer nodes, but the path may be longer.
        levels: number of resolution levels, 1 to 5. Each level halves the arc length
            and the cell size.
        smooth: whether to shorten the path after the search.
        clearance_weight: extra cost of one metre of path without clearance, m. The
            extra cost decreases by a factor of e per body width of clearance. If this
            weight is above 0, the search is repeated with wider footprints.
        improve: whether to search for a shorter path at finer levels until the budget
            is spent.
        touch_limits: limits and cost parameters for leaning on obstacles, or None if
            the body must not touch obstacles.
    """

    nodes: int = 200_000
    seconds: float | None = None
    weight: float = 1.0
    levels: int = 4
    smooth: bool = True
    improve: bool = False
    clearance_weight: float = 0.0
    touch_limits: TouchLimits | None = None

    def __post_init__(self) -> None:
        if self.nodes < 1 or self.levels < 1 or not (1 <= self.weight < math.inf):
            values = f"nodes {self.nodes}, levels {self.levels}, weight {self.weight:g}"
            raise InputError(
                f"planner: {values} are not allowed; each of them must be at least 1"
            )
        if not 0 <= self.clearance_weight < math.inf:
            raise InputError(
                f"planner: `clearance_weight` {self.clearance_weight:g} is not"
                " allowed; it must be at least 0"
            )
        if self.levels > _MAX_LEVELS:
            raise InputError(
                f"planner: `levels` {self.levels} is not allowed; it must be at most"
                f" {_MAX_LEVELS}"
            )
        if self.touch_limits is not None and self.clearance_weight > 0:
            raise InputError(
                "planner: `clearance_weight` must be 0 if contact with obstacles"
                " is allowed"
            )
        if self.seconds is not None and not self.seconds > 0:
            raise InputError(
                f"planner: `seconds` {self.seconds:g} is not allowed; it must be"
                " above 0"
            )


@dataclass(frozen=True)
class Problem:
    """Start, goal, world and body of a planning problem.

    Attributes:
        start: initial pose of the straight snake.
        goal: goal for the centre of mass.
        world: obstacles and bounds.
        footprint: area that the body covers in each possible turn.
        primitives: motion primitives, or None if the planner chooses them.

    Raises:
        InputError: an argument has a wrong type.
    """

    start: Pose
    goal: Goal
    world: World
    footprint: Footprint
    primitives: Primitives | None = None

    def __post_init__(self) -> None:
        check_types("Problem", Problem, vars(self))


def check_problem(problem: Problem) -> None:
    """Check that start and goal are collision-free and that all values are allowed.

    Raises:
        InputError: a check fails.
    """
    validate_footprint(problem.footprint)
    start = problem.start
    goal = problem.goal
    _check_poses(start, goal)
    _check_world(problem.world)
    for name, place in (("start", start), ("goal", goal)):
        if hit := obstacle_at(problem.world, place.x, place.y):
            raise InputError(
                f"{name} ({place.x:g}, {place.y:g}) is not free because of {hit};"
                " move it"
            )
    if hit := Checker(problem.world, problem.footprint).first_collision(start):
        raise InputError(
            f"start ({start.x:g}, {start.y:g}): the footprint of the straight body"
            f" touches {hit}; move the start"
        )


def _check_poses(start: Pose, goal: Goal) -> None:
    angles = (start.heading, goal.heading or 0.0)
    if not all(abs(angle) <= 100 for angle in angles):
        raise InputError(
            f"headings {angles[0]:g} and {angles[1]:g} rad are not allowed; both must"
            " be finite and between -100 and 100"
        )
    for name, place in (("start", start), ("goal", goal)):
        if not (
            abs(place.x) <= _MAX_COORDINATE_M and abs(place.y) <= _MAX_COORDINATE_M
        ):
            raise InputError(
                f"{name} ({place.x:g}, {place.y:g}) m is not allowed; both coordinates"
                f" must be finite and between -{_MAX_COORDINATE_M:g} and"
                f" {_MAX_COORDINATE_M:g}"
            )
    if not (0 <= goal.radius < math.inf and 0 <= goal.heading_tolerance <= math.pi):
        raise InputError(
            f"goal: radius {goal.radius:g} m with `heading_tolerance`"
            f" {goal.heading_tolerance:g} rad is not allowed; the radius must be at"
            " least 0, and `heading_tolerance` between 0 and pi"
        )


def _check_world(world: World) -> None:
    import shapely

    for k, circle in enumerate(world.obstacles):
        if not (
            math.isfinite(circle.x)
            and math.isfinite(circle.y)
            and 0 < circle.radius < math.inf
        ):
            raise InputError(
                f"obstacle {k + 1} is not allowed; its position and radius must be"
                " finite, and its radius above 0"
            )
    for k, polygon in enumerate(world.polygons):
        finite = all(
            math.isfinite(value) for corner in polygon.corners for value in corner
        )
        if (
            len(polygon.corners) < 3
            or not finite
            or not shapely.Polygon(polygon.corners).is_valid
        ):
            raise InputError(
                f"polygon {k + 1} is not allowed; it needs at least three finite"
                " corners, and its sides must not cross"
            )
    if world.bounds and not all(
        low < high for low, high in (world.bounds.x, world.bounds.y)
    ):
        raise InputError(
            "the bounds are not ascending; each lower limit must be below its upper"
            " limit"
        )


class PlanOutcome(StrEnum):
    """Outcome of planning, explained by `Plan.reason`.

    - FOUND: a collision-free path was found.
    - NOT_FOUND: the search found neither a path nor a proof that none exists.
    - PROVEN_IMPOSSIBLE: no path exists, because obstacles separate start and goal.
    """

    FOUND = "found"
    NOT_FOUND = "not_found"
    PROVEN_IMPOSSIBLE = "proven_impossible"


@dataclass(frozen=True)
class Plan(HtmlResult):
    """Result of a planner.

    Without a time limit, equal problems have identical plans on all machines.

    Attributes:
        outcome: outcome of planning.
        reason: explanation of the outcome, with advice if no path was found.
        segments: arcs of the path, if a path was found.
        expanded: number of expanded nodes.
        touches: parts of the path on which the body leans on obstacles, or None if
            `Settings.touch_limits` is None.
        seconds: wall time, which is ignored in comparisons of plans, s.
        problem: problem with the footprint edges that must stay free, which is ignored
            in comparisons of plans.
        lead_in: length of the straight lead-in, at whose end the problem starts, m.
    """

    page: ClassVar[str] = "plan"

    outcome: PlanOutcome
    reason: str
    segments: tuple[Segment, ...] = ()
    expanded: int = 0
    touches: tuple[PlannedContact, ...] | None = None
    seconds: float = field(default=0.0, compare=False)
    problem: Problem | None = field(default=None, compare=False, repr=False)
    lead_in: float = 0.0

    @cached_property
    def least_length(self) -> float:
        """Lower bound on the length of paths with arbitrary curvature, m.

        The bound is the length of the lead-in plus the shortest distance from the end
        of the lead-in to the goal.
        """
        assert self.problem is not None, "set by plan()"
        problem = self.problem
        return self.lead_in + min_path_length(
            problem.start, problem.goal, problem.world, problem.footprint.narrowest
        )

    @property
    def found(self) -> bool:
        """Whether a path was found."""
        return self.outcome is PlanOutcome.FOUND

    @property
    def length(self) -> float:
        """Length of the path, m."""
        return math.fsum(s.length for s in self.segments)

    @property
    def duration(self) -> float:
        """Travel time along the path at the speeds of the footprint, s."""
        return math.fsum(s.length / s.speed for s in self.segments)

    @property
    def end(self) -> Pose | None:
        """Pose at the end of the path, or None if the path has no segments."""
        if self.segments:
            return self.segments[-1].end
        return None

    @property
    def max_heading_jump(self) -> float:
        """Maximum heading jump between consecutive segments, rad."""
        jumps = (
            abs(math.remainder(b.start.heading - a.end.heading, 2 * math.pi))
            for a, b in pairwise(self.segments)
        )
        largest = max(jumps, default=0.0)
        if largest > _KINK_ROUNDING:
            return largest
        return 0.0

    def after(self, begin: tuple[Segment, ...]) -> Plan:
        """Return the plan with additional segments at the start of its path."""
        done = math.fsum(segment.length for segment in begin)
        touches = self.touches and tuple(
            replace(touch, begin=touch.begin + done, end=touch.end + done)
            for touch in self.touches
        )
        return replace(self, segments=(*begin, *self.segments), touches=touches)

    def with_edges_of(self, problem: Problem) -> Plan:
        """Return the plan with offsets and speeds from another problem's footprint."""
        arcs = [(segment.curvature, segment.length) for segment in self.segments]
        return replace(
            self, segments=path_from_arcs(problem.start, arcs, problem.footprint)
        )

    def samples(self, spacing: float = 0.01) -> np.ndarray:
        """Return x, y (m) and heading (rad) along the path, shape (n, 3).

        Args:
            spacing: maximum distance between two poses, m.
        """
        rows = []
        for segment in self.segments:
            steps = max(1, math.ceil(segment.length / spacing))
            rows += [(*segment.pose(segment.length * k / steps),) for k in range(steps)]
        if self.end:
            rows.append((*self.end,))
        return np.array(rows, dtype=float).reshape(-1, 3)
