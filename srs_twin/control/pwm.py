"""PulseWidth: duties of a carrier as valve states, on a raster that is finer than a tick."""

from __future__ import annotations

import math

import numpy as np

from srs_twin.compute.arrays import check_positive
from srs_twin.errors import InputError, count_steps
from srs_twin.io.saved_state import Stateful
from srs_twin.pneumatics.valves import SLOT_S


class PulseWidth(Stateful):
    """Pulse-width modulation of 3/2 valves: each fills for a share of a carrier period, then vents.

    The + chamber's pulse begins its period and the − chamber's ends it, so that two duties that add up to 1
    make each valve the opposite of the other, as Fig. 45c shows them; or both pulses begin their period
    (`together`), so that neither chamber is treated otherwise than the other. A period need be no whole
    number of ticks nor of slots: slot s belongs to the period, and to the pulse, in which its middle lies.
    A pulse is a slot long or short at most, and over many periods the duties are exact. A valve opens once
    a period at most; at duties of 0 and 1 it rests.

    The 3 ms that a valve takes to switch are part of τ₂ (`LagPneumatics`): pulses shorter than that are
    smoothed there, not left out here.

    Attributes:
        period: of the carrier, s.
        duty: of the period that runs, shape (segments, 2).
    """

    state_attributes = ("_ticks", "_running", "duty")

    def __init__(
        self,
        carrier_hz: float,
        tick: float,
        segments: int,
        *,
        together: bool = False,
        long_ticks: bool = False,
    ) -> None:
        """Make a modulator at the begin of a period.

        Args:
            carrier_hz: Hz.
            tick: s, a multiple of the slot of 0.1 ms.
            segments: how many have two chambers each.
            together: whether the − chamber's pulse begins its period as the + chamber's does.
            long_ticks: whether a tick may be longer than a period, for a controller that has no new duty
                for every period.

        Raises:
            InputError: a carrier or tick it cannot do: the tick must not be longer than a period, unless
                `long_ticks`.
        """
        check_positive("carrier_hz", carrier_hz)
        self._slots = count_steps("tick", tick, "valve slot", SLOT_S)
        self.period = 1 / carrier_hz
        if tick > self.period and not long_ticks:
            raise InputError(
                f"a carrier of {carrier_hz:g} Hz does not fit the tick {tick:g} s; "
                f"{1 / tick:g} Hz or less, or a shorter tick, would"
            )
        self._together = together
        self._share = carrier_hz * SLOT_S
        self._ticks = 0
        self._running = -1
        self.duty = np.zeros((segments, 2))

    def due(self) -> bool:
        """Say whether a period begins in the coming tick, for which `step` then takes the duties."""
        return self._last_period() != self._running

    def step(self, duty: np.ndarray) -> np.ndarray:
        """Return the valves of the coming tick.

        Args:
            duty: shares of a period for which to fill the + and − chambers, shape (segments, 2); heeded
                where a period begins, else the running one goes on with its own.

        Returns:
            +1 fill, −1 vent, shape (slots, segments, 2), int8.

        Raises:
            InputError: duties outside 0 to 1, or of another shape.
        """
        coming = np.asarray(duty, dtype=float)
        if coming.shape != self.duty.shape:
            raise InputError(f"duties have shape {coming.shape}; allowed: {self.duty.shape}")
        outside = ~((coming >= 0) & (coming <= 1))
        if outside.any():
            raise InputError(f"duty {coming[outside][0]:g} is not allowed; it must lie between 0 and 1")
        through = (self._ticks * self._slots + np.arange(self._slots) + 0.5) * self._share
        number = np.floor(through)
        fresh = (number != self._running)[:, None, None]
        duties = np.where(fresh, coming, self.duty)
        phase = (through - number)[:, None]
        if self._together:
            filling = phase[..., None] < duties
        else:
            filling = np.stack([phase < duties[..., 0], phase >= 1 - duties[..., 1]], axis=-1)
        self._running, self.duty = int(number[-1]), duties[-1]
        self._ticks += 1
        return np.where(filling, 1, -1).astype(np.int8)

    def _last_period(self) -> int:
        """Return the number of the period to which the coming tick's last slot belongs."""
        return math.floor((self._ticks * self._slots + self._slots - 0.5) * self._share)
