"""Metrics of a module that follows a reference: step response, sine fit, rest, valve openings (Chapter 4)."""

from __future__ import annotations

import numpy as np

from srs_twin.comparison.gait_window import WARM_UP_PERIODS
from srs_twin.comparison.sampling import require, rms
from srs_twin.comparison.sines import SineFit, fit_sine, frequency_of
from srs_twin.comparison.steps import step_response
from srs_twin.trajectory import Trajectory

# Metrics of a run with a reference, each one number or None.
TRACKING_UNITS = {
    "rise_time_s": "s",
    "overshoot_rel": "1",
    "overshoot_rad": "rad",
    "settling_2_s": "s",
    "settling_5_s": "s",
    "steady_error_rad": "rad",
    "steady_rms_rad": "rad",
    "ripple_pp_rad": "rad",
    "ripple_rms_rad": "rad",
    "sensed_ripple_pp_rad": "rad",
    "error_rms_rad": "rad",
    "amplitude_rel": "1",
    "amplitude_spread_rel": "1",
    "phase_lag_rad": "rad",
    "phase_lag_spread_rad": "rad",
    "fit_residual_rad": "rad",
    "inlet_openings": "1",
    "outlet_openings": "1",
}

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
    asked, done = _fits(time, reference, bend, frequency, start, first, whole)
    each = [_fits(time, reference, bend, frequency, start, n, n + 1) for n in range(first, whole)]
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


def _fits(
    time: np.ndarray,
    reference: np.ndarray,
    bend: np.ndarray,
    frequency: float,
    start: float,
    first: int,
    end: int,
) -> tuple[SineFit, SineFit]:
    """Return the sines of reference and bend over the periods from `first` up to `end`."""
    within = slice(*np.searchsorted(time, start + np.array([first, end]) / frequency - 1e-9))
    return (
        fit_sine(time[within], reference[within], frequency),
        fit_sine(time[within], bend[within], frequency),
    )


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
