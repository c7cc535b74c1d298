"""Single and vectorised Gymnasium environments of the tasks.

A `SnakeVectorEnv` contains `SnakeEnv` environments, which threads step in parallel.
Threads are efficient, because each step spends nearly all computing time in one engine
call that releases Python's global interpreter lock. The results of an environment do
not depend on the number of environments.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, Unpack

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import SyncVectorEnv

from srs_twin.compute.claims import Claimable
from srs_twin.compute.workers import Workers
from srs_twin.envs.crawling import AnyTaskKeywords
from srs_twin.envs.rendering import EpisodeRenderer
from srs_twin.envs.task import (
    Episode,
    Signals,
    StepResult,
    abbreviate,
    as_finite_array,
    check_names,
    check_seed,
    lower_bounds,
    upper_bounds,
)
from srs_twin.envs.tasks import make_task
from srs_twin.errors import EngineWarning, InputError, UnknownNameError, check_choice
from srs_twin.io.saved_state import SavedState
from srs_twin.plants.base import SnakeState
from srs_twin.plants.twin.batch import ENGINES, warp_batch

RENDER_MODES = ("rgb_array",)
FPS = 10
"""Frame rate in the class metadata, which instances replace by one frame per step, 1/s.
"""


class SnakeEnv(Claimable, gymnasium.Env[np.ndarray, np.ndarray]):
    """Gymnasium environment of a task.

    Create an environment with `gymnasium.make("srs_twin.envs:SRSTwin/GoTo-v0")`. The
    action and observation spaces are float32 boxes with one number per signal of the
    task. The environment truncates episodes at the time limit of the task, so no
    `TimeLimit` wrapper is needed.

    Attributes:
        task: task that defines the observations, actions and rewards.
        episode: current episode, or None before the first `reset`.
    """

    metadata: ClassVar[dict[str, object]] = {  # type: ignore[misc]
        "render_modes": list(RENDER_MODES),
        "render_fps": FPS,
    }

    def __init__(
        self,
        task: str,
        *,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        **settings: Unpack[AnyTaskKeywords],
    ) -> None:
        """Create the environment.

        Args:
            task: name of the task, one of `TASKS`.
            render_mode: "rgb_array" to render images without a display, or None to
                render no images.
            width: image width, pixels.
            height: image height, pixels.
            **settings: settings of the task, as in `make_task`.

        Raises:
            UnknownNameError: the task or render mode does not exist.
            InputError: a setting is invalid.
        """
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise UnknownNameError("render mode", render_mode, RENDER_MODES)
        self.render_mode = render_mode
        self.task = make_task(task, **settings)
        self.metadata = {**self.metadata, "render_fps": round(1 / self.task.step_s)}  # type: ignore[misc]
        self.action_space = space_of(self.task.commands)
        self.observation_space = space_of(self.task.observations)
        self.episode: Episode | None = None
        self._renderer = EpisodeRenderer(width, height)

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[np.ndarray, dict[str, object]]:
        """Start an episode.

        Args:
            seed: random seed of `np_random`. If None, the current random number
                generator is used.
            options: initial state and goal of the episode. The option `state` is a
                state that `episode.save()` returned in an episode with the same seed.
                Alternatively, the options `snake` and `yaw_rate` (rad/s) set the
                initial physical state. The option `goal` is the position (x, y) of the
                goal, m.

        Raises:
            UnknownNameError: an option does not exist.
            InputError: the saved state does not belong to the episode, or a value is
                not allowed. If an error is raised, the environment is unchanged.
        """
        seed = check_seed(seed)
        return self.start_episode(seed, self.draw_episode(seed, options))

    def draw_episode(
        self, seed: int | None, options: dict[str, object] | None
    ) -> tuple[np.random.Generator, Episode]:
        """Draw an episode, and return the random number generator and the episode.

        The environment does not change until `start_episode` is called.

        Raises:
            UnknownNameError: an option does not exist.
            InputError: an option has an invalid value.
        """
        checked = _checked_options(options)
        if seed is None:
            rng = copy.deepcopy(self.np_random)
        else:
            rng = seeding.np_random(seed)[0]
        # Options may be invalid, so the twin of the current episode is not reused when
        # options are given.
        episode = self.task.begin(rng, None if checked else self.episode)
        if "snake" in checked:
            episode.set_state(checked["snake"], checked.get("yaw_rate", 0.0))
        if "goal" in checked:
            episode.set_goal(checked["goal"])
        if "state" in checked:
            episode.restore(checked["state"])
        return rng, episode

    def start_episode(
        self, seed: int | None, drawn: tuple[np.random.Generator, Episode]
    ) -> tuple[np.ndarray, dict[str, object]]:
        """Start a drawn episode, and return its first observation and info.

        `seed` must be the seed that was passed to `draw_episode`.
        """
        super().reset(seed=seed)
        rng, self.episode = drawn
        self.np_random.bit_generator.state = rng.bit_generator.state
        return self.episode.first.observation, self.episode.first.info

    def step(self, action: np.ndarray) -> StepResult:
        """Apply an action for one step of the task.

        Raises:
            InputError: no episode is running, or the action is invalid.
        """
        return self.current_episode().step(action)

    def render(self) -> np.ndarray | None:
        """Return an image as a uint8 array of shape (height, width, 3).

        The result is None if no render mode is set.

        Raises:
            InputError: no episode has started, or OpenGL cannot render without a
                display on this machine.
        """
        if self.render_mode is None:
            return None
        return self._renderer.render(self.current_episode())

    def close(self) -> None:
        """Release the OpenGL context of the renderer."""
        self._renderer.close()

    def current_episode(self) -> Episode:
        """Return the current episode.

        Raises:
            InputError: no episode has started.
        """
        if self.episode is None:
            raise InputError("no episode is running; reset the environment first")
        return self.episode


_RESET_OPTIONS = ("state", "snake", "yaw_rate", "goal")
_OPTION_TYPES = {
    "state": (SavedState, "a SavedState, which episode.save() returns"),
    "snake": (SnakeState, "a SnakeState, such as plant.state"),
}
"""Required types of reset options, with descriptions for error messages."""


def _checked_options(options: object) -> dict[str, Any]:
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise InputError(
            f"the reset options {abbreviate(options)} are not allowed; give a dict"
            f" with keys from {', '.join(_RESET_OPTIONS)}"
        )
    check_names("option of reset", options, _RESET_OPTIONS)
    for name, (expected_type, expected) in _OPTION_TYPES.items():
        if name in options and not isinstance(options[name], expected_type):
            raise InputError(
                f"the option `{name}` {abbreviate(options[name])} is not allowed; give"
                f" {expected}"
            )
    if "state" in options and not {"state", "goal"}.issuperset(options):
        raise InputError(
            "the options `snake` and `yaw_rate` are not allowed together with the"
            " option `state`; remove `state`, or remove the other two"
        )
    if "yaw_rate" in options and "snake" not in options:
        raise InputError("the option `yaw_rate` needs the option `snake`; give both")
    return dict(options)


class EnvKeywords(AnyTaskKeywords, total=False):
    """Optional keyword arguments of `SnakeEnv`."""

    render_mode: str | None
    width: int
    height: int


def space_of(signals: Signals) -> spaces.Box:
    """Return a box space with the bounds of the signals."""
    return spaces.Box(lower_bounds(signals), upper_bounds(signals), dtype=np.float32)


class SnakeVectorEnv(Claimable, SyncVectorEnv[np.ndarray, np.ndarray]):
    """Vector environment that steps several environments of one task in parallel.

    Create a vector environment with
    `gymnasium.make_vec("srs_twin.envs:SRSTwin/GoTo-v0", num_envs=64)`. After the end of
    an episode, the environment ignores its next action and starts a new episode, as in
    Gymnasium's default `AutoresetMode.NEXT_STEP`.

    Attributes:
        envs: individual environments.
    """

    envs: list[SnakeEnv]  # type: ignore[assignment]

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        threads: int | None = None,
        engine: str = "cpu",
        device: str | None = None,
        **settings: Unpack[EnvKeywords],
    ) -> None:
        """Create the environments.

        Args:
            task: name of the task, one of `TASKS`.
            num_envs: number of environments.
            threads: number of threads, by default one per processor.
            engine: "cpu", or "warp" to step all twins together in MuJoCo Warp. Warp
                requires that all episodes have the same robot and no obstacles.
                Otherwise, an `EngineWarning` is issued and the CPU is used.
            device: device on which Warp runs. If None, Warp selects a device.
            **settings: further arguments of `SnakeEnv`.

        Raises:
            InputError: `num_envs` is less than 1, or a setting is invalid.
        """
        if num_envs < 1:
            raise InputError(
                f"`num_envs` {num_envs} is not allowed; it must be 1 or more"
            )
        super().__init__([partial(SnakeEnv, task, **settings)] * num_envs)
        check_choice("engine", engine, ENGINES)
        self._batch_class: Any = warp_batch() if engine == "warp" else None
        self._device = device
        self._batch: Any = None
        self._workers = Workers(threads)
        self._ended = np.zeros(num_envs, dtype=bool)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, object] | None = None,
    ) -> tuple[np.ndarray, dict[str, object]]:
        """Start an episode in every environment.

        Args:
            seed: one seed per environment, or a single seed s. With a single seed, the
                environments use the seeds s, s + 1 and so on.
            options: options of `SnakeEnv.reset`, which apply to all environments.

        Raises:
            InputError: a seed or an option is invalid, or the number of seeds is wrong.
                If an error is raised, all environments are unchanged.
        """
        if np.iterable(seed):
            seeds = [check_seed(env_seed) for env_seed in seed]
        else:
            first = check_seed(seed)
            seeds = [None if first is None else first + k for k in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise InputError(
                f"{len(seeds)} seeds are given for {self.num_envs} environments; give"
                " one seed for each environment"
            )
        episodes = self._workers.run(
            self.num_envs, lambda k, _: self.envs[k].draw_episode(seeds[k], options)
        )
        starts = [
            env.start_episode(env_seed, episode)
            for env, env_seed, episode in zip(self.envs, seeds, episodes, strict=True)
        ]
        self._ended = np.zeros(self.num_envs, dtype=bool)
        if self._batch_class is not None:
            self._move_to_device()
        observations = np.stack([observation for observation, _ in starts])
        return observations, self._merge_infos(info for _, info in starts)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, object]]:
        """Step all environments.

        Args:
            actions: one action per environment, shape (environments, signals).

        Raises:
            InputError: the shape is wrong, or a value is not finite. If an error is
                raised, no environment is stepped.
        """
        shape = self.action_space.shape
        assert shape is not None, "a box has a shape"
        checked = as_finite_array(actions, shape)
        if checked is None:
            raise InputError(
                f"the actions {abbreviate(actions)} are not allowed; give finite"
                f" numbers of shape {shape}, one action for each of {self.num_envs}"
                " environments"
            )
        if self._batch is not None:
            results = self._step_on_device(checked)
        else:
            results = self._workers.run(
                self.num_envs, lambda k, _: self._step_or_reset(k, checked[k])
            )
        *columns, infos = zip(*results, strict=True)
        observations, rewards, terminated, truncated = map(np.array, columns)
        self._ended = terminated | truncated
        return observations, rewards, terminated, truncated, self._merge_infos(infos)

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """Return an image of each environment, or None if no render mode is set."""
        images = (env.render() for env in self.envs)
        return tuple(image for image in images if image is not None) or None

    def _move_to_device(self) -> None:
        twins = [env.episode.twin for env in self.envs if env.episode is not None]
        try:
            if not self.envs[0].task.has_identical_episodes:
                raise InputError(
                    "the episodes have different robots or obstacles, but this engine"
                    " needs one robot and no obstacles"
                )
            if self._batch is None or any(
                a is not b for a, b in zip(self._batch.twins, twins, strict=True)
            ):
                self._batch = self._batch_class(twins, device=self._device)
        except InputError as error:
            warnings.warn(
                f"the environments run on the CPU: {error}", EngineWarning, stacklevel=3
            )
            self._batch_class = self._batch = None
            return
        self._reset_device_poses(range(self.num_envs))

    def _reset_device_poses(self, environments: Sequence[int]) -> None:
        states = [self.envs[k].current_episode().state for k in environments]
        self._batch.reset(
            poses=[(*s.com, float(s.heading)) for s in states],
            worlds=list(environments),
        )

    def _step_on_device(self, actions: np.ndarray) -> list[StepResult]:
        batch = self._batch
        ended = np.flatnonzero(self._ended).tolist()
        results = {k: self._begin_next(k) for k in ended}
        running = [k for k in range(self.num_envs) if k not in results]
        vented = np.full(
            (self.envs[0].current_episode().twin.spec.segments, 2), -1, dtype=np.int8
        )
        valves = [vented] * self.num_envs
        for k in running:
            valves[k] = self.envs[k].current_episode().command(actions[k])
        batch.update_supply_pressure()
        # Constant valve states are broadcast to the shape of valve states that change
        # within a step.
        batch.step(np.stack(np.broadcast_arrays(*valves, vented[None])[:-1]))
        for k in running:
            episode = self.envs[k].current_episode()
            error = batch.errors[k]
            if error is None:
                results[k] = episode.finish_step(batch.state.at(k))
            else:
                results[k] = episode.diverged(error)
        if ended:
            self._reset_device_poses(ended)
        return [results[k] for k in range(self.num_envs)]

    def _step_or_reset(self, k: int, action: np.ndarray) -> StepResult:
        if self._ended[k]:
            return self._begin_next(k)
        return self.envs[k].step(action)

    def _begin_next(self, k: int) -> StepResult:
        self.envs[k].reset()
        return self.envs[k].current_episode().first

    def _merge_infos(self, infos: Iterable[dict[str, object]]) -> dict[str, object]:
        merged: dict[str, object] = {}
        for k, info in enumerate(infos):
            merged = self._add_info(merged, info, k)
        return merged
