"""A full disk: one clear message, nothing half-written, what an earlier run left as it was."""

from __future__ import annotations

import errno
import os
import resource
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from subsets import first_by_default

from srs_twin import Trajectory, load_scenario
from srs_twin.errors import InputError
from srs_twin.experiment import PRODUCTS, prepare
from srs_twin.io.file_sets import replaced
from srs_twin.io.files import open_folder

SCENARIO = """\
title: Brief
robot: gen2
duration_s: 0.2
supply: {pressure_kpa: 48.3}
controller: {kind: gait, frequency_hz: 2.0}
plants: {analytical: {}}
"""
FILES = len(PRODUCTS) - 1  # one plant


def contents(folder):
    """Return path → bytes of all that lies in a folder."""
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def room(tmp_path):
    (tmp_path / "brief.yaml").write_text(SCENARIO)
    (tmp_path / "out").mkdir()
    for product in ("metrics.json", "twin.parquet", "notes.txt"):
        (tmp_path / "out" / product).write_text(f"{product} of before")
    return tmp_path


@contextmanager
def largest_file(size):
    """Let no file grow beyond a size (bytes), as a quota does; Python would keep bytecode that is cut off."""
    bytecode, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        sys.dont_write_bytecode = bytecode


@pytest.mark.parametrize("size", [0, 4_000, 8_000, 60_000])
def test_real_writers_against_a_limit(room, size):
    before = contents(room)
    job = prepare(load_scenario(room / "brief.yaml"), room / "out")
    with largest_file(size), pytest.raises(InputError) as refused:
        job.execute()
    assert str(refused.value).endswith(
        "/out: the run's files cannot be written there (File too large); an earlier run's are as they were"
    )
    assert contents(room) == before
    assert sorted(path.name for path in (room / "out").iterdir()) == [
        "metrics.json", "notes.txt", "twin.parquet"
    ]  # fmt: skip


@pytest.fixture
def full_at(monkeypatch):
    """Make the disk full at the n-th file that a run writes; half of it fits. Pictures are left out."""
    written = []

    def fake(at):
        write_bytes = Path.write_bytes

        def write(path, raw):
            written.append(path.name)
            if len(written) == at:
                write_bytes(path, raw[: len(raw) // 2])
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            write_bytes(path, raw)

        def write_text(path, text, encoding):
            write(path, text.encode(encoding))

        monkeypatch.setattr(Path, "write_text", write_text)
        monkeypatch.setattr(Trajectory, "to_parquet", lambda run, path: write(path, b"columns"))
        for picture in ("html.report.write_report", "rerun.recording.write_recording"):
            monkeypatch.setattr(f"srs_twin.viewing.{picture}", lambda path, **_: write(path, b"picture"))
        return written

    return fake


@pytest.mark.parametrize("at", range(1, FILES + 1))
def test_full_at_any_write(room, full_at, at):
    before = contents(room)
    job = prepare(load_scenario(room / "brief.yaml"), room / "out")
    written = full_at(at)
    with pytest.raises(InputError, match=r"cannot be written there \(No space left on device\)"):
        job.execute()
    assert len(written) == at
    assert contents(room) == before


def test_with_room_again_the_new_run_takes_the_place_of_the_old(room, full_at):
    written = full_at(FILES + 1)
    prepare(load_scenario(room / "brief.yaml"), room / "out").execute()
    assert len(written) == FILES
    found = {path.name for path in (room / "out").iterdir()}
    assert found == {*PRODUCTS, "notes.txt"} - {"twin.parquet"}
    assert (room / "out/metrics.json").read_text() != "metrics.json of before"


def test_what_a_killed_run_left_half_written_goes_with_the_next(room, full_at):
    (room / "out/.part-killed").mkdir()
    (room / "out/.part-killed/report.html").write_text("hal")
    full_at(0)
    prepare(load_scenario(room / "brief.yaml"), room / "out").execute()
    assert not (room / "out/.part-killed").exists()


@pytest.mark.slow
def test_the_command_says_it_in_one_line_and_exits_with_2(room):
    script = Path(sys.executable).with_name("srs-twin")
    before = contents(room / "out")
    done = subprocess.run(
        ["bash", "-c", 'ulimit -f 8 && exec "$@"', "bash", script, "run", "./brief.yaml", "--out", "out"],
        cwd=room,
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert (done.returncode, done.stdout) == (2, "")
    # Where kernels are compiled here for the first time, their machine code finds no room either.
    (said,) = [line for line in done.stderr.splitlines() if "machine code cannot be kept" not in line]
    assert said == (
        "out: the run's files cannot be written there (File too large); an earlier run's are as they were"
    )
    assert contents(room / "out") == before


def test_two_runs_in_one_folder_do_not_disturb_each_other(tmp_path):
    for name in ("first", "second"):
        (tmp_path / name).write_text("from before")
    with replaced(tmp_path, ("first",)) as one, replaced(tmp_path, ("second",)) as two:
        (one / "first").write_text("of one")
        (two / "second").write_text("of two")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {
        "first": "of one",
        "second": "of two",
    }


@pytest.mark.parametrize("words", first_by_default(1, [["schema"], ["--version"], ["--help"]]))
@pytest.mark.parametrize("buffered", first_by_default(1, ["", "1"]))
def test_a_full_disk_behind_stdout_is_no_fault_of_ours(words, buffered, tmp_path):
    script = Path(sys.executable).with_name("srs-twin")
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            [script, *words],
            stdout=full, stderr=subprocess.PIPE, text=True, timeout=300,
            env=os.environ | {"PYTHONUNBUFFERED": buffered},
        )  # fmt: skip
    said = "stdout: cannot be written (No space left on device)\n"
    assert (done.returncode, done.stderr) == (2, said)


@pytest.mark.slow
def test_what_was_computed_stays_though_it_cannot_be_printed(room):
    script = Path(sys.executable).with_name("srs-twin")
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            [script, "run", "./brief.yaml", "--out", "new"],
            cwd=room, stdout=full, stderr=subprocess.PIPE, text=True, timeout=300,
        )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == "stdout: cannot be written (No space left on device)"
    assert {path.name for path in (room / "new").iterdir()} == {*PRODUCTS} - {"twin.parquet"}


def test_looking_whether_a_folder_can_be_written_leaves_nothing(tmp_path):
    (tmp_path / "old").mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / "link").symlink_to("nowhere")
    before = sorted(tmp_path.rglob("*"))
    for good in ("old", "new/er/est", "no/../../old", "old/new"):
        open_folder(tmp_path / good)
    for bad in ("file", "file/x", "link", "link/x", f"new/{'x' * 400}", "new/\udcff", "new/\x1b"):
        with pytest.raises(InputError):
            open_folder(tmp_path / bad)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_set_of_files_that_fails_leaves_no_folder(tmp_path):
    with pytest.raises(ZeroDivisionError), replaced(tmp_path / "new/folder", ("first",)) as fresh:
        (fresh / "first").write_text("half")
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())
