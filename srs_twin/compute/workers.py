"""Numbered tasks shared out over threads or worker processes.

`Workers` are threads, for tasks that free the interpreter's lock. `each` runs tasks in worker processes, one
of which may die without costing the others anything.

On Linux worker processes are forked from multiprocessing's server: a process of its own that has loaded,
once, what they need. A worker then starts in hundredths of a second instead of one or two, the first one and
every one that takes a dead one's place. Elsewhere every worker is started anew, as the libraries of other
systems do not bear a fork. Why no pool of a library does this: docs/decisions/worker-processes.md.
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
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any, Generic, TypeVar

from srs_twin.errors import InputError, SrsError, TaskFailedError, WorkerDiedError

Argument = TypeVar("Argument")
Result = TypeVar("Result")
Returned = TypeVar("Returned")
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

    def __reduce__(self) -> tuple[Any, ...]:
        return Workers, (self.threads,)

    def each(
        self,
        count: int,
        task: Callable[[int, Stopped], Returned],
        progress: Callable[[int], None] | None = None,
    ) -> list[Returned]:
        """Run tasks 0 … count − 1 and return what they returned, in order.

        An error of a task is raised when all tasks before it are done: the one that a plain loop would have
        met. An interrupt (Ctrl-C) is raised as soon as the running tasks have ended.

        Args:
            count: number of tasks.
            task: called with its number and with what tells it that its result is no longer wanted; then it
                may end in any way.
            progress: called on the calling thread with how many tasks are done.
        """
        progress = progress or (lambda done: None)
        if self._pool is None:
            results = []
            for k in range(count):
                results.append(task(k, lambda: False))
                progress(k + 1)
            return results
        end = count  # results from this number on are not wanted
        futures = [self._pool.submit(task, k, lambda k=k: k >= end) for k in range(count)]  # type: ignore[misc]
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


def processors() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


METHOD = "forkserver" if sys.platform == "linux" else "spawn"
GRACE_S = 2.0
"""How long a worker that is to end may take to leave its task and clean up."""

# What the server imports is what this process would: nothing from the folder that it happens to stand in.
# One thread of linear algebra a worker: there are as many workers as processors, and a process that is
# forked should have no other threads.
# This process warns of machine code that cannot be kept; workers need not say it again.
_WARNINGS = (os.environ.get("PYTHONWARNINGS"), "ignore::UserWarning:srs_twin.compute.compiled")
_ENVIRONMENT = {
    "PYTHONSAFEPATH": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "PYTHONWARNINGS": ",".join(filter(None, _WARNINGS)),
}
_preloaded: list[str] = []


def start_server(preload: str | None = None) -> None:
    """Start the server and return at once; nothing where one runs or none is needed.

    Args:
        preload: module that it imports before it forks anybody.
    """
    if METHOD != "forkserver":
        return
    if preload is not None:
        _preloaded[:] = [preload]
    forkserver.set_forkserver_preload(_preloaded)  # by default it imports the program that is run
    # Started outside the block below: it would let Ctrl-C through again.
    resource_tracker.ensure_running()
    before = dict(os.environ)
    os.environ.update(_ENVIRONMENT)
    try:
        with _interrupts_held_back():
            forkserver.ensure_running()
    finally:
        for name in _ENVIRONMENT:
            del os.environ[name]
        os.environ.update(before)


@contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Let Ctrl-C wait: a process started here begins deaf to it, and this one hears it afterwards."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _empty_main_module() -> Iterator[None]:
    """Put an empty module in the place of the program that is run, which is what a worker has there.

    multiprocessing has a process import that program again, and a script without ``__name__ == "__main__"``
    would run twice. Here it finds none; and what only the program defines cannot be pickled for a worker.
    """
    program = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = program


@dataclass(frozen=True)
class Done(Generic[Result]):
    """How one task ended.

    Attributes:
        number: which argument it had.
        result: what it returned; None after an error.
        error: the `SrsError` that it raised, `TaskFailedError` for anything else that it raised,
            `WorkerDiedError` where its workers died; None after a result.
    """

    number: int
    result: Result | None
    error: Exception | None


def each(
    task: Callable[[Argument], Result],
    arguments: Sequence[Argument],
    *,
    workers: int | None = None,
    attempts: int = 3,
    prepare: Callable[[], None] | None = None,
) -> Generator[Done[Result], None, None]:
    """Run a task on every argument in worker processes; yield what came of it, as it finishes.

    A worker that dies (killed, out of memory, a fault in compiled code) costs only the task it was at: that
    goes to a fresh worker. Workers leave Ctrl-C to this process. They end when the generator is closed, and
    when this process is gone, whatever ended it.

    Args:
        task: called in a worker; it, the arguments and the results can be pickled and the function imported.
        arguments: one a task.
        workers: how many processes; default one a processor, never more than tasks.
        attempts: how many workers a task may cost before it is given up.
        prepare: called once in each worker before its first task.

    Raises:
        InputError: fewer than one worker or attempt; what only the program that is run defines, or what
            cannot be pickled, among task and arguments.
        SrsError: ``prepare`` raised it; no task can run.
        TaskFailedError: ``prepare`` raised anything else, or the task cannot be imported.
        WorkerDiedError: ``attempts`` workers one after another died before their first task.
    """
    count = processors() if workers is None else workers
    for name, given in (("workers", count), ("attempts", attempts)):
        if given < 1:
            raise InputError(f"{name}: {given} is not allowed; it must be 1 or more")
    try:
        with _empty_main_module():
            program, *packed = map(pickle.dumps, [(task, prepare), *arguments])
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise InputError(
            f"worker processes cannot be given this: {error}. They import functions and classes by name, "
            "but not the program that is run: define them in a module and import that"
        ) from error
    return _run(program, packed, count, attempts)


def _run(
    program: bytes, packed: Sequence[bytes], count: int, attempts: int
) -> Generator[Done[Any], None, None]:
    left = len(packed)
    waiting, finished = deque(range(left)), deque[Done[Any]]()
    deaths, stillborn, last_stillborn = [0] * left, 0, 0.0
    workers: list[_Worker] = []
    try:
        while left:
            while len(workers) < min(count, left - len(finished)):
                workers.append(_Worker(program))
            for worker in workers:
                if waiting and worker.ready and worker.number is None:
                    with suppress(OSError):  # it died before the task
                        worker.pipe.send_bytes(packed[waiting[0]])
                        worker.number = waiting.popleft()
            if finished:  # every worker has a task meanwhile
                left -= 1
                yield finished.popleft()
                continue
            heard = wait_for([each for worker in workers for each in (worker.pipe, worker.process.sentinel)])
            for worker in [each for each in workers if each.pipe in heard or each.process.sentinel in heard]:
                number = worker.number
                try:
                    result, error = worker.answer()
                except (EOFError, OSError):  # killed in the middle of an answer, too
                    workers.remove(worker)
                    code = worker.end(time.monotonic() + GRACE_S)
                    if worker.ready:
                        stillborn = 0
                    elif worker.begun > last_stillborn:  # not one of several that died as one
                        stillborn, last_stillborn = stillborn + 1, time.monotonic()
                        if stillborn == attempts:
                            raise WorkerDiedError(code, attempts) from None
                    if number is not None:
                        deaths[number] += 1
                        if deaths[number] < attempts:
                            waiting.append(number)
                        else:
                            finished.append(Done(number, None, WorkerDiedError(code, attempts)))
                    continue
                if number is not None:
                    finished.append(Done(number, result, error))
                elif error is not None:
                    raise error
                worker.ready, worker.number, stillborn = True, None, 0
    finally:
        for worker in workers:
            worker.process.terminate()
        latest = time.monotonic() + GRACE_S
        for worker in workers:
            worker.end(latest)


class _Worker:
    """A worker process.

    Attributes:
        begun: when it was started, on the monotonic clock, s.
        ready: whether it has answered that it can begin.
        number: of the task that it is at, or None.
        pipe: for pickled arguments and answers.
    """

    def __init__(self, program: bytes) -> None:
        self.begun = time.monotonic()
        self.ready = False
        self.number: int | None = None
        self.pipe, theirs = Pipe()
        self.process = _start(_work, (theirs, program))
        theirs.close()

    def answer(self) -> tuple[Any, Exception | None]:
        """Return result and error, one of them None.

        Raises:
            EOFError, OSError: it has died.
        """
        if not self.pipe.poll():  # where its server has died the pipe has no end
            raise EOFError
        answer: tuple[Any, Exception | None] = pickle.loads(self.pipe.recv_bytes())
        return answer

    def end(self, latest: float) -> int:
        """See that the process is gone, by force after a time; return its exit code."""
        self.process.join(max(0.0, latest - time.monotonic()))
        self.process.kill()
        self.process.join()
        code = self.process.exitcode
        self.process.close()
        self.pipe.close()
        return code or 0


def _start(target: Callable[..., None], arguments: tuple[Any, ...]) -> BaseProcess:
    """Start a process that is deaf to Ctrl-C; try again for a while where the server has just died."""
    latest = time.monotonic() + GRACE_S
    while True:
        start_server()
        process = get_context(METHOD).Process(target=target, args=arguments, daemon=True)  # type: ignore[attr-defined]
        # The server is deaf to Ctrl-C, and so is who comes from it.
        held_back = nullcontext() if METHOD == "forkserver" else _interrupts_held_back()
        try:
            with held_back, _empty_main_module():
                process.start()
            started: BaseProcess = process
            return started
        except (OSError, EOFError):
            if time.monotonic() > latest:
                raise
            time.sleep(0.02)


def _work(pipe: Connection, program: bytes) -> None:
    """Be a worker: the main thread runs tasks, another takes in arguments."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(pipe, inbox), daemon=True).start()
    task: Any = None

    def begin() -> None:
        nonlocal task
        task, prepare = pickle.loads(program)
        if prepare is not None:
            prepare()

    with suppress(OSError):  # nobody waits for an answer any more
        pipe.send_bytes(_answer(begin))
        while True:
            raw = inbox.get()
            pipe.send_bytes(_answer(lambda raw=raw: task(pickle.loads(raw))))  # type: ignore[misc]


def _answer(call: Callable[[], Any]) -> bytes:
    """Return what a call came to as the parent reads it: result and error, one of them None."""
    try:
        return pickle.dumps((call(), None))
    except Exception as error:  # a worker's outermost edge: one task must not cost the others theirs
        known = error if isinstance(error, SrsError) else TaskFailedError(error)
        # A traceback does not travel between processes; as a note it is shown where the error is.
        known.add_note("".join(traceback.format_exception(error)))
        try:
            return pickle.dumps((None, known))
        except (pickle.PicklingError, TypeError, AttributeError) as reason:
            return pickle.dumps((None, TaskFailedError(reason)))


def _listen(pipe: Connection, inbox: queue.SimpleQueue[bytes]) -> None:
    """Take in arguments; where the pipe ends, the worker ends, whatever it is at."""
    with suppress(EOFError, OSError):
        while True:
            inbox.put(pipe.recv_bytes())
    # To the main thread itself: nothing else wakes it where it waits.
    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
    time.sleep(GRACE_S / 2)
    os._exit(1)


def _leave(number: int, frame: Any) -> None:
    """Leave the task by an exception, so that it cleans up behind itself."""
    raise SystemExit(128 + number)
