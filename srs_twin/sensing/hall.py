"""HallSensor: from the bend of a segment to the voltage that its controller reads.

Hall element, amplifier, converter:

    element output   s B_n + n                        s sensitivity, n noise
    amplifier        V = V₀ + bias + G (1 + e) (s (B_n − B_n(0)) + n), held within the rails
    converter        the middle of the step that V falls in, 2^bits steps over the converter's range

The amplifier is balanced on the straight strip, as one trims it after assembly: without this, G times the
resting field (54 G) would be far beyond the rails. `bias` and `gain_error` are what has changed since the
calibration (temperature, supply, a magnet that slipped).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from srs_twin.errors import InputError
from srs_twin.sensing.strip import Strip, field

GAUSS = 1e-4
"""T."""

SPAN = math.pi / 2
"""Bends that the text designs the sensor for, ± rad (Section 2.2.2)."""

USED = 0.8
"""Share of the rails' distance that a trimmed amplifier uses over its span."""


@dataclass(frozen=True)
class HallSensor:
    """A strip with its electronics (module docstring).

    Sensitivity and noise are estimates from data sheets of the 49E class, to which the text's AH49E belongs:
    1.6 to 2.0 mV/G at 5 V; 90 µV in 10 kHz, of which an amplifier of 500 Hz lets 25 µV pass. Rails and
    converter are those of an Arduino Pro Mini (Section 2.3.2 for generation 3): 5 V, 10 bits.

    Attributes:
        strip: geometry and magnet.
        gain: G; `trimmed` finds one.
        sensitivity: s, V/T.
        offset: V₀, output of the straight segment, V.
        rails: lowest and highest output of the amplifier, V.
        noise: RMS of the element's noise that the amplifier lets pass, V at the element's output.
        bits: of the converter; None for one without steps.
        converter_range: V.
        bias: V at the amplifier's output, since the calibration.
        gain_error: e, share of the gain, since the calibration.
    """

    strip: Strip
    gain: float
    sensitivity: float = 1.8e-3 / GAUSS
    offset: float = 2.5
    rails: tuple[float, float] = (0.0, 5.0)
    noise: float = 25e-6
    bits: int | None = 10
    converter_range: tuple[float, float] = (0.0, 5.0)
    bias: float = 0.0
    gain_error: float = 0.0

    def __post_init__(self) -> None:
        _check("gain", self.gain, self.gain > 0, "above 0")
        _check("sensitivity", self.sensitivity, self.sensitivity != 0, "other than 0 V/T")
        _check("noise", self.noise, self.noise >= 0, "0 V or more")
        _check("bias", self.bias, True, "a voltage")
        _check("gain_error", self.gain_error, self.gain_error > -1, "above -1")
        for name in ("rails", "converter_range"):
            low, high = getattr(self, name)
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise InputError(f"{name} {low!r} to {high!r} V is not allowed; it must be a finite range")
        low, high = self.rails
        _check("offset", self.offset, low < self.offset < high, f"between the rails, {low:g} and {high:g} V")
        if self.bits is not None and not 1 <= self.bits <= 32:
            raise InputError(f"bits {self.bits!r} is not allowed; it must be 1 to 32, or none")

    @classmethod
    def trimmed(cls, strip: Strip, *, span: float = SPAN, **electronics: object) -> HallSensor:
        """Return a sensor whose gain makes use of `USED` of the rails over ± span.

        Args:
            strip: geometry and magnet.
            span: rad.
            **electronics: other attributes.

        Raises:
            InputError: a strip whose field does not change with the bend, or an attribute out of range.
        """
        unit = cls(strip, gain=1.0, **electronics)  # type: ignore[arg-type]
        low, high = unit.rails
        room = USED * (high - low) / 2 - abs((high + low) / 2 - unit.offset)
        swing = abs(unit.sensitivity) * np.abs(unit.field_change(np.linspace(-span, span, 181))).max()
        if not (room > 0 and swing > 0):
            raise InputError(
                f"no gain suits this sensor: its element swings by {swing:g} V over ±{span:g} rad "
                f"and its output may swing by {room:g} V about {unit.offset:g} V"
            )
        return cls(strip, gain=room / swing, **electronics)  # type: ignore[arg-type]

    @property
    def step(self) -> float:
        """Step of the converter, V; 0 without one."""
        low, high = self.converter_range
        return 0.0 if self.bits is None else (high - low) / 2**self.bits

    @cached_property
    def _resting(self) -> np.ndarray:
        return field(0.0, self.strip)

    def field_change(self, bend: np.ndarray | float) -> np.ndarray:
        """Return B_n − B_n(0), T, at bends (rad, any shape)."""
        return field(bend, self.strip) - self._resting

    def voltage(self, bend: np.ndarray | float, noise: np.ndarray | float = 0.0) -> np.ndarray:
        """Return what the controller reads, V.

        Args:
            bend: rad, any shape. Where it is no number, so is the reading: a state that is none must not
                become a plausible voltage.
            noise: standard normal numbers that broadcast against the bends.
        """
        element = self.sensitivity * self.field_change(bend) + self.noise * np.asarray(noise)
        output = self.offset + self.bias + self.gain * (1 + self.gain_error) * element
        output = _within(output, *self.rails)
        low, high = self.converter_range
        if self.bits is None:
            return _within(output, low, high)
        step = self.step
        code = _within(np.floor((output - low) / step), 0, 2**self.bits - 1)
        read: np.ndarray = low + (code + 0.5) * step
        return read


def _within(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return np.clip of one reading in a third of its time; NaN stays NaN."""
    clipped: np.ndarray = np.minimum(np.maximum(values, low), high)
    return clipped


def _check(name: str, value: float, ok: bool, allowed: str) -> None:
    if not (math.isfinite(value) and ok):
        raise InputError(f"{name} {value!r} is not allowed; it must be finite and {allowed}")
