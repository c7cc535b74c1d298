r"""Sliding mode control: what both controllers of Chapter 4 share.

They bring the sensed bend q of each segment to a reference r by way of the sliding variable

$$ \sigma = \dot e + D e, \qquad e = r - q \qquad (\text{Eq. 24, 31}): $$

on σ = 0 the error fades as e^{−Dt}. How they find ė from noisy readings, and how σ becomes valve states, is
each controller's own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.control.base import Controller
from srs_twin.control.readings import Readings
from srs_twin.control.reference import Reference
from srs_twin.errors import InputError
from srs_twin.spec import RobotSpec
from srs_twin.trajectory import Event

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState

Gain = float | np.ndarray
"""One number for all segments, or one for each, shape (segments,)."""


class SlidingMode(Controller):
    """Follows a reference with every segment, each by itself, from its sensed bend alone.

    Lost readings are dealt with by `Readings`.

    Attributes:
        reference: the bend to follow.
    """

    def __init__(self, reference: Reference, **gains: Gain) -> None:
        for name, value in gains.items():
            if not (np.isfinite(value).all() and np.all(np.asarray(value) > 0)):
                raise InputError(
                    f"{self.kind}: {name} {value!r} is not allowed; it must be finite and above 0"
                )
        self.reference = reference
        self._gains = gains

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`.

        Raises:
            InputError: gains of another shape than one number or one a segment.
        """
        for name, value in self._gains.items():
            if np.shape(value) not in ((), (spec.segments,)):
                raise InputError(
                    f"{self.kind}: {name} has shape {np.shape(value)}; give one number, or one for each of "
                    f"the {spec.segments} segments"
                )
        self._tick = tick
        self._readings = Readings(spec.segments)
        self._reading = self._readings.value
        self._cut = False
        self._wanted = np.full(spec.segments, float(self.reference.value(0.0)))
        self._error = np.zeros(spec.segments)
        self._sigma = np.zeros(spec.segments)
        self._events: list[Event] = []

    def signals(self) -> dict[str, Any]:
        """Return the reference at the end of the tick, where a sample is taken, and e and σ at its begin."""
        return {"reference": self._wanted, "error": self._error, "sigma": self._sigma}

    def events(self) -> list[Event]:
        """Return where the reference began to be cut, and readings lost and found again."""
        events, self._events = self._events, []
        return events

    def _look(self, state: SnakeState) -> float:
        """Take the readings of a tick into `_reading` and the reference after it; return the time (s)."""
        time = float(state.time)
        self._events += self._readings.take(time, state.sensed)
        self._reading = self._readings.value
        self._wanted = np.full(self._reading.shape, float(self.reference.value(time + self._tick)))
        cut = bool(self.reference.beyond(time))
        if cut and not self._cut:
            text = f"the reference goes beyond the module's range and is cut at {self.reference.peak:.4g} rad"
            self._events.append(Event(time, "saturation", text))
        self._cut = self._cut or cut
        return time
