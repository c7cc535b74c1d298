"""Numbers read off a trajectory that rows need and no metric is: drifts, regularity, time constants."""

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
"""Half the distance of the two markers of a connector."""
_ARC_POINTS = 101


def tail_drift(run: Trajectory) -> float | None:
    """Return how fast the tail's heading drifts, rad/s: the slope of its mean over gait periods (Fig. 30)."""
    window = GaitWindow.from_trajectory(run)
    if window is None:
        return None
    _, slope = window.running_mean(run, run.stack("theta")[:, -1])
    return float(slope.mean())


def speed_regularity(run: Trajectory) -> float | None:
    """Return how much the speed of the centre of mass repeats: its correlation a gait period later."""
    window = GaitWindow.from_trajectory(run)
    if window is None:
        return None
    rate = 1 / float(np.median(np.diff(run.time)))
    speed = np.hypot(*(np.gradient(run.com, run.time, axis=0).T))
    apart = round(window.period * rate)
    steady = speed[round(2 * apart) :]
    if len(steady) < 2 * apart:
        return None
    return float(np.corrcoef(steady[:-apart], steady[apart:])[0, 1])


def third_harmonic(run: Trajectory) -> float | None:
    """Return the largest third harmonic of a bend over its first: 1/3 of a square wave, 0 of a sine."""
    window = GaitWindow.from_trajectory(run)
    if window is None:
        return None
    seen = (run.time >= window.start - 1e-9) & (run.time <= window.end + 1e-9)
    time, bends = run.time[seen], run.stack("bend")[seen]
    frequency = 1 / window.period
    shares = [
        fit_sine(time, bend, 3 * frequency).amplitude / fit_sine(time, bend, frequency).amplitude
        for bend in bends.T
    ]
    return float(max(shares))


def sensor_error(run: Trajectory) -> float | None:
    """Return the RMS of reading less bend over all segments, over the RMS of the bends."""
    if not run.has("sensed_1"):
        return None
    bend = run.stack("bend")
    return float(np.sqrt(np.mean((run.stack("sensed") - bend) ** 2) / np.mean(bend**2)))


def algorithm_1_error(run: Trajectory) -> float | None:
    """Return the largest error of the bends of Algorithm 1 (Table 3), from two markers an end, rad."""
    heading = _marked_headings(run)
    found = measured_bend(heading[:, :-1], heading[:, 1:])
    return float(np.abs(found - run.stack("bend")).max())


def algorithm_2_error(run: Trajectory) -> float | None:
    """Return by how much the arcs of Algorithm 2 (Table 4) are off a segment's length at most, over it.

    They go through the connectors with the curvature that Algorithm 1 gives. Only of robots without rigid
    gaps, whose segments are arcs from end to end.
    """
    length = body_length(run) / (run.position.shape[1] - 1)
    place, heading = run.position, _marked_headings(run)
    curvature = measured_bend(heading[:, :-1], heading[:, 1:]) / length
    arcs = arc_between(place[:, :-1], place[:, 1:], curvature, points=_ARC_POINTS)
    found = np.linalg.norm(np.diff(arcs, axis=-2), axis=-1).sum(axis=-1)
    return float(np.abs(found / length - 1).max())


def _marked_headings(run: Trajectory) -> np.ndarray:
    """Return headings from markers a centimetre ahead of and behind each connector, (samples, N), rad."""
    theta = run.stack("theta")
    along = _MARKER_M * np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    return pair_heading(run.position - along, run.position + along)


def step_tau_1(run: Trajectory) -> float | None:
    """Return the longer time constant of a step response, s."""
    return _time_constants(run)[0]


def step_tau_2(run: Trajectory) -> float | None:
    """Return the shorter time constant of a step response, s."""
    return _time_constants(run)[1]


def step_c0(run: Trajectory) -> float:
    """Return the bend at the end of a step response, rad."""
    return float(run["bend_1"][-1])


def step_c1(run: Trajectory) -> float:
    """Return C₁ of Eq. 14, rad: what makes bend and rate zero at the start (E2)."""
    slow, fast = _time_constants(run)
    return -step_c0(run) * slow / (slow - fast)


def step_c2(run: Trajectory) -> float:
    """Return C₂ of Eq. 14, rad."""
    return -step_c0(run) - step_c1(run)


def step_a(run: Trajectory) -> float:
    """Return 1/(τ₁τ₂), which the text calls a, 1/s² (E1)."""
    slow, fast = _time_constants(run)
    return 1 / (slow * fast)


def step_b(run: Trajectory) -> float:
    """Return 1/τ₁ + 1/τ₂, which the text calls b, 1/s (E1)."""
    slow, fast = _time_constants(run)
    return 1 / slow + 1 / fast


def step_c(run: Trajectory) -> float:
    """Return C₀/(τ₁τ₂), rad/s² (Eq. 16)."""
    return step_c0(run) * step_a(run)


def _time_constants(run: Trajectory) -> tuple[float, float]:
    """Return τ₁ and τ₂ of an overdamped step response, from the moments of what is missing at each time.

    ∫(1 − y) dt = τ₁ + τ₂ and ∫ t (1 − y) dt = τ₁² + τ₁τ₂ + τ₂²: no fit, no start values.
    """
    missing = 1 - run["bend_1"] / run["bend_1"][-1]
    total = float(np.trapezoid(missing, run.time))
    moment = float(np.trapezoid(run.time * missing, run.time))
    product = total**2 - moment
    root = math.sqrt(max(total**2 / 4 - product, 0.0))
    return total / 2 + root, total / 2 - root


def learning_law_error(run: Trajectory) -> float:
    """Return by how much a duty differs at most from that of Eq. 32 with k = 0.3 after the period before it.

    Every chamber's own error and duty of one period give its duty of the next, held between 0 and 1.
    """
    seen = PeriodAmplitudes.from_trajectory(run)
    asked = np.clip(seen.duty[:-1] + 0.3 * seen.error[:-1], 0, 1)
    changed = np.isfinite(asked) & (seen.duty[1:] < 1)
    return float(np.abs(seen.duty[1:] - asked)[changed].max(initial=0.0))


def free_periods(run: Trajectory) -> float:
    """Return how many periods pass at full duty before the first target stands."""
    seen = PeriodAmplitudes.from_trajectory(run)
    full = (seen.duty == 1).all(axis=(1, 2))
    return float(np.argmin(full) if not full.all() else len(full))


def target_left(run: Trajectory) -> float:
    """Return the target of the + chambers at the end, rad."""
    return float(np.nanmean(PeriodAmplitudes.from_trajectory(run).target[-1, :, 0]))


def target_right(run: Trajectory) -> float:
    """Return the target of the − chambers at the end, rad."""
    return float(np.nanmean(PeriodAmplitudes.from_trajectory(run).target[-1, :, 1]))


def smallest_amplitude(run: Trajectory) -> float:
    """Return the target over the smallest amplitude of the recorded period, the third (Section 5.1)."""
    seen = PeriodAmplitudes.from_trajectory(run)
    return float(np.nanmean(seen.target[-1]) / seen.amplitude[2].min())


def saturated_after(run: Trajectory) -> float:
    """Return in how many periods after the first update a chamber still passes its target by 5 % or more."""
    seen = PeriodAmplitudes.from_trajectory(run)
    begin = int(free_periods(run))
    over: np.ndarray = seen.amplitude[begin:] > 1.05 * seen.target[begin:]
    return float(over.any(axis=(1, 2)).sum())
