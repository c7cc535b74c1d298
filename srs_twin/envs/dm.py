"""dm_env's face of a task, through `dm_control.rl.control.Environment`."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import numpy as np
from dm_control.rl import control
from dm_env import specs

from srs_twin.envs.task import Episode, Signal, StepResult, Task, check_seed, high, low
from srs_twin.envs.tasks import make_task
from srs_twin.io.saved_state import DeepCopied
from srs_twin.plants.twin.physics import dm as dm_mujoco


class EpisodePhysics(DeepCopied, control.Physics):
    """Episodes of a task as dm_control steps them; one step is one of the task's.

    Attributes:
        episode: the one that runs.
        result: of the last step.
    """

    episode: Episode | None = None
    result: StepResult

    def __init__(self, task: Task, rng: np.random.Generator) -> None:
        """Prepare for episodes that are drawn from `rng`."""
        self._task, self._rng = task, rng

    @property
    def twin(self) -> dm_mujoco.Physics:
        """The twin's own physics, with bodies, joints and `render`."""
        assert self.episode is not None, "reset first"
        return self.episode.twin.physics

    def reset(self) -> None:
        """Begin an episode."""
        self.episode = self._task.begin(self._rng, self.episode)
        self.result = self.episode.first

    def after_reset(self) -> None:
        """Nothing is left to do."""

    def set_control(self, control: np.ndarray) -> None:
        """Take the action of the coming step."""
        self._action = control

    def step(self, n_sub_steps: int = 1) -> None:
        """Let the action hold for that many steps of the task."""
        assert self.episode is not None, "reset first"
        for _ in range(n_sub_steps):
            self.result = self.episode.step(self._action)

    def time(self) -> float:
        """Return the time of the episode, s."""
        return 0.0 if self.episode is None else float(self.episode.state.time)

    def timestep(self) -> float:
        """Return how long an action holds, s."""
        return self._task.step_s


class DmTask(control.Task):
    """A task as dm_control asks for it."""

    def __init__(self, task: Task) -> None:
        """Take a task."""
        self.task = task

    def initialize_episode(self, physics: EpisodePhysics) -> None:
        """Nothing is left to do: the physics has drawn the episode."""

    def before_step(self, action: np.ndarray, physics: EpisodePhysics) -> None:
        """Hand an action on."""
        physics.set_control(action)

    def action_spec(self, physics: EpisodePhysics) -> specs.BoundedArray:
        """Return shape and bounds of actions; the name lists them."""
        actions = self.task.actions
        names = "\t".join(each.name for each in actions)
        return specs.BoundedArray((len(actions),), np.float32, low(actions), high(actions), names)

    def observation_spec(self, physics: EpisodePhysics) -> OrderedDict[str, specs.BoundedArray]:
        """Return bounds of the observations, each by its name."""
        return OrderedDict((each.name, _spec(each)) for each in self.task.observations)

    def get_observation(self, physics: EpisodePhysics) -> OrderedDict[str, np.ndarray]:
        """Return the observations, each by its name, shape (1,)."""
        names = [each.name for each in self.task.observations]
        return OrderedDict(zip(names, physics.result.observation[:, None], strict=True))

    def get_reward(self, physics: EpisodePhysics) -> float:
        """Return the reward of the last step."""
        return physics.result.reward

    def get_termination(self, physics: EpisodePhysics) -> float | None:
        """Return the discount at the end: 0 at the task's own end, 1 where the time is up; else None."""
        if physics.result.terminated:
            return 0.0
        return 1.0 if physics.result.truncated else None


class SnakeEnvironment(DeepCopied, control.Environment):
    """A dm_env environment whose copies share no state with it."""


def load(task: str, *, seed: int | None = None, **settings: Any) -> SnakeEnvironment:
    """Return a task as a dm_env.

    Args:
        task: "GoTo", "Obstacles" or "Module".
        seed: of the episodes; None: another every time.
        **settings: of the task, as `CrawlTask` and `ModuleTask` take them.

    Raises:
        UnknownNameError: another task.
        InputError: as the task raises it.
    """
    check_seed(seed)
    made = make_task(task, **settings)
    return SnakeEnvironment(EpisodePhysics(made, np.random.default_rng(seed)), DmTask(made))


def _spec(signal: Signal) -> specs.BoundedArray:
    return specs.BoundedArray((1,), np.float32, low((signal,)), high((signal,)), signal.name)
