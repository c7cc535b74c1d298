"""Metrics of tracking a reference, compared with closed-form responses."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from srs_twin.comparison.tracking import fit_sine, sine_frequency, tracking_metrics
from srs_twin.errors import InputError
from srs_twin.trajectory import Trajectory

TICK = 1e-3
REST = {"steady_error_rad", "steady_rms_rad", "ripple_pp_rad", "ripple_rms_rad"}
STEP = {"rise_time_s", "overshoot_rel", "overshoot_rad", "settling_2_s", "settling_5_s"}
SINE = {
    "amplitude_rel",
    "amplitude_spread_rel",
    "phase_lag_rad",
    "phase_lag_spread_rad",
    "fit_residual_rad",
}


def run(
    reference: Any, bend: Any, *, duration: float = 4.0, **metadata: Any
) -> Trajectory:
    """Return a trajectory from functions of time for the reference and the bend."""
    time = TICK * np.arange(round(duration / TICK) + 1)
    columns = {
        "time": time,
        "reference_1": reference(time) + 0 * time,
        "bend_1": bend(time) + 0 * time,
    }
    return Trajectory(columns, metadata=metadata)


def step_to(after: float, *, at: float = 0.5, before: float = 0.0) -> Any:
    return lambda t: np.where(t >= at - 1e-9, after, before)


def second_order(after: float, zeta: float, omega: float, at: float) -> Any:
    """Return the step response of an underdamped second-order system."""
    damped = omega * math.sqrt(1 - zeta**2)

    def response(t: np.ndarray) -> np.ndarray:
        s = np.maximum(t - at, 0.0)
        swing = np.cos(damped * s) + zeta * omega / damped * np.sin(damped * s)
        return after * (1 - np.exp(-zeta * omega * s) * swing)

    return response


def first_at(level: float, time: np.ndarray, values: np.ndarray) -> float:
    """Return the first time at which values reach a level, s, interpolated between samples."""
    k = int(np.argmax(values >= level))
    return float(np.interp(level, values[k - 1 : k + 1], time[k - 1 : k + 1]))


def named(metrics: dict[str, float | None]) -> set[str]:
    return {name for name, value in metrics.items() if value is not None}


@settings(max_examples=25)
@given(st.floats(0.2, 0.8), st.floats(15, 60), st.sampled_from([0.436, -0.6, 0.05]))
def test_overshoot_and_rise_time_of_a_second_order_system(zeta, omega, after):
    found = tracking_metrics(run(step_to(after), second_order(after, zeta, omega, 0.5)))
    overshoot = math.exp(-math.pi * zeta / math.sqrt(1 - zeta**2))
    assert found["overshoot_rel"] == pytest.approx(overshoot, abs=1e-3)
    assert found["overshoot_rad"] == pytest.approx(
        overshoot * abs(after), abs=1e-3 * abs(after)
    )
    fine = np.linspace(0, 3.5, 350_001)
    fraction = second_order(1.0, zeta, omega, 0.0)(fine)
    rise = first_at(0.9, fine, fraction) - first_at(0.1, fine, fraction)
    assert found["rise_time_s"] == pytest.approx(rise, abs=2e-5)
    for name, band in (("settling_2_s", 0.02), ("settling_5_s", 0.05)):
        left = fine[np.flatnonzero(np.abs(fraction - 1) > band)[-1]]
        # The response may touch the band between two samples.
        peaks = np.exp(-zeta / math.sqrt(1 - zeta**2) * math.pi * np.arange(1, 30))
        if np.abs(peaks - band).min() > 1e-3:
            assert found[name] == pytest.approx(left, abs=1e-4)


def test_first_order_lag_never_overshoots():
    tau = 0.05
    after = 0.4
    response = lambda t: after * (1 - np.exp(-np.maximum(t - 0.5, 0) / tau))  # noqa: E731
    found = tracking_metrics(run(step_to(after), response))
    assert found["overshoot_rel"] == pytest.approx(0.0, abs=1e-12)
    assert found["rise_time_s"] == pytest.approx(tau * math.log(9), abs=1e-5)
    assert found["settling_2_s"] == pytest.approx(tau * math.log(50), abs=1e-5)
    assert found["settling_5_s"] == pytest.approx(tau * math.log(20), abs=1e-5)


def test_a_constant_reference_is_a_step_from_where_the_bend_starts():
    tau = 0.05
    found = tracking_metrics(run(lambda t: 0.4, lambda t: 0.4 - 0.3 * np.exp(-t / tau)))
    assert found["rise_time_s"] == pytest.approx(tau * math.log(9), abs=1e-5)
    assert found["overshoot_rel"] == 0.0
    held = tracking_metrics(run(lambda t: 0.4, lambda t: 0.4))
    assert named(held) == REST | {"error_rms_rad"}


def test_levels_that_are_not_reached_are_none():
    short = tracking_metrics(run(step_to(0.4), lambda t: 0.2 * (t > 0.6)))
    assert (
        short["rise_time_s"] is None
        and short["settling_5_s"] is None
        and short["settling_2_s"] is None
    )
    assert short["overshoot_rel"] == 0.0
    near = tracking_metrics(run(step_to(0.4), lambda t: 0.388 * (t > 0.6)))
    assert near["settling_2_s"] is None and near["settling_5_s"] == pytest.approx(
        0.1, abs=2 * TICK
    )


def test_steady_state_is_the_second_half_after_the_step():
    """A ripple of whole periods about an offset, after a large disturbance in the first half."""

    def bend(t: np.ndarray) -> np.ndarray:
        calm = 0.4 + 0.01 + 0.02 * np.sin(2 * np.pi * 10 * t)
        return np.where(t < 2.25, np.sin(40 * t), calm)

    trajectory = run(step_to(0.4), bend, duration=4.25 - TICK)
    found = tracking_metrics(trajectory)
    assert found["steady_error_rad"] == pytest.approx(0.01, abs=2e-4)
    assert found["ripple_pp_rad"] == pytest.approx(0.04, abs=1e-5)
    assert found["ripple_rms_rad"] == pytest.approx(0.02 / math.sqrt(2), rel=1e-2)
    assert found["steady_rms_rad"] == pytest.approx(
        math.hypot(0.01, 0.02 / math.sqrt(2)), rel=1e-2
    )
    assert found["measured_ripple_pp_rad"] is None
    measured_bend = {**trajectory.columns, "measured_bend_1": 3 * trajectory["bend_1"]}
    assert tracking_metrics(Trajectory(measured_bend))[
        "measured_ripple_pp_rad"
    ] == pytest.approx(0.12, abs=1e-4)


@settings(max_examples=60)
@given(
    st.floats(0.3, 40),
    st.floats(0.1, 2),
    st.floats(-3, 3),
    st.floats(0.01, 1.5),
    st.floats(-3.1, 3.1),
    st.floats(-0.5, 0.5),
)
def test_amplitude_and_lag_of_a_sine_are_recovered(
    f, asked, phase, fraction, lag, offset
):
    """Periods are not multiples of the sample period, the bend has an offset, lags cover a full circle."""
    reference = lambda t: 0.1 + asked * np.sin(2 * np.pi * f * t + phase)  # noqa: E731
    bend = lambda t: offset + fraction * asked * np.sin(2 * np.pi * f * t + phase - lag)  # noqa: E731
    found = tracking_metrics(run(reference, bend, duration=round(5 / f + 0.1, 3)))
    assert found["amplitude_rel"] == pytest.approx(fraction, rel=1e-6)
    assert found["phase_lag_rad"] == pytest.approx(lag, abs=1e-6)
    assert found["amplitude_spread_rel"] == pytest.approx(0, abs=1e-6)
    assert found["phase_lag_spread_rad"] == pytest.approx(0, abs=1e-6)
    assert found["fit_residual_rad"] == pytest.approx(0, abs=1e-6)
    assert named(found) >= SINE and not named(found) & (STEP | REST)


def test_frequency_of_a_short_sine_is_exact():
    time = TICK * np.arange(16001)
    for f in (0.25, 0.5, 1, 2, 4, 6, 123.0):
        assert sine_frequency(
            time, 0.3 + 0.6 * np.sin(2 * np.pi * f * time + 1)
        ) == pytest.approx(f, rel=1e-9)


def test_only_pure_sines_count_as_sines():
    time = TICK * np.arange(4001)
    sine = np.sin(2 * np.pi * 2 * time)
    assert sine_frequency(time, np.sign(sine)) is None
    assert sine_frequency(time, np.clip(sine, -0.95, 0.95)) is None
    assert sine_frequency(time, sine + 0.01 * np.sin(2 * np.pi * 7 * time)) is None
    assert sine_frequency(time, time) is None
    assert sine_frequency(time, np.full_like(time, 0.2)) is None


def test_spread_and_residual_measure_noise():
    rng = np.random.default_rng(1)
    clean = lambda t: 0.6 * np.sin(2 * np.pi * 2 * t)  # noqa: E731
    noisy = tracking_metrics(
        run(clean, lambda t: clean(t) + 0.02 * rng.standard_normal(len(t)), duration=40)
    )
    assert noisy["fit_residual_rad"] == pytest.approx(0.02, rel=0.05)
    # A fit to n samples has a standard deviation of s √(2/n) in amplitude, that over
    # the amplitude in phase.
    expected = 0.02 * math.sqrt(2 / 500) / 0.6
    assert noisy["amplitude_spread_rel"] == pytest.approx(expected, rel=0.3)
    assert noisy["phase_lag_spread_rad"] == pytest.approx(expected, rel=0.3)


def test_warm_up_is_left_out():
    """Two periods have half the amplitude of the following five."""
    sine = lambda t: 0.6 * np.sin(2 * np.pi * t)  # noqa: E731
    found = tracking_metrics(
        run(sine, lambda t: sine(t) * np.where(t < 2, 0.5, 1.0), duration=7.0)
    )
    assert found["amplitude_rel"] == pytest.approx(1.0, abs=1e-9)


def test_a_fit_needs_two_periods_and_a_spread_three():
    sine = lambda t: 0.6 * np.sin(2 * np.pi * t)  # noqa: E731
    assert not named(tracking_metrics(run(sine, sine, duration=1.9))) & SINE
    two = tracking_metrics(run(sine, sine, duration=2.0))
    assert two["amplitude_rel"] == pytest.approx(1.0)
    assert two["amplitude_spread_rel"] is None and two["phase_lag_spread_rad"] is None


def test_a_square_wave_has_only_error_and_openings():
    square = lambda t: 0.6 * np.sign(np.sin(2 * np.pi * 2 * t + 1e-6))  # noqa: E731
    found = tracking_metrics(run(square, lambda t: 0.0, valve_switches=[[20, 22]]))
    assert named(found) == {"error_rms_rad", "inlet_openings"}
    assert (
        found["error_rms_rad"] == pytest.approx(0.6) and found["inlet_openings"] == 21
    )


def test_outlet_openings_need_hold_states_in_every_tick():
    about = {"tick_s": TICK, "valve_switches": [[2, 0]]}
    held = run(lambda t: 0.4, lambda t: 0.4, duration=0.01, **about)
    plus = np.array([-1, 1, 1, 0, -1, -1, 0, -1, 1, 0, 0], dtype=float)
    minus = np.array([-1, -1, 0, 0, -1, -1, 0, 0, 0, 0, -1], dtype=float)

    def openings(plus, minus, keep=slice(None)):
        valves = {"valve_plus_1": plus, "valve_minus_1": minus}
        columns = {n: c[keep] for n, c in {**held.columns, **valves}.items()}
        return tracking_metrics(Trajectory(columns, metadata=about))["outlet_openings"]

    assert openings(plus, minus) == 2.0
    assert openings(plus[::-1], np.full(11, -1.0)) == 1.5
    assert openings(plus, minus, slice(None, None, 2)) is None
    assert openings(np.where(plus == 0, 1.0, plus), np.ones(11)) is None


@pytest.mark.parametrize("missing", ["reference_1", "bend_1"])
def test_missing_columns_are_named(missing):
    columns = dict(run(lambda t: 0.4, lambda t: 0.4).columns)
    del columns[missing]
    with pytest.raises(InputError, match=f"the column '{missing}' is missing"):
        tracking_metrics(Trajectory(columns))


def test_sine_fit_minimises_the_squares():
    """No sine with similar parameters has a smaller residual."""
    rng = np.random.default_rng(0)
    time = np.sort(rng.uniform(0, 3, 400))
    values = 0.2 + np.sin(7 * time) + 0.3 * rng.standard_normal(400)
    f = 7 / (2 * np.pi)
    best = fit_sine(time, values, f)

    def left(amplitude: float, phase: float, offset: float) -> float:
        return float(
            np.sqrt(
                np.mean((values - offset - amplitude * np.sin(7 * time + phase)) ** 2)
            )
        )

    exact = left(best.amplitude, best.phase, best.offset)
    assert exact == pytest.approx(best.residual, rel=1e-12)
    for change in (-1e-3, 1e-3):
        assert left(best.amplitude + change, best.phase, best.offset) > exact
        assert left(best.amplitude, best.phase + change, best.offset) > exact
        assert left(best.amplitude, best.phase, best.offset + change) > exact
