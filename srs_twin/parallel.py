"""Numbered tasks shared out over threads and worker processes, their results in order.

threads: numbered tasks shared out over threads, their results in order.

process_server: where worker processes come from.

On Linux they are forked from a server: a process of its own that has loaded, once, what they need. A worker
then starts in hundredths of a second instead of one or two, the first one and every one that takes a dead
one's place. The server itself runs nothing but that; it ends with this process. Elsewhere every worker is
started anew, because the libraries of other systems do not bear a fork.

processes: numbered tasks shared out over worker processes; one that dies costs only what it was at.
"""

from __future__ import annotations

import atexit
import contextlib
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
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import Pipe, forkserver, get_context, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any, Generic, TypeVar

from srs_twin.errors import InputError, SrsError, TaskFailedError, WorkerDiedError

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
        count: int, task: Callable[[int, Stopped], Returned], progress: Callable[[int], None] | None
    ) -> list[Returned]:
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


METHOD = "forkserver" if sys.platform == "linux" else "spawn"

# What the server imports is what this process would: nothing from the folder that it happens to stand in.
# One thread of linear algebra a worker: there are as many workers as processors, and a process that is
# forked should have no other threads.
# This process warns of machine code that cannot be kept; workers need not say it again.
_WARNINGS = (os.environ.get("PYTHONWARNINGS"), "ignore::UserWarning:srs_twin.compiled")
_ENVIRONMENT = {
    "PYTHONSAFEPATH": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "PYTHONWARNINGS": ",".join(filter(None, _WARNINGS)),
}

_main_module = threading.RLock()


def start_server(preload: str | None = None) -> None:
    """Start the server and return at once; nothing where one runs or none is needed.

    Args:
        preload: module that it imports before it forks anybody.
    """
    if METHOD != "forkserver":
        return
    server = forkserver._forkserver
    if preload is not None:
        server.set_forkserver_preload([preload])
    elif _server_pid() is None:
        server.set_forkserver_preload([])  # not the program that called this, which is the default
    # Started outside the block below: it would let Ctrl-C through again.
    resource_tracker.ensure_running()
    with _interrupts_held_back(), _environment(_ENVIRONMENT):
        server.ensure_running()
    atexit.unregister(_end_server)
    atexit.register(_end_server)


def start_process(target: Callable[..., None], arguments: tuple[Any, ...]) -> BaseProcess:
    """Start a process that is deaf to Ctrl-C.

    Raises:
        OSError, EOFError: the server died meanwhile.
    """
    start_server()
    process = get_context(METHOD).Process(target=target, args=arguments, daemon=True)  # type: ignore[attr-defined]
    # The server is deaf to Ctrl-C and so is who comes from it, while this process may have to wait for it.
    held_back = contextlib.nullcontext() if METHOD == "forkserver" else _interrupts_held_back()
    with held_back, empty_main_module():
        try:
            process.start()
        except (OSError, EOFError):
            _end_server(os.WNOWAIT)  # one that has closed its door, but is not gone yet, would be asked again
            raise
    started: BaseProcess = process
    return started


@contextmanager
def empty_main_module() -> Iterator[None]:
    """Put an empty module in the place of the program that is run, which is what a worker has there.

    multiprocessing has a process import that program again, and a script without ``__name__ == "__main__"``
    would run twice. Here it finds none; and what only the program defines cannot be pickled for a worker.
    """
    with _main_module:
        program = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = program


def _end_server(left: int = 0) -> None:
    """End the server, whatever it is at; by itself it would first finish what it imports.

    Args:
        left: WNOWAIT leaves it to multiprocessing to see that it is gone, and to start another.
    """
    pid = _server_pid()
    if pid is not None:
        with contextlib.suppress(ProcessLookupError, ChildProcessError):
            os.kill(pid, signal.SIGKILL)
            os.waitid(os.P_PID, pid, os.WEXITED | left)


def _server_pid() -> int | None:
    pid: int | None = getattr(forkserver._forkserver, "_forkserver_pid", None)  # it has no public name
    return pid


@contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Let Ctrl-C wait: a process started here begins deaf to it, and this one hears it afterwards."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _environment(settings: dict[str, str]) -> Iterator[None]:
    """Set variables for a process that is started here."""
    before = {name: os.environ.get(name) for name in settings}
    os.environ.update(settings)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


Argument = TypeVar("Argument")
Result = TypeVar("Result")

SHORT_S = 0.1
"""Below this a worker gets its next argument ahead: waiting for it would cost a good part of the task."""
GRACE_S = 2.0
"""How long a worker that is to end may take to leave its task and clean up."""
_LOST = 255
"""Exit code of a process whose end nobody saw, as multiprocessing has it."""


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
    return _run(_Pool(_packed((task, prepare)), arguments, count, attempts))


def _run(pool: _Pool) -> Generator[Done[Any], None, None]:
    try:
        finished: list[Done[Any]] = []
        while pool.left:
            pool.hand_out()
            # Only now: the workers are busy while the caller deals with the results.
            yield from finished
            finished = pool.wait()
        yield from finished
    finally:
        pool.end()


class _Pool:
    """The worker processes and who is at what."""

    def __init__(self, program: bytes, arguments: Sequence[Any], count: int, attempts: int) -> None:
        self.left = len(arguments)  # not finished
        self._program, self._arguments, self._count, self._attempts = program, arguments, count, attempts
        self._waiting = deque(range(len(arguments)))
        self._deaths = [0] * len(arguments)
        self._stillborn, self._last_stillborn = 0, 0.0
        self._workers: list[_Worker] = []

    def hand_out(self) -> None:
        """Start the workers that are missing and give arguments to those that can take one."""
        while len(self._workers) < min(self._count, self.left):
            try:
                self._workers.append(_Worker(self._program))
            except (OSError, EOFError):
                self._count_stillborn(_LOST)
        for at in (0, 1):
            for worker in self._workers:
                if self._waiting and worker.takes(at):
                    number = self._waiting.popleft()
                    if not worker.give(number, self._arguments[number]):
                        self._waiting.appendleft(number)

    def wait(self) -> list[Done[Any]]:
        """Wait until a worker answers or dies; return what is finished by that."""
        ready = wait_for([end for worker in self._workers for end in (worker.pipe, worker.process.sentinel)])
        finished: list[Done[Any]] = []
        for worker in list(self._workers):
            if worker.pipe in ready or worker.process.sentinel in ready:
                finished += worker.answers()
                if worker.ready:
                    self._stillborn = 0
                if worker.dead:
                    finished += self._bury(worker)
        self.left -= len(finished)
        return finished

    def _bury(self, worker: _Worker) -> list[Done[Any]]:
        """Put back what a dead worker had; return the task that it was at where that is given up."""
        self._workers.remove(worker)
        code = worker.end(time.monotonic() + GRACE_S)
        if not worker.ready and worker.begun > self._last_stillborn:  # not one of several that died as one
            self._count_stillborn(code)
        self._waiting.extendleft(reversed(worker.numbers))
        if not worker.numbers:
            return []
        at = worker.numbers[0]
        self._deaths[at] += 1
        if self._deaths[at] < self._attempts:
            return []
        self._waiting.remove(at)
        return [Done(at, None, WorkerDiedError(code, self._attempts))]

    def _count_stillborn(self, code: int) -> None:
        self._stillborn, self._last_stillborn = self._stillborn + 1, time.monotonic()
        if self._stillborn == self._attempts:
            raise WorkerDiedError(code, self._attempts)

    def end(self) -> None:
        """End the workers, whatever they are at."""
        for worker in self._workers:
            worker.pipe.close()
        latest = time.monotonic() + GRACE_S
        for worker in self._workers:
            worker.end(latest)


class _Worker:
    """One worker process, as its parent sees it.

    Attributes:
        pipe: arguments go there, answers come back in the same order.
        begun: when it was started, on the monotonic clock, s.
        ready: whether it has answered that it can begin.
        numbers: of the arguments that it has; it is at the first.
        dead: whether no more answers will come.
    """

    def __init__(self, program: bytes) -> None:
        self.begun = time.monotonic()
        self.pipe, theirs = Pipe()
        self.process = start_process(_work, (theirs, program))
        theirs.close()
        self.ready = self.dead = False
        self.numbers: deque[int] = deque()
        self._since, self._is_quick = time.monotonic(), False

    def takes(self, at: int) -> bool:
        """Return whether a worker that has this many arguments should get one more."""
        return self.ready and len(self.numbers) == at and (at == 0 or self._is_quick)

    def give(self, number: int, argument: Any) -> bool:
        """Send an argument; return whether the worker was there to take it."""
        raw = _packed(argument)
        try:
            self.pipe.send_bytes(raw)
        except OSError:
            return False
        if not self.numbers:
            self._since = time.monotonic()
        self.numbers.append(number)
        return True

    def answers(self) -> Iterator[Done[Any]]:
        """Yield what has come back; take note where that was the last."""
        alive = self.process.is_alive()
        try:
            while self.pipe.poll():
                result, error = pickle.loads(self.pipe.recv_bytes())
                if not self.ready:
                    if error is not None:
                        raise error
                    self.ready = True
                    continue
                now = time.monotonic()
                self._since, self._is_quick = now, now - self._since < SHORT_S
                yield Done(self.numbers.popleft(), result, error)
        except (EOFError, OSError):
            # Killed in the middle of an answer, too.
            alive = False
        self.dead = not alive

    def end(self, latest: float) -> int:
        """See that the process is gone, by force after a time; return its exit code."""
        self.pipe.close()
        self.process.join(max(0.0, latest - time.monotonic()))
        self.process.kill()
        self.process.join()
        code = self.process.exitcode
        self.process.close()
        return code if code is not None else 0


def _packed(sent: Any) -> bytes:
    """Pickle what a worker is to have."""
    try:
        with empty_main_module():
            return pickle.dumps(sent)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise InputError(
            f"worker processes cannot be given this: {error}. They import functions and classes by name, "
            "but not the program that is run: define them in a module and import that"
        ) from error


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

    _send(pipe, _answer(begin))
    while True:
        raw = inbox.get()
        _send(pipe, _answer(lambda raw=raw: task(pickle.loads(raw))))  # type: ignore[misc]


def _send(pipe: Connection, answer: bytes) -> None:
    """Send an answer; leave where nobody waits for it any more."""
    try:
        pipe.send_bytes(answer)
    except OSError:
        raise SystemExit(1) from None


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
    try:
        while True:
            inbox.put(pipe.recv_bytes())
    except (EOFError, OSError):
        # To the main thread itself: nothing else wakes it where it waits.
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
    time.sleep(GRACE_S / 2)
    os._exit(1)


def _leave(number: int, frame: Any) -> None:
    """Leave the task by an exception, so that it cleans up behind itself."""
    raise SystemExit(128 + number)
