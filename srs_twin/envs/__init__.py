"""Reinforcement-learning environments for Gymnasium and dm_env.

Importing this package registers the tasks of `TASKS` as ``SRSTwin/GoTo-v0`` and so on.
The id ``srs_twin.envs:SRSTwin/GoTo-v0`` imports the package first, because Gymnasium
since version 1.0 does not search entry points. `srs_twin.envs.dm.load("GoTo")` returns
the corresponding task for dm_env and does not need Gymnasium. docs/environments.md
describes the tasks.
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
            # Wrappers are disabled, because SnakeEnv checks order and types itself and
            # `copy.copy` of a wrapper would share the environment.
            order_enforce=False,
            disable_env_checker=True,
        )


if find_spec("gymnasium") is not None:
    _register()
