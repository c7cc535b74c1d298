"""Sets of files are replaced atomically, even if the process ends at any line."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
import sys
from multiprocessing import get_context
from pathlib import Path

import pytest

from srs_twin.errors import InputError
from srs_twin.io import file_sets
from srs_twin.io.file_sets import replace_files

pytestmark = pytest.mark.fast

MARK = "mark.json"
PRODUCTS = (MARK, "page.html", "old.csv", "new.csv", "best/*.yaml")
OLD = {
    name: "old" for name in (MARK, "page.html", "old.csv", "best/1.yaml", "best/2.yaml")
}
NEW = {name: "new" for name in (MARK, "page.html", "new.csv", "best/1.yaml")}
NOTES = {"notes.txt": "of a user", "best/notes.txt": "of a user"}


def without_mark(files):
    return {name: text for name, text in files.items() if name != MARK}


PAIRS = {
    "both complete": (OLD, NEW),
    "new set without mark": (OLD, without_mark(NEW)),
    "old set without mark": (without_mark(OLD), NEW),
    "both without mark": (without_mark(OLD), without_mark(NEW)),
    "no old set": ({}, NEW),
}
READ_ONLY = ("_existing_products", "_lock", "_has_saved_files")
"""Functions that change no file."""


def put(folder, files):
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def contents(folder):
    """Return name → text of all files, including those in hidden folders."""
    return {
        str(path.relative_to(folder)): path.read_text()
        for path in folder.rglob("*")
        if path.is_file()
    }


def finish(folder, files):
    with replace_files(folder, PRODUCTS) as staging:
        put(staging, files)


@pytest.fixture
def room(tmp_path):
    """Return a function that creates a folder with a set of files and notes of a user."""

    def create(name, old):
        put(tmp_path / str(name), old | NOTES)
        return tmp_path / str(name)

    return create


def traced(number, action, call):
    """Make a call, and act before the n-th line of `file_sets` that may change a file."""
    remaining = [number]

    def trace(frame, event, argument):
        if (
            frame.f_code.co_filename != file_sets.__file__
            or frame.f_code.co_name in READ_ONLY
        ):
            return None
        if event == "line":
            remaining[0] -= 1
            if remaining[0] == 0:
                action()
        return trace

    sys.settrace(trace)
    call()


def interrupt():
    raise KeyboardInterrupt


def kill():
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
@pytest.mark.parametrize("end", [interrupt, kill])
@pytest.mark.parametrize(
    "pair",
    [
        name
        if name == "both complete"
        else pytest.param(name, marks=pytest.mark.nightly)
        for name in PAIRS
    ],
)
def test_process_killed_at_any_line_leaves_one_complete_set_or_no_mark(room, pair, end):
    """A failing next run restores the earlier set unless the new one is complete."""
    old, new = PAIRS[pair]
    for line in range(1, 200):
        folder = room(line, old)
        code = in_a_fork(
            lambda line=line, folder=folder: traced(
                line, end, lambda: finish(folder, new)
            )
        )
        if code == 0:
            break
        visible = {
            name: text
            for name, text in contents(folder).items()
            if not name.startswith(".part-")
        }
        if MARK in visible:
            assert visible in (old | NOTES, new | NOTES), line
        with pytest.raises(ZeroDivisionError), replace_files(folder, PRODUCTS):
            raise ZeroDivisionError
        assert contents(folder) in (old | NOTES, new | NOTES), line
        assert not list(folder.glob(".part-*"))
    assert 40 < line < 199
    assert contents(folder) == new | NOTES


def in_a_fork(call):
    """Run a call in a forked process; return its exit status."""
    pid = os.fork()
    if not pid:
        try:
            call()
            os._exit(0)
        finally:
            os._exit(1)
    return os.waitpid(pid, 0)[1]


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("pair", PAIRS)
def test_earlier_set_is_restored_if_a_file_cannot_be_moved(room, monkeypatch, pair):
    """Every move fails once, as with an immutable file, a mount point or a full disk."""
    old, new = PAIRS[pair]
    moved = []
    rename = Path.rename

    def refuse(path, target):
        moved.append(path)
        if len(moved) == number:
            raise PermissionError(
                errno.EPERM, os.strerror(errno.EPERM), os.fspath(path)
            )
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", refuse)
    number = 0
    finish(room("complete", old), new)
    *moves, _ = moved  # the replacement is complete before the last move
    assert len(moves) == len(old) + 1 + len(new)
    for number in range(1, len(moves) + 1):
        moved.clear()
        folder = room(number, old)
        message = (
            r"the run's files cannot be written there \((\S+: )?Operation not"
            r" permitted\); the files"
        )
        with pytest.raises(InputError, match=message):
            finish(folder, new)
        assert contents(folder) == old | NOTES


def test_immutable_file_is_named_and_the_earlier_set_kept(room):
    folder = room("here", OLD)
    if os.system(f"chattr +i {folder}/page.html 2>/dev/null"):
        pytest.skip("immutable files are not possible on this machine")
    try:
        with pytest.raises(
            InputError,
            match=r"cannot be written there \(page.html: Operation not permitted\)",
        ):
            finish(folder, NEW)
    finally:
        os.system(f"chattr -i {folder}/page.html")
    assert contents(folder) == OLD | NOTES


def test_next_run_restores_files_that_could_not_be_moved_back(room, monkeypatch):
    folder = room("here", OLD)
    rename = Path.rename

    def refuse(path, target):
        if path.name == "page.html":
            monkeypatch.setattr(Path, "rename", refuse_all)
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), os.fspath(path))
        return rename(path, target)

    def refuse_all(path, target):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), os.fspath(path))

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(
        InputError,
        match=r"earlier files are in .*\.part-\w+, and the next run restores them",
    ):
        finish(folder, NEW)
    assert MARK not in contents(folder)
    monkeypatch.setattr(Path, "rename", rename)
    with pytest.raises(ZeroDivisionError), replace_files(folder, PRODUCTS):
        raise ZeroDivisionError
    assert contents(folder) == OLD | NOTES


def finishes(folder, who, count, gate):
    for number in range(count):
        gate.wait()
        finish(folder, dict.fromkeys(NEW, f"{who} {number}"))


def test_simultaneous_processes_never_leave_a_mixed_set(tmp_path):
    fork = get_context("fork")
    count = 40
    gate = fork.Barrier(3)
    workers = [
        fork.Process(target=finishes, args=(tmp_path, who, count, gate))
        for who in range(2)
    ]
    for worker in workers:
        worker.start()
    for _ in range(count):
        gate.wait(60)
    for worker in workers:
        worker.join()
        assert worker.exitcode == 0
    remaining = contents(tmp_path)
    assert remaining.keys() == NEW.keys() and len(set(remaining.values())) == 1


def test_lock_timeout_is_an_input_error(room, monkeypatch):
    folder = room("here", OLD)
    monkeypatch.setattr(file_sets._lock.__wrapped__, "__defaults__", (0.0,))
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        with pytest.raises(
            InputError, match=r"\(another process has locked the folder\); the files"
        ):
            finish(folder, NEW)
    finally:
        os.close(handle)
    assert contents(folder) == OLD | NOTES


def test_file_system_without_locks_is_supported(room, monkeypatch):
    """A staging folder may then belong to another run and is kept."""
    folder = room("here", OLD)

    def refuse(handle, operation):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)
    put(folder, {".part-other/page.html": "of another run"})
    finish(folder, NEW)
    assert contents(folder) == NEW | NOTES | {".part-other/page.html": "of another run"}
