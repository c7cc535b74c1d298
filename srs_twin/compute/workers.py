"""Execution of numbered tasks in threads or in worker processes.

The class `Workers` is a pool of threads for tasks that release the global interpreter
lock. The function `run_tasks` executes tasks in worker processes and continues if a
worker process dies.

On Linux, worker processes are forked from the fork server of `multiprocessing`, which
has already imported the required modules. A forked worker starts within hundredths of a
second, whereas a new process takes one or two seconds to start. On other systems, where
forks are unsafe, every worker is a new process. The page
docs/decisions/worker-processes.md compares this design with process pool libraries.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed, wait
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from multiprocessing import Pipe, forkserver, get_context, resource_tracker
from multiprocessing.connection import Connection, wait as wait_for
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any, Generic, TypeVar

from srs_twin.errors import InputError, SrsError, TaskFailedError, WorkerDiedError
from srs_twin.extensions import PLUGINS

Argument = TypeVar("Argument")
Result = TypeVar("Result")
Returned = TypeVar("Returned")
IsCancelled = Callable[[], bool]
"""Function that returns whether the result of a task is no longer needed."""


class Workers:
    """Pool of threads for tasks that release the global interpreter lock."""

    def __init__(self, threads: int | None = None) -> None:
        """Create the pool, whose threads start with the first task.

        Args:
            threads: number of threads, by default one per processor. With one thread,
                the calling thread executes the tasks.
        """
        self.threads = processor_count() if threads is None else threads
        if self.threads < 1:
            raise InputError(
                f"`threads` {threads} is not allowed; it must be 1 or more"
            )
        # Idle threads end when the pool is garbage-collected.
        self._pool = ThreadPoolExecutor(self.threads) if self.threads > 1 else None

    def __reduce__(self) -> tuple[object, ...]:
        return Workers, (self.threads,)

    def run(
        self,
        count: int,
        task: Callable[[int, IsCancelled], Returned],
        progress: Callable[[int], None] | None = None,
    ) -> list[Returned]:
        """Execute the tasks 0 … count − 1 and return their results in order.

        If several tasks fail, the error of the task with the smallest number is raised.
        An interrupt (Ctrl-C) is raised after the running tasks have ended.

        Args:
            count: number of tasks.
            task: function of the task number and an `IsCancelled` function. A cancelled
                task may return any value or raise any exception.
            progress: function that the calling thread calls with the number of finished
                tasks.
        """
        progress = progress or (lambda done: None)
        if self._pool is None:
            results = []
            for k in range(count):
                results.append(task(k, lambda: False))
                progress(k + 1)
            return results
        end = count  # results of tasks with this or a higher number are not needed
        futures = [
            self._pool.submit(task, k, lambda k=k: k >= end)  # type: ignore[misc]
            for k in range(count)
        ]
        try:
            for done, future in enumerate(as_completed(futures), start=1):
                if future.cancelled():
                    continue
                if future.exception() is not None:
                    end = min(end, futures.index(future) + 1)
                    for later in futures[end:]:
                        later.cancel()
                else:
                    progress(done)
        finally:
            end = 0
            for future in futures:
                future.cancel()
            wait(futures)
        return [future.result() for future in futures]


def processor_count() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


START_METHOD = "forkserver" if sys.platform == "linux" else "spawn"
GRACE_S = 2.0
"""Time that a worker has for cleaning up before it is killed, s."""

# Only the parent process warns that kernels cannot be cached.
_WARNINGS = (
    os.environ.get("PYTHONWARNINGS"),
    "ignore::UserWarning:srs_twin.compute.compiled",
)
_ENVIRONMENT = {
    # Workers must not import modules from the current folder.
    "PYTHONSAFEPATH": "1",
    # BLAS uses one thread in each worker, because there is one worker per processor,
    # and because a process with several threads should not be forked.
    "OPENBLAS_NUM_THREADS": "1",
    "PYTHONWARNINGS": ",".join(filter(None, _WARNINGS)),
}

_preloaded: list[str] = []


def start_server(preload: str | None = None) -> None:
    """Start the fork server on Linux, without waiting until it is ready.

    The fork server imports the module `preload` before it forks workers.
    """
    if START_METHOD != "forkserver":
        return
    if preload is not None:
        _preloaded[:] = [preload]
    forkserver.set_forkserver_preload(_preloaded)  # instead of the main program
    # The resource tracker is started first, because starting it inside the block below
    # would unblock Ctrl-C.
    resource_tracker.ensure_running()
    before = dict(os.environ)
    os.environ.update(_ENVIRONMENT)
    try:
        with _interrupts_blocked():
            forkserver.ensure_running()
    finally:
        for name in _ENVIRONMENT:
            del os.environ[name]
        os.environ.update(before)


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block SIGINT (Ctrl-C) in a `with` block that starts processes.

    The started processes ignore the signal, and the current process receives it after
    the block.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _empty_main_module() -> Iterator[None]:
    """Replace the main module by an empty module within a `with` block.

    Otherwise, `multiprocessing` would import the main program in each worker, and a
    script without the guard ``if __name__ == "__main__"`` would run again. Objects that
    are defined in the main program cannot be pickled within the block.
    """
    program = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = program


@dataclass(frozen=True)
class TaskResult(Generic[Result]):
    """Result or error of one task.

    Attributes:
        error: `SrsError` raised by the task, `TaskFailedError` for any other exception,
            `WorkerDiedError` if too many workers died during the task, or None.
    """

    number: int
    result: Result | None
    error: Exception | None


def run_tasks(
    task: Callable[[Argument], Result],
    arguments: Sequence[Argument],
    *,
    workers: int | None = None,
    attempts: int = 3,
) -> Generator[TaskResult[Result], None, None]:
    """Call a function in worker processes and yield the results in order of completion.

    If a worker dies, for example because it runs out of memory, a new worker repeats
    the task. Workers ignore Ctrl-C, and they end when the generator is closed or the
    parent process ends.

    Args:
        task: function called in a worker. The function, its arguments and its results
            must be picklable.
        arguments: argument of each task.
        workers: maximum number of worker processes, by default one per processor.
        attempts: number of worker deaths after which a task fails.
    """
    count = processor_count() if workers is None else workers
    for name, value in (("workers", count), ("attempts", attempts)):
        if value < 1:
            raise InputError(f"`{name}` {value} is not allowed; it must be 1 or more")
    try:
        with _empty_main_module():
            program, *packed = map(pickle.dumps, [task, *arguments])
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise InputError(
            f"the task cannot be sent to worker processes: {error}. Workers import"
            " functions and classes by name, but not from the main program; define"
            " them in a module and import it"
        ) from error
    return _TaskRun(program, packed, count, attempts).results()


class _TaskRun:
    def __init__(
        self, program: bytes, packed: Sequence[bytes], count: int, attempts: int
    ) -> None:
        self._program = program
        self._packed = packed
        self._count = count
        self._attempts = attempts
        self._waiting = deque(range(len(packed)))
        self._finished = deque[TaskResult[Any]]()
        self._deaths = [0] * len(packed)  # number of worker deaths in each task
        # Number of successive failed starts, in which workers died before their tasks.
        self._failed_starts = 0
        self._last_failed_start = 0.0
        self._workers: list[_Worker] = []

    def results(self) -> Generator[TaskResult[Any], None, None]:
        remaining = len(self._packed)
        try:
            while remaining:
                while len(self._workers) < min(
                    self._count, remaining - len(self._finished)
                ):
                    self._workers.append(_Worker(self._program))
                self._assign_tasks()
                # A result is yielded only after all idle workers have received tasks.
                if self._finished:
                    remaining -= 1
                    yield self._finished.popleft()
                else:
                    self._wait()
        finally:
            for worker in self._workers:
                worker.process.terminate()
            deadline = time.monotonic() + GRACE_S
            for worker in self._workers:
                worker.end(deadline)

    def _assign_tasks(self) -> None:
        for worker in self._workers:
            if self._waiting and worker.ready and worker.number is None:
                with suppress(OSError):  # the worker died before it received the task
                    worker.pipe.send_bytes(self._packed[self._waiting[0]])
                    worker.number = self._waiting.popleft()

    def _wait(self) -> None:
        handles = [
            handle
            for worker in self._workers
            for handle in (worker.pipe, worker.process.sentinel)
        ]
        active = wait_for(handles)
        for worker in list(self._workers):
            if worker.pipe not in active and worker.process.sentinel not in active:
                continue
            try:
                result, error = worker.receive()
            except (EOFError, OSError):
                # The worker died, possibly while it sent a result.
                self._handle_death(worker)
                continue
            if worker.number is not None:
                self._finished.append(TaskResult(worker.number, result, error))
            elif error is not None:
                raise error
            worker.ready = True
            worker.number = None
            self._failed_starts = 0

    def _handle_death(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        exit_code = worker.end(time.monotonic() + GRACE_S)
        if worker.ready:
            self._failed_starts = 0
        elif worker.start_time > self._last_failed_start:
            # Failures of workers that started together count as one failed start.
            self._failed_starts += 1
            self._last_failed_start = time.monotonic()
            if self._failed_starts == self._attempts:
                raise WorkerDiedError(exit_code, self._attempts) from None
        if (number := worker.number) is not None:
            self._deaths[number] += 1
            if self._deaths[number] < self._attempts:
                self._waiting.append(number)
            else:
                error = WorkerDiedError(exit_code, self._attempts)
                self._finished.append(TaskResult(number, None, error))


class _Worker:
    """Worker process and its pipe, as seen from the parent process.

    Attributes:
        start_time: start time on the monotonic clock, s.
        ready: whether the worker has reported that it can execute tasks.
        number: number of the current task, or None if the worker is idle.
    """

    def __init__(self, program: bytes) -> None:
        self.start_time = time.monotonic()
        self.ready = False
        self.number: int | None = None
        self.pipe, remote_pipe = Pipe()
        # The fork server may have started before this process loaded its plug-ins.
        plugins = os.environ.get(PLUGINS, "")
        self.process = _start_process(_worker_main, (remote_pipe, program, plugins))
        remote_pipe.close()

    def receive(self) -> tuple[object, Exception | None]:
        """Return (result, None), or (None, error) if the task failed."""
        # If the fork server has died, reading from the pipe does not raise EOFError.
        if not self.pipe.poll():
            raise EOFError
        answer: tuple[object, Exception | None] = pickle.loads(self.pipe.recv_bytes())
        return answer

    def end(self, deadline: float) -> int:
        """Wait for the process until a deadline, kill it, and return its exit code."""
        self.process.join(max(0.0, deadline - time.monotonic()))
        self.process.kill()
        self.process.join()
        code = self.process.exitcode
        self.process.close()
        self.pipe.close()
        return code or 0


def _start_process(
    target: Callable[..., None], arguments: tuple[object, ...]
) -> BaseProcess:
    """Start a process that ignores Ctrl-C."""
    # If the fork server has just died, the start is repeated until it has restarted.
    deadline = time.monotonic() + GRACE_S
    while True:
        start_server()
        process = get_context(START_METHOD).Process(  # type: ignore[attr-defined]
            target=target, args=arguments, daemon=True
        )
        # The fork server already blocks Ctrl-C, and its child processes inherit this.
        blocked = (
            nullcontext() if START_METHOD == "forkserver" else _interrupts_blocked()
        )
        try:
            with blocked, _empty_main_module():
                process.start()
            started: BaseProcess = process
            return started
        except (OSError, EOFError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.02)


def _worker_main(pipe: Connection, program: bytes, plugins: str) -> None:
    os.environ[PLUGINS] = plugins
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _raise_exit)
    arguments: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(
        target=_receive_arguments, args=(pipe, arguments), daemon=True
    ).start()
    task: list[Callable[[object], object]] = []
    with suppress(OSError):  # the parent process no longer reads results
        pipe.send_bytes(_call_and_pickle(lambda: task.append(pickle.loads(program))))
        while True:
            raw = arguments.get()
            pipe.send_bytes(
                _call_and_pickle(
                    lambda raw=raw: task[0](pickle.loads(raw))  # type: ignore[misc]
                )
            )


def _call_and_pickle(call: Callable[[], object]) -> bytes:
    try:
        return pickle.dumps((call(), None))
    except Exception as error:  # any error is reported, and the worker continues
        reported = error if isinstance(error, SrsError) else TaskFailedError(error)
        # Tracebacks cannot be pickled, so the traceback is added as a note.
        reported.add_note("".join(traceback.format_exception(error)))
        try:
            return pickle.dumps((None, reported))
        except (pickle.PicklingError, TypeError, AttributeError) as reason:
            return pickle.dumps((None, TaskFailedError(reason)))


def _receive_arguments(pipe: Connection, arguments: queue.SimpleQueue[bytes]) -> None:
    """Receive arguments, and end the worker when the parent process closes the pipe."""
    with suppress(EOFError, OSError):
        while True:
            arguments.put(pipe.recv_bytes())
    # The main thread waits for arguments, and only a signal can interrupt this wait.
    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
    time.sleep(GRACE_S / 2)
    os._exit(1)


def _raise_exit(number: int, frame: object) -> None:
    """Raise SystemExit in the current task, so that the task can clean up."""
    raise SystemExit(128 + number)
