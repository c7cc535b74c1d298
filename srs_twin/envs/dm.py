"""dm_env interface of the tasks, based on `dm_control.rl.control.Environment`."""

from __future__ import annotations

from collections import OrderedDict
from typing import Unpack

import numpy as np

from srs_twin.compute.claims import Claimable
from srs_twin.envs.crawling import AnyTaskKeywords
from srs_twin.envs.rendering import EpisodeRenderer
from srs_twin.envs.task import (
    Episode,
    Signals,
    StepResult,
    Task,
    check_seed,
    lower_bounds,
    upper_bounds,
)
from srs_twin.envs.tasks import make_task
from srs_twin.errors import InputError
from srs_twin.plants.twin.physics import SnakePhysics

try:
    from dm_control.rl import control
    from dm_env import specs
except ImportError as error:
    raise InputError(
        "srs_twin.envs.dm needs dm-control, which is not installed. On Python 3.13 and"
        " later, dm-control cannot be installed, because labmaze has no wheels for"
        " them. Use the tasks through Gymnasium (docs/environments.md), or use Python"
        " 3.11 or 3.12 with `pip install dm-control`."
    ) from error


class EpisodePhysics(Claimable, control.Physics):  # type: ignore[misc]  # dm_control has no types
    """dm_control physics that runs the episodes of a task.

    One step of the physics corresponds to one step of the task.

    Attributes:
        episode: current episode, or None before the first reset.
        result: observation, reward and ending of the last step.
    """

    episode: Episode | None = None
    result: StepResult

    def __init__(self, task: Task, rng: np.random.Generator) -> None:
        self._task = task
        self._rng = rng
        self._renderer: EpisodeRenderer | None = None

    @property
    def twin(self) -> SnakePhysics:
        """Physics of the twin, with the MuJoCo model and data."""
        assert self.episode is not None, "reset first"
        return self.episode.twin.physics

    def render(self, height: int = 240, width: int = 320) -> np.ndarray:
        """Return an image of the episode as a uint8 array, shape (height, width, 3).

        Raises:
            InputError: OpenGL cannot render without a display on this machine.
        """
        assert self.episode is not None, "reset first"
        if self._renderer is None or self._renderer.size != (width, height):
            self._renderer = EpisodeRenderer(width, height)
        return self._renderer.render(self.episode)

    def reset(self) -> None:
        """Start a new episode."""
        self.episode = self._task.begin(self._rng, self.episode)
        self.result = self.episode.first

    def after_reset(self) -> None:
        """Do nothing after a reset."""

    def set_control(self, control: np.ndarray) -> None:
        """Store the action that the next step applies."""
        self._action = control

    def step(self, n_sub_steps: int = 1) -> None:
        """Apply the stored action for `n_sub_steps` steps of the task."""
        assert self.episode is not None, "reset first"
        for _ in range(n_sub_steps):
            self.result = self.episode.step(self._action)

    def time(self) -> float:
        """Return the time since the start of the episode, s."""
        if self.episode is None:
            return 0.0
        return float(self.episode.state.time)

    def timestep(self) -> float:
        """Return the duration of a task step, s."""
        return self._task.step_s


class DmTask(control.Task):  # type: ignore[misc]  # dm_control has no types
    """Adapter that presents a task as a dm_control task."""

    def __init__(self, task: Task) -> None:
        self.task = task

    def initialize_episode(self, physics: EpisodePhysics) -> None:
        """Do nothing, because the physics has already started the episode."""

    def before_step(self, action: np.ndarray, physics: EpisodePhysics) -> None:
        """Pass the action to the physics."""
        physics.set_control(action)

    def action_spec(self, physics: EpisodePhysics) -> specs.BoundedArray:
        """Return the shape and the bounds of the actions.

        The name of the returned spec contains the signal names, separated by tabs.
        """
        return _spec(self.task.commands)

    def observation_spec(
        self, physics: EpisodePhysics
    ) -> OrderedDict[str, specs.BoundedArray]:
        """Return the bounds of each observation, keyed by signal name."""
        return OrderedDict(
            (signal.name, _spec((signal,))) for signal in self.task.observations
        )

    def get_observation(self, physics: EpisodePhysics) -> OrderedDict[str, np.ndarray]:
        """Return each observation as an array of shape (1,), keyed by signal name."""
        names = [signal.name for signal in self.task.observations]
        return OrderedDict(zip(names, physics.result.observation[:, None], strict=True))

    def get_reward(self, physics: EpisodePhysics) -> float:
        """Return the reward of the last step."""
        return physics.result.reward

    def get_termination(self, physics: EpisodePhysics) -> float | None:
        """Return the final discount, or None while the episode is running.

        The discount is 0 if the episode terminated and 1 if it was truncated.
        """
        if physics.result.terminated:
            return 0.0
        if physics.result.truncated:
            return 1.0
        return None


class SnakeEnvironment(Claimable, control.Environment):  # type: ignore[misc]  # dm_control has no types
    """dm_env environment of a task."""


def load(
    task: str, *, seed: int | None = None, **settings: Unpack[AnyTaskKeywords]
) -> SnakeEnvironment:
    """Create the dm_env environment of a task.

    Args:
        task: name of the task, one of `TASKS`.
        seed: random seed of the episodes. If None, every call uses a different seed.
        **settings: settings of the task, as in `make_task`.

    Raises:
        UnknownNameError: the task does not exist.
        InputError: a setting is invalid.
    """
    check_seed(seed)
    instance = make_task(task, **settings)
    return SnakeEnvironment(
        EpisodePhysics(instance, np.random.default_rng(seed)), DmTask(instance)
    )


def _spec(signals: Signals) -> specs.BoundedArray:
    low = lower_bounds(signals)
    names = "\t".join(signal.name for signal in signals)
    return specs.BoundedArray(low.shape, np.float32, low, upper_bounds(signals), names)
