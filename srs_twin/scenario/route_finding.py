"""Planning of a scenario in SI: from start, goal and world to a plan, once for all who ask."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

from srs_twin.errors import InputError
from srs_twin.scenario.planner_file import BestFirstFile, GivenFile, GreedyFile, OmplFile, PlannerFile
from srs_twin.world import Goal, Pose, World

if TYPE_CHECKING:
    from srs_twin.planning import Footprint, Plan, Problem, Segment, Settings

GIVEN = "given"


@dataclass(frozen=True)
class PlannerSettings:
    """How the way is found.

    Attributes:
        kind: "best_first", "greedy", "ompl" or "given".
        footprint: the robot's, whole: what it can do.
        turn_share: share of the tightest turns to plan with.
        margin: added to both edges, m.
        problem: start, goal, world, and the footprint to plan with; of a path that is given its end is the
            goal.
        settings: how hard to try.
        pieces: (curvature, length) of the path, 1/m and m, where it is given.
        run_up: straight beginning of the first plan, m.
        shaped: whether the way of each change of offset is in the path.
    """

    kind: str
    footprint: Footprint
    turn_share: float
    margin: float
    problem: Problem
    settings: Settings
    pieces: tuple[tuple[float, float], ...] = ()
    run_up: float = 0.0
    shaped: bool = False

    def plan(self) -> Plan:
        """Return the plan.

        Raises:
            InputError: start or goal cannot be, or the extra `ompl` is missing.
        """
        return _plan(self)

    def plan_anew(self) -> Plan:
        """Return the plan, made now: its time is that of this machine now.

        Raises:
            InputError: as `plan`.
        """
        return _plan.__wrapped__(self)

    def plan_from(self, pose: Pose) -> Plan:
        """Return a plan from another pose.

        Raises:
            InputError: as `plan`.
        """
        return _plan(replace(self, problem=replace(self.problem, start=pose), run_up=0.0))


@lru_cache(maxsize=16)
def _plan(settings: PlannerSettings) -> Plan:
    """Plan once: the file's check, both plants and the report ask for the same."""
    from srs_twin.planning import Outcome, Plan
    from srs_twin.planning.collision import Checker
    from srs_twin.planning.problem import path_of

    if settings.kind == GIVEN:
        start, footprint = settings.problem.start, settings.problem.footprint
        return Plan(Outcome.FOUND, "the path is given", path_of(start, list(settings.pieces), footprint))
    problem = settings.problem
    if settings.run_up == 0:
        return _found(settings, problem, ())
    (first,) = path_of(problem.start, [(0.0, settings.run_up)], problem.footprint)
    if hit := Checker(problem.world, problem.footprint).blocker(problem.start, settings.run_up):
        raise InputError(f"the straight beginning of {settings.run_up:g} m touches {hit}; run_up_m sets it")
    return _found(settings, replace(problem, start=first.end), (first,))


def _found(settings: PlannerSettings, problem: Problem, begin: tuple[Segment, ...]) -> Plan:
    """Return the plan behind a fixed beginning."""
    from srs_twin.planning import plan
    from srs_twin.planning.planner import plan_shaped

    if settings.shaped:
        return plan_shaped(problem, settings.settings, begin)
    found = plan(problem, settings.settings, planner=settings.kind)
    return replace(found, segments=(*begin, *found.segments)) if found.found else found


def planner_settings(given: PlannerFile, footprint: Footprint, start: Pose, world: World) -> PlannerSettings:
    """Return what a file says of planning.

    Args:
        given: the file's section.
        footprint: that it names.
        start: of the snake.
        world: what is in the way, and the goal.

    Raises:
        InputError: a turn tighter than the footprint has, edges that are too wide, no goal.
    """
    from srs_twin.planning import Problem
    from srs_twin.planning.footprint import checked

    reduced = checked(footprint.reduced(given.turn_share, given.margin_m))
    pieces: tuple[tuple[float, float], ...] = ()
    if isinstance(given, GivenFile):
        pieces = tuple((turn / given.step_m, given.step_m) for turn in given.turns_rad)
        goal = _end_of(start, pieces, reduced, world.goal)
    elif world.goal is None:
        raise InputError("there is no goal to plan to; give world.goal")
    else:
        goal = world.goal
    problem = Problem(start, goal, world, reduced, _primitives(given))
    return PlannerSettings(
        given.kind, footprint, given.turn_share, given.margin_m, problem, _settings(given), pieces,
        0.0 if isinstance(given, GivenFile) else given.run_up_m,
        isinstance(given, BestFirstFile) and given.shape_changes,
    )  # fmt: skip


def _end_of(
    start: Pose, pieces: tuple[tuple[float, float], ...], footprint: Footprint, goal: Goal | None
) -> Goal:
    from srs_twin.planning.problem import path_of

    end = path_of(start, list(pieces), footprint)[-1].end
    radius = goal.radius if goal else 0.05
    return Goal(end.x, end.y, end.heading, radius)


def _primitives(given: PlannerFile):  # type: ignore[no-untyped-def]
    from srs_twin.planning import Primitives

    arcs = None if isinstance(given, GivenFile | OmplFile) else given.primitives
    return None if arcs is None else Primitives(arcs.count, arcs.turn_rad, arcs.length_m)


def _settings(given: PlannerFile) -> Settings:
    from srs_twin.planning import Settings

    if isinstance(given, BestFirstFile):
        return Settings(given.nodes, given.seconds, given.weight, given.levels, given.smooth, given.improve)
    if isinstance(given, OmplFile):
        return Settings(seconds=given.seconds)
    assert isinstance(given, GreedyFile | GivenFile)
    return Settings()
