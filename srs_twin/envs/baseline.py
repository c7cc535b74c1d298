"""Baseline policies: the package's controllers, given only the observations of an agent.

`PathFollowing` plans a path at the start of an episode and steers with an unmodified
`planning.follower.Follower` from the observed pose. The gait has the frequency and pressure at which its
footprint was measured. `ProportionalIntegral` sets the difference between the two duties of a module by a PI
law, to which Eq. 30 reduces at a constant reference. `OpenLoopWave` and `SensedGrasp` are the controllers of
the scenarios pegs_skin and grasp_cylinder.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np

from srs_twin.control.base import Controller
from srs_twin.control.grasp import Grasp, Phase
from srs_twin.envs.contact import GRASP_FREQUENCY_HZ, HOLD, GraspTask, PegsTask
from srs_twin.envs.crawling import STEP_S, CrawlTask
from srs_twin.envs.module import ModuleTask
from srs_twin.envs.task import Task
from srs_twin.planning.camera import Camera
from srs_twin.planning.follower import Conditions, Follower
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.planner import plan
from srs_twin.planning.problem import Problem, Settings
from srs_twin.planning.steering import PathLaw
from srs_twin.plants.base import SnakeState
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import Circle, Goal, Pose, World

FOOTPRINT = "gen2_gait"
"""Footprint used for planning."""

FREQUENCY_HZ = 2.0
"""Gait frequency at which that footprint was measured, Hz."""

PRESSURE_KPA = 48.3
"""Supply pressure at which that footprint was measured, kPa."""

# The next four are those of scenario follow_fig57; docs/following.md describes how they were chosen.
TURN_SHARE = 0.7
"""Fraction of the measured curvature range that the planner may use; the steering law needs the rest."""

SETTLE_M = 0.035
"""Response length, m."""

LOOKAHEAD_M = 0.15
"""Lookahead distance of the steering law, m."""

STRAY_M = 0.1
"""Cross-track error above which the follower plans again, m."""

AIM_M = 0.05
"""Goal radius of the follower, m; smaller than that of the tasks."""

_PLANNER_SETTINGS = Settings(nodes=50_000)


class Policy(Protocol):
    """Function from observations to actions; one object per episode."""

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action for an observation."""


class PathFollowing:
    """Policy that plans to the goal and follows the path (module docstring)."""

    def __init__(self, task: CrawlTask) -> None:
        """Initialise for an episode of GoTo or Obstacles."""
        self._task, self._names, self._spec = task, _observation_names(task), task.robot
        self._offset = _OffsetStore()
        self._steps = 0
        self._follower: Follower | None = None

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """See `Policy`."""
        values = dict(zip(self._names, map(float, observation), strict=True))
        pose = Pose(values["x_m"], values["y_m"], math.atan2(values["heading_sin"], values["heading_cos"]))
        if self._follower is None:
            self._follower = self._make_follower(values, pose)
        self._follower.step(_state_with_pose(self._steps * STEP_S, pose))
        self._steps += 1
        return self._task.from_physical([self._offset.offset, FREQUENCY_HZ, PRESSURE_KPA])

    def _make_follower(self, values: Mapping[str, float], pose: Pose) -> Follower:
        """Return a follower of a path among the observed obstacles."""
        x, y = _world_position(pose, values["goal_ahead_m"], values["goal_left_m"])
        goal = Goal(x, y, None, AIM_M)
        world = World(tuple(_circles(values, pose)), None, goal)
        measured = load_footprint(FOOTPRINT)
        footprint = measured.reduced(TURN_SHARE, 0.0)

        def replan(start: Pose, _share: float = 1.0) -> Any:
            return plan(Problem(start, goal, world, footprint), _PLANNER_SETTINGS)

        law = PathLaw(measured, LOOKAHEAD_M, SETTLE_M)
        conditions = Conditions(Camera(1 / STEP_S), settle=SETTLE_M, stray=STRAY_M)
        follower = Follower(self._offset, law, replan(pose), goal, measured, conditions, replan=replan)
        follower.reset(self._spec, STEP_S)
        return follower


class ProportionalIntegral:
    """PI control of a module's duties (module docstring)."""

    gain_per_rad = 1.0
    """Proportional gain of the duty difference, 1/rad."""

    rate_per_rad_s = 6.0
    """Integral gain of the duty difference, 1/(rad s)."""

    def __init__(self, task: ModuleTask) -> None:
        """Initialise for an episode of Module."""
        self._task, self._names, self._step = task, _observation_names(task), task.step_s
        self._integral = 0.0

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """See `Policy`."""
        values = dict(zip(self._names, map(float, observation), strict=True))
        error = values["reference_rad"] - values["bend_rad"]
        # Clipping the integral prevents wind-up while the duties are saturated.
        self._integral = _clip_to_unit(self._integral + self.rate_per_rad_s * error * self._step)
        difference = _clip_to_unit(self._integral + self.gain_per_rad * error)
        return self._task.from_physical([(1 + difference) / 2, (1 - difference) / 2])


class OpenLoopWave:
    """Straight wave of the gait at a constant frequency and pressure, the controller of pegs_skin."""

    frequency_hz, pressure_kpa = 1.0, 48.3

    def __init__(self, task: PegsTask) -> None:
        """Initialise for an episode of Pegs."""
        self._action = task.from_physical([0.0, self.frequency_hz, self.pressure_kpa])

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """See `Policy`."""
        return self._action


class SensedGrasp:
    """The unmodified controller `control.grasp.Grasp` in its sensed mode."""

    def __init__(self, task: GraspTask) -> None:
        """Initialise for an episode of Grasp."""
        self._task, self._names, self._steps = task, _observation_names(task), 0
        self._grasp: Grasp | None = None

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """See `Policy`."""
        values = dict(zip(self._names, map(float, observation), strict=True))
        if self._grasp is None:
            side = "left" if values["object_left_m"] > 0 else "right"
            self._grasp = Grasp(GRASP_FREQUENCY_HZ, side=side, hold=HOLD)
            self._grasp.reset(self._task.robot, self._task.step_s)
        pose = Pose(values["x_m"], values["y_m"], math.atan2(values["heading_sin"], values["heading_cos"]))
        bends = np.array([values[f"bend_{k + 1}_rad"] for k in range(self._task.robot.segments)])
        state = _state_with_pose(self._steps * self._task.step_s, pose)
        self._grasp.step(replace(state, sensed=bends))
        self._steps += 1
        return self._task.from_physical([self._grasp.duty, float(self._grasp.phase is Phase.DRAG), 0.0])


def baseline(task: Task) -> Policy:
    """Return the project's controller of a task as a policy for one episode."""
    if isinstance(task, GraspTask):
        return SensedGrasp(task)
    if isinstance(task, PegsTask):
        return OpenLoopWave(task)
    if isinstance(task, ModuleTask):
        return ProportionalIntegral(task)
    assert isinstance(task, CrawlTask), "no other task has a baseline"
    return PathFollowing(task)


@dataclass(frozen=True)
class Score:
    """Outcome of an episode.

    Attributes:
        ending: reason why it ended.
        reward: sum of all rewards.
        time: duration, s.
    """

    ending: str
    reward: float
    time: float


def play_episode(task: Task, policy: Policy, rng: np.random.Generator) -> Score:
    """Run one episode of a task, drawn from `rng`, with a policy."""
    episode = task.begin(rng)
    result, total = episode.first, 0.0
    while not episode.ending:
        result = episode.step(policy(result.observation))
        total += result.reward
    return Score(episode.ending, total, float(episode.state.time))


class _OffsetStore(Controller):
    """Controller that stores the offset of a follower in place of a gait."""

    kind, frequency = "helm", FREQUENCY_HZ
    offset = 0.0

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`."""

    def step(self, state: SnakeState) -> np.ndarray:
        """See `Controller.step`; the valve states are not used."""
        return np.zeros((0, 2), dtype=np.int8)


def _observation_names(task: Task) -> list[str]:
    return [signal.name for signal in task.observations]


def _world_position(pose: Pose, ahead: float, left: float) -> tuple[float, float]:
    c, s = math.cos(pose.heading), math.sin(pose.heading)
    return pose.x + c * ahead - s * left, pose.y + s * ahead + c * left


def _circles(values: Mapping[str, float], pose: Pose) -> Iterator[Circle]:
    for name in values:
        if name.startswith("obstacle_") and name.endswith("_radius_m"):
            stem = name.removesuffix("radius_m")
            x, y = _world_position(pose, values[f"{stem}ahead_m"], values[f"{stem}left_m"])
            yield Circle(x, y, values[name])


def _clip_to_unit(value: float) -> float:
    return min(max(value, -1.0), 1.0)


def _state_with_pose(time: float, pose: Pose) -> SnakeState:
    """Return a snake state with time and pose only; all other values are empty arrays."""
    unknown = dict.fromkeys((entry.name for entry in fields(SnakeState)), np.full(0, math.nan))
    known: dict[str, Any] = {"time": time, "com": np.array([pose.x, pose.y]), "heading": pose.heading}
    return SnakeState(**(unknown | known))
