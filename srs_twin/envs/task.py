"""Tasks for agents, the same for gymnasium and dm_env; how the robots of their episodes vary.

An agent gives an action and gets an observation every `step_s`. Observations hold what sensors and a camera
measure, noise included; reward and `info` may know more. An episode ends where there is nothing more to win
(`terminated`) or at the time limit (`truncated`), which is not part of the task.

Robots vary by three sources, each of which may be absent: the spreads of `modules` in a robot file, the
confidence intervals of a fit file, and given ranges. From a fit the parameters are drawn together, as normal
numbers with its standard errors and correlations, and clipped to their intervals: where the data determine
only a sum, draws keep that sum.
"""

from __future__ import annotations

import os
import reprlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from inspect import signature
from typing import Any, ClassVar

import numpy as np

from srs_twin.errors import DivergedError, InputError, UnknownNameError, count_steps
from srs_twin.identification.fit_file import FitFile, load_fit
from srs_twin.identification.unknowns import unknowns, with_values
from srs_twin.io.saved_state import SavedState, Stateful
from srs_twin.plants.base import SnakeState
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.file import RobotFile, load_robot_file
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import Goal, World


@dataclass(frozen=True)
class Signal:
    """One number of an action or an observation.

    Attributes:
        name: ends with the unit, as keys of files do.
        unit: "1" for a pure number.
        low: smallest value.
        high: largest value.
        what: what it is.
    """

    name: str
    unit: str
    low: float
    high: float
    what: str


Path = str | os.PathLike[str]
Signals = tuple[Signal, ...]
Ranges = Mapping[str, tuple[float, float]]


def low(signals: Signals) -> np.ndarray:
    """Return the smallest values, float32 of shape (signals,)."""
    return np.array([each.low for each in signals], dtype=np.float32)


def high(signals: Signals) -> np.ndarray:
    """Return the largest values, float32 of shape (signals,)."""
    return np.array([each.high for each in signals], dtype=np.float32)


def numbered(count: int, name: str, unit: str, low: float, high: float, what: str) -> list[Signal]:
    """Return a signal of each segment or obstacle; # in the name is its number, from 1."""
    return [Signal(name.replace("#", str(k)), unit, low, high, what) for k in range(1, count + 1)]


def taken(signals: Signals, action: object) -> list[float]:
    """Return an agent's action, brought to the bounds of its signals.

    Raises:
        InputError: another shape, or anything but finite numbers.
    """
    values = finite(action, (len(signals),))
    if values is None:
        names = ", ".join(each.name for each in signals)
        raise InputError(
            f"action {shortened(action)} is not allowed; give {len(signals)} finite numbers: {names}"
        )
    return [
        min(max(value, each.low), each.high) for value, each in zip(values.tolist(), signals, strict=True)
    ]


def finite(numbers: object, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return numbers as float64; None where they have another shape or are not all finite numbers."""
    try:
        values = np.asarray(numbers)
    except (TypeError, ValueError):  # lists of different lengths, tensors on a device
        return None
    if values.dtype.kind not in "biuf" or values.shape != shape:
        return None
    values = values.astype(float)
    return values if np.isfinite(values).all() else None


def shortened(given: object) -> str:
    """Return a value for a message; of an array with many numbers its shape."""
    if isinstance(given, np.ndarray):
        return f"of shape {given.shape}" if given.size > _FEW_NUMBERS else str(given.tolist())
    return reprlib.repr(given)


def check_seed(seed: object) -> None:
    """Refuse a seed of episodes that is not an integer from 0 on, or None.

    Raises:
        InputError: it is not.
    """
    whole = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
    if not (seed is None or (whole and seed >= 0)):  # type: ignore[operator]
        raise InputError(f"seed {shortened(seed)} is not allowed; it must be an integer of 0 or more")


_FEW_NUMBERS = 6
_OPTIONS = ("state", "snake", "yaw_rate")


def checked_options(options: object) -> dict[str, Any]:
    """Return the options of a reset, {} for None.

    Raises:
        UnknownNameError: an option that does not exist.
        InputError: no mapping, options that exclude each other, or a value of another type.
    """
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise InputError(
            f"options {shortened(options)} are not allowed; give a dict with {', '.join(_OPTIONS)}"
        )
    for name in options:
        if name not in _OPTIONS:
            raise UnknownNameError("option of reset", str(name), _OPTIONS)
    kinds = {
        "state": (SavedState, "a SavedState, which episode.save() returns"),
        "snake": (SnakeState, "a SnakeState, such as plant.state"),
    }
    for name, (kind, wanted) in kinds.items():
        if name in options and not isinstance(options[name], kind):
            raise InputError(f"option {name} {shortened(options[name])} is not allowed; give {wanted}")
    if "state" in options and len(options) > 1:
        raise InputError("option state excludes the options snake and yaw_rate; leave them out")
    if "yaw_rate" in options and "snake" not in options:
        raise InputError("option yaw_rate belongs to option snake; give both")
    return dict(options)


_TASKS_OWN = {"spec", "tick", "supply_pa", "base", "world"}

TIME_UP = "time_up"
DIVERGED = "diverged"


@dataclass(frozen=True)
class StepResult:
    """What an agent is told after a step.

    Attributes:
        observation: float32, within the bounds of the task's observations.
        reward: of this step; 0 for the first of an episode.
        terminated: whether the episode has come to its own end.
        truncated: whether the time is up.
        info: more than sensors tell, for people; units in the keys.
    """

    observation: np.ndarray
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


class Task(ABC):
    """What an agent is to do.

    Attributes:
        name: short, as registered.
        actions: what it gives.
        observations: what it gets.
        step_s: how long an action holds, s.
        limit_s: after how long an episode is cut off, s.
        robot: what moves, before anything is drawn.
        solid: whether there is anything to run into, anew in each episode.
    """

    name: str
    actions: Signals
    observations: Signals
    step_s: float
    solid = False

    def __init__(
        self,
        robot: Path,
        limit_s: float,
        *,
        fit: Path | None = None,
        ranges: Ranges | None = None,
        **twin: Any,
    ) -> None:
        """Take what all tasks have.

        Args:
            robot: name or path of what moves; the spreads of its modules are drawn for every episode.
            limit_s: time limit, s.
            fit: path of a fit file, within whose intervals robots are drawn (`Variation`).
            ranges: names of a robot's numbers → lowest and highest, drawn uniformly.
            **twin: settings that go on to `TwinSnake`; a task sets some of its arguments itself.

        Raises:
            UnknownNameError: a setting that the twin does not take.
            InputError: a robot, fit or range that cannot be, a time limit that is no multiple of the step.
        """
        variation = Variation.of(robot, fit, ranges)
        count_steps("limit_s", limit_s, "step", self.step_s)
        allowed = set(signature(TwinSnake).parameters) - _TASKS_OWN
        for name in twin:
            if name not in allowed:
                raise UnknownNameError("setting of the task or its twin", name, allowed)
        self.limit_s, self._variation, self._settings = limit_s, variation, twin
        self.robot = variation.file.spec()

    @property
    def repeats(self) -> bool:
        """Whether all episodes have one robot and nothing to run into."""
        first, second = (self._variation.draw(np.random.default_rng(seed)) for seed in range(2))
        return first == second and not self.solid

    def _twin(
        self, spec: RobotSpec, last: Episode | None, world: World | None = None, **own: Any
    ) -> TwinSnake:
        """Return a twin: that of an episode that is over, where it is the same and met no obstacles."""
        solid = world is not None and world.has_obstacles
        if last is not None and last.twin.spec == spec and not (solid or last.twin.touches):
            return last.twin
        return TwinSnake(spec, tick=self.step_s, world=world, **own, **self._settings)

    @abstractmethod
    def begin(self, rng: np.random.Generator, last: Episode | None = None) -> Episode:
        """Begin an episode; all that is random in it comes from `rng`.

        Args:
            rng: which episode.
            last: an episode that is over: its twin is used again where it is the same.

        Raises:
            InputError: what was drawn cannot be.
        """


class Episode(Stateful, ABC):
    """One try; `save` and `go_on` branch it.

    Attributes:
        twin: what moves.
        state: of it, now.
        goal: where to get to; None where there is no such place.
        ending: why it ended, empty while it goes on.
        first: what the agent gets before its first action.
    """

    state_attributes: ClassVar[tuple[str, ...]] = ("twin", "state", "ending", "_steps", "_seen")

    ending = ""
    goal: Goal | None = None

    def __init__(self, task: Task, twin: TwinSnake, state: SnakeState) -> None:
        """Begin; a subclass sets up what it needs first, for this asks for the first observation."""
        self.twin, self.state = twin, state
        self._task = task
        self._bounds = low(task.observations), high(task.observations)
        self._steps, self._most = 0, count_steps("limit_s", task.limit_s, "step", task.step_s)
        self.first = StepResult(self._observation(), 0.0, False, False, self._info())

    def save(self) -> SavedState:
        """Return all that decides what comes next but the agent, for `go_on`."""
        return SavedState(self.identity(), self.state_dict())

    def go_on(self, state: SavedState) -> None:
        """Go on from a state that an episode of the same draw was in; it is the first one of this episode.

        Raises:
            InputError: the state of another task, robot or surroundings.
        """
        state.check(f"episode of {self._task.name}", self.identity())
        self.load_state_dict(state.content)
        self.first = StepResult(self._seen.copy(), 0.0, False, False, self._info())

    def place(self, snake: SnakeState, yaw_rate: float = 0.0) -> None:
        """Begin from a physical state instead, as `Plant.place` does.

        Raises:
            InputError: a state that the twin cannot be in.
        """
        self.state = self.twin.place(snake, yaw_rate=yaw_rate, seed=self.twin.seed)
        self._placed()
        self.first = StepResult(self._observation(), 0.0, False, False, self._info())

    def _placed(self) -> None:
        """Settle what hangs on the first state."""

    def identity(self) -> dict[str, Any]:
        """Return what a saved state must share with the episode, JSON values."""
        return {"task": self._task.name, **self.twin.identity()}

    def step(self, action: object) -> StepResult:
        """Let an action hold for a step; one beyond its bounds is brought to them.

        Args:
            action: one number for each of the task's actions.

        Raises:
            InputError: another shape, numbers that are not finite, or the episode is over.
        """
        valves = self.command(action)
        try:
            state = self.twin.step(valves)
        except DivergedError as error:
            return self.diverged(error)
        return self.went_on(state)

    def command(self, action: object) -> np.ndarray:
        """Return the valves of the coming step, which `went_on` or `diverged` ends; raises as `step`."""
        if self.ending:
            raise InputError(f"the episode is over ({self.ending}); reset the environment to begin another")
        return self._valves(taken(self._task.actions, action))

    def went_on(self, state: SnakeState) -> StepResult:
        """Take the state at the end of a step."""
        self.state = state
        self._steps += 1
        reward = self._judge()
        terminated = bool(self.ending)
        truncated = not terminated and self._steps >= self._most
        if truncated:
            self.ending = TIME_UP
        return StepResult(self._observation(), reward, terminated, truncated, self._info())

    def diverged(self, error: DivergedError) -> StepResult:
        """End; the state is still that of the step before, which sensors and camera have seen already."""
        self._steps += 1
        self.ending = DIVERGED
        return StepResult(self._seen.copy(), 0.0, True, False, self._info() | {"error": str(error)})

    def _observation(self) -> np.ndarray:
        """Return the observation: float32, within its bounds."""
        least, most = self._bounds
        seen = np.array(self._observed(), dtype=np.float32)
        self._seen: np.ndarray = np.minimum(np.maximum(seen, least), most)
        return self._seen

    @abstractmethod
    def _valves(self, action: list[float]) -> np.ndarray:
        """Return the valves of the coming step."""

    @abstractmethod
    def _observed(self) -> list[float]:
        """Return the numbers of the task's observations; called once a step."""

    @abstractmethod
    def _judge(self) -> float:
        """Return the reward of the step that led to `state`; set `ending` where the episode is over."""

    def _info(self) -> dict[str, Any]:
        """Return what people want to know; units in the keys."""
        return {"time_s": float(self.state.time), "air_j": float(self.state.air), "ending": self.ending}


_MOST_SEEDS = 2**32


@dataclass(frozen=True)
class Variation:
    """How robots differ.

    Attributes:
        file: the robot, with the spreads of its modules.
        fit: its intervals; None: no fit.
        ranges: lowest and highest of other numbers, by their names in a robot file, uniform.
    """

    file: RobotFile
    fit: FitFile | None = None
    ranges: Ranges = field(default_factory=dict)

    @classmethod
    def of(cls, robot: Path, fit: Path | None = None, ranges: Ranges | None = None) -> Variation:
        """Return the variation of a robot.

        Args:
            robot: name or path.
            fit: path of a fit file that started from this robot.
            ranges: as the attribute.

        Raises:
            InputError: no such file, a fit of another robot, or a range that no robot can have.
        """
        found = None if fit is None else load_fit(fit)
        if found is not None and found.robot != os.fspath(robot):
            raise InputError(f"fit {found.name} is of robot '{found.robot}', not of '{os.fspath(robot)}'")
        made = cls(load_robot_file(robot), found, dict(ranges or {}))
        spec = made.file.spec()
        for name, (low, high) in made.ranges.items():
            if not low <= high:
                raise InputError(f"{name}: the range {low:g} to {high:g} is not allowed; lowest first")
            for end in (low, high):
                unknowns(spec, [name], starts={name: end})
        return made

    def draw(self, rng: np.random.Generator) -> RobotSpec:
        """Return the robot of an episode."""
        spec = self.file.spec(int(rng.integers(_MOST_SEEDS)))
        if self.fit is not None:
            spec = with_values(spec, _of_fit(self.fit, spec, rng))
        return with_values(spec, {name: float(rng.uniform(*ends)) for name, ends in self.ranges.items()})


def _of_fit(fit: FitFile, spec: RobotSpec, rng: np.random.Generator) -> dict[str, float]:
    """Return the values of a fit as they may be, and those that it held."""
    fitted = [each for each in fit.parameters if each.value is not None]
    values = np.array([each.value for each in fitted], dtype=float)
    errors = np.array([each.standard_error for each in fitted], dtype=float)
    covariance = np.array(fit.correlation, dtype=float) * np.outer(errors, errors)
    drawn = rng.multivariate_normal(values, covariance, method="eigh") if fitted else values
    bounds = {each.name: each for each in unknowns(spec, (each.name for each in fitted))}
    held = {name: value for name, value in fit.held.items() if name == "actuator.bend_rad"}
    for each, value in zip(fitted, drawn, strict=True):
        bound = bounds[each.name]
        held[each.name] = float(np.clip(value, max(each.low, bound.low), min(each.high, bound.high)))  # type: ignore[type-var]
    return held
