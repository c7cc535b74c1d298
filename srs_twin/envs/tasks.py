"""Tasks by name."""

from __future__ import annotations

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
