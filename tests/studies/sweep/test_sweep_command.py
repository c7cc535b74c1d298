"""`srs-twin sweep`: output, files, messages, interrupts and kills."""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import killed_sweeps as kills
import pyarrow.parquet as pq
import pytest
from conftest import wait_until
from small import SMALL, here, write

import srs_twin as srs
from srs_twin import load_scenario
from srs_twin.errors import InputError
from srs_twin.studies.sweep.loading import load_sweep

COMMAND = Path(sys.executable).with_name("srs-twin")
SLOWER = SMALL.replace("duration_s: 2", "duration_s: 100").replace(
    "count: 4", "count: 24"
)


def test_files_and_output_of_a_sweep(srs_twin, tmp_path):
    write(tmp_path)
    run = srs_twin("sweep", "small.yaml", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert (
        "8 of 8 runs done, 0 failed" in run.stdout
        and "analytical.com_speed_m_s" in run.stdout
    )
    folder = tmp_path / "runs" / "sweeps" / "small"
    about = json.loads((folder / "sweep.json").read_text())
    assert f"results sha256 {about['results_sha256']}" in run.stdout
    table = pq.read_table(folder / "results.parquet")
    assert table.num_rows == 8
    speeds = sorted(table["analytical.com_speed_m_s"].to_pylist())
    ends = (speeds[0], (speeds[3] + speeds[4]) / 2, speeds[7])
    assert re.search(
        r"analytical\.com_speed_m_s +" + " +".join(f"{end:.4g}" for end in ends),
        run.stdout,
    )
    assert "report runs/sweeps/small/report.html\n" in run.stdout
    assert about["results_sha256"] in (folder / "report.html").read_text("utf-8")
    again = srs_twin("sweep", "small.yaml", cwd=tmp_path)
    assert (
        again.returncode == 0 and "8 of 8 rows exist already, 0 to do" in again.stderr
    )
    # The stored sweep.yaml gives the same results.
    assert (
        srs_twin(
            "sweep", str(folder / "sweep.yaml"), "--out", "copy", "-q", cwd=tmp_path
        ).returncode
        == 0
    )
    copy = json.loads((tmp_path / "copy" / "sweep.json").read_text())
    assert copy["results_sha256"] == about["results_sha256"]


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_results_of_other_kinds_are_not_overwritten(srs_twin, tmp_path):
    short = load_scenario("gen2_straight", set={"duration_s": 1})
    small = load_sweep(write(tmp_path))
    run, swept = tmp_path / "run", tmp_path / "sweep"
    srs.run_scenario(short, run, plants=["analytical"])
    srs.sweep(small, out=swept, engine=here)
    (tmp_path / "summary").mkdir()
    # The folder of an interrupted sweep contains no summary.
    (swept / "sweep.json").rename(tmp_path / "summary/sweep.json")
    (tmp_path / "study/twin").mkdir(parents=True)
    shutil.copy(swept / "rows.sqlite", tmp_path / "study/twin")
    before = contents(tmp_path)
    for command, folder, kind in (
        (("sweep", "small.yaml", "--out", "run"), "run", "a run"),
        (("run", "gen2_straight", "--out", "sweep"), "sweep", "a sweep"),
    ):
        done = srs_twin(*command, cwd=tmp_path)
        assert done.returncode == 2
        assert f"{folder}: the folder contains {kind}; give another" in done.stderr
    for function, source, folder, kind in (
        (srs.sweep, small, run, "a run"),
        (srs.optimize, "gen2_speed", run, "a run"),
        (srs.run_scenario, short, swept, "a sweep"),
        (srs.run_scenario, short, tmp_path / "summary", "a sweep"),
        (srs.run_scenario, short, tmp_path / "study", "an optimization"),
        (srs.sweep, small, tmp_path / "study", "an optimization"),
    ):
        with pytest.raises(InputError, match=f"the folder contains {kind}; give"):
            function(source, out=folder)
    assert contents(tmp_path) == before


@pytest.mark.slow
def test_results_do_not_depend_on_engine_or_number_of_workers(srs_twin, tmp_path):
    write(
        tmp_path,
        SMALL.replace("plants: [analytical]\n", "").replace("count: 4", "count: 2"),
    )
    digests = set()
    for out, workers, engine in (
        ("two", 2, "local"),
        ("one", 1, "local"),
        ("ray", 2, "ray"),
    ):
        options = ("--out", out, "--workers", str(workers), "--engine", engine, "-q")
        run = srs_twin("sweep", "small.yaml", *options, cwd=tmp_path)
        assert run.returncode == 0, run.stderr
        summary = json.loads((tmp_path / out / "sweep.json").read_text())
        digests.add(summary["results_sha256"])
    assert len(digests) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("nope",), "unknown sweep 'nope' (available: "),
        (("small.yaml", "--engine", "rai"), "unknown engine 'rai'; did you mean ray?"),
        (
            ("small.yaml", "--address", "x:1"),
            "--address is allowed only for the engines ray and warp",
        ),
        (
            ("small.yaml", "--engine", "ray", "--address", "x:1", "--workers", "2"),
            "--workers is only allowed if Ray is started on this machine",
        ),
        (("small.yaml", "--out", "small.yaml"), "cannot write there"),
    ],
)
def test_invalid_options_are_refused(srs_twin, tmp_path, options, message):
    write(tmp_path)
    run = srs_twin("sweep", *options, cwd=tmp_path)
    assert run.returncode == 2 and message in run.stderr, run.stderr
    assert "Traceback" not in run.stderr and os.listdir(tmp_path) == ["small.yaml"]


@pytest.mark.slow
@pytest.mark.parametrize("options", [("nope",), ("small.yaml",)])
def test_no_process_survives_the_command(tmp_path, options):
    write(tmp_path)
    process = subprocess.Popen(
        [str(COMMAND), "sweep", *options, "-q"],
        cwd=tmp_path,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    assert process.wait() == (2 if options == ("nope",) else 0)
    # The process server and the resource tracker end after the last process that uses
    # them.
    wait_until(lambda: not any(session(process.pid)), 30.0)


def session(number: int) -> list[str]:
    """Return the command lines of the processes of a session."""
    result = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(fields[3]) == number and fields[0] != "Z":
                result.append((folder / "cmdline").read_bytes().decode())
    return result


@pytest.mark.slow
@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_keeps_finished_rows(srs_twin, tmp_path):
    write(tmp_path, SLOWER)
    process = subprocess.Popen(
        [str(COMMAND), "sweep", "small.yaml", "--out", "out"],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
    )
    log = tmp_path / "out" / "rows.sqlite-wal"
    # The empty tables are a dozen pages.
    wait_until(lambda: process.poll() is not None or kills.pages(log) >= 20)
    assert process.poll() is None, process.stderr.read()
    process.send_signal(signal.SIGINT)
    _, message = process.communicate(timeout=300)
    assert (
        process.returncode == 130
        and "rows are kept; start the command again to resume" in message
    )
    assert "Traceback" not in message
    stored = pq.read_table(tmp_path / "out" / "results.parquet").num_rows
    assert 0 < stored < 48
    run = srs_twin("sweep", "small.yaml", "--out", "out", cwd=tmp_path)
    assert run.returncode == 0 and f"{stored} of 48 rows exist already" in run.stderr
    assert pq.read_table(tmp_path / "out" / "results.parquet").num_rows == 48


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "runs"), [(2, 16), pytest.param(20, 60, marks=pytest.mark.nightly)]
)
def test_killed_sweeps_resume_without_lost_or_torn_rows(
    srs_twin, tmp_path, count, runs
):
    """No row is lost, repeated or torn; tools/kills.py repeats this 200 times."""
    sweep = write(tmp_path, kills.SWEEP.format(duration=60, runs=runs))
    quiet = srs_twin(
        "sweep", str(sweep), "--out", "quiet", "--workers", "1", "-q", cwd=tmp_path
    )
    assert quiet.returncode == 0, quiet.stderr
    result = kills.disturbed(sweep, tmp_path / "killed", count, random.Random(4), 0.1)
    assert sum(result.victims.values()) == count
    assert kills.digest(tmp_path / "killed") == kills.digest(tmp_path / "quiet")
