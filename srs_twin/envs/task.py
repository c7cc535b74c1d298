"""Base classes of the reinforcement-learning tasks for Gymnasium and dm_env.

In each step, an agent takes an action and receives an observation. Observations contain
only measurements of the sensors and the camera, whereas the reward and `info` may
depend on the true state. An episode terminates when the goal is reached or the task has
failed, and is truncated at the time limit.
"""

from __future__ import annotations

import reprlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from inspect import signature
from typing import ClassVar, NamedTuple, Unpack

import numpy as np

from srs_twin.envs.variation import Ranges, Robot, Variation
from srs_twin.errors import (
    DivergedError,
    InputError,
    UnknownNameError,
    count_steps,
)
from srs_twin.io.arguments import checked
from srs_twin.io.files import StrPath
from srs_twin.io.saved_state import SavedState, Stateful
from srs_twin.plants.base import SnakeState
from srs_twin.plants.twin.snake import TwinSettings, TwinSnake
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import Goal, World


@dataclass(frozen=True)
class Signal:
    """Component of an action or an observation.

    Attributes:
        name: name of the signal with the unit as a suffix, for example "x_m".
        unit: unit of the signal, or "1" for a dimensionless signal.
        low: lower bound.
        high: upper bound.
        description: one-line description of the signal.
    """

    name: str
    unit: str
    low: float
    high: float
    description: str


@dataclass(frozen=True)
class RewardTerm:
    """Quantity whose weighted value is added to the reward of each step.

    Attributes:
        name: name of the term with the unit as a suffix, for example "time_s".
        weight: default weight, in reward per unit of the quantity.
        description: one-line description of the term.
    """

    name: str
    weight: float
    description: str


Signals = tuple[Signal, ...]


def lower_bounds(signals: Signals) -> np.ndarray:
    """Return the lower bounds of signals as a float32 array, shape (signals,)."""
    return np.array([signal.low for signal in signals], dtype=np.float32)


def upper_bounds(signals: Signals) -> np.ndarray:
    """Return the upper bounds of signals as a float32 array, shape (signals,)."""
    return np.array([signal.high for signal in signals], dtype=np.float32)


def as_finite_array(numbers: object, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return numbers as a float64 array.

    The result is None if the numbers do not have the given shape or are not finite.
    """
    try:
        values = np.asarray(numbers)
    except (TypeError, ValueError):
        return None
    if values.dtype.kind not in "biuf" or values.shape != shape:
        return None
    values = values.astype(float)
    if np.isfinite(values).all():
        return values
    return None


def abbreviate(value: object) -> str:
    """Return a short description of a value for error messages."""
    if isinstance(value, np.ndarray):
        if value.size > _MAX_PRINTED_VALUES:
            return f"of shape {value.shape}"
        return str(value.tolist())
    return reprlib.repr(value)


def check_names(kind: str, names: Iterable[object], known: Collection[str]) -> None:
    """Check that all names are known.

    Raises:
        UnknownNameError: a name is unknown.
    """
    for name in names:
        if name not in known:
            raise UnknownNameError(kind, str(name), known, longest=len(known))


def keywords(function: Callable[..., object]) -> set[str]:
    """Return the names of a function's keyword-only arguments."""
    parameters = signature(function).parameters.values()
    return {entry.name for entry in parameters if entry.kind is entry.KEYWORD_ONLY}


def check_seed(seed: object) -> int | None:
    """Return a seed as a Python integer, or None if no seed is given.

    Raises:
        InputError: the seed is neither None nor a non-negative integer.
    """
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise InputError(
            f"seed {abbreviate(seed)} is not allowed; it must be an integer of 0 or"
            " more"
        )
    return int(seed)


_MAX_PRINTED_VALUES = 6

_RESERVED_TWIN_ARGUMENTS = {"tick", "supply_pa", "base", "world"}
"""Arguments of `TwinSnake` that only the task may set."""

TIME_UP = "time_up"
DIVERGED = "diverged"


class StepResult(NamedTuple):
    """Result of a step, as returned by Gymnasium's `step`.

    Attributes:
        observation: float32 array within the bounds of `Task.observations`.
        reward: reward of the step, which is 0 before the first action.
        terminated: whether the episode has reached a terminal state.
        truncated: whether the episode has reached the time limit.
        info: true state and diagnostics, which the agent must not use.
    """

    observation: np.ndarray
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, object]


class TaskKeywords(TwinSettings, total=False):
    """Optional keyword arguments of `Task`."""

    fit: StrPath | None
    ranges: Ranges | None
    rewards: Mapping[str, float] | None
    observations: str | Sequence[str] | None


class Task(ABC):
    """Base class of the tasks.

    Attributes:
        name: registered name of the task.
        actions: action signals in physical units.
        groups: observation signals, keyed by group name.
        observations: observation signals of the selected groups.
        reward_terms: reward terms with default weights.
        weights: weight of each reward term, keyed by term name.
        step_s: duration of a step, s.
        limit_s: time limit of an episode, s.
        robot: nominal robot, without random variation.
        has_obstacles: whether each episode contains randomly placed obstacles.
        spatial: whether the task needs a spatial robot.
    """

    name: str
    actions: Signals
    groups: Mapping[str, Signals]
    observations: Signals
    reward_terms: ClassVar[tuple[RewardTerm, ...]]
    step_s: float
    has_obstacles = False
    spatial = False

    @checked
    def __init__(
        self,
        robot: Robot,
        limit_s: float,
        *,
        fit: StrPath | None = None,
        ranges: Ranges | None = None,
        rewards: Mapping[str, float] | None = None,
        observations: str | Sequence[str] | None = None,
        **twin_settings: Unpack[TwinSettings],
    ) -> None:
        """Initialise the task.

        Args:
            robot: name or path of a robot file, or a mapping as in the section `robot`
                of a scenario. Random module properties are drawn anew in each episode.
            limit_s: time limit, s.
            fit: path of a fit file from which robot parameters are drawn in each
                episode, as described in `Variation`.
            ranges: limits (low, high) of a uniform distribution, keyed by parameter
                name.
            rewards: weights that replace default weights, keyed by term name.
            observations: name or names of the observation groups that the agent
                receives, by default all groups.
            **twin_settings: further arguments of `TwinSnake`.

        Raises:
            UnknownNameError: a reward term, an observation group or a setting of the
                twin does not exist.
            InputError: the robot, fit or range is invalid, or the time limit is not a
                multiple of the step duration.
        """
        if "action_range" in twin_settings:
            raise InputError(
                "`action_range` has been removed; actions are from −1 to 1, and"
                " `task.from_physical` and `task.to_physical` convert them"
            )
        defaults = {term.name: term.weight for term in self.reward_terms}
        check_names("reward term", rewards or (), defaults)
        self.weights = defaults | dict(rewards or {})
        if not np.isfinite(sum(self.weights.values())):
            raise InputError(f"`rewards` {rewards} is not allowed; use finite weights")
        self._requested_groups = observations
        self._variation = Variation.load(robot, fit, ranges)
        count_steps("limit_s", limit_s, "step", self.step_s)
        own = (
            keywords(kind.__init__)
            for kind in type(self).__mro__
            if issubclass(kind, Task)
        )
        allowed = keywords(TwinSnake).union(*own) - _RESERVED_TWIN_ARGUMENTS
        check_names("setting of the task or its twin", twin_settings, allowed)
        self.limit_s = limit_s
        self._twin_settings = twin_settings
        self.robot = self._variation.file.spec()
        if not self.spatial:
            self.robot.require_planar("an environment other than Crawl3D")
        elif not self.robot.is_spatial:
            raise InputError(
                f"robot '{self.robot.name}' bends in one plane, but this task needs a"
                " robot with chambers in several directions"
                " (`chamber.directions_deg`)"
            )

    def _set_observations(self, groups: Mapping[str, Signals]) -> None:
        selected = self._requested_groups
        if selected is None:
            selected = tuple(groups)
        elif isinstance(selected, str):
            selected = (selected,)
        check_names("group of observations", selected, groups)
        if not selected:
            raise InputError(
                "no group of observations is selected; give at least one of"
                f" {', '.join(groups)}"
            )
        self.groups = groups
        self._selected_groups = tuple(name for name in groups if name in selected)
        self.observations = tuple(
            signal for name in self._selected_groups for signal in groups[name]
        )

    def select(self, measured: Mapping[str, Sequence[float]]) -> np.ndarray:
        """Return the measured values of the selected groups as a float32 array."""
        values = [value for name in self._selected_groups for value in measured[name]]
        return np.array(values, dtype=np.float32)

    @cached_property
    def commands(self) -> Signals:
        """Action signals, scaled to the range from −1 to 1."""
        return tuple(
            replace(signal, unit="1", low=-1.0, high=1.0) for signal in self.actions
        )

    def to_physical(self, action: object) -> list[float]:
        """Clip an action to the range from −1 to 1, and convert it to physical units.

        Raises:
            InputError: the shape is wrong, or a value is not a finite number.
        """
        given = as_finite_array(action, (len(self.actions),))
        if given is None:
            names = [signal.name for signal in self.actions]
            raise InputError(
                f"the action {abbreviate(action)} is not allowed; give {len(names)}"
                f" finite numbers ({', '.join(names)})"
            )
        fractions = (np.clip(given, -1.0, 1.0) + 1) / 2
        return [
            signal.low + fraction * (signal.high - signal.low)
            for fraction, signal in zip(fractions.tolist(), self.actions, strict=True)
        ]

    def from_physical(self, values: Sequence[float]) -> np.ndarray:
        """Convert values in physical units to an action scaled from −1 to 1.

        Raises:
            InputError: the number of values is wrong, or a value is outside its range.
        """
        low = lower_bounds(self.actions).astype(float)
        high = upper_bounds(self.actions).astype(float)
        given = as_finite_array(values, low.shape)
        scaled = None if given is None else 2 * (given - low) / (high - low) - 1
        # The tolerance covers rounding errors, also of `to_physical`.
        if scaled is None or (abs(scaled) > 1 + 1e-6).any():
            ranges = [
                f"{each.name} from {each.low:g} to {each.high:g}"
                for each in self.actions
            ]
            raise InputError(
                f"the physical values {abbreviate(values)} are not allowed; give"
                f" {len(ranges)} numbers ({', '.join(ranges)})"
            )
        return np.asarray(scaled, dtype=np.float32)

    @property
    def has_identical_episodes(self) -> bool:
        """Whether all episodes have the same robot and no obstacles."""
        first, second = (
            self._variation.draw(np.random.default_rng(seed)) for seed in range(2)
        )
        return first == second and not self.has_obstacles

    def _twin(
        self,
        spec: RobotSpec,
        last: Episode | None,
        world: World | None = None,
        *,
        base: str = "free",
        supply_pa: float | None = None,
    ) -> TwinSnake:
        solid = world is not None and world.has_obstacles
        if (
            last is not None
            and last.twin.spec == spec
            and not (solid or last.twin.has_contact)
        ):
            return last.twin
        return TwinSnake(
            spec,
            tick=self.step_s,
            world=world,
            base=base,
            supply_pa=supply_pa,
            **self._twin_settings,
        )

    @abstractmethod
    def begin(self, rng: np.random.Generator, last: Episode | None = None) -> Episode:
        """Start an episode.

        Args:
            rng: random number generator for all random values of the episode.
            last: previous episode, whose twin may be reused, or None.

        Raises:
            InputError: the drawn robot or world is invalid.
        """


class Episode(Stateful, ABC):
    """Episode of a task.

    With `save` and `restore`, several continuations can start from the same state.

    Attributes:
        twin: simulated robot.
        state: current state of the twin.
        goal: goal of the episode, or None if the task has no goal position.
        ending: reason why the episode ended, or an empty string while the episode is
            running.
        first: result before the first action, with the first observation and info.
    """

    state_attributes: ClassVar[tuple[str, ...]] = (
        "twin",
        "state",
        "ending",
        "_steps",
        "_last_observation",
    )

    ending = ""
    goal: Goal | None = None

    def __init__(self, task: Task, twin: TwinSnake, state: SnakeState) -> None:
        """Initialise the episode, and compute the first observation.

        Subclasses must set their own attributes before they call this method.
        """
        self.twin = twin
        self.state = state
        self._task = task
        self._rewards = dict.fromkeys(task.weights, 0.0)
        self._bounds = lower_bounds(task.observations), upper_bounds(task.observations)
        self._steps = 0
        self._max_steps = count_steps("limit_s", task.limit_s, "step", task.step_s)
        self._set_first(self._observation())

    def _set_first(self, observation: np.ndarray) -> None:
        self.first = StepResult(observation, 0.0, False, False, self._info())

    def save(self) -> SavedState:
        """Return the current state, from which `restore` can continue the episode."""
        return SavedState(self.identity(), self.state_dict())

    def restore(self, state: SavedState) -> None:
        """Continue from a saved state, and update `first`.

        The state must come from an episode that was started with the same seed.

        Raises:
            InputError: the state belongs to another task, robot or world.
        """
        state.check(f"episode of {self._task.name}", self.identity())
        self.load_state_dict(state.content)
        self._set_first(self._last_observation.copy())

    def set_state(self, snake: SnakeState, yaw_rate: float = 0.0) -> None:
        """Start the episode from a physical state with the given yaw rate, rad/s.

        Raises:
            InputError: the twin cannot start from this state.
        """
        self.state = self.twin.set_state(snake, yaw_rate=yaw_rate, seed=self.twin.seed)
        self._initialise_from_state()
        self._set_first(self._observation())

    def set_goal(self, place: object) -> None:
        """Set the position (x, y) of the goal before the first action, m.

        Raises:
            InputError: the task has no goal position, or the given position is not
                allowed.
        """
        raise InputError(
            f"the option `goal` is not allowed, because the task {self._task.name} has"
            " no goal position; remove it"
        )

    def _initialise_from_state(self) -> None:
        """Reset the attributes that depend on the initial state."""

    def identity(self) -> dict[str, object]:
        """Return the properties that a saved state must match, as JSON values."""
        return {"task": self._task.name, **self.twin.identity()}

    def step(self, action: object) -> StepResult:
        """Clip an action to its bounds, and apply it for one step.

        Args:
            action: one number per action signal of the task, within the bounds of
                `Task.commands`.

        Raises:
            InputError: the shape is wrong, a number is not finite, or the episode is
                over.
        """
        valves = self.command(action)
        try:
            state = self.twin.step(valves)
        except DivergedError as error:
            return self.diverged(error)
        return self.finish_step(state)

    def command(self, action: object) -> np.ndarray:
        """Return the valve states that an action causes in the next step.

        The caller must then step the twin and call `finish_step` or `diverged`.
        """
        if self.ending:
            raise InputError(
                f"the episode is over ({self.ending}); reset the environment to begin"
                " another"
            )
        return self._valves(self._task.to_physical(action))

    def finish_step(self, state: SnakeState) -> StepResult:
        """Complete a step that ended in the given state, and return its result."""
        self.state = state
        self._steps += 1
        values = self._reward_values()
        self._rewards = {
            name: weight * values[name] for name, weight in self._task.weights.items()
        }
        reward = float(sum(self._rewards.values()))
        terminated = bool(self.ending)
        truncated = not terminated and self._steps >= self._max_steps
        if truncated:
            self.ending = TIME_UP
        return StepResult(
            self._observation(), reward, terminated, truncated, self._info()
        )

    def diverged(self, error: DivergedError) -> StepResult:
        """End the episode after the simulation has diverged.

        The result contains the observation of the previous step.
        """
        self._steps += 1
        self.ending = DIVERGED
        info = self._info() | {"error": str(error)}
        return StepResult(self._last_observation.copy(), 0.0, True, False, info)

    def _observation(self) -> np.ndarray:
        low, high = self._bounds
        measured = self._task.select(self._measure())
        observation: np.ndarray = np.minimum(np.maximum(measured, low), high)
        self._last_observation = observation
        return observation

    @abstractmethod
    def _valves(self, action: list[float]) -> np.ndarray:
        """Return the valve states for an action in physical units."""

    @abstractmethod
    def _measure(self) -> Mapping[str, Sequence[float]]:
        """Return the measured values, keyed by observation group.

        This method must be called once per step, because it draws measurement noise.
        """

    @abstractmethod
    def _reward_values(self) -> dict[str, float]:
        """Return the unweighted value of each reward term in the last step.

        This method also sets `ending` if the episode has terminated.
        """

    def _info(self) -> dict[str, object]:
        return {
            "time_s": float(self.state.time),
            "air_j": float(self.state.pneumatic_energy),
            "ending": self.ending,
            **{f"reward_{name}": value for name, value in self._rewards.items()},
        }
