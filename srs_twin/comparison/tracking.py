r"""Metrics of a module that follows a reference: step response, sine fit, rest, valve openings (Chapter 4).

Sines are fitted to recorded signals by least squares, at the frequency of the reference:

$$ x(t) \approx \bar x + A \sin(2\pi f t + \varphi). $$
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srs_twin.comparison.gait import WARM_UP_PERIODS
from srs_twin.comparison.sampling import require, rms, units_of
from srs_twin.trajectory import Trajectory

# A sine leaves no more than this share of its amplitude, RMS, when it is fitted.
_PURE = 1e-4


@dataclass(frozen=True)
class SineFit:
    """A sine fitted to samples.

    Attributes:
        amplitude: A, unit of the signal, 0 or more.
        phase: φ at time 0, rad.
        offset: mean.
        residual: RMS of what is left.
    """

    amplitude: float
    phase: float
    offset: float
    residual: float


def fit_sine(time: np.ndarray, values: np.ndarray, frequency: float) -> SineFit:
    """Return the sine of a frequency (Hz) that leaves the least squares of samples, shape (samples,)."""
    angle = 2 * np.pi * frequency * time
    basis = np.stack([np.sin(angle), np.cos(angle), np.ones_like(angle)], axis=-1)
    (sine, cosine, offset), *_ = np.linalg.lstsq(basis, values, rcond=None)
    left = values - basis @ np.array([sine, cosine, offset])
    return SineFit(float(np.hypot(sine, cosine)), float(np.arctan2(cosine, sine)), float(offset), rms(left))


def frequency_of(time: np.ndarray, values: np.ndarray) -> float | None:
    """Return the frequency of a signal that is a sine without noise, Hz; None where it is something else.

    Samples m apart of a sine obey x(t + m) + x(t − m) = 2 cos(2π f m) x(t) + const. Neighbours give a
    first f; samples about a quarter period apart, where the cosine tells most, the final one.

    Args:
        time: equally spaced but for the last sample, shape (samples,), s.
        values: shape (samples,).
    """
    values, time = values[:-1], time[:-1]
    if len(values) < 8 or np.ptp(values) == 0:
        return None
    period = (time[-1] - time[0]) / (len(time) - 1)
    turn = _turn(values, 1)
    if turn is None:
        return None
    quarter = max(1, round(np.pi / 2 / turn))
    if quarter > 1 and 2 * quarter + 8 <= len(values):
        finer = _turn(values, quarter)
        turn = turn if finer is None else finer / quarter
    frequency = float(turn / (2 * np.pi * period))
    fit = fit_sine(time, values, frequency)
    return frequency if fit.residual <= _PURE * fit.amplitude else None


def _turn(values: np.ndarray, apart: int) -> float | None:
    """Return by what angle the sine turns from a sample to one so many later, between 0 and π."""
    middle = values[apart:-apart]
    both = values[2 * apart :] + values[: -2 * apart]
    middle, both = middle - middle.mean(), both - both.mean()
    cosine = (middle @ both) / (2 * (middle @ middle))
    return float(np.arccos(cosine)) if 0 < 1 - cosine < 2 else None


def step_response(time: np.ndarray, bend: np.ndarray, before: float, after: float) -> dict[str, float | None]:
    """Return how a bend answers a step of its reference; between samples it goes straight.

    Args:
        time: since the step, shape (samples,), s.
        bend: shape (samples,), rad.
        before: reference before the step, rad.
        after: reference after it, rad.

    Returns:
        ``rise_time_s`` from 10 to 90 %, ``overshoot_rel`` and ``overshoot_rad`` (0 where it never goes
        beyond), ``settling_2_s`` and ``settling_5_s``; None for what is not reached before the run ends.
    """
    share = (bend - before) / (after - before)
    low, high = _first(time, share, 0.1), _first(time, share, 0.9)
    beyond = max(0.0, float(share.max()) - 1.0)
    return {
        "rise_time_s": None if low is None or high is None else high - low,
        "overshoot_rel": beyond,
        "overshoot_rad": beyond * abs(after - before),
        "settling_2_s": _settling(time, share, 0.02),
        "settling_5_s": _settling(time, share, 0.05),
    }


def _first(time: np.ndarray, share: np.ndarray, level: float) -> float | None:
    """Return when a level is first reached from below."""
    above = np.flatnonzero(share >= level)
    if not len(above):
        return None
    return _between(time, share, int(above[0]), level)


def _settling(time: np.ndarray, share: np.ndarray, band: float) -> float | None:
    """Return when the band about 1 is entered for good."""
    outside = np.flatnonzero(np.abs(share - 1.0) > band)
    if not len(outside):
        return 0.0
    last = int(outside[-1])
    if last + 1 == len(share):
        return None
    return _between(time, share, last + 1, 1.0 + np.copysign(band, share[last] - 1.0))


def _between(time: np.ndarray, share: np.ndarray, k: int, level: float) -> float:
    """Return when the straight line from the sample before k to k crosses a level; at k = 0 its time."""
    if k == 0:
        return float(time[0])
    part = (level - share[k - 1]) / (share[k] - share[k - 1])
    return float(time[k - 1] + part * (time[k] - time[k - 1]))


TRACKING_UNITS = units_of("""
    rise_time_s overshoot_rel overshoot_rad settling_2_s settling_5_s
    steady_error_rad steady_rms_rad ripple_pp_rad ripple_rms_rad sensed_ripple_pp_rad error_rms_rad
    amplitude_rel amplitude_spread_rel phase_lag_rad phase_lag_spread_rad fit_residual_rad
    inlet_openings outlet_openings
""")
"""Metrics of a run with a reference, each one number or None."""

# Less of a step than this is none, rad.
_LEAST_STEP = 1e-3


def tracking_metrics(trajectory: Trajectory) -> dict[str, float | None]:
    """Measure how the first segment follows its reference; None where a metric does not apply.

    Of a step, which is a reference that changes once, or never but the bend starts elsewhere:

    - ``rise_time_s`` from 10 to 90 % of it; ``overshoot_rel``, as a share of it, and ``overshoot_rad``;
      ``settling_2_s`` and ``settling_5_s``, after which the bend stays within 2 and 5 % of it.

    Of a reference at rest, over the second half of the time since its last change:

    - ``steady_error_rad``: mean of bend less reference; ``steady_rms_rad``: RMS of that.
    - ``ripple_pp_rad`` and ``ripple_rms_rad``: of the bend about its mean; ``sensed_ripple_pp_rad``: of the
      reading, sensor noise and all, as the text's figures show it.

    Of a sine, over whole periods after a warm-up of two (of one, where there are two or three):

    - ``amplitude_rel``: amplitude of the fitted sine over the reference's; ``phase_lag_rad``: how much it
      comes after the reference's, between −π and π. Their ``…_spread``: standard deviation of fits to each
      period.
    - ``fit_residual_rad``: RMS of what the fitted sine leaves.

    Of every run: ``error_rms_rad`` of reference less bend, ``inlet_openings`` a valve, and
    ``outlet_openings`` a valve, of separate outlet valves in a run recorded at every tick.

    Args:
        trajectory: a run with ``reference_1`` and ``bend_1``.

    Returns:
        Numbers by the names above; units in `TRACKING_UNITS`.

    Raises:
        InputError: columns are missing or unusable.
    """
    require(trajectory, "reference_1", "bend_1")
    reference, bend = trajectory["reference_1"], trajectory["bend_1"]
    metrics: dict[str, float | None] = dict.fromkeys(TRACKING_UNITS)
    metrics["error_rms_rad"] = rms(reference - bend)
    metrics |= _openings(trajectory)
    changes = np.flatnonzero(np.diff(reference)) + 1
    if len(changes) <= 1:
        metrics |= _at_rest(trajectory, int(changes[0]) if len(changes) else 0)
    elif (frequency := frequency_of(trajectory.time, reference)) is not None:
        metrics |= _sine(trajectory.time, reference, bend, frequency)
    return metrics


def _at_rest(trajectory: Trajectory, begin: int) -> dict[str, float | None]:
    """Return the metrics of a step at sample `begin` (0: the reference never changes) and of the rest."""
    reference, bend = trajectory["reference_1"], trajectory["bend_1"]
    target = float(reference[-1])
    before = float(reference[0] if begin else bend[0])
    time = trajectory.time[begin:] - trajectory.time[begin]
    tail = slice(begin + int(np.searchsorted(time, time[-1] / 2)), None)
    rest = bend[tail]
    found: dict[str, float | None] = {
        "steady_error_rad": float(rest.mean() - target),
        "steady_rms_rad": rms(rest - target),
        "ripple_pp_rad": float(np.ptp(rest)),
        "ripple_rms_rad": float(rest.std()),
    }
    if trajectory.has("sensed_1"):
        found["sensed_ripple_pp_rad"] = float(np.ptp(trajectory["sensed_1"][tail]))
    if abs(target - before) >= _LEAST_STEP:
        found |= step_response(time, bend[begin:], before, target)
    return found


def _sine(
    time: np.ndarray, reference: np.ndarray, bend: np.ndarray, frequency: float
) -> dict[str, float | None]:
    """Return the metrics of a sine; none where there are not two whole periods."""
    start = time[0]
    # A run meant to end on a whole period may miss it by rounding.
    whole = int(np.floor((time[-1] - start) * frequency + 1e-6))
    if whole < 2:
        return {}
    first = min(WARM_UP_PERIODS, whole // 2)

    def fits(begin: int, end: int) -> list[SineFit]:
        within = slice(*np.searchsorted(time, start + np.array([begin, end]) / frequency - 1e-9))
        return [fit_sine(time[within], signal[within], frequency) for signal in (reference, bend)]

    asked, done = fits(first, whole)
    each = [fits(n, n + 1) for n in range(first, whole)]
    gains = [b.amplitude / a.amplitude for a, b in each]
    lags = [_lag(a, b) for a, b in each]
    several = len(each) > 1
    return {
        "amplitude_rel": done.amplitude / asked.amplitude,
        "amplitude_spread_rel": float(np.std(gains, ddof=1)) if several else None,
        "phase_lag_rad": _lag(asked, done),
        "phase_lag_spread_rad": float(np.std(np.unwrap(lags), ddof=1)) if several else None,
        "fit_residual_rad": done.residual,
    }


def _lag(reference: SineFit, bend: SineFit) -> float:
    lag = reference.phase - bend.phase
    return float((lag + np.pi) % (2 * np.pi) - np.pi)


def _openings(trajectory: Trajectory) -> dict[str, float | None]:
    """Return openings a valve: inlets as the plant counted them, outlets where the samples tell."""
    counted = trajectory.metadata.get("valve_switches")
    found: dict[str, float | None] = {"inlet_openings": float(np.mean(counted[0])) if counted else None}
    names = ("valve_plus_1", "valve_minus_1")
    tick = trajectory.metadata.get("tick_s")
    if tick is None or len(trajectory) < 2 or not all(trajectory.has(name) for name in names):
        return found
    states = np.stack([trajectory[name] for name in names])
    every = float(np.diff(trajectory.time).max()) < 1.5 * tick
    # Only valves that can hold have outlets of their own.
    if every and (states == 0).any():
        opened = (states[:, 1:] == -1) & (states[:, :-1] != -1)
        found["outlet_openings"] = float(opened.sum(axis=1).mean())
    return found
