"""The tasks by name, for both faces."""

from __future__ import annotations

from typing import Any

from srs_twin.envs import TASKS
from srs_twin.envs.crawling import CIRCLES, OPEN, CrawlTask
from srs_twin.envs.module import ModuleTask
from srs_twin.envs.task import Task
from srs_twin.errors import UnknownNameError


def make_task(name: str, **settings: Any) -> Task:
    """Return a task.

    Args:
        name: of `TASKS`.
        **settings: as `CrawlTask` and `ModuleTask` take them.

    Raises:
        UnknownNameError: another name.
        InputError: as the task raises it.
    """
    if name == "GoTo":
        return CrawlTask(name, OPEN, **settings)
    if name == "Obstacles":
        return CrawlTask(name, CIRCLES, **settings)
    if name == "Module":
        return ModuleTask(**settings)
    raise UnknownNameError("task", name, TASKS)
