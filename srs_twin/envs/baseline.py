"""Baseline policies: the project's own controllers, which see no more than an agent does.

`Pilot` plans at the beginning of an episode and lets `control.following.Follower` steer, unchanged, from the
pose that the observations tell; the gait keeps the frequency and the pressure that its footprint was
measured at. `Balance` moves the duties of a module against each other by a proportional-integral law, the
form that Eq. 30 takes at a constant reference.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np

from srs_twin.control.base import Controller
from srs_twin.control.camera import Camera
from srs_twin.envs.crawling import STEP_S, CrawlTask
from srs_twin.envs.module import ModuleTask
from srs_twin.envs.task import Task
from srs_twin.planning.follower import Conditions, Follower
from srs_twin.planning.footprint import load_footprint
from srs_twin.planning.planner import plan
from srs_twin.planning.problem import Problem, Settings
from srs_twin.planning.steering import PathLaw
from srs_twin.plants.base import SnakeState
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import Circle, Goal, Pose, World

FOOTPRINT = "gen2_gait"
FREQUENCY_HZ, PRESSURE_KPA = 2.0, 48.3
"""At which that footprint was measured."""

TURN_SHARE = 0.7
SETTLE_M, LOOKAHEAD_M, STRAY_M = 0.035, 0.15, 0.1
"""As in scenario follow_fig57; docs/following.md says how they were found."""
AIM_M = 0.05
"""How near to the goal the follower aims; the tasks ask for less."""
_PATIENCE = Settings(nodes=50_000)


class Policy(Protocol):
    """What maps observations to actions; one object an episode."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action for an observation."""


class Pilot:
    """Plans to the goal and follows the plan (module docstring)."""

    def __init__(self, task: CrawlTask) -> None:
        """Prepare for an episode of GoTo or Obstacles."""
        self._names, self._spec = _names(task), task.robot
        self._helm = _Helm()
        self._steps = 0
        self._follower: Follower | None = None

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """See `Policy`."""
        seen = dict(zip(self._names, map(float, observation), strict=True))
        pose = Pose(seen["x_m"], seen["y_m"], math.atan2(seen["heading_sin"], seen["heading_cos"]))
        if self._follower is None:
            self._follower = self._following(seen, pose)
        self._follower.step(_pose_only(self._steps * STEP_S, pose))
        self._steps += 1
        return np.array([self._helm.offset, FREQUENCY_HZ, PRESSURE_KPA], dtype=np.float32)

    def _following(self, seen: Mapping[str, float], pose: Pose) -> Follower:
        """Return a follower of a plan among the obstacles that are seen."""
        x, y = _in_the_world(pose, seen["goal_ahead_m"], seen["goal_left_m"])
        goal = Goal(x, y, None, AIM_M)
        world = World(tuple(_circles(seen, pose)), None, goal)
        whole = load_footprint(FOOTPRINT)
        footprint = whole.reduced(TURN_SHARE, 0.0)

        def way(start: Pose, _share: float = 1.0) -> Any:
            return plan(Problem(start, goal, world, footprint), _PATIENCE)

        law = PathLaw(whole, LOOKAHEAD_M, SETTLE_M)
        conditions = Conditions(Camera(1 / STEP_S), settle=SETTLE_M, stray=STRAY_M)
        follower = Follower(self._helm, law, way(pose), goal, whole, conditions, replan=way)
        follower.reset(self._spec, STEP_S)
        return follower


class Balance:
    """Moves duties against each other (module docstring)."""

    gain_per_rad, rate_per_rad_s = 1.0, 6.0

    def __init__(self, task: ModuleTask) -> None:
        """Prepare for an episode of Module."""
        self._names, self._step = _names(task), task.step_s
        self._held = 0.0

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """See `Policy`."""
        seen = dict(zip(self._names, map(float, observation), strict=True))
        error = seen["reference_rad"] - seen["bend_rad"]
        self._held = _unit(self._held + self.rate_per_rad_s * error * self._step)
        difference = _unit(self._held + self.gain_per_rad * error)
        return np.array([(1 + difference) / 2, (1 - difference) / 2], dtype=np.float32)


@dataclass(frozen=True)
class Score:
    """How an episode went.

    Attributes:
        ending: why it ended.
        reward: sum of all rewards.
        time: how long it took, s.
    """

    ending: str
    reward: float
    time: float


def play_episode(task: Task, policy: Policy, rng: np.random.Generator) -> Score:
    """Let a policy play one episode of a task, drawn from `rng`."""
    episode = task.begin(rng)
    result, total = episode.first, 0.0
    while not episode.ending:
        result = episode.step(policy(result.observation))
        total += result.reward
    return Score(episode.ending, total, float(episode.state.time))


class _Helm(Controller):
    """Stands in for the gait that a follower steers: it only keeps the offset."""

    kind, frequency = "helm", FREQUENCY_HZ
    offset = 0.0

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`."""

    def step(self, state: SnakeState) -> np.ndarray:
        """See `Controller.step`; nobody asks for valves."""
        return np.zeros((0, 2), dtype=np.int8)


def _names(task: Task) -> list[str]:
    return [each.name for each in task.observations]


def _in_the_world(pose: Pose, ahead: float, left: float) -> tuple[float, float]:
    c, s = math.cos(pose.heading), math.sin(pose.heading)
    return pose.x + c * ahead - s * left, pose.y + s * ahead + c * left


def _circles(seen: Mapping[str, float], pose: Pose) -> Iterator[Circle]:
    for name in seen:
        if name.startswith("obstacle_") and name.endswith("_radius_m"):
            stem = name.removesuffix("radius_m")
            x, y = _in_the_world(pose, seen[f"{stem}ahead_m"], seen[f"{stem}left_m"])
            yield Circle(x, y, seen[name])


def _unit(value: float) -> float:
    return min(max(value, -1.0), 1.0)


def _pose_only(time: float, pose: Pose) -> SnakeState:
    """Return a state of which nothing is known but what a camera tells."""
    unknown = dict.fromkeys((each.name for each in fields(SnakeState)), np.full(0, math.nan))
    known: dict[str, Any] = {"time": time, "com": np.array([pose.x, pose.y]), "heading": pose.heading}
    return SnakeState(**(unknown | known))
