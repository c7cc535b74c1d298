"""Reinforcement-learning environments for Gymnasium and dm_env.

Importing this package registers the tasks of `TASKS` with Gymnasium, for example as
``SRSTwin/GoTo-v0``. With the id ``srs_twin.envs:SRSTwin/GoTo-v0``, Gymnasium imports
this package itself. The prefix is needed because Gymnasium 1.0 and later do not search
entry points. `srs_twin.envs.dm.load("GoTo")` returns the same task as a dm_env
environment and does not need Gymnasium. docs/environments.md describes the tasks.
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
            # Gymnasium's wrappers are disabled, because SnakeEnv checks the call order
            # and the action types itself. A copied wrapper would also share the
            # environment.
            order_enforce=False,
            disable_env_checker=True,
        )


if find_spec("gymnasium") is not None:
    _register()
