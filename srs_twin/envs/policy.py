"""Trained network policies and baseline policies for the tasks.

The baselines are conventional controllers that receive the same observations as an
agent.
"""

from __future__ import annotations

import math
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from srs_twin.control.base import Controller
from srs_twin.control.grasp import Grasp, Phase
from srs_twin.envs.contact import (
    GRASP_FREQUENCY_HZ,
    HOLD,
    MAX_PHASE_STEP_RAD,
    GraspTask,
    PegsTask,
)
from srs_twin.envs.crawling import (
    SPATIAL_FREQUENCIES_HZ,
    SPATIAL_RELATIVE_PRESSURES,
    CrawlTask,
    SpatialCrawlTask,
)
from srs_twin.envs.module import ModuleTask
from srs_twin.envs.observed import STEP_S
from srs_twin.envs.task import Task, lower_bounds, upper_bounds
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.io.files import StrPath, atomic_write, data_root
from srs_twin.io.untrusted import read_arrays
from srs_twin.planning.camera import Camera
from srs_twin.planning.follower import Conditions, Follower
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.planner import plan
from srs_twin.planning.problem import Plan, Problem, Settings
from srs_twin.planning.steering import PathTracking
from srs_twin.plants.base import SnakeState
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import Circle, Goal, Pose, World

SHIPPED = "calibration/policies"


@dataclass(frozen=True)
class NetworkPolicy:
    """Fully connected tanh network whose outputs are clipped to the range from −1 to 1.

    Attributes:
        task: name of the task.
        observations: names of the observation signals in the input vector, in order.
        layers: weights, shape (outputs, inputs), and biases, shape (outputs,), of each
            layer.
    """

    task: str
    observations: tuple[str, ...]
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action for a vector of observations."""
        values = np.asarray(observation, dtype=float)
        for weights, biases in self.layers[:-1]:
            values = np.tanh(weights @ values + biases)
        weights, biases = self.layers[-1]
        action: np.ndarray = np.clip(weights @ values + biases, -1.0, 1.0).astype(
            np.float32
        )
        return action

    def bind(self, task: Task) -> Callable[[np.ndarray], np.ndarray]:
        """Return a function that maps the observations of a task to actions.

        Raises:
            InputError: the policy was trained for another task, or the task does not
                provide all observations that the policy needs.
        """
        names = [signal.name for signal in task.observations]
        missing = [name for name in self.observations if name not in names]
        if task.name != self.task or missing:
            problem = "is different; use the policy's task, or another policy"
            if missing:
                problem = (
                    f"does not provide {', '.join(missing)}; select these observations,"
                    " or use another policy"
                )
            raise InputError(
                f"the policy was trained for the task {self.task} with the observations"
                f" {', '.join(self.observations)}, but the task"
                f" {task.name} {problem}"
            )
        indices = [names.index(name) for name in self.observations]
        return lambda observation: self(np.asarray(observation)[indices])

    def save(self, path: StrPath) -> None:
        """Write the policy to an npz file in single precision."""
        arrays: dict[str, np.ndarray] = {
            "task": np.array(self.task),
            "observations": np.array(self.observations),
        }
        for k, (weights, biases) in enumerate(self.layers):
            arrays |= {
                f"weights_{k}": weights.astype(np.float32),
                f"biases_{k}": biases.astype(np.float32),
            }
        with atomic_write(Path(path)) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def load_policy(name_or_path: StrPath) -> NetworkPolicy:
    """Load a shipped policy by name, or a policy file by path.

    Raises:
        UnknownNameError: no shipped policy has the given name.
        InputError: the file does not exist or does not contain a policy.
    """
    path = Path(os.fspath(name_or_path))
    if not path.suffix and path.name == os.fspath(name_or_path):
        names = sorted(entry.stem for entry in (data_root() / SHIPPED).glob("*.npz"))
        if path.name not in names:
            raise UnknownNameError("policy", path.name, names)
        path = data_root() / SHIPPED / f"{path.name}.npz"
    arrays = read_arrays(path, "policy file")

    def get(name: str, what: str, axes: int, kinds: str) -> np.ndarray:
        array = arrays.get(name)
        if array is None or array.ndim != axes or array.dtype.kind not in kinds:
            raise InputError(
                f"{path}: the file is not a policy, because it contains no {what}"
                f" '{name}'; tools/train_ppo.py writes policies"
            )
        return array

    layers = tuple(
        (
            get(f"weights_{k}", "matrix of numbers", 2, "fiu").astype(float),
            get(f"biases_{k}", "vector of numbers", 1, "fiu").astype(float),
        )
        for k in range(sum(name.startswith("weights_") for name in arrays))
    )
    task = get("task", "text", 0, "U")
    # Even a small file can contain millions of empty names, so the number of names is
    # checked before the names are converted to strings.
    observations = get("observations", "list of texts", 1, "U")
    sizes = [observations.size, *(len(biases) for _, biases in layers)]
    shapes = [weights.shape for weights, _ in layers]
    finite = all(np.isfinite(array).all() for layer in layers for array in layer)
    if (
        not layers
        or not finite
        or shapes != [(after, before) for before, after in pairwise(sizes)]
    ):
        raise InputError(
            f"{path}: the file is not a policy, because the shapes of its layers do"
            " not match, or some of the numbers are not finite"
        )
    return NetworkPolicy(str(task), tuple(map(str, observations)), layers)


FOOTPRINT = "gen2_gait"
"""Name of the footprint with which paths are planned."""

FREQUENCY_HZ = 2.0
"""Gait frequency at which the footprint was measured, Hz."""

PRESSURE_KPA = 48.3
"""Supply pressure in the footprint measurement and in the scenario `pegs_skin`, kPa."""

PEGS_FREQUENCY_HZ = 1.0
"""Gait frequency in the scenario `pegs_skin`, Hz."""

TURN_FRACTION = 0.7
"""Ratio of the maximum planned curvature to the maximum curvature of the footprint.

The remaining curvature is reserved for steering.
"""

RESPONSE_LENGTH_M = 0.035
"""Path length over which the curvature responds to a steering command, m.

The value is taken from the scenario `follow_fig57` (docs/course.md).
"""

LOOKAHEAD_M = 0.15
"""Path length over which the steering law reduces a cross-track error, m."""

MAX_CROSS_TRACK_ERROR_M = 0.1
"""Cross-track error above which the follower plans a new path, m."""

AIM_M = 0.05
"""Goal radius of the follower, which is smaller than the goal radius of the tasks, m.
"""

MARGIN_M = 0.03
"""Safety margin added to each side of the footprint for planning, m."""

_PLANNER_SETTINGS = Settings(nodes=50_000)


class Policy(Protocol):
    """Function that maps observations to actions.

    A policy may store its state, so each episode needs a new policy object.
    """

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action for an observation."""


class _Baseline(ABC):
    def __init__(self, task: Task) -> None:
        self._task = task
        self._names = [signal.name for signal in task.observations]
        self._steps = 0

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        values = dict(zip(self._names, map(float, observation), strict=True))
        action = self._action(values)
        self._steps += 1
        actions = self._task.actions
        allowed = np.clip(action, lower_bounds(actions), upper_bounds(actions))
        return self._task.from_physical(allowed.tolist())

    @abstractmethod
    def _action(self, values: Mapping[str, float]) -> Sequence[float]:
        """Return the action in physical units."""

    def _state(self, values: Mapping[str, float]) -> SnakeState:
        unknown = dict.fromkeys(
            (entry.name for entry in fields(SnakeState)), np.full(0, math.nan)
        )
        known: dict[str, Any] = {
            "time": self._steps * self._task.step_s,
            "com": np.array([values["x_m"], values["y_m"]]),
            "heading": _pose(values).heading,
        }
        return SnakeState(**(unknown | known))


class PathFollowing(_Baseline):
    """Policy for GoTo and Obstacles that plans a path to the goal and follows it.

    A `Follower` follows the path with the gait frequency and the supply pressure at
    which the footprint was measured.
    """

    def __init__(self, task: CrawlTask) -> None:
        super().__init__(task)
        self._arena = task.arena
        self._offset = _OffsetStore()
        self._follower: Follower | None = None

    def _action(self, values: Mapping[str, float]) -> Sequence[float]:
        if self._follower is None:
            self._follower = self._make_follower(values)
        self._follower.step(self._state(values))
        return [self._offset.offset, FREQUENCY_HZ, PRESSURE_KPA]

    def _make_follower(self, values: Mapping[str, float]) -> Follower:
        pose = _pose(values)
        x, y = _world_position(pose, values["goal_ahead_m"], values["goal_left_m"])
        goal = Goal(x, y, None, AIM_M)
        world = World(tuple(_circles(values, pose)), self._arena.room, goal)
        measured = load_footprint(FOOTPRINT)

        def replan(start: Pose, fraction: float = 1.0) -> Plan:
            footprint = measured.reduced(TURN_FRACTION, fraction * MARGIN_M)
            return plan(Problem(start, goal, world, footprint), _PLANNER_SETTINGS)

        steering = PathTracking(measured, LOOKAHEAD_M, RESPONSE_LENGTH_M)
        conditions = Conditions(
            Camera(1 / STEP_S),
            response_length=RESPONSE_LENGTH_M,
            max_cross_track_error=MAX_CROSS_TRACK_ERROR_M,
        )
        follower = Follower(
            self._offset,
            steering,
            replan(pose),
            goal,
            measured,
            conditions,
            replan=replan,
        )
        follower.reset(self._task.robot, STEP_S)
        return follower


class ProportionalIntegral(_Baseline):
    """Policy for Module that controls the bend with a PI law.

    The output of the PI law is the difference between the two duties. For a constant
    reference, Eq. 30 reduces to a PI law.
    """

    gain_per_rad = 1.0
    """Proportional gain from the bend error to the duty difference, 1/rad."""

    rate_per_rad_s = 6.0
    """Integral gain from the bend error to the duty difference, 1/(rad s)."""

    _integral = 0.0

    def _action(self, values: Mapping[str, float]) -> Sequence[float]:
        error = values["reference_rad"] - values["bend_rad"]
        # Clipping prevents integrator wind-up while the duties are saturated.
        self._integral = _clip_to_unit(
            self._integral + self.rate_per_rad_s * error * self._task.step_s
        )
        difference = _clip_to_unit(self._integral + self.gain_per_rad * error)
        return [(1 + difference) / 2, (1 - difference) / 2]


class PegSteering(_Baseline):
    """Policy for Pegs that steers the gait of the scenario `pegs_skin` to the goal."""

    gain_per_rad = 0.3
    """Ratio of the steering offset to the bearing of the goal, 1/rad."""

    def _action(self, values: Mapping[str, float]) -> Sequence[float]:
        bearing = math.atan2(values["goal_left_m"], values["goal_ahead_m"])
        return [self.gain_per_rad * bearing, PEGS_FREQUENCY_HZ, PRESSURE_KPA]


class _SidewindingGait(NamedTuple):
    # Phase lag of the pitch wave (rad), mean velocity to the left (m/s) and mean yaw
    # rate (rad/s).
    lag: float
    left: float
    yaw_rate: float


class Sidewinding(_Baseline):
    """Policy for Crawl3D that sidewinds to the goal.

    At the start of each gait period, the policy predicts the motion of the body for
    each of six sidewinding gaits with constant velocities. It then chooses the gait
    that passes closest to the goal within the prediction horizon.
    """

    pitch_fraction = 0.25
    """Pitch fraction of all gaits, dimensionless."""

    horizon_s = 6.0
    """Prediction horizon, s."""

    _LEFTWARD = (
        _SidewindingGait(-3 * math.pi / 4, 0.207, 0.264),
        _SidewindingGait(-math.pi / 2, 0.125, -0.400),
        _SidewindingGait(-math.pi / 4, 0.073, -0.503),
    )
    """Sidewinding gaits of `spatial_example` to the left, at 1 Hz and maximum pressure.

    The velocities are mean values of the twin between 3 and 9 s of simulated time.
    Forward velocities, which are at most 12 mm/s, are neglected.
    """

    _GAITS = (
        *_LEFTWARD,
        *(_SidewindingGait(g.lag + math.pi, -g.left, -g.yaw_rate) for g in _LEFTWARD),
    )
    """Gaits to the left, and mirrored gaits to the right."""

    _gait = _LEFTWARD[0]

    def _action(self, values: Mapping[str, float]) -> Sequence[float]:
        frequency = SPATIAL_FREQUENCIES_HZ[1]
        if self._steps % round(1 / (frequency * self._task.step_s)) == 0:
            goal = complex(values["goal_ahead_m"], values["goal_left_m"])
            self._gait = min(self._GAITS, key=lambda gait: self._closest(gait, goal))
        pressure = SPATIAL_RELATIVE_PRESSURES[1] * self._task.robot.supply.nominal
        return [0.0, frequency, pressure / 1e3, self.pitch_fraction, self._gait.lag]

    def _closest(self, gait: _SidewindingGait, goal: complex) -> float:
        """Return the minimum predicted distance between the body and the goal, m.

        The real and imaginary parts of `goal` are the distances to the goal ahead and
        to the left of the body, m.
        """
        time = np.linspace(0.0, self.horizon_s, 61)
        turn = 1j * gait.yaw_rate * time
        place = 1j * gait.left * time * np.expm1(turn) / np.where(time > 0, turn, 1.0)
        return float(np.abs(goal - place).min())


class SensedGrasp(_Baseline):
    """Policy for Grasp that crawls to the object and then grasps it.

    The snake approaches with short waves until the object is beside the tail, and vents
    for `rest_s` to come to rest. Then the controller of the scenario
    `grasp_cylinder` grasps the object and drags it with long waves.
    """

    stop_ahead_m = -0.185
    """Distance of the object ahead of the centre of mass at which the approach ends, m.

    The snake then coasts by about 25 mm.
    """

    rest_s = 0.4
    """Time between the approach and the grasp, s."""

    drag_phase_lag_rad = 1.2
    """Phase lag per module during the drag, rad."""

    _stopped: int | None = None
    _grasp: Grasp | None = None

    def _action(self, values: Mapping[str, float]) -> Sequence[float]:
        if self._stopped is None:
            if values["object_ahead_m"] > self.stop_ahead_m:
                return [0.0, 1.0, 0.0, MAX_PHASE_STEP_RAD]
            self._stopped = self._steps
        time = (self._steps - self._stopped) * self._task.step_s - self.rest_s
        if self._grasp is None:
            if time < 0:
                return [0.0, 0.0, 0.0, MAX_PHASE_STEP_RAD]
            side = "left" if values["object_left_m"] > 0 else "right"
            self._grasp = Grasp(GRASP_FREQUENCY_HZ, side=side, hold=HOLD)
            self._grasp.reset(self._task.robot, self._task.step_s)
        bends = np.array(
            [values[f"bend_{k + 1}_rad"] for k in range(self._task.robot.segments)]
        )
        self._grasp.step(replace(self._state(values), time=time, measured_bend=bends))
        drive = float(self._grasp.phase is Phase.DRAG)
        return [self._grasp.duty, drive, 0.0, self.drag_phase_lag_rad]


def baseline(task: Task) -> Policy:
    """Create the baseline policy of a task for one episode."""
    if isinstance(task, GraspTask):
        return SensedGrasp(task)
    if isinstance(task, PegsTask):
        return PegSteering(task)
    if isinstance(task, ModuleTask):
        return ProportionalIntegral(task)
    if isinstance(task, SpatialCrawlTask):
        return Sidewinding(task)
    assert isinstance(task, CrawlTask), "no other task has a baseline"
    return PathFollowing(task)


@dataclass(frozen=True)
class Score:
    """Outcome of an episode.

    Attributes:
        ending: reason why the episode ended.
        reward: sum of all rewards.
        time: duration of the episode, s.
    """

    ending: str
    reward: float
    time: float


def play_episode(task: Task, policy: Policy, rng: np.random.Generator) -> Score:
    """Run a policy in one randomly drawn episode of a task."""
    episode = task.begin(rng)
    result = episode.first
    total = 0.0
    while not episode.ending:
        result = episode.step(policy(result.observation))
        total += result.reward
    return Score(episode.ending, total, float(episode.state.time))


class _OffsetStore(Controller):
    kind = "helm"
    frequency = FREQUENCY_HZ
    offset = 0.0

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`."""

    def step(self, state: SnakeState) -> np.ndarray:
        """Return an empty array, because the valve states are not used."""
        return np.zeros((0, 2), dtype=np.int8)


def _pose(values: Mapping[str, float]) -> Pose:
    return Pose(
        values["x_m"],
        values["y_m"],
        math.atan2(values["heading_sin"], values["heading_cos"]),
    )


def _world_position(pose: Pose, forward: float, left: float) -> tuple[float, float]:
    c = math.cos(pose.heading)
    s = math.sin(pose.heading)
    return pose.x + c * forward - s * left, pose.y + s * forward + c * left


def _circles(values: Mapping[str, float], pose: Pose) -> Iterator[Circle]:
    for name in values:
        if name.startswith("obstacle_") and name.endswith("_radius_m"):
            stem = name.removesuffix("radius_m")
            x, y = _world_position(
                pose, values[f"{stem}ahead_m"], values[f"{stem}left_m"]
            )
            yield Circle(x, y, values[name])


def _clip_to_unit(value: float) -> float:
    return min(max(value, -1.0), 1.0)
