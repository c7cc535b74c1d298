"""Environments for agents: tasks on the twin, with the faces of gymnasium and dm_env (docs/environments.md).

Importing this registers ``SRSTwin/GoTo-v0``, ``SRSTwin/Obstacles-v0`` and ``SRSTwin/Module-v0``;
`gymnasium.make("srs_twin.envs:SRSTwin/GoTo-v0")` imports it by itself. (Since its version 1.0 gymnasium looks
for no entry points.) `srs_twin.envs.dm.load("GoTo")` is the dm_env of the same task, and needs no gymnasium.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from srs_twin.errors import UnknownNameError

if TYPE_CHECKING:
    from srs_twin.envs.task import Task

TASKS = ("GoTo", "Obstacles", "Module")


def make_task(name: str, **settings: Any) -> Task:
    """Return a task.

    Args:
        name: of `TASKS`.
        **settings: as `CrawlTask` and `ModuleTask` take them.

    Raises:
        UnknownNameError: another name.
        InputError: as the task raises it.
    """
    from srs_twin.envs.crawling import CIRCLES, OPEN, CrawlTask
    from srs_twin.envs.module import ModuleTask

    if name not in TASKS:
        raise UnknownNameError("task", name, TASKS)
    if name == "Module":
        return ModuleTask(**settings)
    return CrawlTask(name, OPEN if name == "GoTo" else CIRCLES, **settings)


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
