r"""Duties: the law of iterative learning, one duty a chamber (Eq. 32).

$$ u_n = \operatorname{clip}\bigl(u_{n-1} + k\,e_{n-1},\, 0,\, 1\bigr), \qquad
e_{n-1} = \text{target} - \text{amplitude}. $$

Where the amplitude is c u, the error shrinks by 1 − k c an update. What is bounded is the duty itself, not a
sum of errors behind it, so nothing winds up: it leaves its bound with the first error of the other sign.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.trajectory import Event

SIDES = ("+", "−")

WITHIN = 0.05
"""Share of its target by which an amplitude may miss it and still count as there."""

_ROUNDING = 1e-12


class Duties:
    """Duty of each chamber, and what is worth telling of how it was learnt.

    Attributes:
        value: u, shape (segments, 2), from 0 to 1.
        error: e of the last update, same shape, rad; NaN before the first.
    """

    def __init__(self, segments: int, gain: float) -> None:
        """Make full duties that learn with k = `gain`, 1/rad."""
        self.value: np.ndarray = np.ones((segments, 2))
        self.error: np.ndarray = np.full((segments, 2), math.nan)
        self._gain = gain
        self._missed: np.ndarray = np.full((segments, 2), math.inf)
        self._bound = np.zeros((segments, 2), dtype=int)
        self._converged = False

    def learn(self, time: float, chambers: np.ndarray, peak: np.ndarray, target: np.ndarray) -> list[Event]:
        """Update the duties of some chambers, shape (segments, 2), and return where bounds are met or left.

        Args:
            time: s.
            chambers: whose period has ended.
            peak: the amplitudes measured in it, same shape, rad.
            target: same shape, rad.
        """
        self.error = np.where(chambers, target - peak, self.error)
        self._missed = np.where(chambers, np.abs(target - peak) / target, self._missed)
        wanted = np.where(chambers, self.value + self._gain * self.error, self.value)
        self.value = np.clip(wanted, 0.0, 1.0)
        bound = (wanted > 1 + _ROUNDING).astype(int) - (wanted < -_ROUNDING)
        bound = np.where(chambers, bound, self._bound)
        events = [
            Event(time, "saturation", f"segment {j + 1}, {SIDES[side]} chamber: {_met(bound[j, side])}")
            for j, side in np.argwhere(bound != self._bound)
        ]
        self._bound = bound
        return events

    def forget(self) -> None:
        """Have everything converge anew: the targets have changed."""
        self._missed = np.full_like(self._missed, math.inf)
        self._converged = False

    def converged(self, time: float, working: np.ndarray) -> list[Event]:
        """Return, once, that all amplitudes of the working segments, shape (segments,), are there."""
        there = bool(working.any() and (self._missed[working] <= WITHIN).all())
        if self._converged or not there:
            return []
        self._converged = True
        return [Event(time, "converged", f"all amplitudes are within {100 * WITHIN:g} % of their targets")]

    def summary(self, time: float, period: int, working: np.ndarray) -> list[Event]:
        """Return the event that tells of a round of updates; none where no segment works."""
        if not working.any() or np.isnan(self.error[working]).all():
            return []
        error = np.where(working[:, None], self.error, math.nan)
        j, side = np.unravel_index(np.nanargmax(np.abs(error)), error.shape)
        low, high = self.value[working].min(), self.value[working].max()
        text = (
            f"after period {period}: largest amplitude error {error[j, side]:+.3g} rad (segment {j + 1}, "
            f"{SIDES[int(side)]} chamber), duties now {low:.3g} to {high:.3g}"
        )
        return [Event(time, "ilc_update", text)]


def _met(bound: int) -> str:
    return {1: "duty saturated at 1", -1: "duty saturated at 0", 0: "duty no longer saturated"}[int(bound)]
