"""Quantities of trajectories that claims require but no metric provides."""

from __future__ import annotations

import math

import numpy as np

from srs_twin.comparison.gait import GaitWindow
from srs_twin.comparison.learning import PeriodAmplitudes
from srs_twin.comparison.sampling import body_length
from srs_twin.comparison.tracking import fit_sine
from srs_twin.robot.geometry import arc_between, measured_bend, pair_heading
from srs_twin.trajectory import Trajectory

_MARKER_M = 0.01
"""Distance from the centre of a connector to each of its two markers, m."""

_ARC_POINTS = 101


def tail_drift(run: Trajectory) -> float | None:
    """Return the mean drift rate of the tail heading (Fig. 30), rad/s.

    Before the drift rate is computed, the heading is averaged over a gait period.
    """
    window = GaitWindow.from_trajectory(run)
    if window is None:
        return None
    _, drift = window.running_mean(run, run.stack("connector_heading")[:, -1])
    return float(drift.mean())


def speed_regularity(run: Trajectory) -> float | None:
    """Return the autocorrelation of the speed at a lag of one gait period."""
    window = GaitWindow.from_trajectory(run)
    if window is None:
        return None
    rate = 1 / float(np.median(np.diff(run.time)))
    speed = np.hypot(*(np.gradient(run.com, run.time, axis=0).T))
    lag = round(window.period * rate)
    steady = speed[round(2 * lag) :]
    if len(steady) < 2 * lag:
        return None
    return float(np.corrcoef(steady[:-lag], steady[lag:])[0, 1])


def third_harmonic(run: Trajectory) -> float | None:
    """Return the maximum ratio of the third to the first harmonic among all bends.

    A square wave has a ratio of 1/3.
    """
    window = GaitWindow.from_trajectory(run)
    if window is None:
        return None
    in_window = (run.time >= window.start - 1e-9) & (run.time <= window.end + 1e-9)
    time = run.time[in_window]
    bends = run.stack("bend")[in_window]
    frequency = 1 / window.period
    fractions = [
        fit_sine(time, bend, 3 * frequency).amplitude
        / fit_sine(time, bend, frequency).amplitude
        for bend in bends.T
    ]
    return float(max(fractions))


def sensor_error(run: Trajectory) -> float | None:
    """Return the RMS sensor error divided by the RMS bend."""
    if not run.has("measured_bend_1"):
        return None
    bend = run.stack("bend")
    return float(
        np.sqrt(np.mean((run.stack("measured_bend") - bend) ** 2) / np.mean(bend**2))
    )


def algorithm_1_error(run: Trajectory) -> float | None:
    """Return the maximum error of the bends from Algorithm 1 (Table 3), rad."""
    heading = _marker_headings(run)
    bend = measured_bend(heading[:, :-1], heading[:, 1:])
    return float(np.abs(bend - run.stack("bend")).max())


def algorithm_2_error(run: Trajectory) -> float | None:
    """Return the maximum relative error of the arc lengths from Algorithm 2 (Table 4).

    Each arc joins two neighbouring connectors and has the curvature from Algorithm 1.
    The robot must have no rigid gaps, so that each segment is a single arc.
    """
    length = body_length(run) / (run.position.shape[1] - 1)
    position = run.position
    heading = _marker_headings(run)
    curvature = measured_bend(heading[:, :-1], heading[:, 1:]) / length
    arcs = arc_between(position[:, :-1], position[:, 1:], curvature, points=_ARC_POINTS)
    arc_length = np.linalg.norm(np.diff(arcs, axis=-2), axis=-1).sum(axis=-1)
    return float(np.abs(arc_length / length - 1).max())


def _marker_headings(run: Trajectory) -> np.ndarray:
    theta = run.stack("connector_heading")
    offset = _MARKER_M * np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    return pair_heading(run.position - offset, run.position + offset)


def step_tau_1(run: Trajectory) -> float | None:
    """Return the longer time constant of a step response, s."""
    return _time_constants(run)[0]


def step_tau_2(run: Trajectory) -> float | None:
    """Return the shorter time constant of a step response, s."""
    return _time_constants(run)[1]


def step_c0(run: Trajectory) -> float:
    """Return the final bend C₀ of a step response, rad."""
    return float(run["bend_1"][-1])


def step_c1(run: Trajectory) -> float:
    """Return C₁ of Eq. 14 for an initial bend and bend rate of zero (E2), rad."""
    slow, fast = _time_constants(run)
    return -step_c0(run) * slow / (slow - fast)


def step_c2(run: Trajectory) -> float:
    """Return C₂ of Eq. 14, rad."""
    return -step_c0(run) - step_c1(run)


def step_a(run: Trajectory) -> float:
    """Return the coefficient a = 1/(τ₁τ₂) of the dissertation (E1), 1/s²."""
    slow, fast = _time_constants(run)
    return 1 / (slow * fast)


def step_b(run: Trajectory) -> float:
    """Return the coefficient b = 1/τ₁ + 1/τ₂ of the dissertation (E1), 1/s."""
    slow, fast = _time_constants(run)
    return 1 / slow + 1 / fast


def step_c(run: Trajectory) -> float:
    """Return the coefficient C₀/(τ₁τ₂) of Eq. 16, rad/s²."""
    return step_c0(run) * step_a(run)


def _time_constants(run: Trajectory) -> tuple[float, float]:
    """Return the time constants τ₁ and τ₂ of an overdamped step response y, s.

    The time constants follow from the moments ∫(1 − y) dt = τ₁ + τ₂ and
    ∫ t (1 − y) dt = τ₁² + τ₁τ₂ + τ₂², so no fit is needed.
    """
    remainder = 1 - run["bend_1"] / run["bend_1"][-1]
    total = float(np.trapezoid(remainder, run.time))
    moment = float(np.trapezoid(run.time * remainder, run.time))
    product = total**2 - moment
    root = math.sqrt(max(total**2 / 4 - product, 0.0))
    return total / 2 + root, total / 2 - root


def learning_law_error(run: Trajectory) -> float:
    """Return the maximum difference between the duty cycles and Eq. 32 with k = 0.3.

    Eq. 32 computes the duty cycle of a chamber from the error and the duty cycle in the
    previous period, and limits the result to values from 0 to 1. Duty cycles of 1 are
    ignored.
    """
    periods = PeriodAmplitudes.from_trajectory(run)
    expected = np.clip(periods.duty[:-1] + 0.3 * periods.error[:-1], 0, 1)
    is_updated = np.isfinite(expected) & (periods.duty[1:] < 1)
    return float(np.abs(periods.duty[1:] - expected)[is_updated].max(initial=0.0))


def free_periods(run: Trajectory) -> float:
    """Return the number of periods before the first reduction of a duty cycle."""
    periods = PeriodAmplitudes.from_trajectory(run)
    full = (periods.duty == 1).all(axis=(1, 2))
    return float(np.argmin(full) if not full.all() else len(full))


def target_left(run: Trajectory) -> float:
    """Return the mean final target amplitude of the + chambers, rad."""
    return float(np.nanmean(PeriodAmplitudes.from_trajectory(run).target[-1, :, 0]))


def target_right(run: Trajectory) -> float:
    """Return the mean final target amplitude of the − chambers, rad."""
    return float(np.nanmean(PeriodAmplitudes.from_trajectory(run).target[-1, :, 1]))


def smallest_amplitude(run: Trajectory) -> float:
    """Return the mean final target divided by the minimum amplitude in period 3.

    In Section 5.1 of the dissertation, the amplitudes are recorded in the third period.
    """
    periods = PeriodAmplitudes.from_trajectory(run)
    return float(np.nanmean(periods.target[-1]) / periods.amplitude[2].min())


def saturated_after(run: Trajectory) -> float:
    """Return the number of periods with an amplitude more than 5 % above its target.

    The count begins with the first period in which a duty cycle is below 1.
    """
    periods = PeriodAmplitudes.from_trajectory(run)
    begin = int(free_periods(run))
    over: np.ndarray = periods.amplitude[begin:] > 1.05 * periods.target[begin:]
    return float(over.any(axis=(1, 2)).sum())
