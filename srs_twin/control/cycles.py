r"""Cycles: each chamber's own clock, and how far its segment bends in each of its periods.

Period n of a chamber runs from the begin of its n-th fill to that of the next. The bend that a fill causes
comes late, by air and inertia, but by less than the vent that follows: its whole peak falls into one period,
and what is learnt from it is there when the chamber fills again. One clock for all chambers, as Section 5.1
has it, cuts through the peaks of some of them, and gives a new duty in the middle of their fills.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.errors import InputError

LEAST_READINGS = 8
"""Fewer readings a period do not show how far a segment bends."""

_ROUNDING = 1e-9  # of a period


class Cycles:
    """Periods and peaks of the chambers of a snake in a travelling wave.

    Attributes:
        period: T, s.
        begins: when the first fill of each chamber begins, shape (segments, 2), s, from −T/2 to T/2: what
            is filling at the start has begun before.
        number: of the period that runs, 0 before the first, shape (segments, 2).
        peak: of the last finished period: the furthest bend to the chamber's side (+: left), rad, same shape.
        span: … and how far the readings lay apart, rad.
        lost: … and the share of its readings that were lost.
        since: … and when it began, s.
    """

    def __init__(self, lag: np.ndarray, frequency: float, tick: float, *, common: bool = False) -> None:
        """Make clocks at time 0.

        Args:
            lag: of each segment's wave sin(2πft − lag), shape (segments,), rad; the + chamber fills where
                it is positive, the − chamber where it is negative.
            frequency: f, Hz.
            tick: between readings, s.
            common: whether all chambers go by one clock that starts with the run, as in Section 5.1.

        Raises:
            InputError: too few readings a period.
        """
        self.period, self._tick = 1 / frequency, tick
        if self.period / tick < LEAST_READINGS * (1 - _ROUNDING):
            raise InputError(
                f"a gait of {frequency:g} Hz has fewer than {LEAST_READINGS} readings a period with the tick "
                f"{tick:g} s; a tick of {self.period / LEAST_READINGS:.4g} s or less, or "
                f"{1 / (LEAST_READINGS * tick):.4g} Hz or less, would do"
            )
        share = (np.stack([lag, lag + math.pi], axis=-1) / (2 * math.pi) + _ROUNDING) % 1 - _ROUNDING
        share = np.where(share > 0.5 + _ROUNDING, share - 1, share)
        self.begins = np.zeros(share.shape) if common else share * self.period
        self.number = np.where(self.begins < -_ROUNDING * self.period, 1, 0)
        self.peak: np.ndarray = np.full(share.shape, math.nan)
        self.span: np.ndarray = np.full(share.shape, math.nan)
        self.lost: np.ndarray = np.zeros(share.shape)
        self.since: np.ndarray = np.full(share.shape, -math.inf)
        self._most, self._least = np.full(share.shape, -math.inf), np.full(share.shape, math.inf)
        self._fixed, self._common = self.begins, common
        self._sides: np.ndarray = np.zeros(share.shape)
        self._seen, self._missed = np.zeros(share.shape), np.zeros(share.shape)
        self._plan()

    def steer(self, rise: float) -> None:
        """Go on with fills that are longer on one side, as Eq. 13's offset φ makes them.

        Args:
            rise: asin φ, rad: by how much fills of + chambers begin earlier, those of − chambers later.
        """
        if not self._common:
            self.begins = self._fixed + rise / (2 * math.pi) * self.period * np.array([-1, 1])
            self._plan()

    def take(self, reading: np.ndarray, lost: np.ndarray) -> None:
        """Take the readings of a tick and whose are lost, both of shape (segments,)."""
        sides = self._sides
        sides[:, 0] = reading
        np.negative(reading, out=sides[:, 1])
        np.maximum(self._most, sides, out=self._most)
        np.minimum(self._least, sides, out=self._least)
        self._seen += 1
        self._missed += lost[:, None]

    def due(self, time: float) -> bool:
        """Say whether a period begins in the tick that begins at `time` (s)."""
        return time + self._tick > self._next

    def turn(self, time: float) -> np.ndarray:
        """Begin the periods that are due and return whose finished one has a peak, shape (segments, 2)."""
        begun = self.begins + self.number * self.period < time + self._tick - _ROUNDING * self.period
        ended = begun & (self.number >= 1)
        self.peak = np.where(ended, self._most, self.peak)
        self.span = np.where(ended, self._most - self._least, self.span)
        self.lost = np.where(ended, self._missed / np.maximum(self._seen, 1), self.lost)
        self.since = np.where(ended, self.begins + (self.number - 1) * self.period, self.since)
        self._most[begun], self._least[begun] = -math.inf, math.inf
        self._seen[begun] = self._missed[begun] = 0
        self.number = self.number + begun
        self._plan()
        return ended

    def _plan(self) -> None:
        self._next = float((self.begins + self.number * self.period).min()) + _ROUNDING * self.period
