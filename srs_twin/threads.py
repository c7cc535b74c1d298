"""threads: numbered tasks shared out over threads, their results in order."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed, wait
from typing import TypeVar

from srs_twin.errors import InputError

Result = TypeVar("Result")
Stopped = Callable[[], bool]


class Workers:
    """Threads for tasks that free the interpreter's lock while they compute.

    Attributes:
        threads: how many.
    """

    def __init__(self, threads: int | None = None) -> None:
        """Prepare the threads; they start with the first task.

        Args:
            threads: how many; default one a processor. One: tasks run on the calling thread.

        Raises:
            InputError: fewer than one.
        """
        self.threads = processors() if threads is None else threads
        if self.threads < 1:
            raise InputError(f"threads: {threads} is not allowed; it must be 1 or more")
        # Idle threads end by themselves once nobody holds the pool.
        self._pool = ThreadPoolExecutor(self.threads) if self.threads > 1 else None

    def each(
        self,
        count: int,
        task: Callable[[int, Stopped], Result],
        progress: Callable[[int], None] | None = None,
    ) -> list[Result]:
        """Run tasks 0 … count − 1 and return what they returned, in order.

        An error of a task is raised when all tasks before it are done: the one that a plain loop would have
        met. An interrupt (Ctrl-C) is raised as soon as the running tasks have ended.

        Args:
            count: number of tasks.
            task: called with its number and with what tells it that its result is no longer wanted; then it
                may end in any way.
            progress: called on the calling thread with how many tasks are done.
        """
        if self._pool is None:
            return self._in_turn(count, task, progress)
        end = count  # results from this number on are not wanted

        def wanted_no_more(k: int) -> Stopped:
            return lambda: k >= end

        futures = [self._pool.submit(task, k, wanted_no_more(k)) for k in range(count)]
        number = {future: k for k, future in enumerate(futures)}
        try:
            for done, future in enumerate(as_completed(futures), start=1):
                if not future.cancelled() and future.exception() is not None:
                    end = min(end, number[future] + 1)
                    for later in futures[end:]:
                        later.cancel()
                elif progress is not None and not future.cancelled():
                    progress(done)
        finally:
            end = 0
            for future in futures:
                future.cancel()
            wait(futures)
        return [future.result() for future in futures]

    @staticmethod
    def _in_turn(
        count: int, task: Callable[[int, Stopped], Result], progress: Callable[[int], None] | None
    ) -> list[Result]:
        results = []
        for k in range(count):
            results.append(task(k, lambda: False))
            if progress is not None:
                progress(k + 1)
        return results


def processors() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
