"""Runs started as a user starts them: files, messages and exit codes, also after failures."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from conftest import on_interrupt

from srs_twin import Trajectory, load_scenario
from srs_twin.errors import DivergedError
from srs_twin.experiment import PRODUCTS, prepare, run_scenario
from srs_twin.viewing.rerun.viewer import verify_recording

SCENARIO = """\
title: Short
robot: gen2
duration_s: 2
supply: {pressure_kpa: 48.3}
controller: {kind: gait, frequency_hz: 2.0}
plants: {analytical: {}, twin: {}}
expect:
  - {metric: com_speed_m_s, plant: twin, near: 0.214, rel: 0.5, source: Table 10}
  - {metric: com_speed_rel, of: comparison, below: -0.9}
"""


def write(folder: Path, name: str, text: str = SCENARIO) -> str:
    (folder / f"{name}.yaml").write_text(text)
    return str(folder / f"{name}.yaml")


@pytest.fixture(scope="module")
def compared(tmp_path_factory, srs_twin_process):
    """One `compare --check` into a folder that holds something already."""
    room = tmp_path_factory.mktemp("compared")
    write(room, "short")
    (room / "out").mkdir()
    (room / "out/notes.txt").write_text("mine")
    (room / "out/metrics.json").write_text("old")
    done = srs_twin_process(
        "compare", "./short.yaml", "--out", "out", "--check", cwd=room
    )
    return room, done


def test_output_folder_is_complete_and_keeps_other_files(compared):
    room, done = compared
    assert done.returncode == 1, done.stderr
    assert {path.name for path in (room / "out").iterdir()} == {*PRODUCTS, "notes.txt"}
    assert (room / "out/notes.txt").read_text() == "mine"
    assert sorted(path.name for path in room.iterdir()) == ["out", "short.yaml"]
    verify_recording(room / "out/recording.rrd")
    assert (room / "out/report.html").read_text().rstrip().endswith("</html>")


def test_metrics_follow_from_the_trajectories(compared):
    room, _ = compared
    metrics = json.loads((room / "out/metrics.json").read_text())
    keys = ["scenario", "robot", "plants", "comparison", "events", "changes", "cause"]
    keys += ["expectations", "left_out", "versions"]
    assert list(metrics) == keys
    assert (metrics["scenario"], metrics["robot"]) == ("short", "gen2")
    versions = ["srs_twin", "mujoco", "numpy", "scipy", "numba", "python", "arithmetic"]
    assert set(metrics["versions"]) == set(versions)
    speeds = {}
    for plant in ("analytical", "twin"):
        run = Trajectory.from_parquet(room / f"out/{plant}.parquet")
        assert run.metadata["plant"] == plant
        # Straight on along x: displacement over whole periods after the warm-up is the
        # speed.
        speeds[plant] = (run["com_x"][200] - run["com_x"][100]) / 1.0
        assert metrics["plants"][plant]["com_speed_m_s"] == pytest.approx(
            speeds[plant], rel=0.02
        )
        assert metrics["plants"][plant]["wall_s"] > 0
    relative = speeds["twin"] / speeds["analytical"] - 1
    assert metrics["comparison"]["com_speed_rel"] == pytest.approx(relative, abs=0.02)


def test_resolved_scenario_gives_identical_files(compared, tmp_path):
    room, _ = compared
    again = run_scenario(
        load_scenario(room / "out/scenario.resolved.yaml"), tmp_path / "again"
    )
    for name in ("analytical.parquet", "twin.parquet"):
        kept = (room / "out" / name).read_bytes()
        assert (again.folder / name).read_bytes() == kept, name


def test_single_plant_run_removes_files_of_earlier_runs(compared, tmp_path):
    room, _ = compared
    folder = tmp_path / "out"
    folder.mkdir()
    for name in PRODUCTS:
        (folder / name).write_bytes((room / "out" / name).read_bytes())
    lone = SCENARIO.replace(", twin: {}", "").split("expect:")[0]
    result = run_scenario(load_scenario(write(tmp_path, "lone", lone)), folder)
    assert not (folder / "twin.parquet").exists()
    assert list(result.metrics["plants"]) == ["analytical"]
    assert result.metrics["comparison"] is None


def test_progress_rises_to_the_end_for_each_plant(tmp_path):
    progress: dict[str, list[float]] = defaultdict(list)
    text = SCENARIO.replace("duration_s: 2", "duration_s: 0.2").split("expect:")[0]
    run_scenario(
        load_scenario(write(tmp_path, "brief", text)),
        tmp_path / "out",
        progress=lambda plant, fraction: progress[plant].append(fraction),
    )
    assert list(progress) == ["analytical", "twin"]
    for parts in progress.values():
        assert parts == sorted(set(parts))
        assert (parts[0], parts[-1]) == (0.0, 1.0)


def test_diverged_plant_keeps_its_trajectory_and_the_other_runs(tmp_path):
    job = prepare(load_scenario(write(tmp_path, "short")), tmp_path / "out")
    plant = job.pairs["analytical"][0]
    sound = plant.play

    def unsound(schedule, samples):
        if schedule.span < 1.0:  # the tick that compiles
            return sound(schedule, samples)
        first = sound(schedule.slice(0.0, 1.0), samples // 2)
        plant.body.state[3] = np.nan
        try:
            return sound(schedule.slice(1.0, 2.0), samples // 2)
        except DivergedError as error:
            error.history = first
            raise

    plant.play = unsound
    result = job.execute()
    (error,) = result.diverged
    assert error.exit_code == 3
    assert str(error).startswith(
        "short: analytical diverged at t = 1.002 s: the state before the step"
        " contains nan"
    )
    assert str(error).endswith(str(tmp_path / "out/analytical.parquet"))
    kept = Trajectory.from_parquet(tmp_path / "out/analytical.parquet")
    assert kept.time[-1] == pytest.approx(1.0)
    assert np.isfinite(kept.com).all()
    other = Trajectory.from_parquet(tmp_path / "out/twin.parquet")
    assert other.time[-1] == pytest.approx(2.0)
    names = ["analytical.parquet", "scenario.resolved.yaml", "twin.parquet"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names


@pytest.mark.slow
def test_command_keeps_ignored_interrupts(tmp_path):
    """As in the background of a script; so do its workers."""
    twin = SCENARIO.split("expect:", maxsplit=1)[0].replace("analytical: {}, ", "")
    for name, duration in (("brief", "0.2"), ("long", "5")):
        write(tmp_path, name, twin.replace("duration_s: 2", f"duration_s: {duration}"))
    script = Path(sys.executable).with_name("srs-twin")
    words = [script, *["run", "./brief.yaml", "./long.yaml", "--workers", "2"]]
    with on_interrupt(signal.SIG_IGN):
        child = subprocess.Popen(
            words,
            cwd=tmp_path,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
    while child.poll() is None and not (tmp_path / "runs/brief/metrics.json").exists():
        time.sleep(0.05)
    os.killpg(child.pid, signal.SIGINT)
    _, said = child.communicate(timeout=300)
    assert (child.returncode, "interrupted" in said) == (0, False), said
    assert (tmp_path / "runs/long/metrics.json").is_file()


def test_schema_is_json_with_the_keys(tmp_path, srs_twin):
    schema = json.loads(srs_twin("schema", cwd=tmp_path).stdout)
    assert {"robot", "duration_s", "controller", "plants", "expect"} <= schema[
        "properties"
    ].keys()
