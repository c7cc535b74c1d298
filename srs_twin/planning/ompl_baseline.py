"""Baseline: RRT-Connect of the Open Motion Planning Library (extra `ompl`), on the same collision checks.

Its motions are Dubins paths of the footprint's tightest turn, checked as the default planner's are, and the
path is shortened as the default planner's is. The library's random numbers are seeded once a process and its
budget is wall time, so plans differ from run to run.
"""

from __future__ import annotations

import math
from typing import Any

from srs_twin.errors import InputError
from srs_twin.planning.arcs import Primitives
from srs_twin.planning.best_first import Moves, at_rest, passes
from srs_twin.planning.collision import Checker, Surroundings
from srs_twin.planning.dubins import Pieces, shortest, word
from srs_twin.planning.plan import Plan
from srs_twin.planning.problem import Outcome, Problem, Settings, path_of
from srs_twin.planning.shortening import shortened
from srs_twin.planning.tree import moves_of
from srs_twin.robot.world import Pose

SECONDS = 1.0
"""Wall time where the settings give none."""


def rrt_connect(problem: Problem, settings: Settings) -> Plan:
    """Plan; of the settings only `seconds` and `smooth` count.

    Raises:
        InputError: the extra is not installed, or the problem has no bounds or no arrival heading.
    """
    try:
        from ompl import base, geometric, util
    except ImportError as error:
        raise InputError("planner ompl needs the extra of that name: pip install 'srs-twin[ompl]'") from error
    bounds, goal, body = problem.world.bounds, problem.goal, problem.footprint
    if bounds is None or goal.heading is None or body.transients:
        raise InputError("planner ompl needs bounds, an arrival heading, and a footprint without transients")
    util.noOutputHandler()
    radius = 1 / min(body.tightest)
    moves = moves_of(Primitives(3, 0.5, 0.5 * radius), body)
    around = Checker(problem.world, body).surroundings
    space = base.DubinsStateSpace(radius)
    box = base.RealVectorBounds(2)
    for axis, (low, high) in enumerate((bounds.x, bounds.y)):
        box.setLow(axis, low)
        box.setHigh(axis, high)
    space.setBounds(box)
    setup = geometric.SimpleSetup(space)
    info = setup.getSpaceInformation()
    validator = _motion_validator(base)(info, moves, around, radius)
    info.setMotionValidator(validator)
    setup.setStateValidityChecker(lambda state: validator.passes(_pose(state), _pose(state)))
    setup.setStartAndGoalStates(
        _state(space, problem.start), _state(space, Pose(goal.x, goal.y, goal.heading))
    )
    # Compiled before the clock runs.
    validator.passes(problem.start, problem.start)
    setup.setPlanner(geometric.RRTConnect(info))
    seconds = settings.seconds or SECONDS
    setup.solve(seconds)
    if not setup.haveExactSolutionPath():
        return Plan(Outcome.BUDGET_SPENT, f"no path after {seconds:g} s; give more seconds")
    poses = [_pose(state) for state in setup.getSolutionPath().getStates()]
    path: Pieces = []
    for a, b in zip([problem.start, *poses[1:]], poses[1:], strict=False):
        path += shortest(a, b.x, b.y, b.heading, radius)
    if settings.smooth:
        path = shortened(problem.start, path, moves, around, radius)
    return Plan(Outcome.FOUND, "a free path", path_of(problem.start, path, body))


def _motion_validator(base: Any) -> Any:
    """Return the class that checks motions; its base is the library's, which may be missing."""

    class Validator(base.MotionValidator):
        def __init__(self, info: Any, moves: Moves, around: Surroundings, radius: float) -> None:
            super().__init__(info)
            self.moves, self.around, self.radius = moves, around, radius

        def passes(self, a: Pose, b: Pose) -> bool:
            path = word(a.x, a.y, a.heading, b.x, b.y, b.heading, False, self.radius)
            return bool(passes(at_rest(*a, self.moves), path, self.moves, self.around)[0])

        def checkMotion(self, a: Any, b: Any, last: Any = None) -> bool:  # noqa: N802
            return self.passes(_pose(a), _pose(b))

    return Validator


def _pose(state: Any) -> Pose:
    return Pose(state.getX(), state.getY(), state.getYaw())


def _state(space: Any, pose: Pose) -> Any:
    state = space.allocState()
    state.setX(pose.x)
    state.setY(pose.y)
    state.setYaw(math.remainder(pose.heading, 2 * math.pi))
    return state
