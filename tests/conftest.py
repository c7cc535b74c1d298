"""Shared fixtures: the command line, runs of shipped scenarios, processes and signals."""

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
from subsets import mark_other_cases

ROOT = Path(__file__).parents[1]

# Deadlines of single examples would fail on a busy machine. Every run draws other
# examples.
settings.register_profile("srs_twin", deadline=None, print_blob=True, max_examples=50)
settings.load_profile("srs_twin")

# Each of the two workers has one core.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Messages name commands as this process was started, and tests may be started by `uv
# run`.
for variable in ("UV", "UV_RUN_RECURSION_DEPTH"):
    os.environ.pop(variable, None)

# Tests start hundreds of commands, which would compile the package again without stored
# bytecode.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

ENDINGS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the cases that `default_cases` leaves out before pytest selects by markers."""
    mark_other_cases(items)


@pytest.fixture(scope="session")
def root() -> Path:
    """Return the root of the checkout."""
    return ROOT


@pytest.fixture(scope="session")
def srs_twin_process() -> Command:
    """Return a function that runs the installed `srs-twin` in a folder as a process."""
    script = Path(sys.executable).with_name("srs-twin")

    def start(*words: str, cwd: Path, **env: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [str(script), *words],
            cwd=cwd,
            env={**os.environ, **env},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )

    return start


@pytest.fixture(scope="session")
def srs_twin() -> Command:
    """Return a function that runs `srs-twin` in a folder within this process, without a second of imports."""
    from srs_twin.cli import main

    def run(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
        out, err = (
            io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True)
            for _ in range(2)
        )
        with (
            as_in_a_process(),
            chdir(cwd),
            redirect_stdout(out),
            redirect_stderr(err),
            pytest.raises(SystemExit) as exit_,
        ):
            main(list(arguments))
        texts = (stream.buffer.getvalue().decode() for stream in (out, err))
        return subprocess.CompletedProcess(arguments, exit_.value.code or 0, *texts)

    return run


@contextmanager
def as_in_a_process() -> Iterator[None]:
    """Use Python's default warning filters; afterwards restore environment, signals and warnings.

    The notice of the first compilation would otherwise be called in later tests.
    """
    from srs_twin.compute import compiled

    environ = dict(os.environ)
    handlers = {number: signal.getsignal(number) for number in ENDINGS}
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        for category in (
            DeprecationWarning,
            PendingDeprecationWarning,
            ImportWarning,
            ResourceWarning,
        ):
            warnings.simplefilter("ignore", category)
        formatted = warnings.formatwarning
        warnings.showwarning = lambda *about: print(
            warnings.formatwarning(*about[:4]), end="", file=sys.stderr
        )
        try:
            yield
        finally:
            warnings.formatwarning = formatted
            compiled._notices.clear()  # noqa: SLF001
            os.environ.clear()
            os.environ.update(environ)
            for number, handler in handlers.items():
                signal.signal(number, handler)


@pytest.fixture(scope="session")
def shipped_run(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function from the name of a shipped scenario to a read-only run that all tests share.

    The variable SRS_TWIN_SHIPPED_RUNS may name a folder with finished runs.
    """
    from srs_twin import load_scenario
    from srs_twin.experiment import run_scenario

    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    (shared / "shipped").mkdir(exist_ok=True)

    finished = os.environ.get("SRS_TWIN_SHIPPED_RUNS")

    def run(name: str) -> Path:
        if finished:
            return Path(finished) / name
        folder = shared / "shipped" / name
        with FileLock(folder.with_suffix(".lock")):
            if not (folder / "metrics.json").is_file():
                run_scenario(load_scenario(name), folder)
                for path in folder.iterdir():
                    path.chmod(0o444)
        return folder

    return run


def exists(process: int) -> bool:
    """Return whether a process runs and is not a zombie."""
    try:
        return (
            Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
            != "Z"
        )
    except (FileNotFoundError, ProcessLookupError):
        return False


def wait_until(condition: Callable[[], Any], seconds: float = 300.0) -> None:
    """Wait until a condition holds; fail after a time limit."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "the condition did not become true"
        time.sleep(0.01)


@contextmanager
def on_interrupt(handler: Any) -> Iterator[None]:
    """Set the SIGINT handler of this process and of children that it starts for a `with` block.

    A program that a script starts in the background ignores SIGINT, and its children
    inherit that. Tests that interrupt children must undo it.
    """
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Any]:
    """Yield a running MQTT broker."""
    from brokers import MOSQUITTO, Broker

    if MOSQUITTO is None:
        pytest.skip("mosquitto is not installed")
    with Broker(tmp_path) as running:
        yield running


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Allow SIGINT for the test and its children, even if pytest ignores it."""
    with on_interrupt(signal.default_int_handler):
        yield
