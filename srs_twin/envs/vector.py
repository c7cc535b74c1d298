"""SnakeVectorEnv: many environments of one task, stepped together over threads.

Each is a `SnakeEnv` of its own and gives what it gives alone, bit for bit. Threads share out whole
environments, as `TwinBatch` does and for its reasons: nearly all the time of a step is one engine call, which
frees the interpreter's lock, and chambers, commands and observations are computed beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from srs_twin.envs.single import SnakeEnv
from srs_twin.errors import InputError
from srs_twin.threads import Workers

Told = tuple[np.ndarray, float, bool, bool, dict[str, Any]]


class SnakeVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Environments of one task: `gymnasium.make_vec("srs_twin.envs:SRSTwin/GoTo-v0", num_envs=64)`.

    An environment whose episode has ended begins another with the next step, whatever its action
    (`AutoresetMode.NEXT_STEP`, as gymnasium's own vectors do by default).

    Attributes:
        envs: each one.
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        threads: int | None = None,
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        """Make the environments.

        Args:
            task: "GoTo", "Obstacles" or "Module".
            num_envs: how many.
            threads: how many; default one a processor.
            render_mode: as in `SnakeEnv`.
            **settings: as in `SnakeEnv`.

        Raises:
            InputError: no environment at all, or as `SnakeEnv` raises it.
        """
        if num_envs < 1:
            raise InputError(f"num_envs {num_envs} is not allowed; it must be 1 or more")
        self._workers = Workers(threads)
        self.envs = [SnakeEnv(task, render_mode=render_mode, **settings) for _ in range(num_envs)]
        first = self.envs[0]
        self.num_envs, self.render_mode = num_envs, render_mode
        self.metadata = {**first.metadata, "autoreset_mode": AutoresetMode.NEXT_STEP}
        self.single_action_space, self.single_observation_space = first.action_space, first.observation_space
        self.action_space = batch_space(first.action_space, num_envs)
        self.observation_space = batch_space(first.observation_space, num_envs)
        self._over = np.zeros(num_envs, dtype=bool)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode everywhere.

        Args:
            seed: of each environment; of one number s they are s, s + 1, …
            options: there are none.

        Raises:
            InputError: not one seed an environment, or options.
        """
        if seed is None or isinstance(seed, int | np.integer):
            seeds = [None if seed is None else int(seed) + k for k in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise InputError(f"seed: {len(seeds)} were given for {self.num_envs} environments; give one each")
        begun = self._workers.each(
            self.num_envs, lambda k, _: self.envs[k].reset(seed=seeds[k], options=options)
        )
        self._over = np.zeros(self.num_envs, dtype=bool)
        return np.stack([observation for observation, _ in begun]), self._joined(info for _, info in begun)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Let the actions hold for a step of the task, shape (environments, actions).

        Raises:
            InputError: not one action of finite numbers an environment; nothing has moved then.
        """
        given, wanted = np.asarray(actions, dtype=float), self.action_space.shape
        if given.shape != wanted or not np.isfinite(given).all():
            raise InputError(
                f"actions of shape {given.shape} are not allowed; give finite numbers of shape {wanted}, "
                f"an action for each of {self.num_envs} environments"
            )
        told = self._workers.each(self.num_envs, lambda k, _: self._stepped(k, actions[k]))
        terminated, truncated = (np.array([each[i] for each in told]) for i in (2, 3))
        self._over = terminated | truncated
        return (
            np.stack([each[0] for each in told]), np.array([each[1] for each in told]), terminated, truncated,
            self._joined(each[4] for each in told),
        )  # fmt: skip

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a picture of each environment; None without a render mode."""
        pictures = (env.render() for env in self.envs)
        return tuple(picture for picture in pictures if picture is not None) or None

    def close_extras(self, **kwargs: Any) -> None:
        """Give back what pictures have taken."""
        for env in self.envs:
            env.close()

    def _stepped(self, k: int, action: np.ndarray) -> Told:
        if self._over[k]:
            observation, info = self.envs[k].reset()
            return observation, 0.0, False, False, info
        return self.envs[k].step(action)

    def _joined(self, infos: Any) -> dict[str, Any]:
        joined: dict[str, Any] = {}
        for k, info in enumerate(infos):
            joined = self._add_info(joined, info, k)
        return joined
