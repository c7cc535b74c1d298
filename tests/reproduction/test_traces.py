"""Trace metrics of trajectories with known formulas, and computations without a plant."""

from __future__ import annotations

import numpy as np
import pytest

from srs_twin.comparison.learning import PeriodAmplitudes
from srs_twin.reproduction import computations, traces
from srs_twin.reproduction.computations import bend_at, primitive_error, turn_limit
from srs_twin.reproduction.figures import _step
from srs_twin.robot.file import load_robot
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
    # The bend is constant until shortly before the third period.
    run = gait(lambda p: np.where(p < 3.6 * np.pi, 1.0, np.sin(p)))
    assert traces.third_harmonic(run) == pytest.approx(0, abs=1e-3)
    assert traces.third_harmonic(
        gait(lambda p: np.sign(np.sin(p + 1e-3)))
    ) == pytest.approx(1 / 3, rel=0.02)


def test_turning_gives_the_tail_drift_and_the_curvature():
    assert traces.tail_drift(gait(np.sin)) == pytest.approx(0, abs=1e-6)
    turning = gait(np.sin, heading=lambda t: 0.2 * t)
    assert traces.tail_drift(turning) == pytest.approx(0.2, rel=1e-6)
    # It turns by 0.2 rad/s and moves by 0.1 m/s.
    assert computations._curvature(turning, 2.0, 0.5) == pytest.approx(2, rel=1e-6)


def test_a_speed_is_regular_if_it_repeats_in_every_period():
    assert traces.speed_regularity(gait(np.sin)) == pytest.approx(1, abs=1e-3)
    time = np.arange(0, 2, 0.001)
    columns = {
        "time": time,
        "com_x": 0.1 * time + 0.001 * np.sin(8 * np.pi * time),
        "com_y": 0 * time,
    }
    # The speed has a frequency of 4 Hz: cos(8π/f) is its autocorrelation after 1/f.
    for frequency, expected in ((4.0, 1.0), (8.0, -1.0), (12.0, -0.5)):
        run = Trajectory(columns, metadata={"gait_frequency_hz": frequency})
        found = traces.speed_regularity(run)
        assert found == pytest.approx(expected, abs=0.03), frequency
    # Two periods of warm-up and two periods are needed.
    for samples in (2000, 1999):
        begin = {name: column[:samples] for name, column in columns.items()}
        run = Trajectory(begin, metadata={"gait_frequency_hz": 2.0})
        assert (traces.speed_regularity(run) is None) == (samples < 2000)


def test_sensor_error_is_relative_to_the_bend():
    columns = {"time": np.arange(3.0), "bend_1": np.array([1.0, -2.0, 3.0])}
    assert traces.sensor_error(Trajectory(columns)) is None
    measured = {"measured_bend_1": 1.1 * columns["bend_1"]}
    assert traces.sensor_error(Trajectory(columns | measured)) == pytest.approx(0.1)


def test_algorithms_recover_arcs_of_known_bends_and_lengths():
    """Two arcs of 0.1 m with bends of 0.4 and −0.6 rad, from the head backwards."""
    columns = {"time": np.zeros(1)}
    length = 0.1
    at = np.zeros(2)
    heading = 0.3
    for k, bend in enumerate((0.4, -0.6, 0.0), start=1):
        columns |= {f"x_{k}": at[:1], f"y_{k}": at[1:], f"bend_{k}": np.array([bend])}
        columns[f"connector_heading_{k}"] = np.array([heading])
        chord = np.array([np.cos(heading - bend / 2), np.sin(heading - bend / 2)])
        at = at - length * np.sinc(bend / 2 / np.pi) * chord
        heading -= bend
    del columns["bend_3"]
    run = Trajectory(columns, metadata={"body_length_m": 2 * length})
    assert traces.algorithm_1_error(run) == pytest.approx(0, abs=1e-12)
    assert traces.algorithm_2_error(run) == pytest.approx(0, abs=1e-4)
    columns["bend_2"] = np.array([-0.55])
    assert traces.algorithm_1_error(Trajectory(columns)) == pytest.approx(0.05)
    longer = Trajectory(columns, metadata={"body_length_m": 2 * 1.01 * length})
    # The curvature is too small as well, which changes the lengths in second order.
    assert traces.algorithm_2_error(longer) == pytest.approx(1 - 1 / 1.01, rel=0.05)


def test_learning_is_read_from_amplitudes_targets_and_duty_cycles(monkeypatch):
    """Eq. 32 by hand: 1 + 0.3 (0.4 − 0.5) = 0.97, and so on."""
    amplitude = np.array([[0.5, 0.35]] * 3 + [[0.43, 0.32], [0.4, 0.31]])
    target = np.array([[0.4, 0.3]] * 4 + [[0.42, 0.32]])
    duty = np.array([[1, 1], [1, 1], [0.97, 0.985], [0.94, 0.97], [0.931, 0.964]])
    arrays = [array[:, None, :] for array in (amplitude, target, duty)]
    monkeypatch.setattr(PeriodAmplitudes, "from_trajectory", lambda run: run)
    periods = PeriodAmplitudes(*arrays)
    assert traces.learning_law_error(periods) == pytest.approx(0, abs=1e-12)
    assert traces.free_periods(periods) == 2
    assert (traces.target_left(periods), traces.target_right(periods)) == (0.42, 0.32)
    assert traces.smallest_amplitude(periods) == pytest.approx(0.37 / 0.35)
    # In the last period, 0.4 and 0.31 rad are less than 5 % above their targets.
    assert traces.saturated_after(periods) == 2
    periods.duty[4, 0, 0] += 0.01
    assert traces.learning_law_error(periods) == pytest.approx(0.01)
    assert traces.free_periods(PeriodAmplitudes(*arrays[:2], np.ones((5, 1, 2)))) == 5


def test_a_pull_test_finds_the_force_at_which_the_robot_slides(monkeypatch):
    limits = {True: 0.05, False: 0.6}
    slides = lambda robot, pull, *, along: pull > limits[along]  # noqa: E731
    monkeypatch.setattr(computations, "_slides", slides)
    for along, limit in limits.items():
        found = computations._twin_coefficient("gen2", along=along)
        assert found == pytest.approx(limit, abs=2 * 0.6 / 2**12)


def test_the_figure_of_a_step_draws_eq_14_with_the_time_constants_of_the_robot():
    robot = load_robot("gen4_module")
    run = Trajectory({"time": np.arange(3.0), "bend_1": np.array([0.0, 0.5, C0])})
    figure = _step({"analytical": run}, robot)
    curve = figure.axes[0].lines[-1]
    slow, fast = robot.actuator.tau_fill, robot.actuator.tau_mode
    time, bend = curve.get_data()
    # y'' + b y' + a y = a C₀, with a = 1/(τ₁τ₂) and b = 1/τ₁ + 1/τ₂
    rate = np.gradient(bend, time)
    residual = slow * fast * np.gradient(rate, time) + (slow + fast) * rate + bend - C0
    assert np.abs(residual[5:-2]).max() < 0.02 * C0
    assert bend[0] == pytest.approx(0, abs=1e-12)
    assert curve.get_label() == "Eq. 14 (E1, E2)"


def test_computations_without_a_plant():
    assert bend_at("gen2", 7)["alone.bend_deg"] == pytest.approx(90, rel=1e-3)
    assert turn_limit(0.1216, 0.7856)["alone.turn_deg_s"] == pytest.approx(
        8.87, abs=0.01
    )
    assert primitive_error(21, 1.0, 0.2)["alone.error_m"] < 1e-12
