"""Replays on a bench: one module clamped at its head, with valves or pressures, and a bend log or markers."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from recorded import csv_text
from synthetic_takes import Take, write_motive

from srs_twin import AnalyticalSnake, load_robot, rollout
from srs_twin.comparison.compare import MeasuredDifference
from srs_twin.control.replay import Replay
from srs_twin.errors import InputError, InputFileError
from srs_twin.identification.actuator import Response
from srs_twin.identification.locomotion import gait_run
from srs_twin.identification.parameters import with_values
from srs_twin.pneumatics import Schedule
from srs_twin.recordings.recording import read_motion
from srs_twin.recordings.signals.logs import on_bench
from srs_twin.recordings.takes import RecordingReader
from srs_twin.scenario.loading import parse_scenario

MODULE = load_robot("gen4_module")
SUPPLY = MODULE.supply.nominal
SECONDS = 2.0
HEAD = "snake:1a"


def staircase() -> Schedule:
    """Return valve states of one module: at rest, bent to the left, held, bent to the right, vented."""
    states = [[-1, -1], [1, -1], [0, -1], [-1, 1], [-1, -1]]
    return Schedule(
        SECONDS,
        np.array([0.0, 0.3, 0.42, 0.9, 1.4]),
        np.array(states, dtype=np.int8)[:, None, :],
    )


def csv(columns: dict[str, np.ndarray]) -> str:
    return csv_text(list(columns), np.column_stack(list(columns.values())))


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Return a folder with noise-free recordings of a module at another pose, and its logs."""
    folder = tmp_path_factory.mktemp("bench")
    plant = AnalyticalSnake(
        MODULE, base="clamped", tick=0.001, layout="in_out", supply_pa=SUPPLY
    )
    truth = rollout(
        plant, Replay(staircase()), SECONDS, pose=(0.3, -0.2, 2.1), record_hz=1000
    )
    time = truth.time
    air = {
        f"pressure_{s}_1_kpa": truth[f"pressure_{s}_1"] / 1e3 for s in ("plus", "minus")
    }
    bends = {"time_ms": 1e3 * time, "bend_1_deg": np.degrees(truth["bend_1"])}
    (folder / "sensor.csv").write_text(csv(bends))
    (folder / "logger.csv").write_text(csv(bends | air))
    (folder / "air.csv").write_text(csv({"time": time + 7.0} | air))
    schedule = staircase()
    starts = np.append(schedule.starts, SECONDS)
    states = np.vstack([schedule.states[:, 0], schedule.states[-1:, 0]])
    valves = {
        "time": starts,
        "valve_plus_1": states[:, 0],
        "valve_minus_1": states[:, 1],
    }
    for name in ("sensor", "markers"):
        (folder / f"{name}.valves.csv").write_text(csv(valves))
    for name, layout in (("markers", "pair"), ("two", "head")):
        take = Take(layout=layout, noise=0.0, digits=5, rate_hz=200, labeled=True)
        write_motive(truth, take, folder / f"{name}.csv")
    return folder


def replayed(folder, motion="sensor.csv", valves="sensor.valves.csv", **changes):
    recording = {"motion": str(folder / motion), "valves": str(folder / valves)}
    recording |= changes.pop("recording", {"offset_s": 0.0})
    return parse_scenario(
        {
            "robot": "gen4_module",
            "bench": True,
            "duration_s": 1.9,
            "record_hz": 1000,
            "controller": {"kind": "replay"},
            "recording": recording,
            "plants": {"analytical": {}, "twin": {}},
        }
        | changes
    )


def driven(scenario, kind, robot=None):
    plant = scenario.build_plant(kind, robot=robot)
    run = rollout(
        plant,
        scenario.build_controller(),
        scenario.duration,
        record_hz=scenario.record_hz,
    )
    return MeasuredDifference.between(scenario.measured, run)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("motion", "valves", "recording"),
    [
        ("sensor.csv", "sensor.valves.csv", {"offset_s": 0.0}),
        ("sensor.csv", "air.csv", {"offset_s": -7.0}),
        ("logger.csv", "logger.csv", {}),  # one file, one clock
        ("markers.csv", "markers.valves.csv", {"offset_s": 0.0, "head": HEAD}),
        ("two.csv", "air.csv", {"offset_s": -7.0}),  # the second marker tells the head
    ],
)
def test_bench_replay_of_a_simulated_module_has_no_residual(
    bench, motion, valves, recording
):
    scenario = replayed(bench, motion, valves, recording=recording)
    found = {kind: driven(scenario, kind) for kind in ("analytical", "twin")}
    amplitude = np.ptp(scenario.measured["bend_1"])
    assert amplitude > 0.8
    # The chord between two single markers determines the bend, with the error of five
    # digits.
    assert found["analytical"].metrics["measured_bend_rms_rad"] < 1e-3 * amplitude
    assert found["twin"].metrics["measured_bend_rms_rad"] < 0.02 * amplitude
    stronger = with_values(MODULE, {"modules.gain_plus_1": 1.1})
    worse = driven(scenario, "analytical", stronger).metrics["measured_bend_rms_rad"]
    assert worse > 20 * found["analytical"].metrics["measured_bend_rms_rad"]
    for each in found.values():
        told = each.metrics
        assert told["measured_com_speed_rel"] is None
        assert told["measured_yaw_rate_abs"] is None
        if motion in ("sensor.csv", "logger.csv"):
            # The position of the body was not measured.
            known = [name for name, value in told.items() if value is not None]
            assert known == ["measured_bend_rms_rad"]
            assert set(each.document()["rms"]) == {"bend_1_rad"}
        else:
            # Both are clamped at the same point, which is the origin.
            assert told["measured_path_rms_m"] < 2e-3
            assert told["measured_shape_rms_m"] < 2e-3
    assert found["analytical"].comparison.metrics["path_rms_m"] < 1e-4


def test_bend_log_of_a_chain_has_the_geometry_of_the_plant(tmp_path):
    """The bends and the pose of the clamp give the positions of the plant."""
    chain = load_robot("gen2")
    states = np.full((1, chain.segments, 2), -1, dtype=np.int8)
    states[0, :, 0] = [1, -1, 1, 1]
    plant = AnalyticalSnake(chain, base="clamped", tick=0.001)
    truth = rollout(
        plant, Replay(Schedule(0.5, np.zeros(1), states)), 0.5, record_hz=100
    )
    bends = [f"bend_{j}" for j in range(1, 5)]
    valves = [f"valve_{side}_{j}" for j in range(1, 5) for side in ("plus", "minus")]
    path = tmp_path / "all.csv"
    path.write_text(csv({name: truth[name] for name in ("time", *bends, *valves)}))
    take = RecordingReader().take(str(path), str(path), chain)
    found = on_bench(take, chain).trajectory
    assert np.abs(found.position - truth.position).max() < 1e-6
    assert np.abs(found.com - truth.com).max() < 1e-6
    turned = found.stack("connector_heading") - truth.stack("connector_heading")
    assert np.abs(turned).max() < 1e-6


def test_a_bend_log_can_be_used_for_actuator_fits(bench):
    motion = str(bench / "sensor.csv")
    log = str(bench / "sensor.valves.csv")
    take = RecordingReader(offset_s=0.0).take(motion, log, MODULE)
    response = Response.from_recording(take, "sensor", SUPPLY)
    assert response.bend.shape == (2001, 1) and np.isfinite(response.bend).all()
    with pytest.raises(
        InputError, match="sensor: bends alone do not determine where a robot crawls"
    ):
        gait_run(take, "sensor", SUPPLY)


def test_short_gaps_of_a_sensor_are_filled(bench, tmp_path):
    lines = (bench / "sensor.csv").read_text().splitlines()
    for k in (500, 501, *range(1700, 1999)):
        lines[k] = lines[k].partition(",")[0] + ","
    path = tmp_path / "gaps.csv"
    path.write_text("\n".join([*lines, ""]))
    body = RecordingReader(longest_gap_s=0.1).body(str(path), MODULE)
    assert body.summary.samples_filled == 2
    for line in (
        "read: 2001 rows, 1000 Hz",
        "filled: 2 bends",
        "kept: 1699 rows, 0 s to 1.698 s, 302 left out",
    ):
        assert line in body.summary.text()
    assert body.trajectory.time[-1] == pytest.approx(1.698)
    whole = (
        RecordingReader().body(str(bench / "sensor.csv"), MODULE).trajectory["bend_1"]
    )
    assert (
        np.abs(body.trajectory["bend_1"] - whole[: len(body.trajectory)]).max() < 2e-3
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "bend_1,air\n1,1\n",
            "x.csv:1: the column 'time' is missing; a bend log has the columns"
            " time,bend_1",
        ),
        (
            "time,bend_1,bend_2\n0,0,0\n",
            "x.csv:1:3: the column 'bend_2' does not match any segment; gen4_module",
        ),
        (
            "time,bend_1\n0,0\n0.1,47.9\n",
            r"x.csv:3:2: bend_1: 47.9 is not allowed; a bend must be between .*_deg",
        ),
        ("time,bend_1\n0,0\n1,1\n", "x.csv: the recording has 2 frames"),
    ],
)
def test_invalid_bend_logs_are_refused(tmp_path, text, message):
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        RecordingReader().body(str(tmp_path / "x.csv"), MODULE)


def test_a_bend_log_needs_12_successive_rows(tmp_path):
    path = tmp_path / "x.csv"
    for known in (12, 11):
        rows = [f"{k / 10},{'0.1' * (k < known)}\n" for k in range(40)]
        path.write_text("time,bend_1\n" + "".join(rows))
        if known == 12:
            assert len(RecordingReader().body(str(path), MODULE).trajectory) == 12
    with pytest.raises(InputError, match="no 12 successive rows contain all bends"):
        RecordingReader().body(str(path), MODULE)


def test_a_moving_head_is_refused_on_a_bench(bench):
    """A module that is clamped at its other end, or free, is another experiment."""
    with pytest.raises(
        InputFileError,
        match=(
            r"recording.motion: .*markers.csv: the head moves by [\d.]+ mm and turns"
            r" by 40°"
        ),
    ):
        replayed(
            bench,
            "markers.csv",
            "markers.valves.csv",
            recording={"offset_s": 0.0, "head": "snake:2a"},
        )
    take = read_motion(bench / "markers.csv", MODULE, head=HEAD)
    columns = dict(take.trajectory.columns)
    sway = np.radians(np.sin(3 * columns["time"]))

    def swayed(degrees):
        heading = columns["connector_heading_1"] + degrees * sway
        moved = columns | {"connector_heading_1": heading}
        return replace(take, trajectory=replace(take.trajectory, columns=moved))

    on_bench(swayed(4.0), MODULE)
    with pytest.raises(InputError, match="moves by 0 mm and turns by [56]"):
        on_bench(swayed(6.0), MODULE)

    def shifted(distance):
        moved = columns | {"x_1": columns["x_1"] + distance * (columns["time"] > 1.2)}
        return replace(take, trajectory=replace(take.trajectory, columns=moved))

    limit = 0.05 * MODULE.geometry.pitch
    on_bench(shifted(0.98 * limit), MODULE)
    with pytest.raises(InputError, match=f"head moves by {1e3 * limit:.0f} mm and"):
        on_bench(shifted(1.02 * limit), MODULE)


def test_bench_velocities_are_the_slopes_of_the_positions(bench):
    found = on_bench(
        read_motion(bench / "markers.csv", MODULE, head=HEAD), MODULE
    ).trajectory
    for axis in "xy":
        slope = np.gradient(found[f"com_{axis}"], found.time)
        speed = found[f"com_velocity_{axis}"]
        # Velocities are slopes of moving lines, which smooth the fastest changes.
        assert speed.std() == pytest.approx(slope.std(), rel=0.2)
        assert np.corrcoef(speed, slope)[0, 1] > 0.95


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"bench": False},
            r"recording.motion: bends alone do not determine .*, or set `bench: true`",
        ),
        ({"start": {"x_m": 1.0}}, "start: a robot on a bench is clamped"),
        (
            {"plants": {"analytical": {"friction": "wheel"}}},
            "touches no floor",
        ),
        ({"valves": "sensor.csv"}, r"recording.valves: .*one of valve_plus_1,…"),
    ],
)
def test_invalid_bench_replays_name_their_place(bench, changes, message):
    with pytest.raises(InputFileError, match=message):
        replayed(bench, **changes)


@pytest.mark.slow
def test_bench_replay_command(bench, srs_twin, tmp_path):
    expect = tmp_path / "expect.yaml"
    expect.write_text(
        "expect:\n  - {metric: measured_bend_rms_rad, plant: analytical, below: 0.001}\n"
        "  - {metric: measured_bend_rms_rad, plant: twin, below: 0.02}\n"
    )
    log = str(bench / "logger.csv")
    words = ["replay", log, "--valves", log, "-r", "gen4_module"]
    done = srs_twin(*words, "--bench", "--expect", str(expect), "--check", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "met    twin measured_bend_rms_rad" in done.stdout
    run = tmp_path / "runs/logger"
    metrics = json.loads((run / "metrics.json").read_text("utf-8"))
    assert metrics["residuals"]["twin"]["rms"].keys() == {"bend_1_rad"}
    assert metrics["plants"]["twin"]["measured_shape_rms_m"] is None
    recording = (run / "recording.rrd").read_bytes()
    assert b"measured/bend/twin" in recording
    assert b"measured/shape/" not in recording
    assert "measured bend RMS" in (run / "report.html").read_text("utf-8")
    again = srs_twin(
        "run", str(run / "scenario.resolved.yaml"), "--check", "-q", cwd=tmp_path
    )
    assert again.returncode == 0, again.stderr


def test_options_for_a_crawling_robot_are_refused(bench, srs_twin, tmp_path):
    log = str(bench / "logger.csv")
    words = ["replay", log, "--valves", log, "-r", "gen4_module", "--bench"]
    done = srs_twin(*words, "--friction-law", "axis", cwd=tmp_path)
    assert done.returncode == 2
    said = "--friction-law is not allowed, because a robot on a bench touches no floor"
    assert f"{said}; remove this option" in done.stderr
