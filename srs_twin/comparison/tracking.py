r"""Tracking metrics and sensor metrics of a single module on a bench.

Chapter 4 of the dissertation defines the tracking metrics, and Figs. 13 and 14 define
the sensor metrics. Sines with the frequency of the reference are fitted to recorded
signals by least squares:

$$ x(t) \approx \bar x + A \sin(2\pi f t + \varphi). $$

The bends in a run are unevenly distributed, and single sensor readings contain noise.
Readings and bends are therefore averaged in bins, each 1° wide. All bins that contain
samples have equal weight, as in a calibration at evenly spaced angles.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from srs_twin.comparison.gait import WARM_UP_PERIODS
from srs_twin.comparison.sampling import check_columns, meanings_of, rms, units_of
from srs_twin.trajectory import Trajectory

_MAX_SINE_RESIDUAL = 1e-4
"""Ratio of RMS residual to amplitude below which a signal counts as a sine."""


@dataclass(frozen=True)
class SineFit:
    """Sine fitted to samples.

    Attributes:
        amplitude: amplitude A ≥ 0, in the unit of the samples.
        phase: phase φ, rad.
        offset: mean of the sine, in the unit of the samples.
        residual: RMS residual, in the unit of the samples.
    """

    amplitude: float
    phase: float
    offset: float
    residual: float


def fit_sine(time: np.ndarray, values: np.ndarray, frequency: float) -> SineFit:
    """Fit a sine with a given frequency (Hz) by least squares."""
    angle = 2 * np.pi * frequency * time
    basis = np.stack([np.sin(angle), np.cos(angle), np.ones_like(angle)], axis=-1)
    (sine, cosine, offset), *_ = np.linalg.lstsq(basis, values, rcond=None)
    residual = rms(values - basis @ np.array([sine, cosine, offset]))
    return SineFit(
        float(np.hypot(sine, cosine)),
        float(np.arctan2(cosine, sine)),
        float(offset),
        residual,
    )


def sine_frequency(time: np.ndarray, values: np.ndarray) -> float | None:
    """Return the frequency (Hz) of a noise-free sine, or None for any other signal.

    Samples of a sine satisfy x(t + m) + x(t − m) = 2 cos(2π f m) x(t) + const. Adjacent
    samples give a first estimate of f. Samples that are about a quarter of a period
    apart give the final estimate, because the cosine is steepest there. All samples
    except the last must be equally spaced.
    """
    values = values[:-1]
    time = time[:-1]
    if len(values) < 8 or np.ptp(values) == 0:
        return None
    period = (time[-1] - time[0]) / (len(time) - 1)
    step = _phase_step(values, 1)
    if step is None:
        return None
    quarter = max(1, round(np.pi / 2 / step))
    if quarter > 1 and 2 * quarter + 8 <= len(values):
        finer = _phase_step(values, quarter)
        step = step if finer is None else finer / quarter
    frequency = float(step / (2 * np.pi * period))
    fit = fit_sine(time, values, frequency)
    if fit.residual <= _MAX_SINE_RESIDUAL * fit.amplitude:
        return frequency
    return None


def _phase_step(values: np.ndarray, spacing: int) -> float | None:
    """Return the phase difference (0 to π rad) between samples `spacing` apart."""
    middle = values[spacing:-spacing]
    sums = values[2 * spacing :] + values[: -2 * spacing]
    middle = middle - middle.mean()
    sums = sums - sums.mean()
    cosine = (middle @ sums) / (2 * (middle @ middle))
    if 0 < 1 - cosine < 2:
        return float(np.arccos(cosine))
    return None


def step_response(
    time: np.ndarray, bend: np.ndarray, before: float, after: float
) -> dict[str, float | None]:
    """Compute the metrics of a step response.

    The bend is interpolated linearly between samples. A metric is None if the bend does
    not reach the required level before the end of the run.

    Args:
        time: sample times since the step, s.
        bend: bend at each sample, rad.
        before: reference before the step, rad.
        after: reference after the step, rad.
    """
    response = (bend - before) / (after - before)
    low = _first_crossing(time, response, 0.1)
    high = _first_crossing(time, response, 0.9)
    rise = None
    if low is not None and high is not None:
        rise = high - low
    overshoot = max(0.0, float(response.max()) - 1.0)
    return {
        "rise_time_s": rise,
        "overshoot_rel": overshoot,
        "overshoot_rad": overshoot * abs(after - before),
        "settling_2_s": _settling_time(time, response, 0.02),
        "settling_5_s": _settling_time(time, response, 0.05),
    }


def _first_crossing(
    time: np.ndarray, response: np.ndarray, level: float
) -> float | None:
    above = np.flatnonzero(response >= level)
    if not len(above):
        return None
    return _crossing_time(time, response, int(above[0]), level)


def _settling_time(time: np.ndarray, response: np.ndarray, band: float) -> float | None:
    """Return the time after which the response stays within a band around 1."""
    outside = np.flatnonzero(np.abs(response - 1.0) > band)
    if not len(outside):
        return 0.0
    last = int(outside[-1])
    if last + 1 == len(response):
        return None
    return _crossing_time(
        time, response, last + 1, 1.0 + np.copysign(band, response[last] - 1.0)
    )


def _crossing_time(
    time: np.ndarray, response: np.ndarray, k: int, level: float
) -> float:
    if k == 0:
        return float(time[0])
    fraction = (level - response[k - 1]) / (response[k] - response[k - 1])
    return float(time[k - 1] + fraction * (time[k] - time[k - 1]))


TRACKING_MEANINGS = meanings_of("""
rise_time_s: time from 10 to 90 % of a step
overshoot_rel: overshoot divided by the step
overshoot_rad: overshoot as an angle
settling_2_s: time until the bend stays within 2 % of the step
settling_5_s: time until the bend stays within 5 % of the step
steady_error_rad: mean error at rest (second half of the time in which the reference is constant)
steady_rms_rad: RMS error at rest
ripple_pp_rad: peak-to-peak bend at rest
ripple_rms_rad: RMS deviation of the bend from its mean at rest
measured_ripple_pp_rad: peak-to-peak sensor reading at rest
error_rms_rad: RMS of reference minus bend over the run
amplitude_rel: amplitude of the bend divided by that of a sine reference
amplitude_spread_rel: standard deviation of this amplitude ratio between periods
phase_lag_rad: phase lag of the bend behind a sine reference
phase_lag_spread_rad: standard deviation of the phase lag between periods
fit_residual_rad: RMS residual of the sine fitted to the bend
inlet_openings: openings per inlet valve
outlet_openings: openings per outlet valve
""")
TRACKING_UNITS = units_of(TRACKING_MEANINGS)

_MIN_STEP = 1e-3
"""Minimum change of the reference that counts as a step, rad."""


def tracking_metrics(trajectory: Trajectory) -> dict[str, float | None]:
    """Compute the tracking metrics of the first segment (`TRACKING_MEANINGS`).

    A metric that is not applicable is None. Step metrics require a reference that
    changes once, or a constant reference that differs from the initial bend.
    Steady-state metrics cover the second half of the time after the last change of the
    reference. Sine metrics cover whole periods after a warm-up of two periods, or of
    one period if the run has only two or three periods. Standard deviations are
    computed from separate sine fits to each period. The phase lag is between −π and π.
    Outlet openings are counted only for separate outlet valves and only if every tick
    is recorded.

    Raises:
        InputError: columns are missing or unusable.
    """
    check_columns(trajectory, "reference_1", "bend_1")
    reference = trajectory["reference_1"]
    bend = trajectory["bend_1"]
    metrics: dict[str, float | None] = dict.fromkeys(TRACKING_UNITS)
    metrics["error_rms_rad"] = rms(reference - bend)
    metrics |= _openings(trajectory)
    changes = np.flatnonzero(np.diff(reference)) + 1
    if len(changes) <= 1:
        metrics |= _step_metrics(trajectory, int(changes[0]) if len(changes) else 0)
    elif (frequency := sine_frequency(trajectory.time, reference)) is not None:
        metrics |= _sine_metrics(trajectory.time, reference, bend, frequency)
    return metrics


def _step_metrics(trajectory: Trajectory, begin: int) -> dict[str, float | None]:
    """Return steady-state metrics and the metrics of the step at sample `begin`."""
    reference = trajectory["reference_1"]
    bend = trajectory["bend_1"]
    target = float(reference[-1])
    before = float(reference[0] if begin else bend[0])
    time = trajectory.time[begin:] - trajectory.time[begin]
    tail = slice(begin + int(np.searchsorted(time, time[-1] / 2)), None)
    steady = bend[tail]
    metrics: dict[str, float | None] = {
        "steady_error_rad": float(steady.mean() - target),
        "steady_rms_rad": rms(steady - target),
        "ripple_pp_rad": float(np.ptp(steady)),
        "ripple_rms_rad": float(steady.std()),
    }
    if trajectory.has("measured_bend_1"):
        metrics["measured_ripple_pp_rad"] = float(
            np.ptp(trajectory["measured_bend_1"][tail])
        )
    if abs(target - before) >= _MIN_STEP:
        metrics |= step_response(time, bend[begin:], before, target)
    return metrics


def _sine_metrics(
    time: np.ndarray, reference: np.ndarray, bend: np.ndarray, frequency: float
) -> dict[str, float | None]:
    """Return the metrics of a sine reference, or {} if it has less than two periods."""
    start = time[0]
    # The tolerance ensures that the last period counts if the run ends with it.
    whole = int(np.floor((time[-1] - start) * frequency + 1e-6))
    if whole < 2:
        return {}
    first = min(WARM_UP_PERIODS, whole // 2)

    def fits(begin: int, end: int) -> list[SineFit]:
        samples = slice(
            *np.searchsorted(time, start + np.array([begin, end]) / frequency - 1e-9)
        )
        return [
            fit_sine(time[samples], signal[samples], frequency)
            for signal in (reference, bend)
        ]

    reference_fit, bend_fit = fits(first, whole)
    metrics: dict[str, float | None] = {
        "amplitude_rel": bend_fit.amplitude / reference_fit.amplitude,
        "phase_lag_rad": _lag(reference_fit, bend_fit),
        "fit_residual_rad": bend_fit.residual,
    }
    by_period = [fits(n, n + 1) for n in range(first, whole)]
    if len(by_period) > 1:
        gains = [b.amplitude / a.amplitude for a, b in by_period]
        lags = np.unwrap([_lag(a, b) for a, b in by_period])
        metrics["amplitude_spread_rel"] = float(np.std(gains, ddof=1))
        metrics["phase_lag_spread_rad"] = float(np.std(lags, ddof=1))
    return metrics


def _lag(reference: SineFit, bend: SineFit) -> float:
    lag = reference.phase - bend.phase
    return float((lag + np.pi) % (2 * np.pi) - np.pi)


def _openings(trajectory: Trajectory) -> dict[str, float | None]:
    """Return the openings per inlet valve and per outlet valve.

    The plant counts the inlet openings. The outlet openings are counted from the
    recorded valve states.
    """
    metrics: dict[str, float | None] = {}
    if counted := trajectory.metadata.get("valve_switches"):
        metrics["inlet_openings"] = float(np.mean(counted[0]))
    names = ("valve_plus_1", "valve_minus_1")
    tick = trajectory.metadata.get("tick_s")
    is_recorded = len(trajectory) > 1 and all(map(trajectory.has, names))
    if tick is None or not is_recorded:
        return metrics
    states = np.stack([trajectory[name] for name in names])
    every_tick = float(np.diff(trajectory.time).max()) < 1.5 * tick
    # Only chambers with separate inlet and outlet valves can be closed.
    if every_tick and (states == 0).any():
        opened = (states[:, 1:] == -1) & (states[:, :-1] != -1)
        metrics["outlet_openings"] = float(opened.sum(axis=1).mean())
    return metrics


READING_MEANINGS = meanings_of("""
reading_r_squared: R² of a linear relation between sensor readings and bends
reading_error_rad: largest difference between mean reading and mean bend
reading_backstep_rad: largest decrease of the reading with increasing bend
reading_backstep_at_rad: bend at the middle of the largest decrease of the reading
reading_range_t: range of the magnetic field at the sensor
""")
READING_UNITS = units_of(READING_MEANINGS)

BIN_RAD = math.radians(1.0)
"""Width of a bend bin, which is a common step size in calibrations, rad."""

_MIN_BINS = 3
"""Minimum number of bins for a linear fit, because a line fits two points exactly."""


@dataclass(frozen=True)
class ReadingCurve:
    """Mean sensor reading and mean bend in each bin that contains samples.

    Attributes:
        bend: mean bends in ascending order, rad.
        reading: mean readings, rad.
    """

    bend: np.ndarray
    reading: np.ndarray

    @classmethod
    def from_trajectory(cls, trajectory: Trajectory) -> ReadingCurve | None:
        """Return the first segment's curve, or None if the sensor is ideal or missing.

        Raises:
            InputError: columns are missing or unusable.
        """
        kind = _sensor(trajectory).get("kind", "ideal")
        if kind == "ideal" or not trajectory.has("measured_bend_1"):
            return None
        check_columns(trajectory, "bend_1")
        read = np.isfinite(trajectory["measured_bend_1"])
        bend = trajectory["bend_1"][read]
        measured_bend = trajectory["measured_bend_1"][read]
        # One bin is centred at 0, so that both bending directions are treated equally.
        _, bins, samples = np.unique(
            np.round(bend / BIN_RAD), return_inverse=True, return_counts=True
        )
        means = [
            np.bincount(bins, values) / samples for values in (bend, measured_bend)
        ]
        return cls(*means)

    @property
    def r_squared(self) -> float | None:
        """R² of a linear fit of the readings to the bends, or None if undefined."""
        if len(self.bend) < _MIN_BINS or np.ptp(self.reading) == 0:
            return None
        return float(np.corrcoef(self.bend, self.reading)[0, 1] ** 2)

    @property
    def backstep(self) -> tuple[float, float | None]:
        """Maximum decrease of the reading with increasing bend, and its location, rad.

        The location is the mean of the bends between which the reading decreases. If
        the reading never decreases, the decrease is 0 and the location is None.
        """
        decrease = np.maximum.accumulate(self.reading) - self.reading
        low = int(decrease.argmax())
        if decrease[low] == 0:
            return 0.0, None
        high = int(self.reading[: low + 1].argmax())
        return float(decrease[low]), float(self.bend[high] + self.bend[low]) / 2


def reading_metrics(trajectory: Trajectory) -> dict[str, float | None]:
    """Return the metrics of the first segment's sensor (`READING_MEANINGS`).

    All metrics are None if the sensor is ideal or the bends fill fewer than three bins.
    Without noise, ``reading_backstep_rad`` is 0 if the reading increases monotonically
    with the bend. The metrics depend on the range of bends in the run.

    Raises:
        InputError: columns are missing or unusable.
    """
    metrics: dict[str, float | None] = dict.fromkeys(READING_UNITS)
    curve = ReadingCurve.from_trajectory(trajectory)
    if curve is None or len(curve.bend) < _MIN_BINS:
        return metrics
    metrics["reading_r_squared"] = curve.r_squared
    metrics["reading_error_rad"] = float(np.abs(curve.reading - curve.bend).max())
    metrics["reading_backstep_rad"], metrics["reading_backstep_at_rad"] = curve.backstep
    field = _field_per_rad(_sensor(trajectory))
    if field is not None:
        change = float(abs(curve.reading[-1] - curve.reading[0]))
        metrics["reading_range_t"] = change * field
    return metrics


def _sensor(trajectory: Trajectory) -> Mapping[str, object]:
    return _mapping(trajectory.metadata.get("sensor"))


def _field_per_rad(sensor: Mapping[str, object]) -> float | None:
    """Return the field change per measured bend (T/rad), or None if it is unknown."""
    hall = _mapping(sensor.get("hall"))
    line = _mapping(sensor.get("calibration"))
    values = (
        hall.get("gain"),
        hall.get("gain_error"),
        hall.get("sensitivity"),
        line.get("slope"),
    )
    numbers = [float(value) for value in values if isinstance(value, int | float)]
    if len(numbers) < len(values):
        return None
    gain, drift, sensitivity, slope = numbers
    rad_per_tesla = gain * (1 + drift) * sensitivity * slope
    if rad_per_tesla:
        return abs(1 / rad_per_tesla)
    return None


def _mapping(value: object) -> Mapping[str, object]:
    if isinstance(value, Mapping):
        return value
    return {}
