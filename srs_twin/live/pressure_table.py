"""Tables of pressure residuals of a first-order chamber model.

Whenever a valve switches, the pressure of a chamber with compressible flow deviates
from the first-order model in a similar way. The tables are therefore indexed by
chamber, valve state and time since switching.
"""

from __future__ import annotations

import numpy as np

from srs_twin.io.saved_state import Stateful
from srs_twin.live.uncertain import Estimates

BinIndex = tuple[np.ndarray, ...]
"""Index of the current bin of each chamber."""


class ValveAges(Stateful):
    """Time since each valve last switched.

    Attributes:
        filling: 1 for each filling valve and 0 for each venting valve, shape (segments,
            2).
        age: time from switching to the start of the last step, shape (segments, 2), s.
    """

    state_attributes = ("filling", "age", "_dt")

    def __init__(self, segments: int, bins: int, width_s: float) -> None:
        """Initialise all valves as venting.

        `width_s` is the width of the time bins, s.
        """
        self.filling = np.zeros((segments, 2), dtype=int)
        self.age = np.zeros((segments, 2))
        self._dt = 0.0
        self._chambers = np.indices((segments, 2))
        self._bins = bins
        self._width_s = width_s

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a table (segments, sides, valve states, bins)."""
        return *self.age.shape, 2, self._bins

    @property
    def filled_s(self) -> np.ndarray:
        """Filling time of each chamber, s, which is 0 for a venting chamber."""
        return np.where(self.filling == 1, self.age, 0.0)

    def index(self) -> BinIndex:
        """Return the index of the current bin of each chamber."""
        return (
            *self._chambers,
            self.filling,
            np.minimum(self.age / self._width_s, self._bins - 1).astype(int),
        )

    def advance(self, duty: np.ndarray, dt: float) -> None:
        """Advance the times since switching by one time step."""
        filling = (duty > 0.5).astype(int)
        # The time since switching refers to the start of the step, so the previous time
        # step is added.
        self.age = np.where(filling == self.filling, self.age + self._dt, 0.0)
        self.filling = filling
        self._dt = dt


class PressureRates:
    """Learnt deviations of the pressure rates from the first-order model.

    Attributes:
        rate: measured minus modelled pressure rate, shape (segments, 2, states, bins),
            Pa/s.
        wander: variance per time of the random walk of the pressures, shape (segments,
            2, states, bins), Pa²/s.
    """

    _BINS = 50
    _WIDTH_S = 0.01
    """Width of a bin, s (half a tick of the robot)."""
    _GAIN = 0.2
    """Fraction of an innovation that is added to the rates in the corresponding bins.
    """
    _MEMORY = 8.0
    """Number of innovations over which the variance is averaged."""
    _LEAST_WANDER = 0.03
    """Lower limit of the random walk, fraction of the nominal pressure per √s."""
    _LONGEST_S = 0.1
    """Maximum interval between pressures that are used for learning, s."""

    def __init__(self, segments: int, supply: float, wander: float) -> None:
        """Initialise the rates to 0.

        `wander` is the initial random walk per √s, as a fraction of the nominal supply
        pressure `supply` (Pa).
        """
        self.ages = ValveAges(segments, self._BINS, self._WIDTH_S)
        self.rate = np.zeros(self.ages.shape)
        self.wander = np.full_like(self.rate, (wander * supply) ** 2)
        self._least = (self._LEAST_WANDER * supply) ** 2
        self._time_in_bin = np.zeros_like(self.rate)

    def advance(self, duty: np.ndarray, dt: float) -> BinIndex:
        """Advance the times since switching by one time step.

        Args:
            duty: fraction of time in which each valve fills, shape (segments, 2).
            dt: time step, s.

        Returns:
            Index of the current bin of each chamber.
        """
        self.ages.advance(duty, dt)
        index = self.ages.index()
        self._time_in_bin[index] += dt
        return index

    def update(self, innovation: np.ndarray, noise: float) -> None:
        """Learn from the innovations (Pa) of measured pressures.

        Missing innovations are NaN.
        """
        times = self._time_in_bin
        since = times.sum(axis=(2, 3), keepdims=True)
        measured = ~np.isnan(innovation)[..., None, None]
        fraction = np.where(
            measured & (since < self._LONGEST_S), times / np.maximum(since, 1e-9), 0.0
        )
        known = np.nan_to_num(innovation)[..., None, None]
        # The difference of two measured pressures contains twice the noise variance of
        # a single pressure.
        variance = np.maximum(known**2 - 2 * noise**2, 0.0) / np.maximum(since, 1e-9)
        self.wander = np.maximum(
            self.wander + fraction / self._MEMORY * (variance - self.wander),
            self._least,
        )
        squares = np.maximum((times**2).sum(axis=(2, 3), keepdims=True), 1e-12)
        self.rate = self.rate + np.where(
            fraction > 0, self._GAIN * known * times / squares, 0.0
        )
        # If a measurement is missing, the time accumulates until the next measurement.
        self._time_in_bin = np.where(measured, 0.0, times)


class PressureLevels(Stateful):
    """Means and variances of pressure residuals relative to the supply pressure."""

    state_attributes = ("ages", "_count", "_mean", "_variance")
    _BINS = 25
    _WIDTH_S = 0.02
    _MOST_COUNTED = 40
    """Number of pressures over which a mean is computed."""
    _LEAST_COUNTED = 4
    """Number of pressures from which a mean is known."""

    def __init__(self, segments: int, sd: float) -> None:
        """Initialise the means to 0 and the standard deviations to `sd`."""
        self.ages = ValveAges(segments, self._BINS, self._WIDTH_S)
        self._count = np.ones(self.ages.shape)
        self._mean = np.zeros(self.ages.shape)
        self._variance = np.full(self.ages.shape, sd**2)

    def read(self) -> Estimates:
        """Return mean and standard deviation in current bins, shape (segments, 2)."""
        index = self.ages.index()
        return Estimates(self._mean[index], np.sqrt(self._variance[index]))

    def are_known(self) -> np.ndarray:
        """Return whether enough pressures were learnt in current bins, shape (segments, 2)."""
        return np.asarray(self._count[self.ages.index()] > self._LEAST_COUNTED)

    def update(self, residual: np.ndarray, learns: np.ndarray) -> None:
        """Learn from the pressure residuals of the chambers selected by `learns`.

        The residuals are fractions of the supply pressure.
        """
        index = self.ages.index()
        count = np.minimum(self._count[index] + 1, self._MOST_COUNTED)
        self._count[index] = np.where(learns, count, self._count[index])
        gain = np.where(learns, 1 / self._count[index], 0.0)
        self._mean[index] += gain * residual
        self._variance[index] += gain * (residual**2 - self._variance[index])
