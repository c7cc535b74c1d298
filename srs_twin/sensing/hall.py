r"""HallSensor: a magnet and a Hall element on the strip in a segment's neutral axis, as a voltage.

**Strip and field.** The strip bends with constant curvature κ = q/l. The frame sits where the magnet does: x
along the strip towards the element and the head, y normal to it, to the left. At the arc length L the strip
has turned by θ = κL; the element stands h_s and the magnet's centre h_m to the left of the neutral axis
(both less than 0 on its other side):

$$ S = \begin{pmatrix} \sin\theta/\kappa - h_s \sin\theta \\
(1 - \cos\theta)/\kappa + h_s \cos\theta \end{pmatrix}, \qquad
M = \begin{pmatrix} 0 \\ h_m \end{pmatrix}. $$

The magnet is a point dipole with moment m, along y (`up`) or x (`side`), seen from r = S − M:

$$ B = \frac{\mu_0}{4\pi}\left(\frac{3\,(m\cdot r)\,r}{|r|^5} - \frac{m}{|r|^3}\right), $$

and the element measures what is normal to it, B_n = B_y cos θ − B_x sin θ (Eq. 1). θ in Eq. 1 is taken to
be the local angle κL: with the whole bend in its place a reading over ±90° would not be linear, let alone
monotonic (docs/sensor.md).

**Chambers.** A rectangular chamber rounds as soon as it is filled and presses on the strip beside it (Section
2.2.2, Fig. 14a, c). The filled chamber is on the outside of the bend, so it bows the strip against the bend;
once round, it presses no further. The strip then feels

$$ q_s = q - b\,q_c \tanh(q / q_c) $$

in place of the bend q: a slope of 1 − b at q = 0, less than 0 for b > 1, and 1 again beyond a few q_c. The
text says that such readings are not monotonic at small angles; its numbers are in a figure that is lost, so
b and q_c are estimates. The press is taken to follow the bend at rest, not the momentary pressure.

**Electronics.** Hall element, amplifier, converter:

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

from srs_twin.errors import InputError, UnknownNameError

PRESSED = {"semicircular": 0.0, "rectangular": 2.0}
"""b, by cross-section. Estimate: 2 turns the reading round, as fast backwards at q = 0 as it should rise."""

ROUND_AT = 0.15
"""q_c, the bend at which a rectangular chamber has become about round, rad (estimate, 8.6°)."""


def felt_bend(bend: np.ndarray, chamber: str) -> np.ndarray:
    """Return the bend that the strip feels, q_s, rad.

    Args:
        bend: q, rad, any shape; what is not finite stays so.
        chamber: a name in `PRESSED`.
    """
    press = PRESSED[chamber]
    if press == 0.0:
        return bend
    felt: np.ndarray = bend - press * ROUND_AT * np.tanh(bend / ROUND_AT)
    return felt


ORIENTATIONS = ("up", "side")
"""Where the magnet's north pole points: normal to the strip (the text's choice), or along it."""

_MU0_4PI = 1e-7  # T·m/A

INCH = 0.0254
"""m."""

MAGNET_HEIGHT = INCH / 32
"""Height of the magnet, a cylinder, m (Section 2.2.2)."""

MAGNET_DIAMETER = INCH / 16
"""Its diameter, m. Estimate: a stock size of that height; the text gives none."""

REMANENCE = 1.32
"""T. Estimate: NdFeB of grade N42, 1.29 to 1.33 T in makers' tables; the text names no grade."""

MOMENT = REMANENCE * math.pi / 4 * MAGNET_DIAMETER**2 * MAGNET_HEIGHT / (4 * math.pi * _MU0_4PI)
"""Magnetic moment, A·m²: remanence times volume over μ₀, 1.65e-3."""


@dataclass(frozen=True)
class Strip:
    """A magnet and a Hall element on a strip (module docstring).

    The heights are estimates: half of the flexible board (0.05 mm) and half of the magnet; the board and
    0.65 mm up to the element within a SOT-23 package. The text gives none.

    Attributes:
        segment_length: l, the length that bends by q, m.
        distance: L, arc length from magnet to element, m. The text chose 3.1 mm, of 3.1 to 4.6 mm studied.
        orientation: of the magnet, one of `ORIENTATIONS`.
        moment: |m|, A·m².
        magnet_height: h_m, m.
        element_height: h_s, m.
        chamber: cross-section of the pressure chambers, one of `chamber.PRESSED`; a rectangular one presses
            on the strip.
    """

    segment_length: float
    distance: float = 0.0031
    orientation: str = "up"
    moment: float = MOMENT
    magnet_height: float = 0.05e-3 + MAGNET_HEIGHT / 2
    element_height: float = 0.7e-3
    chamber: str = "semicircular"

    def __post_init__(self) -> None:
        if self.orientation not in ORIENTATIONS:
            raise UnknownNameError("magnet orientation", self.orientation, ORIENTATIONS)
        if self.chamber not in PRESSED:
            raise UnknownNameError("chamber cross-section", self.chamber, PRESSED)
        for name in ("segment_length", "distance", "moment"):
            _check(name, getattr(self, name), getattr(self, name) > 0, "above 0")
        if self.distance > self.segment_length:
            given = f"distance {self.distance:g} m from magnet to element is not allowed"
            raise InputError(f"{given}; the segment is {self.segment_length:g} m long")
        for name in ("magnet_height", "element_height"):
            value = getattr(self, name)
            if not abs(value) < self.distance / math.pi:
                raise InputError(
                    f"{name} {value!r} m is not allowed; at this distance it must be within "
                    f"±{self.distance / math.pi:.3g} m, or magnet and element meet when the strip bends"
                )


def dipole(x: np.ndarray, y: np.ndarray, m_x: float, m_y: float) -> tuple[np.ndarray, np.ndarray]:
    """Return B_x and B_y (T) of a dipole in the plane of its moment.

    Args:
        x: place seen from the dipole, m, any shape.
        y: same shape, m; not 0 where x is.
        m_x: moment, A·m².
        m_y: A·m².
    """
    square = x * x + y * y
    cube = square * np.sqrt(square)
    along = 3 * (m_x * x + m_y * y) / square
    return _MU0_4PI * (along * x - m_x) / cube, _MU0_4PI * (along * y - m_y) / cube


def element_place(bend: np.ndarray | float, strip: Strip) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x and y of the element seen from the magnet (r, m) and the angle θ it has turned by, rad.

    Arguments as in `field`.
    """
    theta = felt_bend(np.asarray(bend, dtype=float), strip.chamber) * (strip.distance / strip.segment_length)
    theta = np.where(np.abs(theta) <= math.pi, theta, np.nan)
    # (sin θ, 1 − cos θ)/κ as a chord at θ/2, smooth through κ = 0; np.sinc has π inside.
    chord = strip.distance * np.sinc(theta / (2 * math.pi))
    x = chord * np.cos(theta / 2) - strip.element_height * np.sin(theta)
    y = chord * np.sin(theta / 2) + strip.element_height * np.cos(theta) - strip.magnet_height
    return x, y, theta


def field(bend: np.ndarray | float, strip: Strip) -> np.ndarray:
    """Return the field normal to the element, B_n, T.

    Args:
        bend: q of the segment, rad, any shape. Where it is no number, or bends the strip between magnet
            and element by more than half a turn, so is the result (NaN).
        strip: where magnet and element are.
    """
    x, y, theta = element_place(bend, strip)
    m_x, m_y = (0.0, strip.moment) if strip.orientation == "up" else (strip.moment, 0.0)
    b_x, b_y = dipole(x, y, m_x, m_y)
    normal: np.ndarray = b_y * np.cos(theta) - b_x * np.sin(theta)
    return normal


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
        code = _within(np.floor((output - low) / self.step), 0, 2**self.bits - 1)
        read: np.ndarray = low + (code + 0.5) * self.step
        return read


def _within(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return np.clip of one reading in a third of its time; NaN stays NaN."""
    clipped: np.ndarray = np.minimum(np.maximum(values, low), high)
    return clipped


def _check(name: str, value: float, ok: bool, allowed: str) -> None:
    if not (math.isfinite(value) and ok):
        raise InputError(f"{name} {value!r} is not allowed; it must be finite and {allowed}")
