"""Learnt tables of the differences between measured and modelled chamber pressures.

The model assumes first-order chamber dynamics. After each valve event, the pressure of
a chamber with compressible flow differs from this model in a similar way. The tables
are therefore indexed by chamber, valve state and time since the valve last switched.
"""

from __future__ import annotations

import numpy as np

from srs_twin.io.saved_state import Stateful
from srs_twin.live.uncertain import Estimates

BinIndex = tuple[np.ndarray, ...]
"""Index arrays that select the current bin of each chamber in a table."""


class ValveAges(Stateful):
    """Time since each valve last switched.

    Attributes:
        filling: array that is 1 for filling valves and 0 for venting valves, shape
            (segments, 2).
        age: time between the last switching of each valve and the start of the latest
            time step, shape (segments, 2), s.
    """

    state_attributes = ("filling", "age", "_dt")

    def __init__(self, segments: int, bins: int, width_s: float) -> None:
        """Initialise all valves as venting.

        A table has `bins` time bins with a width of `width_s` (s).
        """
        self.filling = np.zeros((segments, 2), dtype=int)
        self.age = np.zeros((segments, 2))
        self._dt = 0.0
        self._chambers = np.indices((segments, 2))
        self._bins = bins
        self._width_s = width_s

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape (segments, sides, valve states, time bins) of a table."""
        return *self.age.shape, 2, self._bins

    @property
    def filled_s(self) -> np.ndarray:
        """Time for which each chamber has been filling, or 0 if it vents, s."""
        return np.where(self.filling == 1, self.age, 0.0)

    def index(self) -> BinIndex:
        """Return the index of the current bin of each chamber."""
        return (
            *self._chambers,
            self.filling,
            np.minimum(self.age / self._width_s, self._bins - 1).astype(int),
        )

    def advance(self, duty: np.ndarray, dt: float) -> None:
        """Advance the times since switching by a time step `dt` (s)."""
        filling = (duty > 0.5).astype(int)
        # The ages refer to the start of this step, so the duration of the previous step
        # is added.
        self.age = np.where(filling == self.filling, self.age + self._dt, 0.0)
        self.filling = filling
        self._dt = dt


class PressureRates:
    """Learnt deviations of the pressure rates from the first-order model.

    Attributes:
        rate: measured minus modelled pressure rate, shape (segments, 2, states, bins),
            Pa/s.
        wander: variance of the pressure random walk per unit time, shape (segments, 2,
            states, bins), Pa²/s.
    """

    _BINS = 50
    _WIDTH_S = 0.01
    """Width of a time bin, s (half a control tick of the robot)."""
    _GAIN = 0.2
    """Fraction of an innovation that is attributed to errors in the learnt rates."""
    _MEMORY = 8.0
    """Number of innovations over which the variance is averaged."""
    _LEAST_WANDER = 0.03
    """Minimum random walk, as a fraction of the nominal supply pressure per √s."""
    _LONGEST_S = 0.1
    """Maximum interval between two pressures that are used for learning, s."""

    def __init__(self, segments: int, supply: float, wander: float) -> None:
        """Initialise the rates to 0.

        The initial random walk `wander` is a fraction of the nominal supply pressure
        `supply` (Pa) per √s.
        """
        self.ages = ValveAges(segments, self._BINS, self._WIDTH_S)
        self.rate = np.zeros(self.ages.shape)
        self.wander = np.full_like(self.rate, (wander * supply) ** 2)
        self._least = (self._LEAST_WANDER * supply) ** 2
        self._time_in_bin = np.zeros_like(self.rate)

    def advance(self, duty: np.ndarray, dt: float) -> BinIndex:
        """Advance the times since switching by one time step.

        Args:
            duty: fraction of time for which each valve fills its chamber, shape
                (segments, 2).
            dt: time step, s.

        Returns:
            Index of the current bin of each chamber.
        """
        self.ages.advance(duty, dt)
        index = self.ages.index()
        self._time_in_bin[index] += dt
        return index

    def update(self, innovation: np.ndarray, noise: float) -> None:
        """Correct the learnt rates with measured minus predicted pressures (Pa).

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
        # The times in the bins accumulate until the pressure is measured again.
        self._time_in_bin = np.where(measured, 0.0, times)


class PressureLevels(Stateful):
    """Learnt means and variances of pressure residuals.

    A residual is the measured minus the modelled pressure, as a fraction of the supply
    pressure.
    """

    state_attributes = ("ages", "_count", "_mean", "_variance")
    _BINS = 25
    _WIDTH_S = 0.02
    _MOST_COUNTED = 40
    """Maximum number of pressures that contribute to a mean."""
    _LEAST_COUNTED = 4
    """Number of learnt pressures after which a mean is considered known."""

    def __init__(self, segments: int, sd: float) -> None:
        """Initialise the means to 0 and the standard deviations to `sd`."""
        self.ages = ValveAges(segments, self._BINS, self._WIDTH_S)
        self._count = np.ones(self.ages.shape)
        self._mean = np.zeros(self.ages.shape)
        self._variance = np.full(self.ages.shape, sd**2)

    def read(self) -> Estimates:
        """Return means and standard deviations in current bins, shape (segments, 2)."""
        index = self.ages.index()
        return Estimates(self._mean[index], np.sqrt(self._variance[index]))

    def are_known(self) -> np.ndarray:
        """Return a mask of chambers whose mean is known, shape (segments, 2)."""
        return np.asarray(self._count[self.ages.index()] > self._LEAST_COUNTED)

    def update(self, residual: np.ndarray, learns: np.ndarray) -> None:
        """Update the current bins of the chambers in the mask `learns`."""
        index = self.ages.index()
        count = np.minimum(self._count[index] + 1, self._MOST_COUNTED)
        self._count[index] = np.where(learns, count, self._count[index])
        gain = np.where(learns, 1 / self._count[index], 0.0)
        self._mean[index] += gain * residual
        self._variance[index] += gain * (residual**2 - self._variance[index])
