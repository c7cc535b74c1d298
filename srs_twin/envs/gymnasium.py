"""Environments of gymnasium: one task, or many of one kind stepped together over threads.

Each environment of a `SnakeVectorEnv` is a `SnakeEnv` and gives what it gives alone, bit for bit. Threads
take whole environments, as in `TwinBatch`: nearly all the time of a step is one engine call, which releases
the interpreter's lock. Pictures show the twin coloured by pressure, its obstacles and its goal as a ring, as
`srs-twin render` draws them; no screen is needed.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import SyncVectorEnv

from srs_twin.compute.workers import Workers
from srs_twin.envs.task import Episode, Signals, check_seed, checked_options, finite, high, low, shortened
from srs_twin.envs.tasks import make_task
from srs_twin.errors import EngineWarning, InputError, UnknownNameError, one_of
from srs_twin.io.saved_state import CopiedWhole
from srs_twin.plants.twin.batch import ENGINES, warp_batch

_GOAL_LINE = 0.003  # half of its width over the camera's distance
_ELEVATION, _LENGTHS, _APART = -65.0, 4.0, 1.7


class Pictures:
    """Draws episodes one after the other; OpenGL is asked for with the first picture."""

    def __init__(self, width: int, height: int) -> None:
        """Prepare for pictures of so many pixels."""
        self._size = width, height
        self._canvas: Any = None
        self._model: mujoco.MjModel | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return Pictures, self._size  # a copy asks for OpenGL itself

    def of(self, episode: Episode) -> np.ndarray:
        """Return a picture of now, shape (height, width, 3), bytes.

        Raises:
            InputError: no OpenGL draws here without a screen.
        """
        from srs_twin.viewing.mujoco.canvas import Canvas
        from srs_twin.viewing.mujoco.stage import Skins

        physics = episode.twin.physics
        model, data = physics.model.ptr, physics.data.ptr
        if model is not self._model:
            self.close()
            self._canvas, self._model = Canvas(model, *self._size), model
            self._skins = Skins(model, episode.twin.spec.segments)
        self._skins.show(episode.state.pressure, episode.twin.spec.supply.nominal)
        mujoco.mj_camlight(model, data)
        camera = _camera(episode)
        picture: np.ndarray = self._canvas.draw(
            data, camera, lambda scene: _add_goal(scene, episode, camera.distance)
        )
        return picture

    def close(self) -> None:
        """Give OpenGL's memory back."""
        if self._canvas is not None:
            self._canvas.__exit__(None, None, None)
            self._canvas = self._model = None


def _camera(episode: Episode) -> mujoco.MjvCamera:
    """Look down on the snake, and on the goal where there is one, from a distance that shows both."""
    camera, middle = mujoco.MjvCamera(), episode.twin.physics.center_of_mass()
    camera.elevation, camera.azimuth = _ELEVATION, 90.0
    camera.distance = _LENGTHS * episode.twin.spec.geometry.body_length
    if episode.goal is not None:
        way = np.array([episode.goal.x, episode.goal.y]) - middle[:2]
        middle[:2] += way / 2
        camera.distance = max(camera.distance, _APART * float(np.hypot(*way)))
    camera.lookat = middle
    return camera


def _add_goal(scene: mujoco.MjvScene, episode: Episode, distance: float) -> None:
    """Lay the edge of the goal on the floor, seen from a distance in m."""
    from srs_twin.planning.pictures import goal_ring
    from srs_twin.viewing.mujoco.stage import add_line
    from srs_twin.viewing.plots.style import GOAL_COLOR

    if episode.goal is not None:
        ring = goal_ring({key: getattr(episode.goal, key) for key in ("x", "y", "radius")})
        add_line(scene, ring, GOAL_COLOR, _GOAL_LINE * distance)


RENDER_MODES = ("rgb_array",)
FPS = 10


class SnakeEnv(CopiedWhole, gymnasium.Env[np.ndarray, np.ndarray]):
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

        Args:
            seed: of what is drawn.
            options: `state`: what `episode.save()` gave in an episode of the same seed, to go on from; or
                `snake`: a physical state to begin from, with `yaw_rate` (rad/s).

        Raises:
            UnknownNameError: another option.
            InputError: a state that does not belong to this episode, or a value that is not allowed; the
                environment is then as it was before.
        """
        return self.take(seed, self.draw(seed, options))

    def draw(self, seed: int | None, options: dict[str, Any] | None) -> tuple[np.random.Generator, Episode]:
        """Return an episode to begin and the generator that it was drawn from; raises as `reset`."""
        check_seed(seed)
        given = checked_options(options)
        rng = copy.deepcopy(self.np_random) if seed is None else seeding.np_random(seed)[0]
        # With options something may be refused: the twin of the last episode is left alone until then.
        episode = self.task.begin(rng, None if given else self.episode)
        if "state" in given:
            episode.go_on(given["state"])
        elif "snake" in given:
            episode.place(given["snake"], given.get("yaw_rate", 0.0))
        return rng, episode

    def take(
        self, seed: int | None, drawn: tuple[np.random.Generator, Episode]
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode that `draw` returned for this seed; return its first observation and info."""
        super().reset(seed=seed)
        rng, self.episode = drawn
        self.np_random.bit_generator.state = rng.bit_generator.state
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


StepTuple = tuple[np.ndarray, float, bool, bool, dict[str, Any]]


class SnakeVectorEnv(CopiedWhole, SyncVectorEnv[np.ndarray, np.ndarray]):
    """Environments of one task: `gymnasium.make_vec("srs_twin.envs:SRSTwin/GoTo-v0", num_envs=64)`.

    An environment whose episode has ended begins another with the next step, whatever its action
    (`AutoresetMode.NEXT_STEP`, as gymnasium's own vectors do by default).

    Attributes:
        envs: each one.
    """

    envs: list[SnakeEnv]  # type: ignore[assignment]

    def __init__(
        self, task: str, num_envs: int = 1, *, threads: int | None = None, engine: str = "cpu",
        device: str | None = None, **settings: Any,
    ) -> None:  # fmt: skip
        """Make the environments.

        Args:
            task: "GoTo", "Obstacles" or "Module".
            num_envs: how many.
            threads: how many; default one a processor.
            engine: "cpu", or "warp": all twins on a device, where all episodes have one robot and one
                surroundings; on the processor, with a warning, where they have not.
            device: of Warp; None: its preferred one.
            **settings: as in `SnakeEnv`, its render mode and pixels too.

        Raises:
            InputError: no environment at all, or as `SnakeEnv` raises it.
        """
        if num_envs < 1:
            raise InputError(f"num_envs {num_envs} is not allowed; it must be 1 or more")
        super().__init__([partial(SnakeEnv, task, **settings)] * num_envs)
        one_of("engine", engine, ENGINES)
        self._kind: Any = warp_batch() if engine == "warp" else None
        self._device = device
        self._batch: Any = None
        self._workers = Workers(threads)
        self._over = np.zeros(num_envs, dtype=bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode everywhere.

        Args:
            seed: of each environment; of one number s they are s, s + 1, …
            options: of all, as `SnakeEnv.reset` takes them.

        Raises:
            InputError: not one seed an environment, or as `SnakeEnv.reset` raises it; all environments are
                then as they were before.
        """
        if np.iterable(seed):
            seeds = list(seed)
        else:
            check_seed(seed)
            seeds = [None if seed is None else int(seed) + k for k in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise InputError(f"seed: {len(seeds)} were given for {self.num_envs} environments; give one each")
        for each in seeds:
            check_seed(each)
        drawn = self._workers.each(self.num_envs, lambda k, _: self.envs[k].draw(seeds[k], options))
        begun = [env.take(seed, each) for env, seed, each in zip(self.envs, seeds, drawn, strict=True)]
        self._over = np.zeros(self.num_envs, dtype=bool)
        if self._kind is not None:
            self._put()
        return np.stack([observation for observation, _ in begun]), self._joined(info for _, info in begun)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Let the actions hold for a step of the task, shape (environments, actions).

        Raises:
            InputError: not one action of finite numbers an environment; nothing has moved then.
        """
        wanted = self.action_space.shape
        assert wanted is not None, "a box has a shape"
        given = finite(actions, wanted)
        if given is None:
            raise InputError(
                f"actions {shortened(actions)} are not allowed; give finite numbers of shape {wanted}, "
                f"an action for each of {self.num_envs} environments"
            )
        actions = given
        if self._batch is not None:
            stepped = self._together(actions)
        else:
            stepped = self._workers.each(self.num_envs, lambda k, _: self._stepped(k, actions[k]))
        *numbers, infos = zip(*stepped, strict=True)
        observations, rewards, terminated, truncated = map(np.array, numbers)
        self._over = terminated | truncated
        return observations, rewards, terminated, truncated, self._joined(infos)

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """Return a picture of each environment; None without a render mode."""
        pictures = (env.render() for env in self.envs)
        return tuple(picture for picture in pictures if picture is not None) or None

    def _put(self) -> None:
        """Put the twins of all episodes on the device, or say why not."""
        twins = [env.episode.twin for env in self.envs if env.episode is not None]
        try:
            if not self.envs[0].task.repeats:
                raise InputError("each episode has a robot or surroundings of its own")
            if self._batch is None or any(a is not b for a, b in zip(self._batch.twins, twins, strict=True)):
                self._batch = self._kind(twins, device=self._device)
        except InputError as error:
            warnings.warn(f"environments run on the processor: {error}", EngineWarning, stacklevel=3)
            self._kind = self._batch = None
            return
        self._lay(range(self.num_envs))

    def _lay(self, chosen: Sequence[int]) -> None:
        """Lay snakes where their episodes begin."""
        states = [self.envs[k]._running().state for k in chosen]
        self._batch.reset(poses=[(*s.com, float(s.heading)) for s in states], worlds=list(chosen))

    def _together(self, actions: np.ndarray) -> list[StepTuple]:
        """Step all episodes that go on as one, and begin anew those that are over."""
        batch, found = self._batch, dict[int, StepTuple]()
        for k in map(int, np.flatnonzero(self._over)):
            observation, info = self.envs[k].reset()
            found[k] = (observation, 0.0, False, False, info)
        going = [k for k in range(self.num_envs) if k not in found]
        rest = np.full((self.envs[0]._running().twin.spec.segments, 2), -1, dtype=np.int8)
        valves = [rest] * self.num_envs
        for k in going:
            valves[k] = self.envs[k]._running().command(actions[k])
        most = max(each.shape[0] if each.ndim == 3 else 1 for each in valves)
        batch.regulate()
        batch.step(np.stack([np.broadcast_to(v, (most, *rest.shape)) if v.ndim == 2 else v for v in valves]))
        for k in going:
            episode, error = self.envs[k]._running(), batch.errors[k]
            done = episode.diverged(error) if error is not None else episode.went_on(batch.state.at(k))
            found[k] = (done.observation, done.reward, done.terminated, done.truncated, done.info)
        if over := [k for k in found if k not in going]:
            self._lay(over)
        return [found[k] for k in range(self.num_envs)]

    def _stepped(self, k: int, action: np.ndarray) -> StepTuple:
        if self._over[k]:
            observation, info = self.envs[k].reset()
            return observation, 0.0, False, False, info
        return self.envs[k].step(action)

    def _joined(self, infos: Any) -> dict[str, Any]:
        joined: dict[str, Any] = {}
        for k, info in enumerate(infos):
            joined = self._add_info(joined, info, k)
        return joined
