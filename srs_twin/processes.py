"""processes: numbered tasks shared out over worker processes; one that dies costs only what it was at."""

from __future__ import annotations

import os
import pickle
import queue
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar

from srs_twin.errors import InputError, SrsError, TaskFailedError, WorkerDiedError
from srs_twin.process_server import empty_main_module, start_process
from srs_twin.threads import processors

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
        ready = wait([end for worker in self._workers for end in (worker.pipe, worker.process.sentinel)])
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
