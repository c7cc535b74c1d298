"""What many tests share: the command line as a person starts it, runs of the shipped scenarios."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock
from hypothesis import settings

ROOT = Path(__file__).parents[1]

# Wall-clock deadlines of single examples fail on a busy machine and say nothing about the code.
settings.register_profile("srs_twin", deadline=None, print_blob=True)
settings.load_profile("srs_twin")

# Tests start hundreds of commands: each would compile the package anew where Python keeps no bytecode.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

ENDINGS = (signal.SIGINT, signal.SIGTERM)
Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def root() -> Path:
    """The checkout."""
    return ROOT


@pytest.fixture(scope="session")
def srs_twin_process() -> Command:
    """Start the installed `srs-twin` in a folder, as a person does."""
    script = Path(sys.executable).with_name("srs-twin")

    def start(*words: str, cwd: Path, **env: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [str(script), *words],
            cwd=cwd,
            env={**os.environ, **env},
            capture_output=True,
            text=True,
            timeout=300,
        )

    return start


@pytest.fixture(scope="session")
def srs_twin() -> Command:
    """Run `srs-twin` in a folder within this process, which spares a second of imports."""
    from srs_twin.cli import main

    def run(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
        out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True) for _ in range(2))
        with as_in_a_process(), chdir(cwd), redirect_stdout(out), redirect_stderr(err):
            with pytest.raises(SystemExit) as ended:
                main(list(words))
        texts = (stream.buffer.getvalue().decode() for stream in (out, err))
        return subprocess.CompletedProcess(words, ended.value.code or 0, *texts)

    return run


@contextmanager
def as_in_a_process() -> Iterator[None]:
    """Show warnings as Python's own filters do; undo what a command changes of its process."""
    environ, handlers = dict(os.environ), {each: signal.getsignal(each) for each in ENDINGS}
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        for quiet in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
            warnings.simplefilter("ignore", quiet)
        formatted = warnings.formatwarning
        warnings.showwarning = lambda *about: print(
            warnings.formatwarning(*about[:4]), end="", file=sys.stderr
        )
        try:
            yield
        finally:
            warnings.formatwarning = formatted
            os.environ.clear()
            os.environ.update(environ)
            for each, handler in handlers.items():
                signal.signal(each, handler)


@pytest.fixture(scope="session")
def shipped_run(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return the run folder of a shipped scenario, which one worker simulates for all; not to be changed."""
    from srs_twin import load_scenario
    from srs_twin.experiment import run_scenario

    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    (shared / "shipped").mkdir(exist_ok=True)

    def run(name: str) -> Path:
        folder = shared / "shipped" / name
        with FileLock(folder.with_suffix(".lock")):
            if not (folder / "metrics.json").is_file():
                run_scenario(load_scenario(name), folder)
                for path in folder.iterdir():
                    path.chmod(0o444)
        return folder

    return run


def exists(process: int) -> bool:
    """Whether a process runs: not gone, and no zombie that only waits to be looked at."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def wait_until(condition: Callable[[], Any], seconds: float = 300.0) -> None:
    """Wait until something holds; fail where it never does."""
    latest = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < latest, "waited in vain"
        time.sleep(0.01)


@contextmanager
def on_interrupt(handler: Any) -> Iterator[None]:
    """Let this process, and children that it starts meanwhile, do something else on SIGINT.

    Children that are to be interrupted need that: a program that a script starts in the background ignores
    SIGINT, and so does all that it starts.
    """
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Children of the test, and itself, can be interrupted, whether or not pytest can be."""
    with on_interrupt(signal.default_int_handler):
        yield
