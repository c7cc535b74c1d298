"""Worker processes: results are those of a loop, even if workers die."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from multiprocessing import active_children
from pathlib import Path

import pytest
from conftest import exists, wait_until

from srs_twin.compute.workers import START_METHOD, Workers, run_tasks
from srs_twin.errors import (
    DivergedError,
    InputError,
    TaskFailedError,
    WorkerDiedError,
)
from srs_twin.io.files import atomic_write


# Tasks, which workers import from this module.
def square(x):
    return x * x


def pid(_):
    return os.getpid()


def kill_at(bad, how, x):
    """Kill the worker at some arguments; return the square of all other arguments."""
    if x in bad:
        os.kill(os.getpid(), how)
    return square(x)


def kill_at_first_attempt(folder, x):
    """Kill the worker at the first attempt of every argument; return attempt number and square."""
    with (folder / str(x)).open("a") as seen:
        seen.write(f"{os.getpid()}\n")
    tries = (folder / str(x)).read_text().splitlines()
    if len(tries) == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return len(tries), square(x)


def kill_server_once(folder, x):
    """Kill the fork server in the first call."""
    try:
        (folder / "killed").touch(exist_ok=False)
    except FileExistsError:
        return square(x)
    os.kill(os.getppid(), signal.SIGKILL)
    return time.sleep(600)


def loaded(module, _):
    return module in sys.modules


def fail(x):
    if x == 0:
        raise InputError("zero is not allowed")
    if x == 1:
        raise DivergedError("twin", 1.5, "qpos is not finite", history=[x])
    if x == 2:
        return lambda: "cannot be pickled"
    return 1 / (x - 3)


def leave(x):
    sys.exit(x)


def kill_self():
    os.kill(os.getpid(), signal.SIGKILL)


def refuse():
    raise InputError("no such robot")


class Imported:
    """Task that calls a function when a worker imports it."""

    def __init__(self, function):
        self.function = function

    def __reduce__(self):
        return self.function, ()

    def __call__(self, argument):
        return argument


def write_slowly(folder, _):
    """Hold a half-written file for longer than any test takes."""
    with atomic_write(folder / "result") as temporary:
        temporary.write_text("half")
        (folder / "pid").write_text(str(os.getpid()))
        time.sleep(600)


def results(done):
    assert [task.error for task in done] == [None] * len(done)
    return [task.result for task in sorted(done, key=lambda task: task.number)]


@pytest.fixture(autouse=True)
def nothing_left_behind():
    yield
    assert active_children() == []


@pytest.mark.parametrize("workers", [1, 3])
def test_every_argument_has_one_result(workers):
    arguments = list(range(50))
    assert results(list(run_tasks(square, arguments, workers=workers))) == [
        x * x for x in arguments
    ]


def test_there_are_at_most_as_many_workers_as_tasks():
    assert len(set(results(list(run_tasks(pid, [0, 1], workers=8))))) <= 2
    assert list(run_tasks(pid, [], workers=8)) == []


@pytest.mark.parametrize("options", [{"workers": 0}, {"attempts": 0}])
def test_fewer_than_one_worker_or_attempt_is_rejected(options):
    with pytest.raises(
        InputError,
        match=r"`(workers|attempts)` 0 is not allowed; it must be 1 or more",
    ):
        run_tasks(square, [1], **options)


def test_killed_worker_counts_as_an_attempt_of_its_own_task(tmp_path):
    done = results(
        list(run_tasks(partial(kill_at_first_attempt, tmp_path), range(4), workers=2))
    )
    # Two attempts each: deaths do not count for tasks of other workers.
    assert done == [(2, x * x) for x in range(4)]


@pytest.mark.parametrize(
    ("how", "words"), [(signal.SIGKILL, "SIGKILL"), (signal.SIGSEGV, "SIGSEGV")]
)
def test_task_that_kills_every_worker_fails_alone(how, words):
    arguments = list(range(30))
    done = {
        d.number: d
        for d in run_tasks(partial(kill_at, {7}, how), arguments, workers=2, attempts=2)
    }
    assert sorted(done) == arguments
    assert isinstance(done[7].error, WorkerDiedError)
    assert f"killed by {words}, 2 times in a row" in str(done[7].error)
    del done[7]
    assert all(d.result == n * n and d.error is None for n, d in done.items())


def test_task_that_exits_counts_as_a_death():
    (done,) = run_tasks(leave, [5], attempts=1)
    assert isinstance(done.error, WorkerDiedError)
    assert "ended with exit code 5; " in str(done.error)


@pytest.mark.slow
@pytest.mark.skipif(
    START_METHOD != "forkserver", reason="this system has no fork server"
)
def test_killed_fork_server_is_replaced(tmp_path):
    task = partial(kill_server_once, tmp_path)
    assert results(list(run_tasks(task, range(20), workers=4))) == [
        x * x for x in range(20)
    ]
    assert (tmp_path / "killed").exists()


def test_errors_of_tasks_are_returned_and_other_tasks_continue():
    done = {d.number: d for d in run_tasks(fail, range(6), workers=1)}
    assert [d.result for d in done.values()] == [None, None, None, None, 1.0, 0.5]
    assert isinstance(done[0].error, InputError)
    assert str(done[0].error) == "zero is not allowed"
    diverged = done[1].error
    assert isinstance(diverged, DivergedError)
    assert (diverged.time, diverged.history, diverged.exit_code) == (1.5, [1], 3)
    assert isinstance(done[2].error, TaskFailedError)
    assert "pickle" in str(done[2].error)
    assert isinstance(done[3].error, TaskFailedError)
    assert "ZeroDivisionError: division by zero (test_workers.py:" in str(done[3].error)
    assert "return 1 / (x - 3)" in "".join(done[3].error.__notes__)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("function", "kind", "words"),
    [
        (refuse, InputError, "^no such robot"),
        (kill_self, WorkerDiedError, "SIGKILL, 2 times in a row"),
    ],
)
def test_failing_import_of_the_task_stops_the_run(function, kind, words):
    with pytest.raises(kind, match=words):
        list(run_tasks(Imported(function), [1, 2], workers=2, attempts=2))


MAIN_PROGRAM = """
from dataclasses import dataclass
from functools import partial
from srs_twin.errors import InputError
from srs_twin.compute.workers import run_tasks
from test_workers import square

def mine(x):
    return x

@dataclass
class Mine:
    x: int

for task, arguments in ((mine, [1]), (partial(max, key=mine), [1]), (lambda x: x, [1]), (square, [Mine(1)])):
    try:
        print(*run_tasks(task, arguments, workers=1))
    except InputError as error:
        print(error)
"""


def script(folder, text, *words, **further):
    """Write a script that can import test modules; return the arguments of `subprocess.run`."""
    (folder / "script.py").write_text(text)
    here = Path(__file__).parent
    folders = [here, here.parent, here.parent / "helpers"]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders))}
    return {
        "args": [sys.executable, folder / "script.py", *words],
        "env": env,
        "text": True,
        **further,
    }


def test_objects_of_the_main_program_are_rejected(tmp_path):
    run = subprocess.run(
        check=False, **script(tmp_path, MAIN_PROGRAM, capture_output=True)
    )
    assert run.stderr == ""
    lines = run.stdout.splitlines()
    assert len(lines) == 4
    for line, name in zip(lines, ("mine", "mine", "<lambda>", "Mine"), strict=True):
        assert (
            line.startswith("the task cannot be sent to worker processes: ")
            and name in line
        )
        assert line.endswith(
            "but not from the main program; define them in a module and import it"
        )


PARENT = """
import sys
from functools import partial
from pathlib import Path
from test_workers import write_slowly
from srs_twin.compute.workers import run_tasks

list(run_tasks(partial(write_slowly, Path(sys.argv[1])), [0, 1], workers=1))
"""


@pytest.fixture
def parent(tmp_path, interruptible):
    """Yield a process whose worker holds a half-written file, the folder, and the worker's process id."""
    folder = tmp_path / "results"
    folder.mkdir()
    with subprocess.Popen(
        **script(
            tmp_path,
            PARENT,
            str(folder),
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
    ) as process:
        wait_until(lambda: (folder / "pid").exists() and (folder / "pid").read_text())
        yield process, folder, int((folder / "pid").read_text())
        process.kill()


def test_ctrl_c_interrupts_the_parent_and_workers_clean_up(parent):
    process, folder, worker = parent
    # To the process group, as a terminal does.
    os.killpg(process.pid, signal.SIGINT)
    output = process.stderr.read()
    assert process.wait(timeout=300) == -signal.SIGINT
    assert output.count("Traceback") == 1
    assert not exists(worker)
    assert [path.name for path in folder.iterdir()] == ["pid"]


def test_workers_end_when_their_parent_is_killed(parent):
    process, folder, worker = parent
    process.kill()
    process.wait()
    wait_until(lambda: not exists(worker))
    assert [path.name for path in folder.iterdir()] == ["pid"]


PRELOADING = """
import sys
from functools import partial
from test_workers import loaded
from srs_twin.compute.workers import start_server
from srs_twin.compute.workers import run_tasks

start_server("srs_twin.studies.sweep.warm")
names = ("srs_twin.studies.sweep.warm", "srs_twin.plants.analytical", "mujoco")
print(*(done.result for name in names for done in run_tasks(partial(loaded, name), [0], workers=1)))
"""


@pytest.mark.slow
@pytest.mark.skipif(
    START_METHOD != "forkserver", reason="this system has no fork server"
)
def test_workers_have_the_preloaded_modules_and_ignore_the_current_folder(tmp_path):
    # multiprocessing ignores modules that cannot be imported; the output below would
    # show it.
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for name in ("numpy", "numba", "srs_twin", "random"):
        (elsewhere / f"{name}.py").write_text(
            "raise SystemExit('imported from the current folder')"
        )
    run = subprocess.run(
        check=False, **script(tmp_path, PRELOADING, cwd=elsewhere, capture_output=True)
    )
    assert (run.stdout, run.stderr) == ("True True False\n", "")


def test_closing_the_generator_ends_the_workers():
    done = run_tasks(square, range(1000), workers=2)
    next(done)
    assert len(active_children()) == 2
    done.close()
    assert active_children() == []


def test_a_failed_task_cancels_only_the_tasks_after_it():
    """Task 2 of 4 fails first; tasks with lower numbers still decide the result."""
    failed = threading.Event()
    cancelled = threading.Event()
    started = threading.Barrier(4)
    seen = {}

    def task(number, is_cancelled):
        started.wait(60)
        if number == 2:
            failed.set()
            raise ValueError("task 2")
        failed.wait(60)
        if number == 3:
            wait_until(is_cancelled, 20)
            cancelled.set()
        if number == 1:
            cancelled.wait(30)
        seen[number] = is_cancelled()
        if number == 1:
            raise ValueError("task 1")
        return number

    done = []
    with pytest.raises(ValueError, match="task 1"):
        Workers(4).run(4, task, done.append)
    assert seen == {0: False, 1: False, 3: True}
    assert Workers(2).run(3, lambda k, _: k, done.append) == [0, 1, 2]
    assert done[-3:] == [1, 2, 3]
