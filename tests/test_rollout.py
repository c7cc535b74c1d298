"""rollout: what is recorded when, who is told, when it ends, and what is left of a run that diverges."""

from __future__ import annotations

import re
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
from srs_twin.errors import whole_steps
from srs_twin.rollout import sampling

SPEC = robot()


class Clock(Plant):
    """A plant that only tells the time: heading = time, x of the centre of mass = number of ticks."""

    name = "clock"

    def __init__(self, tick: float = 0.02, *, breaks_at: float = np.inf) -> None:
        self.spec, self.tick, self._breaks_at = SPEC, tick, breaks_at
        self.given: list[np.ndarray] = []
        self.resets: list[tuple[Any, int]] = []

    def reset(self, *, pose=(0.0, 0.0, 0.0), seed=0) -> SnakeState:
        self.resets.append((pose, seed))
        self._ticks = 0
        return self._state(0.0)

    def advance(self, valves, samples) -> list[SnakeState]:
        self.given.append(valves)
        begun = self._ticks * self.tick
        if begun + self.tick > self._breaks_at:
            raise DivergedError(self.name, begun + self.tick, "it was told to")
        self._ticks += 1
        return [self._state(begun + self.tick * k / samples) for k in range(1, samples + 1)]

    def openings(self) -> np.ndarray:
        return np.full((4, 2), self._ticks)

    def _state(self, time: float) -> SnakeState:
        connectors, segments = np.zeros(5), np.zeros(4)
        return SnakeState(
            time=time, com=np.array([self._ticks, -time]), com_velocity=np.zeros(2), heading=time,
            position=np.arange(10.0).reshape(5, 2), theta=connectors, bend=segments + time,
            bend_rate=segments, pressure=np.arange(8.0).reshape(4, 2), valves=np.tile([1, -1], (4, 1)),
            sensed=segments, contact_force=np.zeros((5, 2)),
            obstacle_force=np.zeros((5, 2)), torque=segments, work=0.0, internal_loss=0.0, air=0.0,
            qpos=np.empty(0),
        )  # fmt: skip


class Teller(Controller):
    """A controller with a scalar and an array signal and an event every fifth tick."""

    kind = "teller"

    def reset(self, spec, tick, *, seed=0) -> None:
        self.prepared = (spec.name, tick, seed)
        self.count = 0

    def step(self, state: SnakeState) -> np.ndarray:
        self.count += 1
        self.seen = state.time
        return np.full((4, 2), -1)

    def signals(self) -> dict[str, Any]:
        return {"count": self.count, "reference": np.array([0.5, self.count])}

    def events(self) -> list[Event]:
        return [Event(self.seen, "fifth", f"tick {self.count}")] if self.count % 5 == 0 else []


@pytest.mark.parametrize(
    ("record_hz", "step", "samples"), [(50, 0.02, 51), (200, 0.005, 201), (10, 0.1, 11), (25, 0.04, 26)]
)
def test_samples_are_evenly_spaced_ends_included(record_hz, step, samples):
    trajectory = rollout(Clock(), Teller(), 1.0, record_hz=record_hz)
    assert trajectory.time == pytest.approx(step * np.arange(samples))
    assert (trajectory["heading"] == trajectory.time).all()
    assert trajectory["com_y"] == pytest.approx(-trajectory.time)


def test_default_is_a_hundred_samples_a_second():
    assert rollout(Clock(), Teller(), 0.2).time == pytest.approx(np.arange(21) / 100)


def test_what_does_not_fit_is_refused_with_what_would():
    with pytest.raises(InputError, match=r"duration 1.01 s is no multiple of tick 0.02 s; 1 s or tick"):
        rollout(Clock(), Teller(), 1.01)
    message = (
        r"record_hz 70 does not fit the tick 0.02 s; 50 Hz or any whole multiple or fraction of 50 Hz would"
    )
    with pytest.raises(InputError, match=message):
        rollout(Clock(), Teller(), 1.0, record_hz=70)
    with pytest.raises(InputError, match=r"record_hz 30 does not fit the tick 0.02 s; 25 Hz or any"):
        rollout(Clock(), Teller(), 1.0, record_hz=30)
    with pytest.raises(InputError, match=r"record_hz 2500 does not fit the tick 0.02 s; 1000 Hz or any"):
        rollout(TwinSnake(SPEC), Gait(2.0), 0.1, record_hz=2500)
    with pytest.raises(InputError, match=r"tick 0.02 s is no multiple of time step 0.0015 s"):
        TwinSnake(SPEC, timestep=0.0015)
    with pytest.raises(InputError, match=r"time step nan s is not allowed; it must be finite and above 0"):
        AnalyticalSnake(SPEC, timestep=np.nan)


@pytest.mark.parametrize("record_hz", [7.14286, 2.94118, 3.33333, 50 / 7.0001, 333.3, 1.00003e-3, 123456.7])
@pytest.mark.parametrize(
    ("tick", "step"), [(0.02, None), (0.02, 0.001), (0.02, 0.02), (0.03, None), (1 / 3, None)]
)
def test_proposed_record_hz_is_accepted(record_hz, tick, step):
    with pytest.raises(InputError, match="does not fit") as refused:
        sampling(tick, record_hz, step)
    nearest, whole = re.findall(r"([0-9.e+-]+) Hz", str(refused.value))
    for text in (nearest, whole):
        samples, stride = sampling(tick, float(text), step)
        assert samples / stride == pytest.approx(tick * float(text), rel=1e-9)


@pytest.mark.parametrize("record_hz", [0, -50, np.nan, np.inf])
def test_record_hz_without_an_interval_is_refused(record_hz):
    with pytest.raises(InputError, match="is not allowed; it must be finite and above 0"):
        rollout(Clock(), Teller(), 1.0, record_hz=record_hz)


@pytest.mark.parametrize(("period", "step"), [(0.13999994, 0.02), (1234.567891, 0.00123), (7.0, 0.3333)])
def test_times_proposed_for_a_period_are_accepted(period, step):
    with pytest.raises(InputError) as refused:
        whole_steps("duration", period, "tick", step)
    given, longer, shorter = re.fullmatch(
        r"duration (\S+) s is no multiple of tick \S+ s; (\S+) s or tick (\S+) s would be", str(refused.value)
    ).groups()
    with pytest.raises(InputError):  # the text shows the fault
        whole_steps("duration", float(given), "tick", step)
    assert whole_steps("duration", float(longer), "tick", step) >= 1
    assert whole_steps("duration", period, "tick", float(shorter)) >= 1


@pytest.mark.parametrize("timestep", [0.003, 0.0007, 0.05])
def test_analytical_steps_end_on_samples_whatever_the_time_step(timestep):
    """Steps are shortened to end on samples and ticks, so a run is that of a step somewhat finer."""
    coarse = rollout(AnalyticalSnake(SPEC, timestep=timestep), Gait(1.7), 0.3, record_hz=250)
    fine = rollout(AnalyticalSnake(SPEC, timestep=0.0005), Gait(1.7), 0.3, record_hz=250)
    assert coarse.time == pytest.approx(0.004 * np.arange(76))
    assert coarse.stack("bend") == pytest.approx(fine.stack("bend"), abs=1e-12)
    assert coarse.com == pytest.approx(fine.com, abs=1e-3)


@pytest.mark.parametrize("record_hz", [100, 25, 1000])
@pytest.mark.parametrize(("frequency", "offset"), [(2.0, 0.0), (1.7, -0.3), (0.9, 0.94), (49.0, 0.1)])
def test_following_a_script_is_meeting_every_tick(record_hz, frequency, offset):
    plant, gait = AnalyticalSnake(SPEC), Gait(frequency, offset)
    followed = rollout(plant, gait, 0.62, record_hz=record_hz)
    met = rollout(plant, gait, 0.62, record_hz=record_hz, observers=[lambda state: None])
    assert list(followed.columns) == list(met.columns)
    for name, column in followed.columns.items():
        assert column == pytest.approx(met[name], rel=1e-9, abs=1e-9), name
    assert followed.metadata == met.metadata


def test_long_scripts_are_followed_in_stretches_and_tell_their_progress():
    told: list[float] = []
    whole = rollout(AnalyticalSnake(SPEC), Gait(1.3), 21.0, record_hz=10, progress=told.append)
    assert told == pytest.approx([10.0, 20.0, 21.0])
    part = rollout(AnalyticalSnake(SPEC), Gait(1.3), 9.0, record_hz=10, progress=told.append)
    assert whole.com[:91] == pytest.approx(part.com, abs=1e-12)


def test_a_resumed_run_continues_its_script_where_it_ended():
    """The run after the cut is the rest of the uninterrupted run."""
    plant, gait = AnalyticalSnake(SPEC), Gait(1.7, -0.3)
    whole = rollout(plant, gait, 0.6, record_hz=50)
    rollout(plant, gait, 0.24, record_hz=50)
    kept = plant.save(), gait.save()
    rest = rollout(AnalyticalSnake(SPEC), Gait(1.7, -0.3), 0.36, record_hz=50, resume=kept)
    assert rest.time == pytest.approx(whole.time[12:])
    for name in ("com_x", "com_y", "bend_2", "pressure_plus_3", "valve_minus_4", "work"):
        assert rest[name] == pytest.approx(whole[name][12:], rel=1e-9, abs=1e-9), name


def test_pose_and_seed_reach_plant_and_controller():
    plant, controller = Clock(), Teller()
    rollout(plant, controller, 0.1, pose=(1.0, 2.0, 3.0), seed=7)
    assert plant.resets == [((1.0, 2.0, 3.0), 7)]
    assert controller.prepared == ("gen2", 0.02, 7)
    assert len(plant.given) == controller.count == 5


def test_columns_carry_numbered_names_and_units():
    trajectory = rollout(Clock(), Teller(), 0.1, record_hz=50)
    per_connector = [f"{name}_{i}" for name in ("x", "y", "theta") for i in range(1, 6)]
    per_segment = [
        f"{name}_{j}"
        for name in (
            "bend", "sensed", "torque", "pressure_plus", "pressure_minus", "valve_plus", "valve_minus"
        )
        for j in range(1, 5)
    ]  # fmt: skip
    expected = ["time", "com_x", "com_y", "heading", *per_connector, *per_segment]
    assert list(trajectory.columns) == [*expected, "work", "air", "count", "reference_1", "reference_2"]
    assert all(len(column) == 6 for column in trajectory.columns.values())
    assert trajectory["x_3"][0] == 4 and trajectory["y_3"][0] == 5
    assert trajectory["pressure_plus_2"][0] == 2 and trajectory["pressure_minus_2"][0] == 3
    assert trajectory["valve_plus_1"][1] == 1 and trajectory["valve_minus_1"][1] == -1
    units = {name: trajectory.unit(name) for name in ("time", "com_x", "theta_2", "pressure_plus_1", "count")}
    assert units == {"time": "s", "com_x": "m", "theta_2": "rad", "pressure_plus_1": "Pa", "count": "1"}


def test_signals_are_those_in_force_at_each_sample():
    trajectory = rollout(Clock(), Teller(), 0.1, record_hz=50)
    assert trajectory["count"].tolist() == [0, 1, 2, 3, 4, 5]
    assert trajectory["reference_1"].tolist() == [0.5] * 6
    assert trajectory["reference_2"].tolist() == [0, 1, 2, 3, 4, 5]


def test_events_are_kept_whatever_is_recorded():
    trajectory = rollout(Clock(), Teller(), 0.4, record_hz=10)
    assert [event.text for event in trajectory.events] == ["tick 5", "tick 10", "tick 15", "tick 20"]
    assert [event.time for event in trajectory.events] == pytest.approx([0.08, 0.18, 0.28, 0.38])


def test_metadata_says_what_ran():
    trajectory = rollout(Clock(), Teller(), 0.2, record_hz=50)
    assert trajectory.metadata == {
        "plant": "clock", "robot": "gen2", "tick_s": 0.02, "record_hz": 50, "duration_s": 0.2,
        "body_length_m": pytest.approx(0.22), "body_width_m": 0.04, "segment_length_m": 0.037,
        "rigid_gap_m": 0.018, "mass_kg": pytest.approx(0.15), "controller": "teller",
        "gait_frequency_hz": None,
        "control": {}, "ended_by": None, "valve_switches": [[10, 10]] * 4,
    }  # fmt: skip


def test_observers_see_the_start_and_every_tick():
    first: list[float] = []
    second: list[int] = []
    rollout(
        Clock(), Teller(), 0.1, record_hz=10,
        observers=[lambda s: first.append(s.time), lambda s: second.append(len(first))],
    )  # fmt: skip
    assert first == pytest.approx([0, 0.02, 0.04, 0.06, 0.08, 0.1])
    assert second == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("record_hz", [100, 50, 10])
def test_a_controller_that_has_finished_ends_the_run_after_its_tick(record_hz):
    class Sated(Teller):
        """Has enough at its seventh tick."""

        def step(self, state: SnakeState) -> np.ndarray:
            valves = super().step(state)
            self.finished = self.count >= 7
            return valves

    plant = Clock()
    trajectory = rollout(plant, Sated(), 1.0, record_hz=record_hz)
    assert len(plant.given) == 7 and trajectory.time[-1] == pytest.approx(0.14)
    assert trajectory.metadata["ended_by"] == "controller"
    assert trajectory.metadata["duration_s"] == 1.0


def test_until_ends_after_the_tick_in_which_it_holds():
    asked: list[float] = []

    def far(state: SnakeState) -> bool:
        asked.append(state.time)
        return state.com[0] >= 3

    trajectory = rollout(Clock(), Teller(), 1.0, record_hz=100, until=far)
    assert trajectory.metadata["ended_by"] == "until"
    assert trajectory.time[-1] == pytest.approx(0.06)
    assert asked == pytest.approx([0.02, 0.04, 0.06])
    assert rollout(Clock(), Teller(), 0.1, until=lambda s: False).time[-1] == pytest.approx(0.1)


def test_diverged_run_keeps_what_was_recorded():
    with pytest.raises(DivergedError, match=r"clock diverged at t = 0.52 s: it was told to") as caught:
        rollout(Clock(breaks_at=0.51), Teller(), 1.0)
    kept = caught.value.trajectory
    assert isinstance(kept, Trajectory)
    assert kept.time == pytest.approx(np.arange(51) / 100)
    assert [event.text for event in kept.events] == [f"tick {k}" for k in (5, 10, 15, 20, 25)]
    assert kept.metadata["valve_switches"] == [[25, 25]] * 4


def spoil_analytical(plant: AnalyticalSnake, value: float) -> None:
    plant._body.state[3] = value


def spoil_twin(plant: TwinSnake, value: float) -> None:
    plant.physics.data.qvel[0] = value


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e7])
@pytest.mark.parametrize(
    ("build", "spoil"),
    [(AnalyticalSnake, spoil_analytical), (TwinSnake, spoil_twin)],
    ids=["analytical", "twin"],
)
def test_plants_that_left_the_plausible_say_when_and_keep_the_good_part(build, spoil, value):
    plant = build(SPEC)

    def break_it(state: SnakeState) -> None:
        if state.time > 0.099:
            spoil(plant, value)

    with pytest.raises(DivergedError, match=rf"{plant.name} diverged at t = 0.1(0[12]|1|2) s: ") as caught:
        rollout(plant, Gait(2.0), 0.4, observers=[break_it])
    kept = caught.value.trajectory
    assert kept.time == pytest.approx(np.arange(11) / 100)
    assert all(np.isfinite(column).all() for column in kept.columns.values())
    # The same plant is fit again after a reset.
    assert np.isfinite(rollout(plant, Gait(2.0), 0.1).com).all()


@pytest.mark.parametrize("build", [AnalyticalSnake, TwinSnake])
def test_recording_more_or_less_often_does_not_change_the_run(build):
    plant = build(SPEC)
    runs = {hz: rollout(plant, Gait(1.7, 0.1), 0.4, record_hz=hz) for hz in (10, 50, 500)}
    for name in ("com_x", "com_y", "heading", "bend_3", "pressure_plus_2", "x_5"):
        assert runs[50][name][::5] == pytest.approx(runs[10][name], rel=1e-9, abs=1e-12)
        assert runs[500][name][::10] == pytest.approx(runs[50][name], rel=1e-9, abs=1e-9)
    assert runs[10].metadata["valve_switches"] == runs[500].metadata["valve_switches"]


def test_real_plants_record_their_settings():
    """Settings that are not the defaults, which a constant would tell as well."""
    model = AnalyticalSnake(SPEC, model="compliant", friction="wheel", timestep=0.001)
    about = rollout(model, Gait(1.7), 0.1).metadata
    assert (about["model"], about["friction"], about["timestep_s"]) == ("compliant", "wheel", 0.001)
    assert (about["gait_frequency_hz"], about["controller"]) == (1.7, "gait")
    twin = rollout(TwinSnake(SPEC, hinges_per_segment=3, contact=PreloadedContact("skid")), Gait(2.0), 0.1)
    assert (twin.metadata["wheels"], twin.metadata["hinges_per_segment"]) == ("skid", 3)
    # Free joint, three hinges + pitch + roll a segment.
    assert twin.stack("qpos").shape == (11, 7 + 4 * 5)
    rolling = rollout(TwinSnake(SPEC, contact="preloaded"), Gait(2.0), 0.1)
    # Two hinges, and two axles a connector besides.
    assert rolling.metadata["wheels"] == "rolling" and rolling.stack("qpos").shape == (11, 7 + 4 * 4 + 10)
    loaded = rollout(TwinSnake(SPEC, contact=LoadedContact("axis", slip_speed=0.002)), Gait(2.0), 0.1)
    about = loaded.metadata
    assert (about["contact"], about["friction"], about["slip_speed_m_s"]) == ("loaded", "axis", 0.002)
