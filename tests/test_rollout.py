"""Rollouts: sampling, observers, ends of a run, diverged runs and metadata."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from snakes import robot

from srs_twin import (
    AnalyticalSnake,
    Controller,
    DivergedError,
    Event,
    Gait,
    InputError,
    LoadedContact,
    Plant,
    PreloadedContact,
    SnakeState,
    Trajectory,
    TwinSnake,
    rollout,
)
from srs_twin.errors import count_steps
from srs_twin.rollout import sample_counts

SPEC = robot()


class Clock(Plant):
    """Plant whose heading is the time, and whose x coordinate is the number of ticks."""

    name = "clock"

    def __init__(self, tick: float = 0.02, *, breaks_at: float = np.inf) -> None:
        self.spec = SPEC
        self.tick = tick
        self._breaks_at = breaks_at
        self.commands: list[np.ndarray] = []
        self.resets: list[tuple[Any, int]] = []

    def reset(self, *, pose=(0.0, 0.0, 0.0), seed=0) -> SnakeState:
        self.resets.append((pose, seed))
        self._ticks = 0
        self._rest = AnalyticalSnake(SPEC).reset()
        return self._state(0.0)

    def advance(self, valves, samples) -> list[SnakeState]:
        self.commands.append(valves)
        begun = self._ticks * self.tick
        if begun + self.tick > self._breaks_at:
            raise DivergedError(self.name, begun + self.tick, "on request")
        self._ticks += 1
        return [
            self._state(begun + self.tick * k / samples) for k in range(1, samples + 1)
        ]

    def openings(self) -> np.ndarray:
        return np.full((4, 2), self._ticks)

    def _state(self, time: float) -> SnakeState:
        return replace(
            self._rest,
            time=time,
            com=np.array([self._ticks, -time]),
            heading=time,
            position=np.arange(10.0).reshape(5, 2),
            bend=np.full(4, time),
            pressure=np.arange(8.0).reshape(4, 2),
            valves=np.tile([1, -1], (4, 1)),
        )


class Scripted(Controller):
    """Controller with a scalar signal, an array signal and an event every fifth tick.

    It finishes at a given tick.
    """

    kind = "scripted"

    def __init__(self, ticks: int = 1000) -> None:
        self._ticks = ticks

    def reset(self, spec, tick, *, seed=0) -> None:
        self.prepared = (spec.name, tick, seed)
        self.count = 0

    def step(self, state: SnakeState) -> np.ndarray:
        self.count += 1
        self.seen = state.time
        self.finished = self.count >= self._ticks
        return np.full((4, 2), -1)

    def signals(self) -> dict[str, Any]:
        return {"count": self.count, "reference": np.array([0.5, self.count])}

    def events(self) -> list[Event]:
        if self.count % 5:
            return []
        return [Event(self.seen, "fifth", f"tick {self.count}")]


@pytest.mark.parametrize(
    ("options", "step"),
    [
        ({}, 0.01),
        ({"record_hz": 50}, 0.02),
        ({"record_hz": 200}, 0.005),
        ({"record_hz": 10}, 0.1),
    ],
)
def test_samples_are_evenly_spaced_and_include_both_ends(options, step):
    trajectory = rollout(Clock(), Scripted(), 1.0, **options)
    assert trajectory.time == pytest.approx(step * np.arange(round(1 / step) + 1))
    assert (trajectory["heading"] == trajectory.time).all()
    assert trajectory["com_y"] == pytest.approx(-trajectory.time)


@pytest.mark.parametrize(
    ("run", "words"),
    [
        (
            lambda: rollout(Clock(), Scripted(), 1.01),
            "duration 1.01 s is not a multiple of tick 0.02 s; use 1 s, or set tick to",
        ),
        (
            lambda: rollout(Clock(), Scripted(), 1.0, record_hz=70),
            "`record_hz` 70 does not fit the tick of 0.02 s; use 50 Hz, or any integer"
            " multiple or integer fraction of 50 Hz",
        ),
        (
            lambda: rollout(Clock(), Scripted(), 1.0, record_hz=30),
            "`record_hz` 30 does not fit the tick of 0.02 s; use 25 Hz, or any",
        ),
        (
            lambda: rollout(TwinSnake(SPEC), Gait(2.0), 0.1, record_hz=2500),
            "`record_hz` 2500 does not fit the tick of 0.02 s; use 1000 Hz, or any",
        ),
        (
            lambda: TwinSnake(SPEC, timestep=0.0015),
            "tick 0.02 s is not a multiple of time step 0.0015 s",
        ),
        (
            lambda: AnalyticalSnake(SPEC, timestep=np.nan),
            "time step nan s is not allowed; it must be finite and above 0",
        ),
        (
            lambda: rollout(Clock(), Scripted(), 1.0, record_hz=0),
            "is not allowed; it must be finite and above 0",
        ),
        (
            lambda: rollout(TwinSnake(SPEC), Gait(2.0), 0.1, pose=(0.0, 0.0, np.nan)),
            "the pose at the start is not allowed; it must be finite",
        ),
    ],
)
def test_incompatible_times_and_poses_are_rejected_with_a_remedy(run, words):
    with pytest.raises(InputError, match=words):
        run()


@pytest.mark.parametrize("record_hz", [7.14286, 50 / 7.0001, 1.00003e-3, 123456.7])
@pytest.mark.parametrize(("tick", "step"), [(0.02, 0.001), (1 / 3, None)])
def test_suggested_record_hz_is_accepted(record_hz, tick, step):
    with pytest.raises(InputError, match="does not fit") as refused:
        sample_counts(tick, record_hz, step)
    nearest, whole = re.findall(r"([0-9.e+-]+) Hz", str(refused.value))
    for text in (nearest, whole):
        samples, stride = sample_counts(tick, float(text), step)
        assert samples / stride == pytest.approx(tick * float(text), rel=1e-9)


def test_only_one_start_is_accepted():
    placed = []

    def begin(plant: Plant, seed: int) -> SnakeState:
        placed.append(seed)
        return plant.reset(seed=seed)

    with pytest.raises(
        InputError, match="`pose`, `initial_state` and `resume` .*; give only one"
    ):
        rollout(Clock(), Scripted(), 0.2, pose=(1.0, 0.0, 0.0), initial_state=begin)
    assert not placed
    rollout(Clock(), Scripted(), 0.2, initial_state=begin, seed=3)
    assert placed == [3]
    with pytest.raises(InputError, match="initial_state returned None, but must"):
        rollout(Clock(), Scripted(), 0.2, initial_state=lambda plant, seed: None)


@pytest.mark.parametrize(
    ("period", "step"), [(0.13999994, 0.02), (1234.567891, 0.00123), (7.0, 0.3333)]
)
def test_suggested_times_are_accepted(period, step):
    with pytest.raises(InputError) as refused:
        count_steps("duration", period, "tick", step)
    printed, longer, shorter = re.fullmatch(
        r"duration (\S+) s is not a multiple of tick \S+ s; use (\S+) s, or set"
        r" tick to (\S+) s",
        str(refused.value),
    ).groups()
    with pytest.raises(InputError):  # the printed digits show the problem
        count_steps("duration", float(printed), "tick", step)
    assert count_steps("duration", float(longer), "tick", step) >= 1
    assert count_steps("duration", period, "tick", float(shorter)) >= 1


@pytest.mark.parametrize("timestep", [0.003, 0.0007, 0.05])
def test_analytical_steps_end_on_samples(timestep):
    """Steps are shortened to end on samples and ticks, so that the results are those of a finer step."""
    coarse = rollout(
        AnalyticalSnake(SPEC, timestep=timestep), Gait(1.7), 0.3, record_hz=250
    )
    fine = rollout(
        AnalyticalSnake(SPEC, timestep=0.0005), Gait(1.7), 0.3, record_hz=250
    )
    assert coarse.time == pytest.approx(0.004 * np.arange(76))
    assert coarse.stack("bend") == pytest.approx(fine.stack("bend"), abs=1e-12)
    assert coarse.com == pytest.approx(fine.com, abs=1e-3)


@pytest.mark.parametrize(
    ("frequency", "offset", "record_hz"),
    [(2.0, 0.0, 100), (0.9, 0.94, 25), (49.0, 0.1, 1000)],
)
def test_script_equals_stepping_every_tick(frequency, offset, record_hz):
    pair = AnalyticalSnake(SPEC), Gait(frequency, offset)
    scripted = rollout(*pair, 0.62, record_hz=record_hz)
    stepped = rollout(*pair, 0.62, record_hz=record_hz, observers=[lambda state: None])
    assert list(scripted.columns) == list(stepped.columns)
    for name, column in scripted.columns.items():
        assert column == pytest.approx(stepped[name], rel=1e-9, abs=1e-9), name
    assert scripted.metadata == stepped.metadata


def test_long_script_is_simulated_in_chunks_with_progress():
    times: list[float] = []
    whole = rollout(
        AnalyticalSnake(SPEC), Gait(1.3), 21.0, record_hz=10, progress=times.append
    )
    assert times == pytest.approx([10.0, 20.0, 21.0])
    part = rollout(
        AnalyticalSnake(SPEC), Gait(1.3), 9.0, record_hz=10, progress=times.append
    )
    assert whole.com[:91] == pytest.approx(part.com, abs=1e-12)


def test_resumed_run_continues_its_script():
    """The resumed run equals the rest of an uninterrupted run."""
    plant = AnalyticalSnake(SPEC)
    gait = Gait(1.7, -0.3)
    whole = rollout(plant, gait, 0.6, record_hz=50)
    rollout(plant, gait, 0.24, record_hz=50)
    kept = plant.save(), gait.save()
    rest = rollout(
        AnalyticalSnake(SPEC), Gait(1.7, -0.3), 0.36, record_hz=50, resume=kept
    )
    assert rest.time == pytest.approx(whole.time[12:])
    for name in (
        "com_x",
        "com_y",
        "bend_2",
        "pressure_plus_3",
        "valve_minus_4",
        "work",
    ):
        assert rest[name] == pytest.approx(whole[name][12:], rel=1e-9, abs=1e-9), name


def test_pose_and_seed_are_passed_to_plant_and_controller():
    plant = Clock()
    controller = Scripted()
    rollout(plant, controller, 0.1, pose=(1.0, 2.0, 3.0), seed=7)
    assert plant.resets == [((1.0, 2.0, 3.0), 7)]
    assert controller.prepared == ("gen2", 0.02, 7)
    assert len(plant.commands) == controller.count == 5


def test_columns_have_numbered_names_and_units():
    run = rollout(Clock(), Scripted(), 0.1, record_hz=50)
    numbered = {
        5: "x y connector_heading",
        4: "bend measured_bend torque pressure_plus pressure_minus valve_plus"
        " valve_minus",
    }
    expected = ["time", "com_x", "com_y", "heading"]
    for count, names in numbered.items():
        expected += [f"{n}_{i}" for n in names.split() for i in range(1, count + 1)]
    expected += ["work", "pneumatic_energy", "count", "reference_1", "reference_2"]
    assert list(run.columns) == expected
    assert (run["x_3"][0], run["y_3"][0]) == (4, 5)
    assert (run["pressure_plus_2"][0], run["pressure_minus_2"][0]) == (2, 3)
    assert (run["valve_plus_1"][1], run["valve_minus_1"][1]) == (1, -1)
    names = ("time", "com_x", "connector_heading_2", "pressure_plus_1", "count")
    assert list(map(run.unit, names)) == ["s", "m", "rad", "Pa", "1"]
    assert run["count"].tolist() == run["reference_2"].tolist() == [0, 1, 2, 3, 4, 5]
    assert run["reference_1"].tolist() == [0.5] * 6


@pytest.mark.parametrize(
    ("signals", "wrong"),
    [
        (lambda count: {"com_x": 0.0}, "signal 'com_x'"),
        (lambda count: {"time": 0.0}, "signal 'time'"),
        (lambda count: {"bend": np.zeros(4)}, "signal 'bend_1'"),
        (lambda count: {"a": 1.0} | ({"b": 1.0} if count else {}), "signal 'b'"),
        (lambda count: {} if count else {"a": 1.0}, "signal 'a'"),
        (lambda count: {"a": "text"}, "signal 'a'"),
        (lambda count: {"a": None}, "signal 'a'"),
        (lambda count: None, "None"),
        (lambda count: [1], r"\[1\]"),
    ],
)
def test_invalid_signals_are_named(signals, wrong):
    controller = Scripted()
    controller.signals = lambda: signals(controller.count)
    with pytest.raises(
        InputError, match=f"^controller 'scripted': {wrong} is not allowed; `signals`"
    ):
        rollout(Clock(), controller, 0.1)


def test_errors_of_observers_do_not_name_the_controller():
    def refuse(state: SnakeState) -> None:
        raise InputError("not now")

    with pytest.raises(InputError, match="^not now$"):
        rollout(Clock(), Scripted(), 0.1, observers=[refuse])


def test_events_are_kept_at_any_sampling_rate():
    events = rollout(Clock(), Scripted(), 0.4, record_hz=10).events
    assert [event.text for event in events] == [f"tick {k}" for k in (5, 10, 15, 20)]
    times = [event.time for event in events]
    assert times == pytest.approx([0.08, 0.18, 0.28, 0.38])


def test_metadata_describe_plant_robot_and_controller():
    trajectory = rollout(Clock(), Scripted(), 0.2, record_hz=50)
    assert trajectory.metadata == {
        "plant": "clock",
        "robot": "gen2",
        "tick_s": 0.02,
        "record_hz": 50,
        "duration_s": 0.2,
        "body_length_m": pytest.approx(0.22),
        "body_width_m": 0.04,
        "segment_length_m": 0.037,
        "rigid_gap_m": 0.018,
        "mass_kg": pytest.approx(0.15),
        "controller": "scripted",
        "gait_frequency_hz": None,
        "control": {},
        "ended_by": None,
        "valve_switches": [[10, 10]] * 4,
    }


def test_observers_are_called_at_the_start_and_every_tick():
    first: list[float] = []
    second: list[int] = []
    rollout(
        Clock(),
        Scripted(),
        0.1,
        record_hz=10,
        observers=[lambda s: first.append(s.time), lambda s: second.append(len(first))],
    )
    assert first == pytest.approx([0, 0.02, 0.04, 0.06, 0.08, 0.1])
    assert second == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("build", [AnalyticalSnake, TwinSnake])
@pytest.mark.parametrize("time", [0.0, 0.02])
def test_observers_and_controllers_cannot_change_the_recorded_state(build, time):
    def shift(state: SnakeState) -> None:
        if state.time == time:
            state.measured_bend[:] = 9.0

    with pytest.raises(ValueError, match="read-only"):
        rollout(build(SPEC), Gait(2.0), 0.04, observers=[shift])


@pytest.mark.parametrize("record_hz", [100, 10])
def test_finished_controller_ends_the_run(record_hz):
    plant = Clock()
    trajectory = rollout(plant, Scripted(ticks=7), 1.0, record_hz=record_hz)
    assert len(plant.commands) == 7 and trajectory.time[-1] == pytest.approx(0.14)
    assert trajectory.metadata["ended_by"] == "controller"
    assert trajectory.metadata["duration_s"] == 1.0


def test_until_ends_the_run_after_its_tick():
    times: list[float] = []

    def far(state: SnakeState) -> bool:
        times.append(state.time)
        return state.com[0] >= 3

    trajectory = rollout(Clock(), Scripted(), 1.0, record_hz=100, until=far)
    assert trajectory.metadata["ended_by"] == "until"
    assert trajectory.time[-1] == pytest.approx(0.06)
    assert times == pytest.approx([0.02, 0.04, 0.06])
    whole = rollout(Clock(), Scripted(), 0.1, until=lambda s: False)
    assert whole.time[-1] == pytest.approx(0.1)


def test_diverged_run_keeps_its_samples():
    with pytest.raises(
        DivergedError, match=r"clock diverged at t = 0.52 s: on request"
    ) as caught:
        rollout(Clock(breaks_at=0.51), Scripted(), 1.0)
    kept = caught.value.trajectory
    assert isinstance(kept, Trajectory)
    assert kept.time == pytest.approx(np.arange(51) / 100)
    assert [event.text for event in kept.events] == [
        f"tick {k}" for k in (5, 10, 15, 20, 25)
    ]
    assert kept.metadata["valve_switches"] == [[25, 25]] * 4


def spoil_analytical(plant: AnalyticalSnake, value: float) -> None:
    plant.body.state[3] = value


def spoil_twin(plant: TwinSnake, value: float) -> None:
    plant.physics.data.qvel[0] = value


@pytest.mark.parametrize("value", [np.nan, 1e7])
@pytest.mark.parametrize(
    ("build", "spoil"),
    [(AnalyticalSnake, spoil_analytical), (TwinSnake, spoil_twin)],
    ids=["analytical", "twin"],
)
def test_implausible_state_is_a_divergence_with_time_and_samples(build, spoil, value):
    plant = build(SPEC)

    def spoil_state(state: SnakeState) -> None:
        if state.time > 0.099:
            spoil(plant, value)

    with pytest.raises(
        DivergedError, match=rf"{plant.name} diverged at t = 0.1(0[12]|1|2) s: "
    ) as caught:
        rollout(plant, Gait(2.0), 0.4, observers=[spoil_state])
    kept = caught.value.trajectory
    assert kept.time == pytest.approx(np.arange(11) / 100)
    assert all(np.isfinite(column).all() for column in kept.columns.values())
    # The plant can be used again after a reset.
    assert np.isfinite(rollout(plant, Gait(2.0), 0.1).com).all()


@pytest.mark.parametrize("build", [AnalyticalSnake, TwinSnake])
def test_sampling_rate_does_not_change_the_run(build):
    plant = build(SPEC)
    runs = {
        hz: rollout(plant, Gait(1.7, 0.1), 0.4, record_hz=hz) for hz in (10, 50, 500)
    }
    for name in ("com_x", "com_y", "heading", "bend_3", "pressure_plus_2", "x_5"):
        assert runs[50][name][::5] == pytest.approx(runs[10][name], rel=1e-9, abs=1e-12)
        assert runs[500][name][::10] == pytest.approx(
            runs[50][name], rel=1e-9, abs=1e-9
        )
    assert runs[10].metadata["valve_switches"] == runs[500].metadata["valve_switches"]


@pytest.mark.parametrize(
    ("build", "settings", "coordinates"),
    [
        (
            lambda: AnalyticalSnake(
                SPEC, model="compliant", friction="wheel", timestep=1e-3
            ),
            {"model": "compliant", "friction": "wheel", "timestep_s": 0.001},
            0,
        ),
        # Free joint; three hinges, pitch and roll per segment.
        (
            lambda: TwinSnake(
                SPEC, hinges_per_segment=3, contact=PreloadedContact("skid")
            ),
            {"wheels": "skid", "hinges_per_segment": 3},
            7 + 4 * 5,
        ),
        # Two hinges instead of three, and two wheels per connector.
        (
            lambda: TwinSnake(SPEC, contact="preloaded"),
            {"wheels": "rolling"},
            7 + 4 * 4 + 10,
        ),
        (
            lambda: TwinSnake(SPEC, contact=LoadedContact("axis", slip_speed=0.002)),
            {"contact": "loaded", "friction": "axis", "slip_speed_m_s": 0.002},
            None,
        ),
    ],
)
def test_metadata_contain_the_settings_of_the_plant(build, settings, coordinates):
    """All settings differ from the defaults."""
    run = rollout(build(), Gait(1.7), 0.1)
    settings = settings | {"gait_frequency_hz": 1.7, "controller": "gait"}
    assert run.metadata | settings == run.metadata
    if coordinates:
        assert run.stack("qpos").shape == (11, coordinates)
