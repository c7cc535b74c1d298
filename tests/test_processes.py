"""Worker processes: results as a plain loop would give them, whatever happens to the workers."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial
from multiprocessing import active_children
from pathlib import Path

import pytest
from conftest import exists, wait_until

from srs_twin.compute.workers import METHOD, each
from srs_twin.errors import DivergedError, InputError, SrsError, TaskFailedError, WorkerDiedError
from srs_twin.io.files import atomic_write

# Tasks: a worker imports them from here.
PREPARED: list[str] = []


def square(x):
    return x * x


def pid(_):
    return os.getpid()


def suicide_of(bad, how, x):
    """Kill the worker at some arguments, with all it has; return the others' squares."""
    if x in bad:
        os.kill(os.getpid(), how)
    return square(x)


def suicide_at_first(folder, x):
    """Kill the worker at every argument's first attempt; return the attempt and the square."""
    with (folder / str(x)).open("a") as seen:
        seen.write(f"{os.getpid()}\n")
    tries = (folder / str(x)).read_text().splitlines()
    if len(tries) == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return len(tries), square(x)


def end_the_server_at_first(folder, x):
    """Kill what this worker came from, the first time that anybody gets here."""
    try:
        (folder / "killed").touch(exist_ok=False)
    except FileExistsError:
        return square(x)
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(600)


def count_and_die(folder, _):
    (folder / str(os.getpid())).touch()
    kill_self()


def loaded(module, _):
    return module in sys.modules


def fail(x):
    if x == 0:
        raise InputError("zero is not allowed")
    if x == 1:
        raise DivergedError("twin", 1.5, "qpos is not finite", history=[x])
    if x == 2:
        return lambda: "nobody can send this"
    return 1 / (x - 3)


def leave(x):
    sys.exit(x)


def prepared(_):
    return PREPARED


def note(word):
    PREPARED.append(word)


def kill_self():
    os.kill(os.getpid(), signal.SIGKILL)


def refuse():
    raise InputError("no such robot")


def write_slowly(folder, _):
    """Stay in the middle of a file for longer than any test takes."""
    with atomic_write(folder / "result") as part:
        part.write_text("half")
        (folder / "pid").write_text(str(os.getpid()))
        time.sleep(600)


def results(done):
    assert [each.error for each in done] == [None] * len(done)
    return [each.result for each in sorted(done, key=lambda each: each.number)]


@pytest.fixture(autouse=True)
def nothing_left_behind():
    yield
    assert active_children() == []


@pytest.mark.parametrize("workers", [1, 3])
def test_every_argument_once_and_its_own_result(workers):
    arguments = list(range(50))
    assert results(list(each(square, arguments, workers=workers))) == [x * x for x in arguments]


def test_no_more_workers_than_tasks_and_none_for_none():
    assert len(set(results(list(each(pid, [0, 1], workers=8))))) <= 2
    assert list(each(pid, [], workers=8)) == []


@pytest.mark.parametrize("given", [{"workers": 0}, {"workers": -1}, {"attempts": 0}])
def test_fewer_than_one_is_refused_at_once(given):
    with pytest.raises(InputError, match=r"(workers|attempts): -?\d is not allowed; it must be 1 or more"):
        each(square, [1], **given)


def test_a_killed_worker_costs_an_attempt_of_the_task_it_was_at(tmp_path):
    done = results(list(each(partial(suicide_at_first, tmp_path), range(4), workers=2)))
    # Two attempts each, no more: nobody is blamed for what a neighbour did.
    assert done == [(2, x * x) for x in range(4)]


@pytest.mark.parametrize(("how", "words"), [(signal.SIGKILL, "SIGKILL"), (signal.SIGSEGV, "SIGSEGV")])
def test_a_task_that_kills_every_worker_fails_alone(how, words):
    arguments = list(range(30))
    done = {d.number: d for d in each(partial(suicide_of, {7}, how), arguments, workers=2, attempts=2)}
    assert sorted(done) == arguments
    assert isinstance(done[7].error, WorkerDiedError)
    assert f"killed by {words}, 2 times in a row" in str(done[7].error)
    del done[7]
    assert all(d.result == n * n and d.error is None for n, d in done.items())


@pytest.mark.slow
@pytest.mark.parametrize("attempts", [1, 2])
def test_a_task_that_kills_its_workers_is_tried_as_often_as_allowed(attempts, tmp_path):
    (done,) = each(partial(count_and_die, tmp_path), [0], workers=1, attempts=attempts)
    assert isinstance(done.error, WorkerDiedError)
    assert len(list(tmp_path.iterdir())) == attempts


def test_a_task_that_leaves_the_interpreter_counts_as_a_death():
    (done,) = each(leave, [5], attempts=1)
    assert isinstance(done.error, WorkerDiedError)
    assert "ended with exit code 5; " in str(done.error)


@pytest.mark.slow
@pytest.mark.skipif(METHOD != "forkserver", reason="workers of this system come from no server")
def test_the_end_of_the_server_costs_an_attempt_and_another_takes_its_place(tmp_path):
    task = partial(end_the_server_at_first, tmp_path)
    assert results(list(each(task, range(20), workers=4))) == [x * x for x in range(20)]
    assert (tmp_path / "killed").exists()


def test_what_tasks_raise_comes_back_and_the_others_go_on():
    done = {d.number: d for d in each(fail, range(6), workers=1)}
    assert [d.result for d in done.values()] == [None, None, None, None, 1.0, 0.5]
    assert isinstance(done[0].error, InputError)
    assert str(done[0].error) == "zero is not allowed"
    diverged = done[1].error
    assert isinstance(diverged, DivergedError)
    assert (diverged.time, diverged.history, diverged.exit_code) == (1.5, [1], 3)
    assert isinstance(done[2].error, TaskFailedError)
    assert "pickle" in str(done[2].error)
    assert isinstance(done[3].error, TaskFailedError)
    assert "ZeroDivisionError: division by zero (test_processes.py:" in str(done[3].error)
    assert "return 1 / (x - 3)" in "".join(done[3].error.__notes__)


def test_prepare_runs_once_in_every_worker():
    assert results(list(each(prepared, range(3), workers=1, prepare=partial(note, "x")))) == [["x"]] * 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("prepare", "kind", "words"),
    [(refuse, InputError, "^no such robot"), (kill_self, WorkerDiedError, "SIGKILL, 2 times in a row")],
)
def test_what_stops_every_worker_stops_the_whole(prepare, kind, words):
    with pytest.raises(kind, match=words):
        list(each(square, [1, 2], workers=2, attempts=2, prepare=prepare))


OF_THE_SCRIPT = """
from dataclasses import dataclass
from functools import partial
from srs_twin.errors import InputError
from srs_twin.compute.workers import each
from test_processes import square

def mine(x):
    return x

@dataclass
class Mine:
    x: int

for task, arguments in ((mine, [1]), (partial(max, key=mine), [1]), (lambda x: x, [1]), (square, [Mine(1)])):
    try:
        print(*each(task, arguments, workers=1))
    except InputError as error:
        print(error)
"""


def script(folder, text, *words, **further):
    """Write a script that can import the modules of tests; return the arguments for `subprocess`."""
    (folder / "script.py").write_text(text)
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    return {"args": [sys.executable, folder / "script.py", *words], "env": env, "text": True, **further}


def test_what_only_the_script_defines_is_refused(tmp_path):
    run = subprocess.run(**script(tmp_path, OF_THE_SCRIPT, capture_output=True))
    assert run.stderr == ""
    lines = run.stdout.splitlines()
    assert len(lines) == 4
    for line, name in zip(lines, ("mine", "mine", "<lambda>", "Mine"), strict=True):
        assert line.startswith("worker processes cannot be given this: ") and name in line
        assert line.endswith("but not the program that is run: define them in a module and import that")


PARENT = """
import sys
from functools import partial
from pathlib import Path
from test_processes import write_slowly
from srs_twin.compute.workers import each

list(each(partial(write_slowly, Path(sys.argv[1])), [0, 1], workers=1))
"""


@pytest.fixture
def parent(tmp_path, interruptible):
    """A process whose worker is in the middle of writing a file: (it, folder, the worker's id)."""
    folder = tmp_path / "results"
    folder.mkdir()
    with subprocess.Popen(
        **script(tmp_path, PARENT, str(folder), stderr=subprocess.PIPE, start_new_session=True)
    ) as process:
        wait_until(lambda: (folder / "pid").exists() and (folder / "pid").read_text())
        yield process, folder, int((folder / "pid").read_text())
        process.kill()


def test_ctrl_c_is_the_parents_and_the_workers_clean_up(parent):
    process, folder, worker = parent
    # As the terminal does it: to the worker, too.
    os.killpg(process.pid, signal.SIGINT)
    said = process.stderr.read()
    assert process.wait(timeout=300) == -signal.SIGINT
    assert said.count("Traceback") == 1
    assert not exists(worker)
    assert [path.name for path in folder.iterdir()] == ["pid"]


def test_workers_do_not_outlive_a_parent_that_was_killed(parent):
    process, folder, worker = parent
    process.kill()
    process.wait()
    wait_until(lambda: not exists(worker))
    assert [path.name for path in folder.iterdir()] == ["pid"]


PRELOADING = """
import sys
from functools import partial
from test_processes import loaded
from srs_twin.compute.workers import start_server
from srs_twin.compute.workers import each

start_server("srs_twin.studies.sweep.warm")
names = ("srs_twin.studies.sweep.warm", "srs_twin.plants.analytical", "mujoco")
print(*(done.result for name in names for done in each(partial(loaded, name), [0], workers=1)))
"""


@pytest.mark.slow
@pytest.mark.skipif(METHOD != "forkserver", reason="workers of this system load everything themselves")
def test_workers_begin_with_what_the_server_has_loaded_from_no_folder_of_the_users(tmp_path):
    # multiprocessing keeps silent about a module that cannot be imported: this is where it would be seen.
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for name in ("numpy", "numba", "srs_twin", "random"):
        (elsewhere / f"{name}.py").write_text("raise SystemExit('of the folder that we stand in')")
    run = subprocess.run(**script(tmp_path, PRELOADING, cwd=elsewhere, capture_output=True))
    assert (run.stdout, run.stderr) == ("True True False\n", "")


def test_closing_ends_the_workers():
    done = each(square, range(1000), workers=2)
    next(done)
    assert len(active_children()) == 2
    done.close()
    assert active_children() == []


def test_errors_are_of_one_family():
    assert issubclass(WorkerDiedError, SrsError)
    assert issubclass(TaskFailedError, SrsError)
    assert (WorkerDiedError.exit_code, TaskFailedError.exit_code) == (4, 4)
