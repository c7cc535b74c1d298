r"""Duty cycles and target amplitudes in iterative learning control (Section 5.1).

**Target amplitudes.** The chambers on the inner side of a turn have the target
amplitude A, which is 0.7 rad in the dissertation. The target amplitude on the outer
side decreases linearly with |φ|, to 4 A / 7 (0.4 rad) at |φ| = 0.3:

$$ A_{\text{larger}} = A, \qquad
A_{\text{smaller}} = A \Bigl(1 - \tfrac{3}{7} \tfrac{|\varphi|}{0.3}\Bigr). $$

**Periods.** The bend amplitude of each chamber is measured over the chamber's own
period. Period n of a chamber begins when the chamber starts to fill for the n-th time,
and ends when the chamber starts to fill again. Due to air flow and inertia, the bend
reaches its peak after the end of the fill, but before the chamber fills again. The peak
therefore lies within one period, and the duty cycle is updated before the next fill.
With one period for all chambers, as in Section 5.1, the period of some chambers would
end during a bend peak, and their duty cycles would change during a fill.

**Learning law.** The duty cycle u of each chamber is updated once per period (Eq. 32):

$$ u_n = \operatorname{clip}\bigl(u_{n-1} + k\,e_{n-1},\, 0,\, 1\bigr), \qquad
e_{n-1} = \text{target} - \text{amplitude}. $$

If the amplitude is equal to c u with a constant c, each update multiplies the amplitude
error e by 1 − k c. Clipping the duty cycle avoids integrator wind-up, because a
saturated duty cycle leaves its bound as soon as the error changes sign.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.saved_state import Stateful
from srs_twin.trajectory import Event

MAX_OFFSET = 0.3
"""Maximum |φ| for which Section 5.1 gives target amplitudes, dimensionless."""
MIN_AMPLITUDE_RATIO = 4 / 7
"""Ratio of the smaller to the larger target amplitude at the maximum steering offset
(0.4 rad / 0.7 rad), dimensionless."""
MIN_READINGS_PER_PERIOD = 8
"""Minimum number of bend readings per gait period."""
SIDES = ("+", "−")
"""Names of the two chambers of a segment, in the order of the last array axis."""
CONVERGENCE_TOLERANCE = 0.05
"""Maximum relative amplitude error of a converged chamber, dimensionless."""

_PERIOD_ROUNDING = 1e-9
"""Tolerance for comparing times, as a fraction of a gait period."""
_DUTY_ROUNDING = 1e-12


def validated_offset(offset: float) -> float:
    """Check a steering offset and return it as a float.

    Raises:
        InputError: the magnitude of the offset exceeds `MAX_OFFSET`.
    """
    if not abs(offset) <= MAX_OFFSET:
        raise InputError(
            f"ilc offset {offset!r} is not allowed; it must be between -{MAX_OFFSET:g}"
            f" and {MAX_OFFSET:g}, the offsets for which the dissertation gives targets"
            " (Section 5.1)"
        )
    return float(offset)


def targets(amplitude: float, offset: float) -> np.ndarray:
    """Return the target amplitudes for bends to the left and right, shape (2,), rad.

    Args:
        amplitude: target amplitude A of a straight gait, rad.
        offset: steering offset φ, positive to the left.
    """
    smaller = amplitude * (1 - (1 - MIN_AMPLITUDE_RATIO) * abs(offset) / MAX_OFFSET)
    left_and_right = np.array([amplitude, smaller])
    return left_and_right if offset >= 0 else left_and_right[::-1]


class ChamberPeriods(Stateful):
    """Gait periods of all chambers, and the bend amplitudes measured in these periods.

    All arrays have one value per chamber and the shape (segments, 2).

    Attributes:
        period: duration T of a gait period, s.
        fill_starts: start time of the first fill, between −T/2 and T/2 without
            steering, s. If it is negative, the chamber is already filling at time 0.
        number: number of the current period, counted from 1, or 0 before the first
            period.
        peak: maximum bend to the left (+ chamber) or to the right (− chamber) in the
            last completed period, rad.
        span: difference between the maximum and minimum bend readings in the last
            completed period, rad.
        lost: fraction of lost readings in the last completed period, dimensionless.
        started: start time of the last completed period, s.
    """

    state_attributes = (
        *("fill_starts", "number", "peak", "span", "lost", "started"),
        *("_max", "_min", "_readings", "_lost_readings", "_next"),
    )

    def __init__(self, phase_lag: np.ndarray, frequency: float, tick: float) -> None:
        """Initialise the periods at time 0.

        Args:
            phase_lag: phase lag in the wave sin(2πft − phase_lag) of each segment,
                shape (segments,), rad. The + chamber fills while the wave is positive,
                and the − chamber fills while the wave is negative.
            frequency: gait frequency f, Hz.
            tick: time between successive bend readings, s.

        Raises:
            InputError: a gait period contains too few readings.
        """
        self.period = 1 / frequency
        self._tick = tick
        if self.period / tick < MIN_READINGS_PER_PERIOD * (1 - _PERIOD_ROUNDING):
            raise InputError(
                f"at {frequency:g} Hz and with a tick of {tick:g} s, a gait period contains"
                f" fewer than {MIN_READINGS_PER_PERIOD} readings; use a tick of at most"
                f" {self.period / MIN_READINGS_PER_PERIOD:.4g} s, or a frequency of at"
                f" most {1 / (MIN_READINGS_PER_PERIOD * tick):.4g} Hz"
            )
        fraction = np.stack([phase_lag, phase_lag + math.pi], axis=-1) / (2 * math.pi)
        fraction = (fraction + _PERIOD_ROUNDING) % 1 - _PERIOD_ROUNDING
        fraction[fraction > 0.5 + _PERIOD_ROUNDING] -= 1
        self.fill_starts = fraction * self.period
        self.number = np.where(self.fill_starts < -_PERIOD_ROUNDING * self.period, 1, 0)
        self.peak: np.ndarray = np.full(fraction.shape, math.nan)
        self.span: np.ndarray = np.full(fraction.shape, math.nan)
        self.lost: np.ndarray = np.zeros(fraction.shape)
        self.started: np.ndarray = np.full(fraction.shape, -math.inf)
        self._max = np.full(fraction.shape, -math.inf)
        self._min = np.full(fraction.shape, math.inf)
        self._unsteered = self.fill_starts
        self._bends: np.ndarray = np.zeros(fraction.shape)
        self._readings = np.zeros(fraction.shape)
        self._lost_readings = np.zeros(fraction.shape)
        self._set_next()

    def steer(self, shift: float) -> None:
        """Shift the start times of the fills for a steering offset φ (Eq. 13).

        Args:
            shift: phase shift asin φ, rad. If it is positive, + chambers start to fill
                earlier and − chambers start to fill later.
        """
        lead = shift / (2 * math.pi) * self.period
        self.fill_starts = self._unsteered + lead * np.array([-1, 1])
        self._set_next()

    def update(self, reading: np.ndarray, lost: np.ndarray) -> None:
        """Add the bend readings (rad) of one tick, and the mask of lost readings."""
        bends = self._bends
        bends[:, 0] = reading
        np.negative(reading, out=bends[:, 1])
        np.maximum(self._max, bends, out=self._max)
        np.minimum(self._min, bends, out=self._min)
        self._readings += 1
        self._lost_readings += lost[:, None]

    def due(self, time: float) -> bool:
        """Return whether any period begins in the tick that starts at `time` (s)."""
        return time + self._tick > self._next

    def advance(self, time: float) -> np.ndarray:
        """Begin new periods in the tick that starts at `time` (s).

        Returns:
            Mask of the chambers that have completed a period, shape (segments, 2).
        """
        latest = time + self._tick - _PERIOD_ROUNDING * self.period
        begun = self.fill_starts + self.number * self.period < latest
        ended = begun & (self.number >= 1)
        self.peak = np.where(ended, self._max, self.peak)
        self.span = np.where(ended, self._max - self._min, self.span)
        lost = self._lost_readings / np.maximum(self._readings, 1)
        self.lost = np.where(ended, lost, self.lost)
        started = self.fill_starts + (self.number - 1) * self.period
        self.started = np.where(ended, started, self.started)
        self._max[begun] = -math.inf
        self._min[begun] = math.inf
        self._readings[begun] = self._lost_readings[begun] = 0
        self.number = self.number + begun
        self._set_next()
        return ended

    def _set_next(self) -> None:
        starts = self.fill_starts + self.number * self.period
        self._next = float(starts.min()) + _PERIOD_ROUNDING * self.period


class Duties(Stateful):
    """Duty cycles that are adapted by the learning law (Eq. 32).

    Attributes:
        value: duty cycle u of each chamber, from 0 to 1, shape (segments, 2).
        error: amplitude error e of each chamber in its last update, or NaN before the
            first update, shape (segments, 2), rad.
    """

    state_attributes = (
        "value",
        "error",
        "_relative_error",
        "_saturation",
        "_converged",
    )

    def __init__(self, segments: int, gain: float) -> None:
        """Initialise all duty cycles to 1, for a learning gain k (1/rad)."""
        self.value: np.ndarray = np.ones((segments, 2))
        self.error: np.ndarray = np.full((segments, 2), math.nan)
        self._gain = gain
        self._relative_error: np.ndarray = np.full((segments, 2), math.inf)
        self._saturation = np.zeros((segments, 2), dtype=int)
        self._converged = False

    def learn(
        self, time: float, chambers: np.ndarray, peak: np.ndarray, target: np.ndarray
    ) -> list[Event]:
        """Update the duty cycles of selected chambers and return saturation events.

        The mask `chambers`, the measured amplitudes `peak` (rad) and the target
        amplitudes (rad) have shape (segments, 2).
        """
        self.error = np.where(chambers, target - peak, self.error)
        relative = np.abs(target - peak) / target
        self._relative_error = np.where(chambers, relative, self._relative_error)
        unclipped = np.where(chambers, self.value + self._gain * self.error, self.value)
        self.value = np.clip(unclipped, 0.0, 1.0)
        saturation = 1 * (unclipped > 1 + _DUTY_ROUNDING)
        saturation[unclipped < -_DUTY_ROUNDING] = -1
        saturation = np.where(chambers, saturation, self._saturation)
        events = []
        for j, k in np.argwhere(saturation != self._saturation):
            what = _SATURATIONS[saturation[j, k]]
            text = f"segment {j + 1}, {SIDES[k]} chamber: {what}"
            events.append(Event(time, "saturation", text))
        self._saturation = saturation
        return events

    def restart_convergence(self) -> None:
        """Reset the convergence test after a change of the target amplitudes."""
        self._relative_error = np.full_like(self._relative_error, math.inf)
        self._converged = False

    def converged(self, time: float, working: np.ndarray) -> list[Event]:
        """Return one event when all working segments reach their target amplitudes."""
        errors = self._relative_error[working]
        reached = errors.size and (errors <= CONVERGENCE_TOLERANCE).all()
        if self._converged or not reached:
            return []
        self._converged = True
        text = (
            f"all amplitudes are within {100 * CONVERGENCE_TOLERANCE:g} % of their"
            " targets"
        )
        return [Event(time, "converged", text)]

    def summary(self, time: float, period: int, working: np.ndarray) -> list[Event]:
        """Return an event with the largest amplitude error of the working segments."""
        if not working.any() or np.isnan(self.error[working]).all():
            return []
        error = np.where(working[:, None], self.error, math.nan)
        j, side = np.unravel_index(np.nanargmax(np.abs(error)), error.shape)
        low = self.value[working].min()
        high = self.value[working].max()
        text = (
            f"after period {period}: largest amplitude error {error[j, side]:+.3g} rad"
            f" (segment {j + 1}, {SIDES[int(side)]} chamber), duties now {low:.3g} to"
            f" {high:.3g}"
        )
        return [Event(time, "ilc_update", text)]


_SATURATIONS = {
    1: "duty saturated at 1",
    -1: "duty saturated at 0",
    0: "duty no longer saturated",
}
