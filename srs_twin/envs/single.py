"""SnakeEnv: gymnasium's face of a task."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

from srs_twin.envs.pictures import Pictures
from srs_twin.envs.signals import Signals, high, low
from srs_twin.envs.task import Episode
from srs_twin.envs.tasks import make_task
from srs_twin.errors import InputError, UnknownNameError

RENDER_MODES = ("rgb_array",)
FPS = 10


class SnakeEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A task for one agent; `gymnasium.make("srs_twin.envs:SRSTwin/GoTo-v0")` makes it.

    Actions and observations are boxes of float32, one number for each of the task's signals. The time limit
    is the task's own, so that `truncated` comes from here and no wrapper is needed.

    Attributes:
        task: what is to be done, with its tables of signals.
        episode: the one that runs; None before the first `reset`.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": list(RENDER_MODES), "render_fps": FPS}  # type: ignore[misc]

    def __init__(
        self,
        task: str,
        *,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        **settings: Any,
    ) -> None:
        """Make the environment.

        Args:
            task: "GoTo", "Obstacles" or "Module".
            render_mode: "rgb_array": pictures, without a screen; None: no pictures.
            width: of pictures, pixels.
            height: of pictures, pixels.
            **settings: of the task, as `CrawlTask` and `ModuleTask` take them.

        Raises:
            UnknownNameError: another task or render mode.
            InputError: as the task raises it.
        """
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise UnknownNameError("render mode", render_mode, RENDER_MODES)
        self.render_mode = render_mode
        self.task = make_task(task, **settings)
        self.metadata = {**self.metadata, "render_fps": round(1 / self.task.step_s)}  # type: ignore[misc]
        self.action_space = space_of(self.task.actions)
        self.observation_space = space_of(self.task.observations)
        self.episode: Episode | None = None
        self._pictures = Pictures(width, height)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; all that is random in it comes from `np_random`, which `seed` sets.

        Raises:
            InputError: options; there are none.
        """
        super().reset(seed=seed)
        if options:
            raise InputError(f"reset takes no options; given: {', '.join(options)}")
        self.episode = self.task.begin(self.np_random, self.episode)
        return self.episode.first.observation, self.episode.first.info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Let an action hold for a step of the task.

        Raises:
            InputError: before the first `reset`, after the end, or an action of another shape.
        """
        done = self._running().step(action)
        return done.observation, done.reward, done.terminated, done.truncated, done.info

    def render(self) -> np.ndarray | None:
        """Return a picture, shape (height, width, 3), bytes; None without a render mode.

        Raises:
            InputError: before the first `reset`, or no OpenGL draws here without a screen.
        """
        return None if self.render_mode is None else self._pictures.of(self._running())

    def close(self) -> None:
        """Give back what pictures have taken."""
        self._pictures.close()

    def _running(self) -> Episode:
        if self.episode is None:
            raise InputError("no episode has begun; reset the environment first")
        return self.episode


def space_of(signals: Signals) -> spaces.Box:
    """Return the box of some signals."""
    return spaces.Box(low(signals), high(signals), dtype=np.float32)
