"""Habits: by how much chambers fill or vent faster than their lags, by how long ago their valves switched.

What a lag misses of a chamber of compressible flow comes again with each stroke: at first air rushes, and
what the body swings pumps it to and fro. Where pressures are told, that is learnt for each chamber, valve
state and age, and so is how well it is known.
"""

from __future__ import annotations

import numpy as np

_AGES, _AGE_S = 50, 0.01
"""For how many ages of a valve's state, of which length: half a robot's tick, as pressures come each tick."""
_STEP = 0.2
"""Share of what a pressure was off by that its ages are corrected by."""
_MEMORY = 8.0
"""Pressures of an age that tell how well its rate is known."""
_LEAST = 0.03
"""What rates wander at the least, share of the supply's pressure a square root of a second."""
_LONGEST_S = 0.1
"""A pressure that comes later than this after the last one tells of no age."""

Place = tuple[np.ndarray, ...]
"""Where each chamber is in the tables."""


class Habits:
    """Tables of all chambers, shape (segments, 2, states, ages).

    Attributes:
        rate: by which pressures change faster than their lags, Pa/s.
        wander: variance that they gain besides, Pa²/s.
    """

    def __init__(self, segments: int, supply: float, wander: float) -> None:
        """Know nothing.

        Args:
            segments: how many.
            supply: nominal, gauge, Pa.
            wander: of a pressure at first, share of the supply's a square root of a second.
        """
        self._filling, self._age = np.zeros((segments, 2), dtype=int), np.zeros((segments, 2))
        self._chambers = np.indices(self._age.shape)
        self.rate = np.zeros((segments, 2, 2, _AGES))
        self.wander = np.full_like(self.rate, (wander * supply) ** 2)
        self._least, self._spent = (_LEAST * supply) ** 2, np.zeros_like(self.rate)

    def let(self, opens: np.ndarray, span: float) -> Place:
        """Let valves be open for a share (shape (segments, 2)) of a time (s); return where chambers are."""
        filling = (opens > 0.5).astype(int)
        age = np.where(filling == self._filling, self._age, 0.0)
        place = *self._chambers, filling, np.minimum(age / _AGE_S, _AGES - 1).astype(int)
        self._filling, self._age = filling, age + span
        self._spent[place] += span
        return place

    def learn(self, off: np.ndarray, noise: float) -> None:
        """Take by what pressures were off since they were told last, NaN where none is told, Pa.

        Args:
            off: shape (segments, 2).
            noise: of a measurement, RMS, Pa.
        """
        spent = self._spent
        since = spent.sum(axis=(2, 3), keepdims=True)
        there = ~np.isnan(off)[..., None, None]
        share = np.where(there & (since < _LONGEST_S), spent / np.maximum(since, 1e-9), 0.0)
        known = np.nan_to_num(off)[..., None, None]
        # The last pressure was not known better than this one.
        grown = np.maximum(known**2 - 2 * noise**2, 0.0) / np.maximum(since, 1e-9)
        self.wander = np.maximum(self.wander + share / _MEMORY * (grown - self.wander), self._least)
        squares = np.maximum((spent**2).sum(axis=(2, 3), keepdims=True), 1e-12)
        self.rate = self.rate + np.where(share > 0, _STEP * known * spent / squares, 0.0)
        self._spent = np.where(there, 0.0, spent)
