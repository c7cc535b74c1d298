"""Environments for agents: tasks on the twin, with the faces of gymnasium and dm_env (docs/environments.md).

Importing this registers ``SRSTwin/GoTo-v0``, ``SRSTwin/Obstacles-v0`` and ``SRSTwin/Module-v0``;
`gymnasium.make("srs_twin.envs:SRSTwin/GoTo-v0")` imports it by itself. (Since its version 1.0 gymnasium looks
for no entry points.) `srs_twin.envs.dm.load("GoTo")` is the dm_env of the same task, and needs no gymnasium.
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
            # The environment checks both itself; `copy.copy` of a wrapper would share the environment.
            order_enforce=False,
            disable_env_checker=True,
        )


if find_spec("gymnasium") is not None:
    _register()
