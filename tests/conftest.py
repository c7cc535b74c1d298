"""What many tests share: the command line as a person starts it, runs of the shipped scenarios."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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

Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def root() -> Path:
    """The checkout."""
    return ROOT


@pytest.fixture(scope="session")
def srs_twin() -> Command:
    """Start the installed `srs-twin` in a folder: srs_twin("run", "x", cwd=tmp_path)."""
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
