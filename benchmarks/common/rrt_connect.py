"""RRT-Connect of the Open Motion Planning Library, as a baseline for the planner.

Collision checks are those of the planner. Motions are Dubins paths with the footprint's
tightest turn, and the path is shortened, as in `best_first`. The library seeds its
random numbers once per process and its budget is wall time, so plans differ between
runs.
"""

from __future__ import annotations

import math
from typing import Any

from ompl import base, geometric, util

from srs_twin.errors import InputError
from srs_twin.planning.arcs import ArcSequence, Primitives
from srs_twin.planning.collision import Checker, ObstacleGrid
from srs_twin.planning.dubins import dubins_path, shortest_path
from srs_twin.planning.path import path_from_arcs
from srs_twin.planning.primitives import (
    MotionPrimitives,
    follow_dubins_path,
    initial_state,
    make_motion_primitives,
    shorten_path,
)
from srs_twin.planning.problem import Plan, PlanOutcome, Problem, Settings
from srs_twin.robot.world import Pose

DEFAULT_SECONDS = 1.0
"""Wall time without `Settings.seconds`, s."""


def rrt_connect(problem: Problem, settings: Settings) -> Plan:
    """Plan by RRT-Connect; of the settings only `seconds` and `smooth` are used.

    Raises:
        InputError: the problem has no bounds or no arrival heading, or the footprint
            has transients.
    """
    bounds = problem.world.bounds
    goal = problem.goal
    body = problem.footprint
    if bounds is None or goal.heading is None or body.transients:
        raise InputError(
            "RRT-Connect needs bounds, an arrival heading, and a footprint without"
            " transients"
        )
    util.noOutputHandler()
    radius = 1 / min(body.tightest)
    moves = make_motion_primitives(Primitives(3, 0.5, 0.5 * radius), body)
    grid = Checker(problem.world, body).grid
    space = base.DubinsStateSpace(radius)
    box = base.RealVectorBounds(2)
    for axis, (low, high) in enumerate((bounds.x, bounds.y)):
        box.setLow(axis, low)
        box.setHigh(axis, high)
    space.setBounds(box)
    setup = geometric.SimpleSetup(space)
    info = setup.getSpaceInformation()
    validator = _motion_validator(base)(info, moves, grid, radius)
    info.setMotionValidator(validator)
    # A state is a motion of length 0.
    setup.setStateValidityChecker(
        lambda state: validator.is_free(_pose(state), _pose(state))
    )
    setup.setStartAndGoalStates(
        _state(space, problem.start), _state(space, Pose(goal.x, goal.y, goal.heading))
    )
    # Compile the kernels before the time limit starts.
    validator.is_free(problem.start, problem.start)
    setup.setPlanner(geometric.RRTConnect(info))
    seconds = settings.seconds or DEFAULT_SECONDS
    setup.solve(seconds)
    if not setup.haveExactSolutionPath():
        return Plan(
            PlanOutcome.NOT_FOUND, f"no path after {seconds:g} s; give more seconds"
        )
    poses = [_pose(state) for state in setup.getSolutionPath().getStates()]
    path: ArcSequence = []
    for a, b in zip([problem.start, *poses[1:]], poses[1:], strict=False):
        path += shortest_path(a, b.x, b.y, b.heading, radius)
    if settings.smooth:
        path = shorten_path(problem.start, path, moves, grid, radius)
    return Plan(
        PlanOutcome.FOUND, "a free path", path_from_arcs(problem.start, path, body)
    )


def _motion_validator(base: Any) -> Any:
    """Return the class of the motion validator; its base class needs the optional library."""

    class Validator(base.MotionValidator):  # type: ignore[misc]  # OMPL has no types
        def __init__(
            self, info: Any, moves: MotionPrimitives, grid: ObstacleGrid, radius: float
        ) -> None:
            super().__init__(info)
            self.moves = moves
            self.grid = grid
            self.radius = radius

        def is_free(self, a: Pose, b: Pose) -> bool:
            path = dubins_path(
                a.x, a.y, a.heading, b.x, b.y, b.heading, False, self.radius
            )
            return bool(
                follow_dubins_path(
                    initial_state(*a, self.moves), path, 0, self.moves, self.grid
                )[0]
            )

        def checkMotion(self, a: Any, b: Any, last: Any = None) -> bool:  # noqa: N802
            return self.is_free(_pose(a), _pose(b))

    return Validator


def _pose(state: Any) -> Pose:
    return Pose(state.getX(), state.getY(), state.getYaw())


def _state(space: Any, pose: Pose) -> Any:
    state = space.allocState()
    state.setX(pose.x)
    state.setY(pose.y)
    state.setYaw(math.remainder(pose.heading, 2 * math.pi))
    return state
