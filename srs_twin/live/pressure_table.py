"""PressureTable: pressure residuals of a first-order chamber model, by the time since a valve switched.

A chamber with compressible flow deviates from its first-order model in the same way in
each stroke. The tables are indexed by chamber, valve state and the age of that state.
"""

from __future__ import annotations

import numpy as np

from srs_twin.io.saved_state import Stateful
from srs_twin.live.uncertain import Uncertain

BinIndex = tuple[np.ndarray, ...]
"""Index of the current bin of each chamber."""


class ValveAges(Stateful):
    """Time since the valves of all chambers switched.

    Attributes:
        filling: 1 where the valve fills, else 0, shape (segments, 2).
        age: time from its switching to the start of the last step, same shape, s.
    """

    state_attributes = ("filling", "age", "_dt")

    def __init__(self, segments: int, bins: int, width_s: float) -> None:
        """Begin with vented chambers; tables have a number of bins of a width (s)."""
        self.filling = np.zeros((segments, 2), dtype=int)
        self.age = np.zeros((segments, 2))
        self._dt = 0.0
        self._chambers = np.indices((segments, 2))
        self._bins = bins
        self._width_s = width_s

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a table: segments, sides, valve states, bins."""
        return *self.age.shape, 2, self._bins

    @property
    def filled_s(self) -> np.ndarray:
        """Time for which each chamber has been filled, shape (segments, 2), s; 0 while it vents."""
        return np.where(self.filling == 1, self.age, 0.0)

    def index(self) -> BinIndex:
        """Return the current bins."""
        return (
            *self._chambers,
            self.filling,
            np.minimum(self.age / self._width_s, self._bins - 1).astype(int),
        )

    def advance(self, duty: np.ndarray, dt: float) -> None:
        """Advance by a step (s) with a duty of the valves, share of time in which they fill."""
        filling = (duty > 0.5).astype(int)
        # The age is that at the start of the step, so it grows by the duration of the
        # step before.
        self.age = np.where(filling == self.filling, self.age + self._dt, 0.0)
        self.filling = filling
        self._dt = dt


class PressureRates:
    """Learnt differences between the pressure rates of the chambers and of their first-order model.

    Attributes:
        rate: shape (segments, 2, states, bins), Pa/s.
        wander: additional variance of the pressures per time, same shape, Pa²/s.
    """

    _BINS = 50
    _WIDTH_S = 0.01
    """Bins of half the robot's tick, because pressures arrive once per tick."""
    _GAIN = 0.2
    """Fraction of an innovation that is added to the rates of its bins."""
    _MEMORY = 8.0
    """Number of innovations over which the variance is averaged."""
    _LEAST_WANDER = 0.03
    """Lower limit of the wander, share of the nominal supply pressure per square root of a second."""
    _LONGEST_S = 0.1
    """Interval between pressures above which nothing is learnt, s."""

    def __init__(self, segments: int, supply: float, wander: float) -> None:
        """Begin with rates of 0.

        Args:
            segments: number of segments.
            supply: nominal supply pressure, gauge, Pa.
            wander: initial wander, share of the supply pressure per square root of a
                second.
        """
        self.ages = ValveAges(segments, self._BINS, self._WIDTH_S)
        self.rate = np.zeros(self.ages.shape)
        self.wander = np.full_like(self.rate, (wander * supply) ** 2)
        self._least = (self._LEAST_WANDER * supply) ** 2
        self._time_in_bin = np.zeros_like(self.rate)

    def advance(self, duty: np.ndarray, dt: float) -> BinIndex:
        """Advance by dt (s) with a duty of the valves, shape (segments, 2); return the bins."""
        self.ages.advance(duty, dt)
        index = self.ages.index()
        self._time_in_bin[index] += dt
        return index

    def update(self, innovation: np.ndarray, noise: float) -> None:
        """Learn from the innovations of measured pressures.

        Args:
            innovation: shape (segments, 2), Pa, NaN where nothing was measured.
            noise: standard deviation of a measurement, Pa.
        """
        times = self._time_in_bin
        since = times.sum(axis=(2, 3), keepdims=True)
        measured = ~np.isnan(innovation)[..., None, None]
        share = np.where(
            measured & (since < self._LONGEST_S), times / np.maximum(since, 1e-9), 0.0
        )
        known = np.nan_to_num(innovation)[..., None, None]
        # The difference of two pressures contains the noise of both.
        variance = np.maximum(known**2 - 2 * noise**2, 0.0) / np.maximum(since, 1e-9)
        self.wander = np.maximum(
            self.wander + share / self._MEMORY * (variance - self.wander), self._least
        )
        squares = np.maximum((times**2).sum(axis=(2, 3), keepdims=True), 1e-12)
        self.rate = self.rate + np.where(
            share > 0, self._GAIN * known * times / squares, 0.0
        )
        # Without a measurement the time accumulates until the next one.
        self._time_in_bin = np.where(measured, 0.0, times)


class PressureLevels(Stateful):
    """Means and variances of pressure residuals relative to the supply pressure.

    Attributes:
        ages: time since switching of the valves.
    """

    state_attributes = ("ages", "_count", "_mean", "_variance")
    _BINS = 25
    _WIDTH_S = 0.02
    _MOST_COUNTED = 40
    """Number of pressures over which a mean is taken."""

    def __init__(self, segments: int, sd: float) -> None:
        """Begin with means of 0 and an initial standard deviation."""
        self.ages = ValveAges(segments, self._BINS, self._WIDTH_S)
        self._count = np.ones(self.ages.shape)
        self._mean = np.zeros(self.ages.shape)
        self._variance = np.full(self.ages.shape, sd**2)

    def read(self) -> Uncertain:
        """Return means and standard deviations in the current bins, shape (segments, 2)."""
        index = self.ages.index()
        return Uncertain(self._mean[index], np.sqrt(self._variance[index]))

    def update(self, residual: np.ndarray, learns: np.ndarray) -> None:
        """Learn from residuals, pressures less those of the model and the mean.

        Args:
            residual: share of the supply pressure, shape (segments, 2).
            learns: whether a chamber is used for learning, shape (segments, 2).
        """
        index = self.ages.index()
        count = np.minimum(self._count[index] + 1, self._MOST_COUNTED)
        self._count[index] = np.where(learns, count, self._count[index])
        gain = np.where(learns, 1 / self._count[index], 0.0)
        self._mean[index] += gain * residual
        self._variance[index] += gain * (residual**2 - self._variance[index])
