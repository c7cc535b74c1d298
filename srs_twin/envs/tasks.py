"""Registry of the reinforcement-learning tasks."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Unpack

from srs_twin.errors import UnknownNameError

if TYPE_CHECKING:
    from srs_twin.envs.crawling import AnyTaskKeywords
    from srs_twin.envs.task import Task

TASKS = ("GoTo", "Obstacles", "Module", "Crawl3D", "Pegs", "Grasp")


def make_task(name: str, **settings: Unpack[AnyTaskKeywords]) -> Task:
    """Create the task with the given name.

    Args:
        name: name of the task, one of `TASKS`.
        **settings: arguments of the task's class, which is `CrawlTask`, `ModuleTask`,
            `SpatialCrawlTask`, `PegsTask` or `GraspTask`.

    Raises:
        UnknownNameError: the task does not exist.
        InputError: a setting is invalid.
    """
    from srs_twin.envs.contact import GraspTask, PegsTask
    from srs_twin.envs.crawling import CIRCLES, OPEN, CrawlTask, SpatialCrawlTask
    from srs_twin.envs.module import ModuleTask

    if name not in TASKS:
        raise UnknownNameError("task", name, TASKS)
    arenas = {"GoTo": OPEN, "Obstacles": CIRCLES}
    if name in arenas:
        return CrawlTask(name, arenas[name], **settings)
    tasks: dict[str, Callable[..., Task]] = {
        "Module": ModuleTask,
        "Crawl3D": SpatialCrawlTask,
        "Pegs": PegsTask,
        "Grasp": GraspTask,
    }
    return tasks[name](**settings)
