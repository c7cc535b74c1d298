"""Task: what an agent is to do, told once for gymnasium and dm_env. Episode: one try of it on a twin.

An agent gives an action and gets an observation every `step_s`. Observations hold what sensors and a camera
tell, noise included; reward and `info` may know more. An episode ends where there is nothing more to win
(`terminated`) or at the time limit (`truncated`), which is not the task's doing.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from inspect import signature
from typing import Any

import numpy as np

from srs_twin.envs.signals import Signals, high, low, taken
from srs_twin.errors import DivergedError, InputError, UnknownNameError, whole_steps
from srs_twin.plants.base import SnakeState
from srs_twin.plants.twin import TwinSnake
from srs_twin.world import Goal

_TASKS_OWN = {"spec", "tick", "supply_pa", "base", "world"}

TIME_UP = "time_up"
DIVERGED = "diverged"


@dataclass(frozen=True)
class Outcome:
    """What an agent is told after a step.

    Attributes:
        observation: float32, within the bounds of the task's observations.
        reward: of this step; 0 for the first outcome of an episode.
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
    """

    name: str
    actions: Signals
    observations: Signals
    step_s: float
    limit_s: float

    @abstractmethod
    def begin(self, rng: np.random.Generator, last: Episode | None = None) -> Episode:
        """Begin an episode; all that is random in it comes from `rng`.

        Args:
            rng: which episode.
            last: an episode that is over: its twin is used again where it is the same.

        Raises:
            InputError: what was drawn cannot be.
        """


def twin_settings(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings that go on to `TwinSnake`; a task sets some of its arguments itself.

    Raises:
        UnknownNameError: one that it does not take.
    """
    allowed = set(signature(TwinSnake).parameters) - _TASKS_OWN
    for name in given:
        if name not in allowed:
            raise UnknownNameError("setting of the task or its twin", name, allowed)
    return dict(given)


class Episode(ABC):
    """One try.

    Attributes:
        twin: what moves.
        state: of it, now.
        goal: where to get to; None where there is no such place.
        ending: why it ended, empty while it goes on.
        first: what the agent is told before its first action.
    """

    ending = ""
    goal: Goal | None = None

    def __init__(self, task: Task, twin: TwinSnake, state: SnakeState) -> None:
        """Begin; a subclass sets up what it needs first, for this asks for the first observation."""
        self.twin, self.state = twin, state
        self._task = task
        self._bounds = low(task.observations), high(task.observations)
        self._steps, self._most = 0, whole_steps("limit_s", task.limit_s, "step", task.step_s)
        self.first = Outcome(self._told(), 0.0, False, False, self._info())

    def step(self, action: object) -> Outcome:
        """Let an action hold for a step; one beyond its bounds is brought to them.

        Args:
            action: one number for each of the task's actions.

        Raises:
            InputError: another shape, numbers that are not finite, or the episode is over.
        """
        if self.ending:
            raise InputError(f"the episode is over ({self.ending}); reset the environment to begin another")
        valves = self._valves(taken(self._task.actions, action))
        self._steps += 1
        try:
            self.state = self.twin.step(valves)
        except DivergedError as error:
            # The state is still that of the step before, which sensors and camera have seen already.
            self.ending = DIVERGED
            return Outcome(self._seen.copy(), 0.0, True, False, self._info() | {"error": str(error)})
        reward = self._judge()
        terminated = bool(self.ending)
        truncated = not terminated and self._steps >= self._most
        if truncated:
            self.ending = TIME_UP
        return Outcome(self._told(), reward, terminated, truncated, self._info())

    def _told(self) -> np.ndarray:
        """Return the observation: float32, within its bounds."""
        least, most = self._bounds
        self._seen: np.ndarray = np.minimum(
            np.maximum(np.array(self._observed(), dtype=np.float32), least), most
        )
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

    @abstractmethod
    def _info(self) -> dict[str, Any]:
        """Return what people want to know; units in the keys."""
