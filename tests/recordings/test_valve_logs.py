"""Valve and pressure logs: their values, and their clocks."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from recorded import SPEC, csv_text, motion, recorded, valve_csv
from synthetic_takes import Take

from srs_twin import InputError
from srs_twin.recordings.formats.topics import RecordedTopics
from srs_twin.recordings.recording import Recording, ValveLog
from srs_twin.recordings.recording_map import RecordingMap
from srs_twin.recordings.signals.clock import driven_bends, estimate_offset, join
from srs_twin.recordings.signals.logs import log_of_topics, read_valves
from srs_twin.trajectory import Trajectory

pytestmark = pytest.mark.fast

HEAD = ",".join(
    ["time", *(f"valve_{side}_{j}" for j in range(1, 5) for side in ("plus", "minus"))]
)
DUTY = np.array([0.0, 0.1, 0.25, 0.3, 0.5, 0.8, 0.95, 1.0])


def log(folder, text):
    path = folder / "valves.csv"
    path.write_text(text)
    return read_valves(path, SPEC)


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    return recorded(tmp_path_factory.mktemp("take"), Take(layout="pair", lost=0.02))


@pytest.mark.parametrize("shift", [0.0, 3.217, -20.1])
def test_offset_is_estimated_from_the_start_of_a_gait(tmp_path, captured, shift):
    """The log has previous valve states every 10 ms, so its unobservable mean delay is 5 ms."""
    joined = join(captured, log(tmp_path, valve_csv(motion(), 0.0, 4.0, shift)), SPEC)
    about = joined.trajectory.metadata["valve_log"]
    assert about["offset_s"] == pytest.approx(-shift - 0.005, abs=0.003)
    assert about["offset_estimated"] and 0 < about["offset_error_s"] < 0.002
    assert about["bends_explained"] > 0.99
    note = (
        f"valves.csv: 401 rows of valves; offset {about['offset_s']:.4f} s"
        f" (± {1000 * about['offset_error_s']:.2g} ms, estimated)"
    )
    assert any(text.endswith(note) for text in joined.summary.corrections)
    assert {"valve_plus_1", "valve_minus_4"} <= joined.trajectory.columns.keys()
    assert joined.valves.time[0] == pytest.approx(about["offset_s"] + shift)


def test_pressures_drive_the_bends_without_delay(tmp_path, captured):
    truth = motion()
    names = [name.replace("valve", "pressure") for name in HEAD.split(",")[1:]]
    values = np.column_stack(
        [1e3 * (truth.time + 7), *(truth[name] / 6894.757 for name in names)]
    )
    text = csv_text(["time_ms", *(f"{name}_psi" for name in names)], values)
    joined = join(captured, log(tmp_path, text), SPEC)
    assert joined.trajectory.metadata["valve_log"]["offset_s"] == pytest.approx(
        -7.0, abs=0.001
    )
    rows = np.rint(joined.trajectory.time * 100).astype(int)
    assert (
        np.abs(
            joined.trajectory["pressure_plus_2"] - truth["pressure_plus_2"][rows]
        ).max()
        < 2e3
    )


def test_a_gait_without_its_start_is_ambiguous(tmp_path, captured):
    middle = {
        name: column[100:300] for name, column in captured.trajectory.columns.items()
    }
    inside = replace(captured, trajectory=replace(captured.trajectory, columns=middle))
    text = valve_csv(motion(), 0.8, 4.0, 0.0)
    with pytest.raises(
        InputError, match="clock offset is ambiguous, because the gait is periodic"
    ) as refused:
        join(inside, log(tmp_path, text), SPEC)
    (listed,) = re.findall(r"equally well \((.*) s, …\)", str(refused.value))
    # The offsets that fit differ by the period of 0.5 s.
    assert np.diff([*map(float, listed.split(", "))]) == pytest.approx(0.5, abs=0.02)
    given_one = join(inside, log(tmp_path, text), SPEC, offset=0.0)
    assert given_one.trajectory.metadata["valve_log"]["offset_estimated"] is False
    assert len(given_one.trajectory) == 200


def test_a_log_of_another_run_is_refused(tmp_path, captured):
    other = valve_csv(motion(4.0, 0.0, 1.3), 0.0, 4.0, 0.0)
    with pytest.raises(
        InputError,
        match=r"valves.csv: (no clock offset explains|the clock offset is ambiguous)",
    ):
        join(captured, log(tmp_path, other), SPEC)


def test_frames_outside_the_log_are_left_out_with_a_note(tmp_path, captured):
    joined = join(
        captured, log(tmp_path, valve_csv(motion(), 1.0, 2.0, 0.0)), SPEC, offset=0.0
    )
    assert (joined.trajectory.time[0], joined.trajectory.time[-1]) == (1.0, 2.0)
    summary = joined.summary
    assert (summary.frames_kept, summary.start, summary.end) == (101, 1.0, 2.0)
    assert joined.trajectory.metadata["duration_s"] == 1.0
    assert f"{len(captured.trajectory) - 101} frames outside the log were left out" in (
        summary.corrections
    )
    said = (
        "with an offset of 100 s, the log covers 101 to 102 s and the motion 0.1 to 4 s,"
        " so they have only 0 frames in common"
    )
    with pytest.raises(InputError, match=said):
        join(
            captured,
            log(tmp_path, valve_csv(motion(), 1.0, 2.0, 0.0)),
            SPEC,
            offset=100.0,
        )


@pytest.mark.parametrize(
    ("seconds", "amplitude", "said"),
    [(4.0, 1e-7, "because nothing moves"), (0.07, 1.0, "is too short to estimate")],
)
def test_an_offset_needs_a_long_motion(seconds, amplitude, said):
    time = np.arange(0, seconds, 0.01)
    bends = amplitude * np.sin(9 * time)[:, None]
    with pytest.raises(InputError, match=said):
        estimate_offset(time, bends, time, bends)


def opened(times, until=10.0):
    """Return a log of a module whose valves open at given times for 10 ms."""
    clock = np.sort(np.concatenate([[0.0], times, np.add(times, 0.01), [until]]))
    states = np.where(np.isin(clock, times), 1.0, -1.0)
    values = np.repeat(states[:, None, None], 2, axis=2)
    return ValveLog("valve", clock, values, "a log", "", ())


@pytest.mark.parametrize(
    ("times", "frequency"),
    [
        (0.3 + 0.5 * np.arange(6), 2.0),
        # The first period is shorter, because the gait starts within it.
        (np.append(0.1, 0.3 + 0.5 * np.arange(5)), 2.0),
        # Pulses at 20 Hz are one opening.
        ((0.3 + 0.5 * np.arange(6)[:, None] + [0.0, 0.05, 0.1]).ravel(), 2.0),
        (0.3 + 0.5 * np.arange(4), None),
        (np.cumsum([0.3, 0.5, 0.5, 0.6, 0.5, 0.5]), None),
    ],
)
def test_frequency_of_a_gait_is_the_rate_of_its_openings(times, frequency):
    found = opened(times).gait_frequency()
    assert found == (frequency and pytest.approx(frequency))
    assert replace(opened(times), kind="pressure").gait_frequency() is None


def test_standard_error_equals_the_scatter_over_noise():
    """Errors of 200 offsets divided by their standard errors; the standard deviation of 200 values is known
    within 5 %. The gain of the bends is random.

    Resampling at half of a frame's time smooths white noise, which makes the standard
    errors a little large.
    """
    time = np.arange(0, 8, 0.02)
    log_time = np.arange(0, 8, 0.002)

    def bend(t):
        return np.where(t > 3, 1 - np.exp(-np.maximum(t - 3, 0) / 0.3), 0.0)[:, None]

    off = []
    for seed in range(200):
        random = np.random.default_rng(seed)
        true = random.uniform(-1, 1)
        gain = random.uniform(0.3, 3)
        noise = 0.02 * random.standard_normal((len(time), 1))
        measured = gain * bend(time) + noise
        found = estimate_offset(time, measured, log_time + true, bend(log_time))
        off.append((found.seconds + true) / found.error)
    assert abs(np.mean(off)) < 0.3
    assert 0.65 < np.std(off) < 1.09


@pytest.mark.parametrize(("fill", "vent"), [(0.05, 0.4), (0.4, 0.05)])
def test_modelled_bends_begin_when_initial_pressures_have_settled(fill, vent):
    """A log from the middle of a run gives the bends of the whole log, up to exp(-5) of the largest."""
    spec = replace(SPEC, actuator=replace(SPEC.actuator, tau_fill=fill, tau_vent=vent))
    time = np.arange(0.0, 6.0, 0.1)
    states = np.random.default_rng(1).choice([-1.0, 1.0], (len(time), spec.segments, 2))
    states[0] = -1.0
    states[20] = 1.0
    whole = ValveLog("valve", time, states, "whole", "", ())
    cut = replace(whole, time=time[20:], values=states[20:])
    clock, bends = driven_bends(cut, spec)
    all_times, all_bends = driven_bends(whole, spec)
    assert all_times[0] == 0.0 and clock[-1] == pytest.approx(5.9)
    same = np.stack(
        [np.interp(clock, all_times, column) for column in all_bends.T], axis=1
    )
    assert np.abs(bends - same).max() < np.exp(-5) * np.abs(all_bends).max()


def test_valve_states_hold_until_the_next_row(tmp_path):
    rows = [
        "0.0" + ",-1" * 8,
        "0.5,1" + ",-1" * 7,
        "0.5,1,-1,1" + ",-1" * 5,
        "2.0" + ",-1" * 8,
    ]
    found = log(tmp_path, "\n".join([HEAD, rows[3], *rows[:3], ""]))
    assert found.time.tolist() == [0.0, 0.5, 2.0]
    assert found.at(np.array([0.2, 0.5, 1.9, 5.0]))[:, 1, 0].tolist() == [-1, 1, 1, -1]
    schedule = found.schedule()
    assert schedule.starts.tolist() == [0.0, 0.5, 2.0] and schedule.span == 2.0
    said = "; ".join(found.corrections)
    assert "sorted" in said and "1 rows were left out, because" in said


def duties(folder, full):
    """Write duties that are reversed after one second."""
    unit = "_%" if full == 100 else ""
    names = [f"{name}{unit}".replace("valve", "duty") for name in HEAD.split(",")[1:]]
    rows = [[0.0, *full * DUTY], [1.0, *full * DUTY[::-1]], [2.0, *full * DUTY]]
    path = folder / "duties.csv"
    path.write_text(csv_text(["time", *names], rows), "utf-8")
    return path


@pytest.mark.parametrize("full", [1.0, 100.0], ids=["shares", "percent"])
def test_valves_fill_for_the_duty_of_each_carrier_period(tmp_path, full):
    path = duties(tmp_path, full)
    found = read_valves(path, SPEC, RecordingMap(log={"carrier_hz": 10.0}))
    assert found.kind == "valve"
    assert "converted to valve states at 10 Hz, where" in found.corrections[-1]
    filling = found.at(np.arange(0.0005, 2.0, 0.001)) == 1
    for k, period in enumerate(filling.reshape(20, 100, 8)):
        duty = DUTY if k < 10 else DUTY[::-1]
        assert period.mean(axis=0) == pytest.approx(duty, abs=0.011)
        assert (np.diff(period.astype(int), axis=0) <= 0).all()  # filling comes first


def test_duties_need_a_carrier_frequency(tmp_path):
    path = duties(tmp_path, 1.0)
    with pytest.raises(
        InputError, match="the carrier frequency of the duties is missing"
    ):
        read_valves(path, SPEC)
    path.write_text(path.read_text().replace("\n2,", "\n101,"))
    with pytest.raises(InputError, match="more than 1000000 carrier periods"):
        read_valves(path, SPEC, RecordingMap(log={"carrier_hz": 1e4}))


def test_duties_above_1_need_the_unit_per_cent(tmp_path):
    path = duties(tmp_path, 100)
    path.write_text(path.read_text().replace("_%", ""))
    with pytest.raises(
        InputError,
        match=r":2:3: duty_minus_1: 10 is not allowed; .* give the unit %",
    ):
        read_valves(path, SPEC, RecordingMap(log={"carrier_hz": 10.0}))


def test_states_0_and_1_mean_venting_and_filling(tmp_path):
    found = log(tmp_path, "\n".join([HEAD, "0" + ",0" * 8, "1" + ",1,0" * 4, ""]))
    assert found.values[:, 0].tolist() == [[-1, -1], [1, -1]]
    assert any("0 is read as venting" in each for each in found.corrections)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "valve_plus_1",
            "valve_plus_9",
            "valves.csv:1: the column 'valve_plus_1' is missing; gen2 has 4 segments",
        ),
        (
            "valve_minus_4",
            "valve_minus_4,valve_plus_5",
            "the column 'valve_plus_5' does not match any segment; gen2 has 4 segments",
        ),
        ("time", "clock", "valves.csv:1: the column 'time' is missing"),
        (
            "valve_plus_2",
            "valve_plus_1",
            "valves.csv:1:4: the column 'valve_plus_1' has the same meaning as the"
            " column",
        ),
        (
            "valve_plus_1",
            "valve_plus_1_kpa",
            "valves.csv:1:2: valve_plus_1_kpa: unknown unit 'kpa'",
        ),
        (
            "valve_plus_1",
            "pressure_plus_1",
            "this file has pressure, valve; assign other",
        ),
        ("1.0,", "1.0,2,", "valves.csv:3: the row has 10 cells, but the header has 9"),
        (
            "1.0,-1",
            "1.0,2",
            ":3:2: valve_plus_1: 2 is not allowed; it must be -1 (vent), 0 (hold)",
        ),
        ("1.0,-1", "1.0,", "valves.csv:3:2: valve_plus_1: the value is missing"),
        ("1.0,-1", "\n\n1.0,2", "valves.csv:5:2: valve_plus_1: 2 is not allowed"),
        ("time,valve_plus_1", "# a\ntime,x", "valves.csv:2: the column 'valve_plus_1'"),
        (
            "valve_plus_1",
            "pressure_plus_1_kpa (psi)",
            "valves.csv:1:2: pressure_plus_1_kpa (psi): two units, kPa and psi",
        ),
        (
            "valve_plus_1",
            "pressure_plus_1_kpa (abs)",
            "valves.csv:1:2: pressure_plus_1_kpa (abs): unknown unit 'abs'",
        ),
    ],
)
def test_errors_of_a_log_name_their_place(tmp_path, monkeypatch, old, new, says):
    monkeypatch.chdir(tmp_path)
    good = f"{HEAD}\n0.0{',-1' * 8}\n1.0{',-1' * 8}\n"
    bad = good.replace(old, new, 1)
    if new == "valve_minus_4,valve_plus_5":
        bad = bad.replace(",-1\n", ",-1,-1\n")
    with open("valves.csv", "w") as stream:
        stream.write(bad)
    with pytest.raises(InputError) as error:
        read_valves("valves.csv", SPEC)
    assert says in str(error.value)
    assert error.value.exit_code == 2


def test_set_points_hold_until_the_next_row(tmp_path):
    """A regulator holds its set point, while measured pressures are interpolated."""
    path = tmp_path / "air.csv"
    for kind, between in (("setpoint", 10e3), ("pressure", 15e3)):
        names = [f"{name}_kpa".replace("valve", kind) for name in HEAD.split(",")[1:]]
        rows = [[1.0, *[10.0] * 8], [2.0, *[20.0] * 8], [3.0, *[0.0] * 8]]
        path.write_text(csv_text(["time", *names], rows))
        found = read_valves(path, SPEC)
        assert found.at(np.array([1.0, 1.5, 2.0, 3.0]))[:, 2, 1] == pytest.approx(
            [10e3, between, 20e3, 0.0]
        )
        time, values = found.breakpoints()
        assert (np.diff(time) > 0).all()
        assert np.interp(
            [1.5, 1.99999, 2.0, 2.5], time, values[:, 2, 1]
        ) == pytest.approx(
            [
                between,
                10e3 if kind == "setpoint" else 19999.9,
                20e3,
                20e3 if kind == "setpoint" else 10e3,
            ]
        )


def test_set_points_of_signals_hold_until_their_next_message(tmp_path):
    signals = {}
    for k, (side, j) in enumerate(
        (side, j) for side in ("plus", "minus") for j in range(1, 5)
    ):
        start = np.array([0.0, 1.0, 2.0]) + 0.1 * k
        signals[f"setpoint_kpa_{side}_{j}"] = (start, np.array([10.0, 20.0, 30.0]))
    topics = RecordedTopics("a.mcap", "", 0, None, signals, ())
    found = log_of_topics(
        topics, SPEC, RecordingMap(log={name: name for name in signals})
    )
    assert found.at(np.array([0.95, 1.45]))[:, 3, 0] == pytest.approx([10e3, 20e3])
    assert found.at(np.array([1.05]))[0, 0, 0] == pytest.approx(20e3)
    assert found.at(np.array([1.05]))[0, 3, 1] == pytest.approx(10e3)


@pytest.mark.parametrize(
    ("kind", "still", "driven"), [("valve", -1.0, 1.0), ("pressure", 0.0, 40e3)]
)
def test_the_start_pose_is_the_mean_before_the_first_valve_opens(kind, still, driven):
    time = np.arange(0, 4, 0.01)
    wobble = 0.01 * np.cos(200 * time)
    moved = np.maximum(time - 2.0, 0.0)
    columns = {"time": time, "com_x": moved + wobble, "com_y": -moved}
    columns["heading"] = 0.5 + moved
    states = np.full((2, 4, 2), still)
    states[1, 0, 0] = driven
    log = ValveLog(kind, np.array([0.0, 2.0]), states, "x", "", ())
    pose = Recording(Trajectory(columns), summary=None, valves=log).start_pose()
    assert pose == pytest.approx((0.0, 0.0, 0.5), abs=1e-3)
