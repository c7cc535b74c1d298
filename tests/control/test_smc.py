"""Sliding mode controllers of Chapter 4 with mock plants that share no code with the package."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from module_law import Module
from scipy import signal
from snakes import chain

from srs_twin import InputError, RobotSpec
from srs_twin.comparison.tracking import tracking_metrics
from srs_twin.control.base import Controller
from srs_twin.control.reference import Constant, Reference, Sine, Square, StepReference
from srs_twin.control.smc import DirectSMC, IterativeSMC, SlidingMode, VelocityFilter
from srs_twin.pneumatics.valves import LAYOUTS

TICK = 1e-3
DEGREE = math.pi / 180
BOTH = [DirectSMC, IterativeSMC]
# SensorReadings of a faulty sensor, and more often those of a working one.
readings = st.floats(-1.5, 1.5) | st.floats(allow_nan=True, allow_infinity=True)
MODULES, EXAMPLES = 200, 25  # 2 controllers × 25 × 200 = 10,000 histories


def robot(segments: int) -> RobotSpec:
    return chain((0.03,) * (segments + 1))


def state(time: float, measured_bend: Any) -> Any:
    """Return a state without true values, so that reading one would fail."""
    return SimpleNamespace(
        time=time, measured_bend=np.atleast_1d(np.asarray(measured_bend, dtype=float))
    )


def ready(controller: SlidingMode, segments: int = 1) -> SlidingMode:
    controller.reset(robot(segments), TICK)
    return controller


def fed(
    controller: SlidingMode, measured_bend: np.ndarray, *, start: int = 0
) -> np.ndarray:
    """Return the valves of ticks with these readings, shape (ticks, …, segments, 2)."""
    valves = [
        controller.step(state(TICK * (start + k), row))
        for k, row in enumerate(measured_bend)
    ]
    return np.array(valves)


def signals(controller: Controller) -> dict[str, np.ndarray]:
    return {name: np.asarray(value) for name, value in controller.signals().items()}


# --- any bounded sensed input: 10,000 histories
# -------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", BOTH)
@settings(max_examples=EXAMPLES)
@given(
    arrays(float, (12, MODULES), elements=readings, fill=st.floats(-1.5, 1.5)),
    st.integers(1, 60),
    st.sampled_from(
        [
            Constant(0.3),
            Sine(0.6, 6.0),
            Square(0.6, 2.0),
            StepReference(0.4, -0.4, 0.01),
        ]
    ),
)
def test_any_readings_give_valid_valves_and_no_wind_up(kind, rows, hold, reference):
    """Each row lasts some ticks.

    Then the bend is 0.1 rad too small, and the controller must increase it.
    """
    controller = ready(kind(reference), MODULES)
    history = np.repeat(rows, hold, axis=0)
    for k, row in enumerate(history):
        valves = controller.step(state(TICK * k, row))
        assert valves.dtype == np.int8 and valves.shape[-2:] == (MODULES, 2)
        assert np.isin(valves, LAYOUTS[kind.layouts[0]]).all()
        now = signals(controller)
        assert all(np.isfinite(each).all() for each in now.values())
        assert all(each.shape == (MODULES,) for each in now.values())
        if kind is IterativeSMC:
            assert (np.abs(now["mu"]) <= 1).all()
            assert ((now["duty_plus"] >= 0) & (now["duty_plus"] <= 1)).all()
            assert now["duty_plus"] + now["duty_minus"] == pytest.approx(1.0)
    # Δμ is K D e per update over a range of 2; the filter settles within a few of its
    # lags.
    updates = math.ceil(2 / (0.042 * 16 * 0.1)) + 3
    ticks = math.ceil(updates / 60 / TICK) if kind is IterativeSMC else 150
    for k in range(len(history), len(history) + ticks):
        valves = controller.step(
            state(TICK * k, np.full(MODULES, reference.value(TICK * k) - 0.1))
        )
    if kind is IterativeSMC:
        assert signals(controller)["mu"] == pytest.approx(1.0)
    elif getattr(reference, "frequency", None) is None:
        assert (valves == [1, -1]).all()


@settings(max_examples=10)
@given(
    arrays(float, (20, MODULES), elements=st.floats(-1.5, 1.5)),
    st.sampled_from([1, 7, 40]),
)
def test_direct_controller_holds_without_an_error(rows, hold):
    controller = ready(DirectSMC(Constant(0.3)), MODULES)
    fed(controller, np.repeat(rows, hold, axis=0))
    assert (fed(controller, np.full((200, MODULES), 0.3))[-1] == 0).all()


def test_iterative_controller_leaves_saturation_immediately():
    after = []
    for ticks in (200, 5000):
        controller = ready(IterativeSMC(Constant(0.3)))
        fed(controller, np.zeros((ticks, 1)))
        assert signals(controller)["mu"] == 1.0
        fed(controller, np.full((34, 1), 0.35), start=ticks)
        after.append(float(signals(controller)["mu"][0]))
    assert after[0] < 0.5 and after[1] == pytest.approx(after[0], abs=0.05)


# --- mock plants
# --------------------------------------------------------------------------------------------


def integrator(controller: SlidingMode, seconds: float, speed: float) -> np.ndarray:
    """Return the bend of a perfect module, which moves at a constant speed or not at all."""
    bend = [0.0]
    for k in range(round(seconds / TICK)):
        bend.append(
            bend[-1] + TICK * speed * controller.step(state(TICK * k, bend[-1]))[0, 0]
        )
    return np.array(bend)


@pytest.mark.parametrize(
    "reference",
    [Constant(0.4), StepReference(-0.4, 0.2, 0.5), Sine(0.4, 0.5), Sine(0.4, 1.0)],
)
def test_direct_controller_follows_within_its_dead_zone(reference):
    bend = integrator(ready(DirectSMC(reference)), 3.0, speed=6.0)
    time = TICK * np.arange(len(bend))
    jump = getattr(reference, "time", 0.0)
    late = (time > 0.4) & ((time < jump) | (time > jump + 0.4))
    # ε/D, the filter delay of one tick of motion, and the second derivative of the bend
    # over the filter lag.
    lag = VelocityFilter(16.0, TICK).lag
    bend_over = 0.4 * (2 * math.pi * getattr(reference, "frequency", 0.0)) ** 2 * lag**2
    allowed = 84 * DEGREE / 58 + 3 * TICK * 6.0 + bend_over
    assert np.abs(bend - reference.value(time))[late].max() <= allowed


def test_iterative_controller_has_no_steady_error_on_a_first_order_module():
    """q̇ = (q_max (2d − 1) − q)/τ, d the mean duty of each tick."""
    controller = ready(IterativeSMC(Constant(0.4)))
    bend = 0.0
    for k in range(3000):
        drive = controller.step(state(TICK * k, bend))[:, 0, 0].mean()
        bend += TICK * (0.7326 * drive - bend) / 0.1107
        if k >= 3000 - 50:
            assert bend == pytest.approx(0.4, abs=0.03)
    error = controller.signals()["mu"] * 0.7326 - 0.4
    assert abs(error[0]) < 0.01


@pytest.mark.parametrize("off", [0.9, -0.9, 1.1, -1.1])
def test_dead_zone_is_epsilon_over_d_at_rest(off):
    controller = ready(DirectSMC(Constant(0.2), D=50.0, epsilon=0.5))
    valves = fed(controller, np.full((100, 1), 0.2 - off * 0.5 / 50.0))
    expected = 0 if abs(off) < 1 else int(np.sign(off))
    assert valves[-1].tolist() == [[expected, -expected]]


@pytest.mark.parametrize("kind", BOTH)
def test_mirrored_readings_give_mirrored_valves(kind):
    rng = np.random.default_rng(0)
    measured_bend = rng.uniform(-0.8, 0.8, (300, 5))
    one = fed(ready(kind(Sine(0.5, 3.0)), 5), measured_bend)
    other = fed(ready(kind(Sine(0.5, 3.0, math.pi)), 5), -measured_bend)
    if kind is DirectSMC:
        assert np.array_equal(one, other[..., ::-1])
    else:
        # The two chambers fill at opposite ends of a period, so only the duties agree.
        duties = [each.mean(axis=(0, 1)) for each in (one, other)]
        assert duties[0] == pytest.approx(duties[1][..., ::-1], abs=0.04)


@pytest.mark.parametrize("kind", BOTH)
def test_segments_are_independent(kind):
    measured_bend = np.random.default_rng(1).uniform(-0.8, 0.8, (200, 3))
    together = fed(ready(kind(Constant(0.1)), 3), measured_bend)
    for j in range(3):
        alone = fed(ready(kind(Constant(0.1))), measured_bend[:, j : j + 1])
        assert np.array_equal(together[..., j, :], alone[..., 0, :])


def test_gains_may_differ_between_segments():
    measured_bend = np.random.default_rng(2).uniform(0.0, 0.4, (200, 1))
    many = DirectSMC(
        Constant(0.2), D=np.array([20.0, 60.0]), epsilon=np.array([1.0, 2.0])
    )
    together = fed(ready(many, 2), np.repeat(measured_bend, 2, axis=1))
    for j, (d, e) in enumerate([(20.0, 1.0), (60.0, 2.0)]):
        alone = fed(ready(DirectSMC(Constant(0.2), D=d, epsilon=e)), measured_bend)
        assert np.array_equal(together[:, j], alone[:, 0])


@pytest.mark.parametrize("kind", BOTH)
def test_reset_restores_the_initial_state(kind):
    measured_bend = np.random.default_rng(3).uniform(-1, 1, (150, 1))
    controller = ready(kind(Sine(0.5, 2.0)))
    first = fed(controller, measured_bend)
    controller.reset(robot(1), TICK)
    assert np.array_equal(first, fed(controller, measured_bend))


# --- lost readings, events, signals
# -------------------------------------------------------------------------


@pytest.mark.parametrize("kind", BOTH)
@pytest.mark.parametrize("lost", [math.nan, -math.inf, 6.29])
def test_a_lost_reading_is_replaced_by_the_last_valid_one(kind, lost):
    measured_bend = np.linspace(0, 0.2, 100)[:, None].repeat(2, axis=1)
    measured_bend[20, 0] = 6.28  # less than a full turn
    held = measured_bend.copy()
    broken = measured_bend.copy()
    held[40:60, 1] = measured_bend[39, 1]
    broken[40:60, 1] = lost
    controller = ready(kind(Constant(0.3)), 2)
    valves = fed(controller, broken)
    same = fed(ready(kind(Constant(0.3)), 2), held)
    assert np.array_equal(valves, same)
    events = controller.events()
    assert [(e.kind, round(e.time, 9)) for e in events] == [
        ("reading_lost", 0.04),
        ("reading_back", 0.06),
    ]
    assert (
        events[0].text
        == f"segment 2: reading lost; the last valid reading, {measured_bend[39, 1]:.4g}"
        " rad, is used instead"
    )
    assert controller.events() == []


@pytest.mark.parametrize("kind", BOTH)
def test_clipping_of_the_reference_is_reported_once(kind):
    controller = ready(kind(Sine(0.6, 2.0).limited(0.5, "saturate")))
    fed(controller, np.zeros((1000, 1)))
    (event,) = controller.events()
    first = math.asin(0.5 / 0.6) / (2 * math.pi * 2.0)
    assert event.kind == "saturation" and first < event.time <= first + TICK
    assert "clipped at 0.5 rad" in event.text


@pytest.mark.parametrize("kind", BOTH)
def test_signals_have_the_same_names_before_the_first_tick(kind):
    controller = ready(kind(StepReference(0.3)), 2)
    before = signals(controller)
    assert before["reference"].tolist() == [0.3, 0.3]
    fed(controller, np.zeros((3, 2)))
    assert (
        signals(controller).keys() == before.keys() >= {"reference", "error", "sigma"}
    )


@pytest.mark.parametrize("kind", BOTH)
def test_recorded_reference_belongs_to_the_end_of_the_tick(kind):
    sine = Sine(0.6, 6.0)
    controller = ready(kind(sine))
    fed(controller, np.zeros((20, 1)))
    assert signals(controller)["reference"][0] == pytest.approx(sine.value(20 * TICK))


# --- the law of Eq. 30, and what is refused
# -----------------------------------------------------------------


def test_mu_is_proportional_and_integral():
    """μ = (K/T) e + (K D/T) ∫ e dt for a linearly growing error and the carrier period T."""
    gain = 0.002
    slope = 5.0
    rise = 0.5
    controller = ready(IterativeSMC(Constant(0.0), K=gain, D=slope))
    ticks = 500
    measured_bend = -rise * TICK * np.arange(ticks)
    fed(controller, measured_bend[:, None])
    last = math.floor((ticks - 1) * TICK * 60) / 60  # the last period began here
    expected = gain * 60 * rise * (last + slope * last**2 / 2)
    assert signals(controller)["mu"][0] == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("bad", [0.0, math.nan, math.inf])
@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (DirectSMC, "D"),
        (DirectSMC, "epsilon"),
        (DirectSMC, "cutoff_hz"),
        (IterativeSMC, "K"),
        (IterativeSMC, "D"),
    ],
)
def test_invalid_gains_are_refused(kind, name, bad):
    with pytest.raises(
        InputError,
        match=rf"{kind.kind}: {name} .* is not allowed; it must be finite and above 0",
    ):
        kind(Constant(0.1), **{name: bad})


def test_gains_for_another_number_of_segments_are_refused():
    controller = DirectSMC(Constant(0.1), D=np.array([1.0, 2.0]))
    with pytest.raises(
        InputError,
        match=r"direct_smc: `D` has the shape \(2,\); give one number, or one per segment",
    ):
        controller.reset(robot(3), TICK)


# --- the velocity filter
# ------------------------------------------------------------------------------------


def filtered(
    cutoff: float, values: np.ndarray, tick: float = TICK
) -> tuple[np.ndarray, np.ndarray]:
    velocity_filter = VelocityFilter(cutoff, tick)
    out = []
    for value in values:
        velocity_filter.step(np.array([value]))
        out.append((velocity_filter.value[0], velocity_filter.rate[0]))
    return np.array(out).T


@pytest.mark.parametrize("cutoff", [5.0, 16.0, 400.0])
def test_filter_equals_the_analog_butterworth_filter_for_linear_readings(cutoff):
    """SciPy integrates the same transfer function by matrix exponentials, for a linear input."""
    time = TICK * np.arange(800)
    values = np.cumsum(np.random.default_rng(5).standard_normal(800)) * 0.01
    values -= values[0]
    numerator, denominator = signal.butter(2, 2 * math.pi * cutoff, analog=True)
    for outcome, top in zip(
        filtered(cutoff, values), (numerator, [*numerator, 0.0]), strict=True
    ):
        _, expected, _ = signal.lsim((top, denominator), values, time, interp=True)
        assert outcome == pytest.approx(
            expected, abs=1e-7 * max(1.0, np.abs(expected).max())
        )


def test_filter_delay_is_its_lag():
    time = TICK * np.arange(1000)
    value, rate = filtered(16.0, 3.0 * time)
    lag = float(VelocityFilter(16.0, TICK).lag)
    assert rate[-1] == pytest.approx(3.0, rel=1e-9)
    assert value[-1] == pytest.approx(3.0 * (time[-1] - lag), rel=1e-9)
    assert lag == pytest.approx(math.sqrt(2) / (2 * math.pi * 16.0))


def test_filter_starts_at_rest_at_the_first_reading():
    value, rate = filtered(16.0, np.full(50, 0.7))
    assert (value == 0.7).all() and (rate == 0.0).all()


# --- what must come out, on one module as Eq. 14 has it
# -----------------------------------------------------


def followed(
    kind: type[SlidingMode], reference: Reference, seconds: float, **module: Any
) -> dict[str, Any]:
    controller: Any = kind
    return tracking_metrics(Module(**module).follow(controller(reference), seconds)[0])


def test_direct_controller_settles_faster_and_only_iterative_overshoots():
    """Section 4.2, Fig. 42: 0.2 s without overshoot against 0.4 s with 40 % (here far less)."""
    step = StepReference(25 * DEGREE, time=0.1)
    direct, iterative = (followed(kind, step, 1.1) for kind in BOTH)
    assert direct["settling_5_s"] <= 0.25
    assert direct["overshoot_rad"] < direct["measured_ripple_pp_rad"]
    assert (
        iterative["overshoot_rel"] > 0.03
        and iterative["settling_5_s"] > direct["settling_5_s"]
    )


def test_direct_controller_stops_switching_at_rest_unless_a_chamber_leaks():
    """Fig. 46 and Section 4.3."""
    hold = Constant(25 * DEGREE)
    tight = followed(DirectSMC, hold, 3.0)
    leaking = followed(DirectSMC, hold, 3.0, leak_per_s=0.5)
    assert tight["inlet_openings"] <= 3 and tight["ripple_pp_rad"] < 0.05 * DEGREE
    assert leaking["ripple_pp_rad"] > 0.5 * DEGREE and leaking["inlet_openings"] > 10
    iterative = followed(IterativeSMC, hold, 3.0, leak_per_s=0.5)
    assert leaking["steady_rms_rad"] > 1.5 * iterative["steady_rms_rad"]
