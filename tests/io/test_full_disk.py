"""A full disk gives one clear message and no partial file, and keeps the files of an earlier run."""

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
from srs_twin.cli import _StandardStream
from srs_twin.errors import InputError, WriteError
from srs_twin.experiment import PRODUCTS, prepare
from srs_twin.io.file_sets import replace_files
from srs_twin.io.files import check_output_folder

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
    """Return path → bytes of all files in a folder."""
    return {
        path.relative_to(folder): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.fixture
def room(tmp_path):
    (tmp_path / "brief.yaml").write_text(SCENARIO)
    (tmp_path / "out").mkdir()
    for product in ("metrics.json", "twin.parquet", "notes.txt"):
        (tmp_path / "out" / product).write_text(f"{product} of before")
    return tmp_path


@contextmanager
def largest_file(size):
    """Limit the size of files (bytes), as a quota does, without writing truncated bytecode."""
    bytecode = sys.dont_write_bytecode
    sys.dont_write_bytecode = True
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        sys.dont_write_bytecode = bytecode


@pytest.mark.parametrize("size", [0, 60_000])
def test_file_size_limit_keeps_the_earlier_run(room, size):
    before = contents(room)
    job = prepare(load_scenario(room / "brief.yaml"), room / "out")
    with largest_file(size), pytest.raises(InputError) as refused:
        job.execute()
    assert str(refused.value).endswith(
        "/out: the run's files cannot be written there (File too large); "
        "the files of an earlier run are unchanged"
    )
    assert contents(room) == before


@pytest.fixture
def full_at(monkeypatch):
    """Return a function that fills the disk in the middle of the n-th file of a run without pictures."""
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
        monkeypatch.setattr(
            Trajectory, "to_parquet", lambda run, path: write(path, b"columns")
        )
        for picture in ("html.report.write_report", "rerun.recording.write_recording"):
            monkeypatch.setattr(
                f"srs_twin.viewing.{picture}",
                lambda path, *_, **__: write(path, b"picture"),
            )
        return written

    return fake


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("at", range(1, FILES + 1))
def test_full_disk_at_any_write_keeps_the_earlier_run(room, full_at, at):
    before = contents(room)
    job = prepare(load_scenario(room / "brief.yaml"), room / "out")
    written = full_at(at)
    with pytest.raises(
        InputError, match=r"cannot be written there \(No space left on device\)"
    ):
        job.execute()
    assert len(written) == at
    assert contents(room) == before


def test_complete_run_replaces_the_earlier_run(room, full_at):
    written = full_at(FILES + 1)
    prepare(load_scenario(room / "brief.yaml"), room / "out").execute()
    assert len(written) == FILES
    written_names = {path.name for path in (room / "out").iterdir()}
    assert written_names == {*PRODUCTS, "notes.txt"} - {"twin.parquet"}
    assert (room / "out/metrics.json").read_text() != "metrics.json of before"


def test_next_run_removes_files_of_a_killed_run(room, full_at):
    (room / "out/.part-killed").mkdir()
    (room / "out/.part-killed/report.html").write_text("hal")
    full_at(0)
    prepare(load_scenario(room / "brief.yaml"), room / "out").execute()
    assert not (room / "out/.part-killed").exists()


def test_two_sets_in_one_folder_are_independent(tmp_path):
    for name in ("first", "second"):
        (tmp_path / name).write_text("from before")
    with (
        replace_files(tmp_path, ("first",)) as one,
        replace_files(tmp_path, ("second",)) as two,
    ):
        (one / "first").write_text("of one")
        (two / "second").write_text("of two")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {
        "first": "of one",
        "second": "of two",
    }


@pytest.mark.slow
@pytest.mark.parametrize("buffered", first_by_default(1, ["", "1"]))
def test_results_are_kept_if_stdout_is_full(room, buffered):
    script = Path(sys.executable).with_name("srs-twin")
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            [script, "run", "./brief.yaml", "--out", "new"],
            cwd=room,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=300,
            env=os.environ | {"PYTHONUNBUFFERED": buffered},
            check=False,
        )
    assert done.returncode == 2
    message = "stdout: the output cannot be written (No space left on device)"
    assert done.stderr.splitlines()[-1] == message
    written = {path.name for path in (room / "new").iterdir()}
    assert written == {*PRODUCTS} - {"twin.parquet"}


def test_check_of_an_output_folder_leaves_no_files(tmp_path):
    (tmp_path / "old").mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / "link").symlink_to("nowhere")
    before = sorted(tmp_path.rglob("*"))
    for good in ("old", "new/er/est", "no/../../old", "old/new"):
        check_output_folder(tmp_path / good)
    for bad in (
        "file",
        "file/x",
        "link",
        "link/x",
        f"new/{'x' * 400}",
        "new/\udcff",
        "new/\x1b",
    ):
        with pytest.raises(InputError):
            check_output_folder(tmp_path / bad)
    assert sorted(tmp_path.rglob("*")) == before


def test_failed_set_of_files_removes_its_folders(tmp_path):
    with (
        pytest.raises(ZeroDivisionError),
        replace_files(tmp_path / "new/folder", ("first",)) as fresh,
    ):
        (fresh / "first").write_text("half")
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())


def test_full_disk_behind_a_stream_is_a_write_error():
    with (
        _StandardStream("/dev/full", "wb") as stream,
        pytest.raises(WriteError, match=r"the output cannot be written \(No space"),
    ):
        stream.write(b"x")
