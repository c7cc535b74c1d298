"""PressureRates: rates of pressures beyond a first-order chamber model, by the time since a valve switched.

A chamber with compressible flow deviates from its first-order model in the same way in each stroke. The
table is indexed by chamber, valve state and the age of that state.
"""

from __future__ import annotations

import numpy as np

from srs_twin.io.saved_state import Stateful

BinIndex = tuple[np.ndarray, ...]
"""Index of the current bin of each chamber."""


class ValveAges(Stateful):
    """Time since the valves of all chambers switched.

    Attributes:
        filling: 1 where the valve fills, else 0, shape (segments, 2).
        age: time from its switching to the start of the last step, same shape, s.
    """

    state_attributes = ("filling", "age", "_dt")

    def __init__(self, segments: int) -> None:
        """Begin with vented chambers."""
        self.filling, self.age, self._dt = np.zeros((segments, 2), dtype=int), np.zeros((segments, 2)), 0.0

    @property
    def filled_s(self) -> np.ndarray:
        """Time for which each chamber has been filled, shape (segments, 2), s; 0 while it vents."""
        return np.where(self.filling == 1, self.age, 0.0)

    def advance(self, duty: np.ndarray, dt: float) -> None:
        """Advance by a step (s) with a duty of the valves, share of time in which they fill."""
        filling = (duty > 0.5).astype(int)
        self.age = np.where(filling == self.filling, self.age + self._dt, 0.0)
        self.filling, self._dt = filling, dt


class PressureRates:
    """Rates by which pressures change faster than in their first-order model.

    Attributes:
        rate: shape (segments, 2, states, bins), Pa/s.
        wander: variance that the pressures gain in addition, same shape, Pa²/s.
    """

    _BINS, _WIDTH_S = 50, 0.01
    """Bins of half the robot's tick, because pressures arrive once per tick."""
    _GAIN = 0.2
    """Share of an innovation by which the rates of its bins are corrected."""
    _MEMORY = 8.0
    """Number of innovations that the variance is a mean of."""
    _LEAST_WANDER = 0.03
    """Lower limit of the wander, share of the nominal supply pressure per square root of a second."""
    _LONGEST_S = 0.1
    """Interval between pressures above which nothing is learnt, s."""

    def __init__(self, segments: int, supply: float, wander: float) -> None:
        """Begin with rates of 0.

        Args:
            segments: number of segments.
            supply: nominal supply pressure, gauge, Pa.
            wander: initial wander, share of the supply pressure per square root of a second.
        """
        self.ages, self._chambers = ValveAges(segments), np.indices((segments, 2))
        self.rate = np.zeros((segments, 2, 2, self._BINS))
        self.wander = np.full_like(self.rate, (wander * supply) ** 2)
        self._least, self._time_in_bin = (self._LEAST_WANDER * supply) ** 2, np.zeros_like(self.rate)

    def advance(self, duty: np.ndarray, dt: float) -> BinIndex:
        """Advance by dt (s) with a duty of the valves, shape (segments, 2); return the bins."""
        self.ages.advance(duty, dt)
        ages = self.ages
        bins = np.minimum(ages.age / self._WIDTH_S, self._BINS - 1).astype(int)
        index = *self._chambers, ages.filling, bins
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
        share = np.where(measured & (since < self._LONGEST_S), times / np.maximum(since, 1e-9), 0.0)
        known = np.nan_to_num(innovation)[..., None, None]
        # The previous pressure has the same noise as this one.
        variance = np.maximum(known**2 - 2 * noise**2, 0.0) / np.maximum(since, 1e-9)
        self.wander = np.maximum(self.wander + share / self._MEMORY * (variance - self.wander), self._least)
        squares = np.maximum((times**2).sum(axis=(2, 3), keepdims=True), 1e-12)
        self.rate = self.rate + np.where(share > 0, self._GAIN * known * times / squares, 0.0)
        self._time_in_bin = np.where(measured, 0.0, times)
