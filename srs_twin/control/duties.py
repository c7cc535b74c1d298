r"""The parts of iterative learning: each chamber's clock, its target, and the law of its duty (Eq. 32).

Targets: how far each side of the snake is to bend for a steering offset (Section 5.1). The side towards which
it turns keeps the amplitude A (0.7 rad in the text), the other one gets less, linear
in the offset φ, down to A · 4/7 (0.4 rad) at |φ| = 0.3:

$$ A_{\text{larger}} = A, \qquad
A_{\text{smaller}} = A \Bigl(1 - \tfrac{3}{7} \tfrac{|\varphi|}{0.3}\Bigr). $$

Cycles: each chamber has a clock of its own, and its segment's bend is measured in each of its periods.
Period n of a chamber runs from the begin of its n-th fill to that of the next. The bend that a fill causes
comes late, by air and inertia, but by less than the vent that follows: its whole peak falls into one period,
and what is learnt from it is there when the chamber fills again. One clock for all chambers, as Section 5.1
has it, cuts through the peaks of some of them, and gives a new duty in the middle of their fills.

Duties: the law of iterative learning, one duty a chamber (Eq. 32),

$$ u_n = \operatorname{clip}\bigl(u_{n-1} + k\,e_{n-1},\, 0,\, 1\bigr), \qquad
e_{n-1} = \text{target} - \text{amplitude}. $$

Where the amplitude is c u, the error shrinks by 1 − k c an update. What is bounded is the duty itself, not a
sum of errors behind it, so nothing winds up: it leaves its bound with the first error of the other sign.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.saved_state import Stateful
from srs_twin.trajectory import Event

LARGEST_OFFSET = 0.3
SMALLEST_SHARE = 4 / 7
"""0.4 of 0.7 rad."""


def checked_offset(offset: float) -> float:
    """Return an offset that has targets.

    Raises:
        InputError: it is beyond ±0.3.
    """
    if not abs(offset) <= LARGEST_OFFSET:
        raise InputError(
            f"ilc offset {offset!r} is not allowed; it must lie between -{LARGEST_OFFSET:g} and "
            f"{LARGEST_OFFSET:g}, for which Section 5.1 gives targets"
        )
    return float(offset)


def targets(amplitude: float, offset: float) -> np.ndarray:
    """Return how far to bend to the left and to the right, shape (2,), rad.

    Args:
        amplitude: A, rad.
        offset: φ, positive to the left.
    """
    smaller = amplitude * (1 - (1 - SMALLEST_SHARE) * abs(offset) / LARGEST_OFFSET)
    return np.array([amplitude, smaller] if offset >= 0 else [smaller, amplitude])


LEAST_READINGS = 8
"""Fewer readings a period do not show how far a segment bends."""

_ROUNDING = 1e-9  # of a period


class Cycles(Stateful):
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

    state_attributes = (
        *("begins", "number", "peak", "span", "lost", "since"),
        *("_most", "_least", "_seen", "_missed", "_next"),
    )

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


SIDES = ("+", "−")

WITHIN = 0.05
"""Share of its target by which an amplitude may miss it and still count as there."""

_DUTIES_ROUNDING = 1e-12


class Duties(Stateful):
    """Duty of each chamber, and what is worth telling of how it was learnt.

    Attributes:
        value: u, shape (segments, 2), from 0 to 1.
        error: e of the last update, same shape, rad; NaN before the first.
    """

    state_attributes = ("value", "error", "_missed", "_bound", "_converged")

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
        bound = (wanted > 1 + _DUTIES_ROUNDING).astype(int) - (wanted < -_DUTIES_ROUNDING)
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
