"""process_server: where worker processes come from.

On Linux they are forked from a server: a process of its own that has loaded, once, what they need. A worker
then starts in hundredths of a second instead of one or two, the first one and every one that takes a dead
one's place. The server itself runs nothing but that; it ends with this process. Elsewhere every worker is
started anew, because the libraries of other systems do not bear a fork.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import forkserver, get_context, resource_tracker
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any

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
