"""Metrics of a gait: how far its periods carry a snake, on which circle, and at what cost.

All averages are taken over whole gait periods (`GaitWindow`). What moving costs is the power of the segments
and of the air that they use, and the cost of transport.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from srs_twin.comparison.sampling import interpolant, positive_number
from srs_twin.robot.spec import GRAVITY
from srs_twin.trajectory import Trajectory

WARM_UP_PERIODS = 2
LEAST_PERIODS = 3
# Fewer samples a period than this cannot show a wave.
_LEAST_SAMPLES_A_PERIOD = 4
# Instants a period at which signals are looked at: no fewer than this, and four to each sample period.
_LEAST_INSTANTS = 64
_ROUNDING = 1e-6  # of a period


@dataclass(frozen=True)
class GaitWindow:
    r"""Whole gait periods after the warm-up, and running period means over them.

    Of a signal x the running mean over one period T, and its exact derivative, are

    $$\bar x(t) = \frac{1}{T} \int_t^{t+T} x\,ds, \qquad \dot{\bar x}(t) = \frac{x(t+T) - x(t)}{T},$$

    for t from the start of the window to one period before its end. Between the samples x is a cubic
    spline, so T need not be a multiple of the sample period, nor the window begin on a sample.

    Attributes:
        start: begin of the window, s.
        period: T, s.
        periods: K, whole periods in the window, 2 or more.
        instants: instants per period at which signals are looked at.
    """

    start: float
    period: float
    periods: int
    instants: int

    @classmethod
    def of(cls, trajectory: Trajectory) -> GaitWindow | None:
        """Return the window of a run: all whole periods after a warm-up of two.

        A run of exactly three whole periods gives up one of the warm-up, so that two are left to average.

        Returns:
            None where nothing is periodic (no gait frequency in the metadata), where the run has fewer than
            three whole periods, or where the samples are too sparse to show one.

        Raises:
            InputError: the gait frequency in the metadata is no positive number.
        """
        frequency = positive_number(trajectory, "gait_frequency_hz")
        if frequency is None or cls.lacking(trajectory):
            return None
        time = trajectory.time
        whole, samples = _extent(trajectory, frequency)
        warm_up = min(WARM_UP_PERIODS, whole - 2)
        instants = max(_LEAST_INSTANTS, int(np.ceil(4 * samples)))
        return cls(float(time[0]) + warm_up / frequency, 1.0 / frequency, whole - warm_up, instants)

    @classmethod
    def lacking(cls, trajectory: Trajectory) -> str:
        """Return the reason why a run has no window, in words; empty where it has one.

        Raises:
            InputError: as `of`.
        """
        frequency = positive_number(trajectory, "gait_frequency_hz")
        if frequency is None:
            return "the run has no gait frequency"
        whole, samples = _extent(trajectory, frequency)
        if whole < LEAST_PERIODS:
            return f"the run has {whole} of the {LEAST_PERIODS} whole gait periods that are needed"
        few = samples < _LEAST_SAMPLES_A_PERIOD or len(trajectory) < LEAST_PERIODS * _LEAST_SAMPLES_A_PERIOD
        return f"the run has fewer than {_LEAST_SAMPLES_A_PERIOD} samples per gait period" if few else ""

    @classmethod
    def last(cls, trajectory: Trajectory, period: float, end: float, periods: int) -> GaitWindow | None:
        """Return so many periods (s each) up to a time (s), None where the run does not have them."""
        start, step = end - periods * period, float(np.median(np.diff(trajectory.time)))
        if start < trajectory.time[0] - _ROUNDING * period:
            return None
        return cls(start, period, periods, max(_LEAST_INSTANTS, math.ceil(4 * period / step)))

    @property
    def end(self) -> float:
        """End of the window, s."""
        return self.start + self.periods * self.period

    def times(self, periods: int) -> np.ndarray:
        """Return equally spaced instants over that many periods, shape (periods · instants,), s.

        They are midpoints: their plain mean is the integral over whole periods, exact to the last digits
        for what is smooth and periodic.
        """
        step = self.period / self.instants
        return self.start + step * (np.arange(periods * self.instants) + 0.5)

    def running(self, trajectory: Trajectory, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the running period mean of a signal and its rate.

        Args:
            trajectory: the run of which this is the window.
            values: shape (samples, …).

        Returns:
            Mean and rate at equally spaced instants over K − 1 periods, each (instants, …).
        """
        signal = interpolant(trajectory, values)
        integral = signal.antiderivative()
        begin = self.times(self.periods - 1)
        end = begin + self.period
        return (integral(end) - integral(begin)) / self.period, (signal(end) - signal(begin)) / self.period

    def mean(self, trajectory: Trajectory, values: np.ndarray) -> np.ndarray:
        """Return the mean of a signal over the window; values of shape (samples, …) give (…)."""
        integral = interpolant(trajectory, values).antiderivative()
        return (integral(self.end) - integral(self.start)) / (self.end - self.start)

    def amplitude(self, trajectory: Trajectory, values: np.ndarray) -> np.ndarray:
        """Return half the peak-to-peak of each period, averaged over the window; (samples, …) gives (…)."""
        seen = interpolant(trajectory, values)(self.times(self.periods))
        by_period = seen.reshape(self.periods, self.instants, *values.shape[1:])
        return 0.5 * np.ptp(by_period, axis=1).mean(axis=0)


def _extent(trajectory: Trajectory, frequency: float) -> tuple[int, float]:
    """Return the number of whole gait periods of a run, and its samples per period."""
    time = trajectory.time
    # A run meant to end on a whole period may miss it by rounding.
    whole = int(np.floor((time[-1] - time[0]) * frequency + 1e-6))
    return whole, (1.0 / (frequency * float(np.median(np.diff(time)))) if len(time) > 1 else 0.0)


LEAST_WAY = 1e-3
"""A snake that gets less far than this in a period has no path, body lengths."""


def carried(trajectory: Trajectory, window: GaitWindow) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much a period carries the centre of mass (m, backward negative) and turns it (rad).

    Both are means over all periods that begin within one: at one phase alone, what the body sways to the side
    would be taken for a part of the radius. K periods give K − 1 numbers of each.
    """
    speed, turning = running_rates(trajectory, window)
    each = (window.periods - 1, window.instants)
    chords = window.period * speed
    return chords.reshape(each).mean(axis=1), window.period * turning.reshape(each).mean(axis=1)


def running_rates(trajectory: Trajectory, window: GaitWindow) -> tuple[np.ndarray, np.ndarray]:
    """Return the speed of the period-averaged path and the rate of the period-mean heading at each instant.

    The speed (m/s) is negative throughout where that path runs, on the whole, against the heading; the rate
    (rad/s) is positive to the left.
    """
    heading, turning = window.running(trajectory, trajectory["heading"])
    _, velocity = window.running(trajectory, trajectory.com)
    along = velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)
    return np.copysign(1.0, along.mean()) * np.hypot(velocity[:, 0], velocity[:, 1]), turning


# Straight is what turns on a circle of more body lengths than this (for gen 2 some 20 m, where a path of
# 2 m leaves its tangent by 0.1 m), or by less than this angle in a gait period (0.06°, what contact creep
# does to a snake that does not get anywhere).
STRAIGHT_BODY_LENGTHS = 100.0
STRAIGHT_TURN_RAD = 1e-3


def turning_radius(speed: float, yaw_rate: float, period: float, length: float) -> float | None:
    """Return the signed radius (m), positive where its centre lies on the left; None when straight.

    In one period the body is carried speed · period along a chord and turns by yaw_rate · period; the chord
    of that angle has this radius. (Speed over yaw rate would be that of the averaged path, which the
    averaging draws inwards: by 1 % where a period turns by half a radian.)

    Args:
        speed: along the heading, m/s.
        yaw_rate: rad/s.
        period: of the gait, s.
        length: of the body, m.
    """
    turn = yaw_rate * period
    if abs(turn) < STRAIGHT_TURN_RAD:
        return None
    radius = speed * period / (2 * math.sin(turn / 2))
    return radius if abs(radius) <= STRAIGHT_BODY_LENGTHS * length else None


def path_curvature(chord: float, turn: float) -> float:
    """Return the curvature of the circle with a chord (m, not 0) over which the body turns (rad), 1/m."""
    return 2 * math.sin(turn / 2) / chord


ENERGY_METRICS = (
    "mechanical_power_w internal_power_w cost_of_transport pneumatic_power_w pneumatic_cost_of_transport"
)


def energy_metrics(trajectory: Trajectory, window: GaitWindow, speed: float) -> dict[str, Any]:
    """Measure what a gait costs, over whole periods.

    - ``mechanical_power_w``: work of the torques; on average, power that friction and segments dissipate.
    - ``internal_power_w``: part of it that segments dissipate inside, in a twin.
    - ``cost_of_transport``: that over weight times speed.
    - ``pneumatic_power_w``: supply pressure times the volume of air drawn at that pressure.
    - ``pneumatic_cost_of_transport``: likewise.

    Each is None where the run did not record what it needs.

    Args:
        trajectory: one run.
        window: its gait periods.
        speed: mean speed, m/s.
    """
    mass = positive_number(trajectory, "mass_kg")
    metrics: dict[str, Any] = dict.fromkeys(ENERGY_METRICS.split())
    if trajectory.has("internal_loss"):
        metrics["internal_power_w"] = _mean_rate(trajectory, window, "internal_loss")
    for source, power, cost in (
        ("work", "mechanical_power_w", "cost_of_transport"),
        ("air", "pneumatic_power_w", "pneumatic_cost_of_transport"),
    ):
        if trajectory.has(source):
            metrics[power] = _mean_rate(trajectory, window, source)
            if mass is not None and speed != 0:
                metrics[cost] = metrics[power] / (mass * GRAVITY * abs(speed))
    return metrics


def _mean_rate(trajectory: Trajectory, window: GaitWindow, name: str) -> float:
    """Return how fast a column that adds up grows over the window."""
    start, end = np.interp([window.start, window.end], trajectory.time, trajectory[name])
    return float((end - start) / (window.end - window.start))
