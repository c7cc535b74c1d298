"""Replays: recorded valves or pressures drive the plants, which are compared with the measurement."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import yaml
from conftest import ROOT
from recorded import SPEC, csv_text
from synthetic_takes import Take, write_motive

from srs_twin import (
    AnalyticalSnake,
    Gait,
    TwinSnake,
    load_robot,
    load_scenario,
    rollout,
)
from srs_twin.cli import main
from srs_twin.comparison.compare import MeasuredDifference
from srs_twin.control.replay import Replay
from srs_twin.errors import InputError, InputFileError
from srs_twin.identification.parameters import with_values
from srs_twin.pneumatics import LagPneumatics, Schedule
from srs_twin.recordings.recorded_pressures import RecordedPressures
from srs_twin.scenario.loading import parse_scenario

EXAMPLE = ROOT / "calibration/examples/my_snake"
SUPPLY = 48e3
PRESSURES = [f"pressure_{side}_{j}" for j in range(1, 5) for side in ("plus", "minus")]


def recorded_of(spec, schedule, times, step) -> tuple[np.ndarray, RecordedPressures]:
    """Return the bends for valve states, and chambers with the resulting pressures every `step` s."""
    valves = LagPneumatics(spec, supply_pa=SUPPLY)
    log = np.arange(0.0, schedule.span + step / 2, step)
    logged = LagPneumatics(spec, supply_pa=SUPPLY).advance(
        schedule, np.minimum(log, schedule.span)
    )
    bends = valves.advance(schedule, times).bend
    return bends, RecordedPressures(spec, log, logged.pressure, supply_pa=SUPPLY)


def test_recorded_pressures_give_the_bends_of_their_valves():
    """With recorded pressures only the lag τ₂ remains; the error decreases with the sample period."""
    spec = with_values(
        SPEC,
        {
            "modules.gain_plus_2": 1.2,
            "modules.bias_rad_3": 0.1,
            "actuator.tau_mode_s": 0.02,
        },
    )
    gait = Gait(2.0, 0.1)
    gait.reset(spec, 0.02)
    schedule = gait.script(2.0)
    times = np.linspace(0.0, 2.0, 401)
    off = []
    for step in (0.008, 0.004, 0.002):
        bends, chambers = recorded_of(spec, schedule, times, step)
        off.append(np.abs(chambers.advance(schedule, times).bend - bends).max())
    assert off[-1] < 2e-3 and off[0] > 1.8 * off[1] > 1.8 * 1.8 * off[2] * 0.9
    # Rates are the derivatives of bends, also between chunks and at the bend limit.
    spec = with_values(spec, {"actuator.bend_limit_rad": 1.2})
    _, chambers = recorded_of(spec, schedule, times, 0.002)
    first = chambers.advance(schedule.slice(0.0, 0.9), np.linspace(0.0, 0.9, 9001))
    second = chambers.advance(schedule.slice(0.9, 2.0), np.linspace(0.0, 1.1, 11001))
    assert first.bend[-1] == pytest.approx(second.bend[0], abs=1e-12)
    for name, rate in (("bend", "bend_rate"), ("bend_rate", "bend_acceleration")):
        slope = np.gradient(getattr(second, name), 1e-4, axis=0)[2:-2]
        assert (
            np.median(np.abs(slope - getattr(second, rate)[2:-2]))
            < 1e-3 * np.abs(slope).max()
        )
    assert (first.pneumatic_energy == 0).all()
    assert chambers.max_pressure_ratio == 1.0
    assert chambers.describe()["samples"] == 1001
    pressure = np.full((2, SPEC.segments, 2), 2.5 * SUPPLY)
    higher = RecordedPressures(SPEC, np.arange(2.0), pressure, supply_pa=SUPPLY)
    assert higher.max_pressure_ratio == 2.5


def test_invalid_recorded_pressures_are_refused():
    time = np.array([0.0, 1.0])
    with pytest.raises(
        InputError, match=r"shape \(2, 1, 2\), but gen2 needs the shape \(2, 4, 2\)"
    ):
        RecordedPressures(SPEC, time, np.zeros((2, 1, 2)), supply_pa=SUPPLY)
    pressure = np.zeros((2, 4, 2))
    with pytest.raises(InputError, match="times of the recorded pressures must incr"):
        RecordedPressures(SPEC, 0 * time, pressure, supply_pa=SUPPLY)
    pressure[1, 2, 0] = np.nan
    with pytest.raises(InputError, match="row 2 lacks a finite pressure"):
        RecordedPressures(SPEC, time, pressure, supply_pa=SUPPLY)


def test_both_plants_follow_recorded_pressures():
    """The run with valve states is recovered from its pressures alone, on either plant."""
    for plant in (AnalyticalSnake, TwinSnake):
        truth = rollout(
            plant(SPEC, supply_pa=SUPPLY),
            Gait(2.0),
            1.0,
            record_hz=500 if plant is AnalyticalSnake else 1000,
        )
        sides = [truth.stack("pressure_plus"), truth.stack("pressure_minus")]
        chambers = RecordedPressures(
            SPEC, truth.time, np.stack(sides, axis=-1), supply_pa=SUPPLY
        )
        vented = Replay(
            Schedule(1.0, np.zeros(1), np.full((1, 4, 2), -1, dtype=np.int8))
        )
        again = rollout(
            plant(SPEC, supply_pa=SUPPLY, pneumatics=chambers),
            vented,
            1.0,
            record_hz=100,
        )
        last = again.com[-1] - truth.com[-1]
        assert np.hypot(*last) < 0.01 * np.hypot(*(truth.com[-1] - truth.com[0])), (
            plant.name
        )
        assert again["pressure_plus_2"][-1] == pytest.approx(
            truth["pressure_plus_2"][-1]
        )
        # Nobody knows what air the robot drew.
        assert truth.has("pneumatic_energy")
        assert not again.has("pneumatic_energy")
        assert truth.metadata["valve_switches"]
        assert again.metadata["valve_switches"] is None


@pytest.fixture(scope="module")
def perfect(tmp_path_factory):
    """Return a folder with a noise-free recording of the analytical plant at another pose, and its logs."""
    folder = tmp_path_factory.mktemp("perfect")
    plant = AnalyticalSnake(SPEC, supply_pa=48.3e3, friction="wheel")
    rest = Schedule(0.4, np.zeros(1), np.full((1, 4, 2), -1, dtype=np.int8))
    gait = Gait(2.0, 0.1)
    gait.reset(SPEC, 0.02)
    whole = rest.followed_by(gait.script(2.6))
    # Pressures are linear between the samples of a log, which at 100 Hz changes the
    # distance by 2 %.
    truth = rollout(plant, Replay(whole), 3.0, pose=(1.0, -2.0, 2.5), record_hz=1000)
    write_motive(
        truth,
        Take(layout="pair", noise=0.0, digits=4, rate_hz=100),
        folder / "take.csv",
    )
    valves = [f"valve_{side}_{j}" for j in range(1, 5) for side in ("plus", "minus")]
    log = np.column_stack([whole.starts + 5.0, whole.states.reshape(-1, 8)])
    log = np.vstack([log, [8.0, *log[-1, 1:]]])
    (folder / "take.valves.csv").write_text(csv_text(["time", *valves], log))
    rows = np.column_stack([truth.time + 5.0, *(truth[name] for name in PRESSURES)])
    (folder / "pressures.csv").write_text(csv_text(["time", *PRESSURES], rows))
    return folder


def replayed(folder, offset_s=-5.0, **changes):
    document = {
        "robot": "gen2",
        "duration_s": 2.9,
        "controller": {"kind": "replay"},
        "recording": {"motion": str(folder / "take.csv"), "offset_s": offset_s},
        "plants": {"analytical": {"friction": "wheel"}},
    }
    return parse_scenario(document | changes)


@pytest.mark.parametrize("log", ["take.valves.csv", "pressures.csv"])
def test_replay_of_a_simulated_run_has_no_residual(perfect, log):
    scenario = replayed(
        perfect,
        recording={
            "motion": str(perfect / "take.csv"),
            "valves": str(perfect / log),
            "offset_s": -5.0,
        },
    )
    assert scenario.pose == pytest.approx((1.0, -2.0, 2.5), abs=1e-3)
    assert scenario.measured is not None and scenario.measured.time[0] == 0.0
    run = rollout(
        scenario.build_plant("analytical"),
        scenario.build_controller(),
        2.9,
        pose=scenario.pose,
        record_hz=scenario.record_hz,
    )
    found = MeasuredDifference.between(scenario.measured, run)
    # The centre of mass moves 0.5 m, and sliding friction amplifies rounding errors.
    assert found.metrics["measured_path_rms_m"] < 2e-3
    assert found.metrics["measured_shape_rms_m"] < 1e-5
    assert found.metrics["measured_bend_rms_rad"] < 1e-4
    assert found.metrics["measured_heading_rms_rad"] < 0.02
    heavier = scenario.build_plant(
        "analytical", robot=with_values(SPEC, {"friction.mu_n": 0.3})
    )
    other = rollout(heavier, scenario.build_controller(), 2.9, pose=scenario.pose)
    worse = MeasuredDifference.between(scenario.measured, other)
    assert (
        worse.metrics["measured_path_rms_m"] > 5 * found.metrics["measured_path_rms_m"]
    )
    told = found.document()
    assert told["rms"]["path_m"] == pytest.approx(found.metrics["measured_path_rms_m"])
    parts = np.array(told["over_time"]["path_m"])
    assert np.sqrt((parts**2).mean()) == pytest.approx(told["rms"]["path_m"], rel=0.02)
    assert len(parts) == 50
    middles = np.arange(0.5, 50) * 2.9 / 50
    assert told["over_time"]["time_s"] == pytest.approx(middles, abs=0.02)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"controller": {"kind": "gait", "frequency_hz": 2.0}},
            "recording: the recording is not used",
        ),
        # The log begins after 1 s, and the motion ends after 3 s.
        (
            {"duration_s": 2.1, "offset_s": -4.0},
            r"duration_s: 2\.1 s is longer than the recording, which lasts 2 s",
        ),
        ({"robot": "gen4_module"}, r"recording.valves: .*gen4_module has 1 segments"),
        (
            {"bench": True, "plants": {"analytical": {}}},
            "recording.motion: .*a bench requires a clamped head",
        ),
    ],
)
def test_sections_in_conflict_with_a_replay_are_reported(perfect, changes, message):
    with pytest.raises(InputFileError, match=message):
        replayed(perfect, **changes)


def test_a_replay_needs_a_recording():
    document = {"robot": "gen2", "duration_s": 1.0, "controller": {"kind": "replay"}}
    with pytest.raises(
        InputFileError, match="controller: `kind: replay` needs a recording"
    ):
        parse_scenario(document)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("key", "value", "place"),
    [
        ("motion", "none.csv", "5:11: recording.motion: none.csv: no such file"),
        ("valves", "none.csv", "6:11: recording.valves: none.csv: no such file"),
        ("offset_s", 400, "7:13: recording.offset_s: "),
        ("head", "tip", "8:9: recording.head: "),
    ],
)
def test_errors_of_a_recording_name_their_keys(perfect, tmp_path, key, value, place):
    recording = {
        "motion": perfect / "take.csv",
        "valves": perfect / "take.valves.csv",
        "offset_s": -5,
    }
    lines = [f"  {name}: {given}" for name, given in (recording | {key: value}).items()]
    path = tmp_path / "r.yaml"
    path.write_text(
        "robot: gen2\nduration_s: 2\ncontroller: {kind: replay}\nrecording:\n"
        + "\n".join(lines)
        + "\nplants: {analytical: {}}\n"
    )
    with pytest.raises(InputFileError) as found:
        load_scenario(path)
    assert f"r.yaml:{place}" in str(found.value)


def test_chamber_models_are_refused_with_recorded_pressures(perfect):
    recording = {
        "motion": str(perfect / "take.csv"),
        "valves": str(perfect / "pressures.csv"),
        "offset_s": -5.0,
    }
    with pytest.raises(
        InputFileError, match="pneumatics: the recorded pressures replace this section"
    ):
        replayed(perfect, recording=recording, pneumatics={"leak_per_s": 1.0})


def test_a_measured_metric_needs_a_recording():
    expect = [{"metric": "measured_shape_rms_m", "plant": "twin", "below": 0.01}]
    with pytest.raises(
        InputFileError,
        match=r"expect\[0\].metric: the metric `measured_shape_rms_m` compares with"
        r" a recording",
    ):
        parse_scenario(
            {
                "robot": "gen2",
                "duration_s": 1.0,
                "controller": {"kind": "gait", "frequency_hz": 2.0},
                "expect": expect,
            }
        )


def test_resolved_scenario_does_not_depend_on_the_folder(
    perfect, monkeypatch, tmp_path
):
    monkeypatch.chdir(perfect)
    recording = {"motion": "take.csv", "valves": "pressures.csv", "offset_s": -5.0}
    scenario = replayed(perfect, recording=recording, valves={"layout": "in_out"})
    monkeypatch.chdir(tmp_path)
    again = parse_scenario(scenario.document, name=scenario.name)
    assert again == scenario
    assert again.pose == scenario.pose
    assert again.layout == "in_out"
    assert again.recording.valves.kind == "pressure"
    assert (again.measured["bend_1"] == scenario.measured["bend_1"]).all()


@pytest.mark.slow
def test_replay_command(tmp_path, srs_twin):
    expect = tmp_path / "expect.yaml"
    text = (
        "expect:\n  - {metric: measured_shape_rms_m, plant: analytical, below: LIMIT}\n"
    )
    expect.write_text(text.replace("LIMIT", "0.02"))
    words = ["replay", str(EXAMPLE / "walk_check.csv"), "-r", "gen2"]
    words += ["--longest-gap", "0.3", "--expect", "expect.yaml", "--check"]
    done = srs_twin(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    run = tmp_path / "runs/walk_check"
    metrics = json.loads((run / "metrics.json").read_text("utf-8"))
    assert list(metrics["plants"]) == ["analytical", "twin", "measured"]
    assert metrics["plants"]["measured"]["com_speed_m_s"] == pytest.approx(
        0.166, abs=0.01
    )
    assert set(metrics["residuals"]) == {"analytical", "twin"}
    assert metrics["residuals"]["twin"]["rms"]["shape_m"] == pytest.approx(
        metrics["plants"]["twin"]["measured_shape_rms_m"]
    )
    assert "met    analytical measured_shape_rms_m" in done.stdout
    report = (run / "report.html").read_text("utf-8")
    assert "Difference of each plant from the measured robot" in report
    assert b"world/measured/connectors" in (run / "recording.rrd").read_bytes()
    assert (run / "measured.parquet").is_file()

    # The scenario in the folder is the same replay; a missed limit determines the exit
    # code.
    resolved = run / "scenario.resolved.yaml"
    document = yaml.safe_load(resolved.read_text("utf-8"))
    assert document["controller"] == {"kind": "replay"}
    assert document["recording"]["longest_gap_s"] == 0.3
    again = load_scenario(resolved)
    assert again.name == "walk_check" and again.robot == load_robot("gen2")
    resolved.write_text(resolved.read_text().replace("below: 0.02", "below: 0.0001"))
    missed = srs_twin("run", str(resolved), "--check", "--out", "x", "-q", cwd=tmp_path)
    assert missed.returncode == 1
    assert "MISSED analytical measured_shape_rms_m" in missed.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["w.csv", "--expect", "e.yaml"], "e.yaml:1:19: expect[0].metric"),
        (
            ["w.csv", "--check"],
            "--check needs expectations; give them with --expect FILE.yaml",
        ),
        (["w.csv", "--fit", "none.yaml"], "none.yaml: no such file"),
        (["w.csv", "--pressure", "-3"], "Invalid value for '--pressure'"),
        (["w.csv", "--up", "w"], "up 'w' is unknown"),
    ],
)
def test_invalid_replays_are_refused(tmp_path, monkeypatch, capsys, words, message):
    for suffix in (".csv", ".valves.csv"):
        shutil.copy(EXAMPLE / f"walk_check{suffix}", tmp_path / f"w{suffix}")
    (tmp_path / "e.yaml").write_text(
        "expect: [{metric: speed, plant: twin, below: 1}]\n"
    )
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["replay", *words, "-r", "gen2"])
    assert end.value.code == 2 and message in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()
