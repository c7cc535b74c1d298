"""Trace metrics of trajectories with known formulas, and computations without a plant."""

from __future__ import annotations

import numpy as np
import pytest

from srs_twin.reproduction import traces
from srs_twin.reproduction.computations import bend_at, primitive_error, turn_limit
from srs_twin.trajectory import Trajectory

TAU_1 = 0.15
TAU_2 = 0.004
C0 = 0.7


def test_parameters_of_a_step_response_after_eq_14_are_recovered():
    time = np.arange(0, 3.5, 0.0005)
    c1 = -C0 * TAU_1 / (TAU_1 - TAU_2)
    c2 = C0 * TAU_2 / (TAU_1 - TAU_2)
    run = Trajectory(
        {
            "time": time,
            "bend_1": C0 + c1 * np.exp(-time / TAU_1) + c2 * np.exp(-time / TAU_2),
        }
    )
    assert traces.step_tau_1(run) == pytest.approx(TAU_1, rel=1e-3)
    assert traces.step_tau_2(run) == pytest.approx(TAU_2, rel=5e-3)
    assert (
        traces.step_c0(run),
        traces.step_c1(run),
        traces.step_c2(run),
    ) == pytest.approx((C0, c1, c2), rel=5e-3)
    assert traces.step_a(run) == pytest.approx(1 / (TAU_1 * TAU_2), rel=5e-3)
    assert traces.step_b(run) == pytest.approx(1 / TAU_1 + 1 / TAU_2, rel=5e-3)
    assert traces.step_c(run) == pytest.approx(C0 / (TAU_1 * TAU_2), rel=5e-3)


def gait(bend, *, frequency=2.0, heading=lambda t: 0 * t):
    """Return a crawling run with a given bend over the phase and a given heading over time."""
    time = np.arange(0, 6, 0.001)
    columns = {
        "time": time,
        "com_x": 0.1 * time + 0.01 * np.sin(4 * np.pi * frequency * time),
        "com_y": 0 * time,
        "heading": heading(time),
        "bend_1": bend(2 * np.pi * frequency * time),
    }
    columns |= {
        "connector_heading_1": columns["heading"],
        "connector_heading_2": columns["heading"]
        + 0.3 * np.sin(time * 2 * np.pi * frequency),
    }
    return Trajectory(
        columns, metadata={"gait_frequency_hz": frequency, "body_length_m": 0.1}
    )


def test_harmonics_of_a_sine_and_of_a_square_wave():
    assert traces.third_harmonic(gait(np.sin)) == pytest.approx(0, abs=1e-3)
    assert traces.third_harmonic(
        gait(lambda p: np.sign(np.sin(p + 1e-3)))
    ) == pytest.approx(1 / 3, rel=0.02)


def test_tail_drift_is_that_of_the_mean_heading():
    assert traces.tail_drift(gait(np.sin)) == pytest.approx(0, abs=1e-6)
    assert traces.tail_drift(gait(np.sin, heading=lambda t: 0.2 * t)) == pytest.approx(
        0.2, rel=1e-6
    )


def test_a_periodic_speed_is_regular():
    assert traces.speed_regularity(gait(np.sin)) == pytest.approx(1, abs=1e-3)


def test_a_run_without_a_period_has_no_sensor_error():
    run = Trajectory(
        {"time": np.arange(3.0), "bend_1": np.zeros(3), "heading": np.zeros(3)}
    )
    assert traces.sensor_error(run) is None


def test_computations_without_a_plant():
    assert bend_at("gen2", 7)["alone.bend_deg"] == pytest.approx(90, rel=1e-3)
    assert turn_limit(0.1216, 0.7856)["alone.turn_deg_s"] == pytest.approx(
        8.87, abs=0.01
    )
    assert primitive_error(21, 1.0, 0.2)["alone.error_m"] < 1e-12
