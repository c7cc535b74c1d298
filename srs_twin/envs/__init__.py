"""Reinforcement-learning environments for Gymnasium and dm_env.

Importing this package registers every task in `TASKS` with Gymnasium, for example as
``SRSTwin/GoTo-v0``. With the id ``srs_twin.envs:SRSTwin/GoTo-v0``, Gymnasium imports
the package itself. `srs_twin.envs.dm.load` creates dm_env environments, for which
Gymnasium is not needed. The tasks are described in docs/environments.md.
"""

from __future__ import annotations

from importlib.util import find_spec

from srs_twin.envs.tasks import TASKS, make_task

__all__ = ["TASKS", "make_task"]


def _register() -> None:
    import gymnasium

    for task in TASKS:
        gymnasium.register(
            f"SRSTwin/{task}-v0",
            entry_point="srs_twin.envs.gymnasium:SnakeEnv",
            vector_entry_point="srs_twin.envs.gymnasium:SnakeVectorEnv",
            kwargs={"task": task},
            # Gymnasium's checking wrappers are disabled, because SnakeEnv checks the
            # call order and the actions itself. Moreover, a copied wrapper would share
            # its environment with the original wrapper.
            order_enforce=False,
            disable_env_checker=True,
        )


if find_spec("gymnasium") is not None:
    _register()
