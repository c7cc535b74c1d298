"""Iterative learning (Eq. 32) with perfect modules, with faulty ones, and on the analytical plant."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from learning_law import SEGMENTS, TICK, Run
from snakes import chain

from srs_twin import AnalyticalSnake, Gait, InputError, load_robot, rollout
from srs_twin.control.duties import Duties
from srs_twin.control.learning import ILC, STEERINGS
from srs_twin.control.module_faults import ModuleFaults
from srs_twin.errors import UnknownNameError

gains = arrays(float, (SEGMENTS, 2), elements=st.floats(0.8, 1.5))
offsets = st.floats(-0.3, 0.3)
readings = st.floats(-1.5, 1.5) | st.floats(allow_nan=True, allow_infinity=True)
SLOTS = 0.007  # of a duty: pulses are a slot of 0.1 ms long or short, 60 times a second


# --- the law
# ------------------------------------------------------------------------------------------------


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(gains, offsets, st.floats(0.1, 0.6))
def test_each_update_multiplies_the_error_by_1_minus_k_c(gain, offset, k):
    run = Run(ILC(1.0, offset, target=0.7, k=k), gain).go(11)
    smaller = 0.7 - abs(offset)  # 0.7 rad at 0, 0.4 rad at 0.3
    target = np.array([0.7, smaller] if offset >= 0 else [smaller, 0.7])
    error = target - run.amplitudes()
    free = target - gain
    n = np.arange(1, 7)[:, None, None]
    assert error[1:3] == pytest.approx(np.stack([free, free]), abs=1e-9)
    assert error[3:9] == pytest.approx(free * (1 - k * gain) ** n, abs=SLOTS * 1.5)
    assert run.event_texts("fault") == []


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(gains)
def test_the_smallest_amplitude_becomes_the_target(gain):
    run = Run(ILC(1.0), gain).go(16)
    assert run.amplitudes()[-1] == pytest.approx(gain.min(), abs=0.05 * gain.min())
    (text,) = run.event_texts("target")
    weakest = gain.min(axis=1).argmin() + 1
    assert (
        text == f"target {gain.min():.4g} rad, the smallest amplitude recorded (segment"
        f" {weakest})"
    )
    # Two periods are free and the third is recorded, so nothing changes in the first
    # 3.5 periods.
    assert (np.array(run.duty)[: round(3.49 / TICK)] == 1).all()


def test_the_largest_error_is_reported_once_per_period():
    run = Run(ILC(1.0, target=0.7), 1.2).go(12)
    assert len(run.event_texts("ilc_update")) == 9
    first, *_, last = run.event_texts("ilc_update")
    assert first.startswith(
        "after period 3: largest amplitude error -0.5 rad (segment "
    )
    assert first.endswith(" chamber), duties now 0.85 to 0.85")
    assert last.startswith("after period 11: ")
    assert run.event_texts("converged") == [
        "all amplitudes are within 5 % of their targets"
    ]


def test_steering_during_a_run_changes_the_targets_only():
    run = Run(ILC(1.0, target=0.7), 1.2).go(10)
    run.controller.offset = -0.15
    run.go(10)
    assert run.amplitudes()[-1] == pytest.approx(
        np.tile([0.55, 0.7], (SEGMENTS, 1)), abs=0.01
    )
    run.controller.offset = 0.3
    run.go(10)
    assert run.amplitudes()[-1] == pytest.approx(
        np.tile([0.7, 0.4], (SEGMENTS, 1)), abs=0.01
    )
    assert len(run.event_texts("converged")) == 3


# --- the offset on the wave as well
# -------------------------------------------------------------------------

ON_WAVE = {"target": 0.7, "steering": "targets_and_wave"}


def gait_valves(offset: float, ticks: range) -> list[np.ndarray]:
    """Return Eq. 13's valves in these ticks, shape (100, segments, 2) each."""
    gait = Gait(1.0, offset)
    gait.reset(chain((0.03,) * (SEGMENTS + 1)), TICK)
    valves = [gait.valves_at(k * TICK) for k in ticks]
    return [np.broadcast_to(each, (100, SEGMENTS, 2)) for each in valves]


@settings(max_examples=10, deadline=None)
@given(offsets, offsets)
def test_full_duties_give_the_valves_of_eq_13_with_and_without_offset(before, after):
    for steering, seen in (
        ("targets_and_wave", (before, after)),
        ("targets", (0.0, 0.0)),
    ):
        controller = ILC(1.0, before, target=0.7, steering=steering, free_periods=50)
        # SensorReadings must vary; otherwise the sensors are detected as dead and the
        # modules are vented.
        rows = np.tile(
            0.7 * np.sin(2 * np.pi * TICK * np.arange(300))[:, None], SEGMENTS
        )
        valves = valves_of(controller, rows[:150])
        controller.offset = after
        valves += [controller.step(state(k, rows[k])) for k in range(150, 300)]
        expected = gait_valves(seen[0], range(150)) + gait_valves(
            seen[1], range(150, 300)
        )
        assert (np.array(valves) == np.array(expected)).all()


@pytest.mark.parametrize("offset", [0.3, -0.1])
def test_periods_begin_with_the_fills_of_the_steered_wave(offset):
    begins = np.array(
        Run(ILC(1.0, offset, **ON_WAVE)).controller.describe()["fill_begins_s"]
    )
    slots = np.concatenate(gait_valves(offset, range(300)))
    for j, side in np.ndindex(SEGMENTS, 2):
        rises = (np.flatnonzero(np.diff(slots[:, j, side]) > 0) + 1) * 1e-4
        assert (
            begins[j, side] + np.arange(1, 3) == pytest.approx(rises[:2], abs=1.1e-4)
        ) or (begins[j, side] + np.arange(2) == pytest.approx(rises[:2], abs=1.1e-4))


def test_targets_are_reached_with_a_steered_wave():
    run = Run(ILC(1.0, 0.3, **ON_WAVE), 1.2).go(16)
    assert run.amplitudes()[-1] == pytest.approx(
        np.tile([0.7, 0.4], (SEGMENTS, 1)), abs=0.02
    )
    run.controller.offset = -0.3
    run.go(14)
    assert run.amplitudes()[-1] == pytest.approx(
        np.tile([0.4, 0.7], (SEGMENTS, 1)), abs=0.02
    )


# --- any input
# ----------------------------------------------------------------------------------------------


def valves_of(controller: ILC, rows: np.ndarray) -> list[np.ndarray]:
    """Return the valves of ticks with these readings, shape (ticks, segments)."""
    controller.reset(chain((0.03,) * (SEGMENTS + 1)), TICK)
    return [controller.step(state(k, row)) for k, row in enumerate(rows)]


def state(tick: int, measured_bend: np.ndarray) -> Any:
    return SimpleNamespace(time=tick * TICK, measured_bend=measured_bend)


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    arrays(float, (20, SEGMENTS), elements=readings, fill=st.floats(-1.5, 1.5)),
    st.sampled_from(["smallest", 0.05, 0.7]),
    offsets,
    st.sampled_from([1, 17, 80]),
    st.sampled_from(["go_on", "stop"]),
)
def test_any_readings_keep_duties_within_0_and_1(rows, target, offset, hold, on_fault):
    controller = ILC(2.5, offset, target=target, k=3.0, on_fault=on_fault)
    controller.reset(chain((0.03,) * (SEGMENTS + 1)), TICK)
    for k, row in enumerate(np.repeat(rows, hold, axis=0)):
        valves = controller.step(state(k, row))
        assert valves.dtype == np.int8 and valves.shape == (100, SEGMENTS, 2)
        assert set(np.unique(valves)) <= {-1, 1}
        # No tick fills both chambers of a segment at once.
        assert not ((valves == 1).all(axis=-1)).any()
        signals = controller.signals()
        duty = np.stack([signals["duty_plus"], signals["duty_minus"]])
        assert ((duty >= 0) & (duty <= 1)).all() and np.isfinite(
            controller.duties.value
        ).all()
        assert all(np.shape(each) in ((), (SEGMENTS,)) for each in signals.values())


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(
    arrays(float, (30, SEGMENTS), elements=st.floats(-1.0, 1.0)),
    offsets,
    st.sampled_from([1.0, 1.7, 2.5]),
    st.sampled_from(["smallest", 0.5]),
    st.sampled_from(STEERINGS),
)
def test_mirrored_readings_swap_the_chambers(rows, offset, frequency, target, steering):
    rows = np.repeat(rows, 10, axis=0)
    left = valves_of(ILC(frequency, offset, target=target, steering=steering), rows)
    right = valves_of(
        ILC(frequency, -offset, target=target, steering=steering, phase=math.pi), -rows
    )
    assert (np.array(left) == np.array(right)[..., ::-1]).all()


# --- nothing winds up
# ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("periods", [14, 60])
def test_a_saturated_duty_leaves_its_bound_immediately(periods):
    gain = np.full((SEGMENTS, 2), 1.3)
    gain[1] = 0.4
    run = Run(ILC(1.0, target=0.7), gain).go(periods)
    assert (run.duty[-1][1] == 1).all()
    others = np.delete(run.amplitudes()[-1], 1, axis=0)
    assert others == pytest.approx(0.7, abs=0.05 * 0.7)
    assert "segment 2, + chamber: duty saturated at 1" in run.event_texts("saturation")
    assert run.event_texts("fault") == [] and run.event_texts("converged") == []
    run.modules.gain[1] = 1.0
    run.go(3)
    # The amplitude of the first period with the new gain is 0.3 rad too large,
    # regardless of the time in saturation.
    assert run.duty[-1][1].max() <= 1 - 0.3 * 0.3 + SLOTS
    assert "segment 2, + chamber: duty no longer saturated" in run.event_texts(
        "saturation"
    )


# --- faults
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("segment", "side", "how", "target"),
    [
        (0, 0, "open", "smallest"),
        (2, 1, "shut", 0.7),
    ],
)
def test_a_stuck_valve_is_detected_and_the_other_segments_converge(
    segment, side, how, target
):
    gain = 1.0 + 0.2 * np.linspace(0, 1, 2 * SEGMENTS).reshape(SEGMENTS, 2)
    run = Run(ILC(1.0, target=target), gain)
    run.modules.stuck[segment, side] = how
    run.go(20)
    assert run.event_texts("fault") == [
        f"segment {segment + 1}: valve of the {'+−'[side]} chamber stuck {how}"
    ]
    assert (run.duty[-1][segment] == 0).all()
    wanted = 0.7 if target == 0.7 else np.delete(gain, segment, axis=0).min()
    assert np.delete(run.amplitudes()[-1], segment, axis=0) == pytest.approx(
        wanted, rel=0.05
    )
    assert len(run.event_texts("converged")) == 1 and not run.controller.finished
    assert np.isnan(run.controller.signals()["target_plus"][segment])


@pytest.mark.parametrize(
    ("says", "what", "from_period"),
    [
        (0.31, "readings stay within 0.02 rad", 0),
        (math.nan, "all readings of a period are lost", 9),
    ],
)
def test_a_dead_sensor_is_detected(says, what, from_period):
    run = Run(ILC(1.0, target="smallest"), 1.2)
    run.sensor = lambda time, bend: np.where(
        (np.arange(4) == 2) & (time >= from_period), says, bend
    )
    run.go(20)
    assert run.event_texts("fault") == [f"segment 3: sensor dead, {what}"]
    assert (run.duty[-1][2] == 0).all() and len(run.event_texts("converged")) == 1


def test_learning_continues_with_some_lost_readings():
    rng = np.random.default_rng(3)
    run = Run(ILC(1.0, target=0.7), 1.2)
    run.sensor = lambda time, bend: np.where(rng.random(4) < 0.2, math.nan, bend)
    run.go(14)
    assert run.event_texts("fault") == []
    assert run.controller.duties.value == pytest.approx(0.7 / 1.2, rel=0.05)


def test_a_loaded_segment_is_not_reported_as_a_stuck_valve():
    """A segment that is moved by its load rests straight in the test and continues to work."""
    run = Run(ILC(1.0, target=0.3), 1.2)
    run.sensor = lambda time, bend: (
        bend - [0.0, 0.6 * math.sin(2 * math.pi * time), 0.0, 0.0]
    )
    run.go(25)
    assert run.event_texts("fault") == []
    assert run.event_texts("fault_not_found") == [
        "segment 2: rests straight when vented; no valve is stuck"
    ]
    assert np.delete(run.duty[-1], 1, axis=0) == pytest.approx(0.25, rel=0.05)


def test_option_stop_ends_the_run_at_a_detected_fault():
    run = Run(ILC(1.0, on_fault="stop"), 1.2)
    run.modules.stuck[0, 0] = "shut"
    run.go(4)
    assert not run.controller.finished
    run.go(3)
    assert run.controller.finished
    assert run.controller.describe()["faults"] == [
        "segment 1: valve of the + chamber stuck shut"
    ]


ONES = np.ones((1, 2))


@pytest.mark.parametrize(
    ("duty", "peak", "is_tested"),
    [
        (1.0, 0.049, True),
        (1.0, 0.051, False),
        (0.99, 0.0, False),
        (0.0, 0.53, True),
        (0.0, 0.52, False),
        (0.01, 9.0, False),
    ],
)
def test_two_abnormal_periods_start_a_test_of_the_valves(duty, peak, is_tested):
    """For a target of 0.5 rad, 10 % are 0.05 rad and 105 % are 0.525 rad."""
    faults = ModuleFaults(1, 1.0)
    for time in (1.0, 2.0):
        assert not faults.tested[0]
        duties, peaks = np.array([[[0.5, duty]], [[0.5, peak]]])
        faults.check_valves(time, ONES == 1, duties, peaks, 0.5 * ONES)
    assert faults.tested[0] == is_tested


@pytest.mark.parametrize(
    ("rest", "fault"),
    [
        (0.27, "+ chamber stuck open"),
        (-0.27, "− chamber stuck open"),
        (0.23, "+ chamber stuck shut"),
    ],
)
def test_a_vented_segment_is_judged_by_its_mean_bend(rest, fault):
    """The limit is half the target, and the mean is taken from 1 s to 3 s after the start."""
    faults = ModuleFaults(1, 2.0)
    for time in (0.0, 2.0):
        faults.check_valves(time, ONES == 1, ONES, np.array([[0.0, 0.5]]), 0.5 * ONES)
    for time in np.arange(2.0, 5.1, 0.125):
        sway = 0.2 * math.cos(math.pi * time) if time >= 3 else 9.0
        assert faults.tested[0] == (time <= 5)
        faults.update_tests(time, np.array([rest + sway]))
    assert faults.detected == [f"segment 1: valve of the {fault}"]
    assert faults.resumed[0] == 5.0


@pytest.mark.parametrize(
    ("span", "duty", "number", "is_dead"),
    [(0.02, 0.1, 3, True), (0.021, 0.1, 3, False), (0.02, 0.09, 3, False)]
    + [(0.02, 0.1, 2, False)],
)
def test_a_driven_segment_with_constant_readings_has_a_dead_sensor(
    span, duty, number, is_dead
):
    faults = ModuleFaults(1, 1.0)
    periods: Any = SimpleNamespace(
        number=number * ONES, lost=0 * ONES, span=span * ONES
    )
    faults.check_sensors(0.0, ONES == 1, np.array([[0.0, duty]]), periods)
    assert faults.faulty[0] == is_dead


def test_amplitudes_within_5_per_cent_have_converged_once():
    duties = Duties(1, 0.3)
    target = np.array([[0.5, 0.4]])
    for error, count in ((0.051, 0), (-0.049, 1), (0.0, 0)):
        duties.learn(0.0, ONES == 1, target * (1 - error), target)
        assert len(duties.converged(0.0, np.array([True]))) == count


# --- on the analytical plant
# --------------------------------------------------------------------------------


@pytest.mark.parametrize("frequency", [1.0, 1.7])
def test_full_duties_equal_the_open_loop_gait(frequency):
    """An unreachable target keeps all duties at 1, and the runs are equal to the last bit."""
    ilc = rollout(AnalyticalSnake(load_robot("gen4")), ILC(frequency, target=1.5), 6.0)
    # `until` keeps the gait from running as one script.
    gait = rollout(
        AnalyticalSnake(load_robot("gen4")), Gait(frequency), 6.0, until=lambda _: False
    )
    assert "duty_plus_1" in ilc.columns and (ilc.stack("duty_plus") == 1).all()
    for name in gait.columns.keys() - {"offset"}:
        assert (ilc[name] == gait[name]).all(), name


# --- refused
# ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [0.31, -0.31, math.nan])
def test_offsets_without_targets_are_refused(offset):
    words = "ilc offset .* is not allowed; it must be between -0.3 and 0.3"
    with pytest.raises(InputError, match=words):
        ILC(1.0, offset)
    controller = ILC(1.0, 0.1)
    with pytest.raises(InputError, match=words):
        controller.offset = offset
    assert controller.offset == 0.1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"frequency": 0.0}, "gait frequency 0.0 Hz"),
        (
            {"target": 0.0},
            "ilc target 0.0 is not allowed; it must be finite and above 0",
        ),
        ({"target": "largest"}, "target 'largest'"),
        ({"k": -0.3}, "ilc k -0.3 is not allowed"),
        ({"carrier_hz": math.inf}, "ilc carrier_hz inf is not allowed"),
        (
            {"carrier_hz": 7.0},
            "ilc `carrier_hz` 7 gives fewer than 4 pulses per fill at a gait"
            " frequency of 1 Hz; it must be at least 8",
        ),
        (
            {"free_periods": 0},
            "ilc `free_periods` 0 is not allowed; it must be 1 or more",
        ),
        ({"on_fault": "pause"}, "on_fault 'pause'"),
        ({"steering": "wave"}, "steering 'wave'"),
    ],
)
def test_invalid_arguments_are_refused(arguments, words):
    with pytest.raises((InputError, UnknownNameError), match=words):
        ILC(**({"frequency": 1.0} | arguments))


def test_ticks_with_too_few_readings_per_period_are_refused():
    controller = ILC(7.0, carrier_hz=60.0)
    words = (
        "at 7 Hz and with a tick of 0.02 s, a gait period contains fewer than 8"
        " readings; use"
        " a tick of at most 0.01786 s, or"
    )
    with pytest.raises(InputError, match=words):
        controller.reset(load_robot("gen4"), 0.02)
