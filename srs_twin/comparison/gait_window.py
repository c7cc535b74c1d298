"""GaitWindow: the whole gait periods of a run that its averages are taken over."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from srs_twin.comparison.sampling import interpolant, positive_number
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
        if frequency is None or len(trajectory) < LEAST_PERIODS * _LEAST_SAMPLES_A_PERIOD:
            return None
        time = trajectory.time
        # A run meant to end on a whole period may miss it by rounding.
        whole = int(np.floor((time[-1] - time[0]) * frequency + 1e-6))
        samples = 1.0 / (frequency * float(np.median(np.diff(time))))
        if whole < LEAST_PERIODS or samples < _LEAST_SAMPLES_A_PERIOD:
            return None
        warm_up = min(WARM_UP_PERIODS, whole - 2)
        instants = max(_LEAST_INSTANTS, int(np.ceil(4 * samples)))
        return cls(float(time[0]) + warm_up / frequency, 1.0 / frequency, whole - warm_up, instants)

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
