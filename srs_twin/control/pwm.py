"""Pulse-width modulation of valves in time slots shorter than a control tick."""

from __future__ import annotations

import numpy as np

from srs_twin.compute.arrays import check_positive
from srs_twin.errors import InputError, count_steps
from srs_twin.io.saved_state import Stateful
from srs_twin.pneumatics.valves import valve_slot
from srs_twin.robot.scale import SHIPPED, Scale


class PulseWidthModulator(Stateful):
    """Pulse-width modulator for 3/2 valves.

    In each carrier period, a chamber fills during one pulse and vents for the rest of
    the period. The duty cycle is the ratio of the pulse duration to the carrier period.
    By default, a period begins with the pulse of the + chamber and ends with the pulse
    of the − chamber. If the two duty cycles add up to 1, the two valves are then always
    in opposite states, as in Fig. 45c. If `aligned` is True, all pulses are at the
    start of the period.

    The carrier period need not be a multiple of the tick or of the slot duration. A
    chamber fills in a slot if the centre of the slot lies within the pulse. Rounding to
    slots changes the duration of a pulse by at most one slot, but does not change the
    mean duration over many periods. A valve opens at most once per period, and does not
    switch if the duty cycle is 0 or 1.

    Pulses shorter than the valve switching time of 3 ms are not suppressed.
    `LagPneumatics` smooths such pulses, because its time constant τ₂ includes the
    switching time.

    Attributes:
        period: carrier period, s.
        duty: duty cycles in the current carrier period, shape (segments, chambers).
    """

    state_attributes = ("_ticks", "_period_number", "duty")

    def __init__(
        self,
        carrier_hz: float,
        tick: float,
        segments: int,
        *,
        aligned: bool = False,
        allow_long_ticks: bool = False,
        scale: Scale = SHIPPED,
        chambers: int = 2,
    ) -> None:
        """Create a modulator at the start of a carrier period.

        Args:
            carrier_hz: carrier frequency, Hz.
            tick: control tick, s.
            segments: number of segments.
            aligned: whether the pulses of all chambers begin at the start of the
                period.
            allow_long_ticks: whether a tick may be longer than a carrier period. Long
                ticks suit controllers that rarely update the duty cycles.
            scale: scale of the robot, which determines the slot duration.
            chambers: number of chambers per segment, which must be 2 unless `aligned`
                is True.

        Raises:
            InputError: the carrier frequency or the tick is not positive, or the tick
                is longer than a carrier period although `allow_long_ticks` is False.
        """
        check_positive("carrier_hz", carrier_hz)
        slot = valve_slot(tick, scale)
        self._slots = count_steps("tick", tick, "valve slot", slot)
        self.period = 1 / carrier_hz
        if tick > self.period and not allow_long_ticks:
            raise InputError(
                f"a carrier of {carrier_hz:g} Hz is too fast for the tick of {tick:g}"
                f" s; use {1 / tick:g} Hz or less, or a shorter tick"
            )
        self._aligned = aligned
        self._periods_per_slot = carrier_hz * slot
        self._ticks = 0
        self._period_number = -1
        self.duty = np.zeros((segments, chambers))

    def due(self) -> bool:
        """Return whether a carrier period begins in the next control tick."""
        last_period = int(self._elapsed_periods()[-1])
        return last_period != self._period_number

    def step(self, duty: np.ndarray) -> np.ndarray:
        """Return the valve states for the next control tick.

        Args:
            duty: duty cycles for the carrier periods that begin in this tick, from 0 to
                1, shape (segments, chambers).

        Returns:
            Valve states of type int8, +1 to fill and −1 to vent, shape (slots,
            segments, chambers).

        Raises:
            InputError: a duty cycle is outside 0 to 1, or the shape is wrong.
        """
        new_duty = np.asarray(duty, dtype=float)
        if new_duty.shape != self.duty.shape:
            raise InputError(
                f"duties of shape {new_duty.shape} are not allowed; their shape must"
                f" be {self.duty.shape}"
            )
        outside = ~((new_duty >= 0) & (new_duty <= 1))
        if outside.any():
            raise InputError(
                f"duty {new_duty[outside][0]:g} is not allowed; it must be between 0"
                " and 1"
            )
        elapsed = self._elapsed_periods()
        number = np.floor(elapsed)
        new_period = (number != self._period_number)[:, None, None]
        duties = np.where(new_period, new_duty, self.duty)
        phase = (elapsed - number)[:, None]
        if self._aligned:
            filling = phase[..., None] < duties
        else:
            filling = np.stack(
                [phase < duties[..., 0], phase >= 1 - duties[..., 1]], axis=-1
            )
        self._period_number = int(number[-1])
        self.duty = duties[-1]
        self._ticks += 1
        return np.where(filling, 1, -1).astype(np.int8)

    def _elapsed_periods(self) -> np.ndarray:
        """Return the time at each slot centre of the next tick, in carrier periods."""
        slots = self._ticks * self._slots + np.arange(self._slots)
        return (slots + 0.5) * self._periods_per_slot
