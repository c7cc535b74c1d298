r"""Hall sensor on the neutral axis of a segment, and its calibration.

**Strip and field.** The strip bends with constant curvature κ = q/l. The coordinate
frame is at the magnet: x points along the strip towards the element and the head, and y
points to the left, normal to the strip. At the arc length L the strip has turned by θ =
κL. The element lies at the distance h_s to the left of the neutral axis, and the centre
of the magnet at h_m. Negative distances are to the right. The positions are

$$ S = \begin{pmatrix} \sin\theta/\kappa - h_s \sin\theta \\
(1 - \cos\theta)/\kappa + h_s \cos\theta \end{pmatrix}, \qquad
M = \begin{pmatrix} 0 \\ h_m \end{pmatrix}. $$

The magnet is a point dipole with moment m along y (`up`) or x (`side`). With r = S − M
the field of the magnet is

$$ B = \frac{\mu_0}{4\pi}\left(\frac{3\,(m\cdot r)\,r}{|r|^5} - \frac{m}{|r|^3}\right), $$

and the element measures the normal component of the field, B_n = B_y cos θ − B_x sin θ
(Eq. 1). θ in Eq. 1 is interpreted as the local angle κL. If θ were the whole bend q,
the reading over ±90° would be neither linear nor monotonic (docs/module.md#the-curvature-sensor).

**Chambers.** A rectangular chamber becomes round when it is filled and presses on the
adjacent strip (Section 2.2.2, Fig. 14a, c). The filled chamber is on the outside of the
bend, so it bows the strip against the bend. The displacement of the strip stops growing
when the chamber is round. With the strength b and the bend q_c at which the chamber is
nearly round, the bend of the strip is

$$ q_s = q - b\,q_c \tanh(q / q_c) . $$

The derivative of q_s is 1 − b at q = 0, negative for b > 1, and 1 for |q| ≫ q_c. The
dissertation states that such readings are not monotonic at small angles. The figure
with the values is lost, so b and q_c are estimates. The effect depends on the bend and
not on the instantaneous pressure.

**Electronics.** A Hall element, an amplifier and a converter form a chain:

- The element's output is s B_n + n, with the sensitivity s and the noise n.
- The amplifier's output is V = V₀ + bias + G (1 + e) (s (B_n − B_n(0)) + n), limited to
  the rails. It has the gain G and, on the straight strip, the output V₀.
- The converter returns the centre of the quantisation step of V, with 2^bits steps over
  its range.

The amplifier is balanced on the straight strip, as after assembly. Otherwise the
amplified field at rest (54 gauss) would far exceed the rails. `bias` and the gain error
e are changes since the calibration, caused by temperature, supply or a slipped magnet.

**Calibration** fits the straight line from the voltage to the bend. As in the
dissertation (Section 3.4.3, a line fit to the bending angle against the voltage), the
module is held at evenly spaced angles over ± span. The reading at each angle is
averaged until the noise vanishes, and the angle is regressed on the voltage by least
squares:

$$ q \approx a V + b. $$

All nonlinearity of the sensor (field, rails, a pressing chamber) remains in the
readings as an error. The maximum error is `worst_error`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from srs_twin.compute.arrays import Array, check_positive
from srs_twin.errors import InputError, UnknownNameError

STRIP_PRESSURE_FACTOR = {"semicircular": 0.0, "rectangular": 2.0}
"""Factor b by cross-section, dimensionless.

The estimate 2 reverses the sign of the reading's derivative at q = 0.
"""

ROUNDING_BEND_RAD = 0.15
"""Bend q_c at which a rectangular chamber has become nearly round, rad.

The value of 8.6° is an estimate.
"""


def strip_bend(bend: Array, chamber: str) -> Array:
    """Return the bend q_s of the strip, rad.

    Args:
        bend: bend q of the segment, any shape, rad; NaN stays NaN.
        chamber: cross-section of the chambers, a name in `STRIP_PRESSURE_FACTOR`.
    """
    factor = STRIP_PRESSURE_FACTOR[chamber]
    if factor == 0.0:
        return bend
    bend_of_strip: Array = bend - factor * ROUNDING_BEND_RAD * np.tanh(
        bend / ROUNDING_BEND_RAD
    )
    return bend_of_strip


ORIENTATIONS = ("up", "side")
"""Direction of the magnet's north pole: "up" is normal to the strip, "side" along it.

The dissertation uses a magnet normal to the strip.
"""

_MU0_4PI = 1e-7  # μ₀/4π, T·m/A

INCH = 0.0254
"""One inch, m."""

MAGNET_HEIGHT = INCH / 32
"""Height of the cylindrical magnet, m (Section 2.2.2)."""

MAGNET_DIAMETER = INCH / 16
"""Diameter of the magnet, m.

The dissertation does not state the diameter. The value is a stock size for the known
height.
"""

REMANENCE = 1.32
"""Remanence of the magnet, T. Estimate for NdFeB of grade N42, 1.29 to 1.33 T."""

MOMENT = (
    REMANENCE
    * math.pi
    / 4
    * MAGNET_DIAMETER**2
    * MAGNET_HEIGHT
    / (4 * math.pi * _MU0_4PI)
)
"""Magnetic moment, A·m²: remanence times volume over μ₀, 1.65e-3."""


@dataclass(frozen=True)
class Strip:
    """Magnet and Hall element on a strip; see the module docstring.

    The dissertation states neither height, so both are estimates. The centre of the
    magnet is above the neutral axis by half the flexible board (0.05 mm) and half the
    magnet. The element is above the neutral axis by half the board and 0.65 mm inside a
    SOT-23 package.

    Attributes:
        segment_length: length l that bends by q, m.
        distance: arc length L from the magnet to the element, m. The dissertation
            studied 3.1 to 4.6 mm and chose 3.1 mm.
        orientation: orientation of the magnet, one of `ORIENTATIONS`.
        moment: magnetic moment |m|, A·m².
        magnet_height: height h_m of the magnet's centre, m.
        element_height: height h_s of the element, m.
        chamber: cross-section of the chambers, a name in `STRIP_PRESSURE_FACTOR`; a
            rectangular chamber presses on the strip.
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
        if self.chamber not in STRIP_PRESSURE_FACTOR:
            raise UnknownNameError(
                "chamber cross-section", self.chamber, STRIP_PRESSURE_FACTOR
            )
        for name in ("segment_length", "distance", "moment"):
            _check(name, getattr(self, name), getattr(self, name) > 0, "above 0")
        if self.distance > self.segment_length:
            raise InputError(
                f"distance {self.distance:g} m from magnet to element is not allowed;"
                f" it must be at most the segment's length, {self.segment_length:g} m"
            )
        for name in ("magnet_height", "element_height"):
            value = getattr(self, name)
            if not abs(value) < self.distance / math.pi:
                raise InputError(
                    f"{name} {value!r} m is not allowed; at this distance it must be"
                    f" within ±{self.distance / math.pi:.3g} m, so that magnet and"
                    " element never touch"
                )


def dipole(x: Array, y: Array, m_x: float, m_y: float) -> tuple[Array, Array]:
    """Return the field B_x and B_y (T) of a dipole in the plane of its moment.

    Args:
        x: position relative to the dipole, any shape, m.
        y: position with the shape of x, m; not 0 where x is 0.
        m_x: moment along x, A·m².
        m_y: moment along y, A·m².
    """
    square = x * x + y * y
    cube = square * np.sqrt(square)
    along = 3 * (m_x * x + m_y * y) / square
    return _MU0_4PI * (along * x - m_x) / cube, _MU0_4PI * (along * y - m_y) / cube


def element_place(bend: Array | float, strip: Strip) -> tuple[Array, Array, Array]:
    """Return the position x, y (m) of the element relative to the magnet, and θ (rad).

    Args:
        bend: bend q of the segment, any shape, rad.
        strip: strip geometry.
    """
    theta = strip_bend(np.asarray(bend, dtype=float), strip.chamber) * (
        strip.distance / strip.segment_length
    )
    theta = np.where(np.abs(theta) <= math.pi, theta, np.nan)
    # (sin θ, 1 − cos θ)/κ is a chord in the direction θ/2 and smooth at κ = 0;
    # np.sinc(x) is sin(πx)/(πx).
    chord = strip.distance * np.sinc(theta / (2 * math.pi))
    x = chord * np.cos(theta / 2) - strip.element_height * np.sin(theta)
    y = (
        chord * np.sin(theta / 2)
        + strip.element_height * np.cos(theta)
        - strip.magnet_height
    )
    return x, y, theta


def field(bend: Array | float, strip: Strip) -> Array:
    """Return the field component B_n normal to the element, T.

    Args:
        bend: bend q of the segment, any shape, rad. The result is NaN for a NaN, and
            for a bend that turns the strip by more than half a revolution between
            magnet and element.
        strip: strip geometry.
    """
    x, y, theta = element_place(bend, strip)
    m_x, m_y = (0.0, strip.moment) if strip.orientation == "up" else (strip.moment, 0.0)
    b_x, b_y = dipole(x, y, m_x, m_y)
    normal: Array = b_y * np.cos(theta) - b_x * np.sin(theta)
    return normal


GAUSS = 1e-4
"""One gauss, T."""

SPAN = math.pi / 2
"""Maximum bend to both sides in the dissertation's design, rad (Section 2.2.2)."""

RAIL_FRACTION = 0.8
"""Fraction of the rail-to-rail voltage that a trimmed amplifier uses over its span."""


@dataclass(frozen=True)
class HallSensor:
    """Strip with its electronics; see the module docstring.

    Sensitivity and noise are estimates from data sheets of the 49E class, to which the
    AH49E of the dissertation belongs. The data sheets state 1.6 to 2.0 mV/G at 5 V. The
    noise of 90 µV in a bandwidth of 10 kHz corresponds to 25 µV in the amplifier's 500
    Hz. Rails and converter belong to an Arduino Pro Mini (Section 2.3.2 for generation
    3): 5 V, 10 bits.

    Attributes:
        strip: geometry and magnet.
        gain: amplification G, dimensionless; see `trimmed`.
        sensitivity: sensitivity s of the element, V/T.
        offset: output V₀ of the straight segment, V.
        rails: minimum and maximum output of the amplifier, V.
        noise: RMS noise of the element within the amplifier's bandwidth, V at the
            element's output.
        bits: number of bits of the converter; None for no quantisation.
        converter_range: voltage range of the converter, V.
        bias: change since the calibration, V at the amplifier's output.
        gain_error: relative change e of the gain since the calibration, dimensionless.
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
        _check(
            "sensitivity", self.sensitivity, self.sensitivity != 0, "other than 0 V/T"
        )
        _check("noise", self.noise, self.noise >= 0, "0 V or more")
        _check("bias", self.bias, True, "a voltage")
        _check("gain_error", self.gain_error, self.gain_error > -1, "above -1")
        for name in ("rails", "converter_range"):
            low, high = getattr(self, name)
            if not -math.inf < low < high < math.inf:
                raise InputError(
                    f"{name} {low!r} to {high!r} V is not allowed; it must be a finite"
                    " range"
                )
        low, high = self.rails
        _check(
            "offset",
            self.offset,
            low < self.offset < high,
            f"between the rails, {low:g} and {high:g} V",
        )
        if self.bits is not None and not 1 <= self.bits <= 32:
            raise InputError(
                f"bits {self.bits!r} is not allowed; it must be 1 to 32, or none"
            )

    @classmethod
    def trimmed(
        cls, strip: Strip, *, span: float = SPAN, **electronics: object
    ) -> HallSensor:
        """Return a sensor whose gain uses `RAIL_FRACTION` of the rails over ± span.

        Args:
            strip: geometry and magnet.
            span: maximum bend, rad.
            **electronics: other attributes.

        Raises:
            InputError: the field of the strip does not change with the bend, or an
                attribute is out of range.
        """
        unit = cls(strip, gain=1.0, **electronics)  # type: ignore[arg-type]
        low, high = unit.rails
        allowed = RAIL_FRACTION * (high - low) / 2 - abs((high + low) / 2 - unit.offset)
        swing = (
            abs(unit.sensitivity)
            * np.abs(unit.field_change(np.linspace(-span, span, 181))).max()
        )
        if not (allowed > 0 and swing > 0):
            raise InputError(
                f"no gain suits this sensor: the element's output changes by {swing:g}"
                f" V over ±{span:g} rad, and the amplifier's may change by {allowed:g}"
                f" V about {unit.offset:g} V"
            )
        return cls(strip, gain=allowed / swing, **electronics)  # type: ignore[arg-type]

    @property
    def step(self) -> float:
        """Quantisation step of the converter, V; 0 without quantisation."""
        low, high = self.converter_range
        return 0.0 if self.bits is None else (high - low) / 2**self.bits

    @cached_property
    def _field_at_rest(self) -> Array:
        return field(0.0, self.strip)

    def field_change(self, bend: Array | float) -> Array:
        """Return B_n − B_n(0) (T) at bends of any shape (rad)."""
        return field(bend, self.strip) - self._field_at_rest

    def voltage(self, bend: Array | float, noise: Array | float = 0.0) -> Array:
        """Return the voltage that the controller reads, V.

        Args:
            bend: bend of any shape, rad. A NaN gives NaN, because a diverged state must
                not become a plausible voltage.
            noise: standard normal numbers that broadcast with the bends.
        """
        random = self.noise * np.asarray(noise)
        element = self.sensitivity * self.field_change(bend) + random
        output = self.offset + self.bias + self.gain * (1 + self.gain_error) * element
        output = _within(output, *self.rails)
        low, high = self.converter_range
        if self.bits is None:
            return _within(output, low, high)
        code = _within(np.floor((output - low) / self.step), 0, 2**self.bits - 1)
        voltage: Array = low + (code + 0.5) * self.step
        return voltage


def _within(values: Array, low: float, high: float) -> Array:
    """Return the values clipped to a range; NaN stays NaN.

    The function is three times as fast as `np.clip`.
    """
    clipped: Array = np.minimum(np.maximum(values, low), high)
    return clipped


def _check(name: str, value: float, ok: bool, allowed: str) -> None:
    if not (math.isfinite(value) and ok):
        raise InputError(
            f"{name} {value!r} is not allowed; it must be finite and {allowed}"
        )


ANGLES = 181
"""Number of angles in a calibration: one per degree over ±90°."""

LEAST_R_SQUARED = 0.5
"""Minimum fraction of variance that the line must explain for a usable sensor."""


@dataclass(frozen=True)
class HallCalibration:
    """Straight line from voltage to bend, with its quality.

    Attributes:
        slope: slope a, rad/V.
        intercept: intercept b, rad.
        r_squared: fraction of the variance that the line explains, dimensionless.
        span: maximum angle to both sides, rad.
        voltage_range: minimum and maximum voltage, V.
        worst_error: maximum difference between line and angle, rad.
        monotonic: whether the voltage never reverses over the angles.
    """

    slope: float
    intercept: float
    r_squared: float
    span: float
    voltage_range: tuple[float, float]
    worst_error: float
    monotonic: bool

    def angle(self, voltage: Array | float) -> Array:
        """Return the bends (rad) for voltages of any shape (V).

        The line continues beyond the span.
        """
        return self.slope * np.asarray(voltage) + self.intercept


def fit_line(voltage: Array, angle: Array) -> HallCalibration:
    """Fit a line to measured pairs of voltage and angle.

    Args:
        voltage: voltage at each angle, shape (angles,), V.
        angle: ascending angles, shape (angles,), rad.

    Raises:
        InputError: there are fewer than 3 pairs, a value is not finite, or all voltages
            are equal.
    """
    voltage = np.asarray(voltage, dtype=float)
    angle = np.asarray(angle, dtype=float)
    if voltage.ndim != 1 or voltage.shape != angle.shape or len(voltage) < 3:
        raise InputError(
            "a calibration needs 3 or more pairs of voltage and angle, not"
            f" {voltage.shape} and {angle.shape}"
        )
    if not (np.isfinite(voltage).all() and np.isfinite(angle).all()):
        raise InputError("voltages and angles of a calibration must be finite")
    low = float(voltage.min())
    high = float(voltage.max())
    if low == high or (np.diff(angle) <= 0).any():
        raise InputError(
            f"voltages from {low:g} to {high:g} V do not give a line: the voltage must"
            " change, and the angles must ascend"
        )
    v = voltage - voltage.mean()
    q = angle - angle.mean()
    slope = float(v @ q / (v @ v))
    intercept = float(angle.mean() - slope * voltage.mean())
    steps = np.diff(voltage)
    return HallCalibration(
        slope,
        intercept,
        r_squared=float((v @ q) ** 2 / ((v @ v) * (q @ q))),
        span=float(np.abs(angle).max()),
        voltage_range=(low, high),
        worst_error=float(np.abs(slope * voltage + intercept - angle).max()),
        monotonic=bool((steps >= 0).all() or (steps <= 0).all()),
    )


def calibrate(sensor: HallSensor, span: float = SPAN) -> HallCalibration:
    """Calibrate a sensor in the state before its drift.

    Args:
        sensor: Hall sensor. Its `bias` and `gain_error` are ignored, because they arise
            after the calibration.
        span: maximum angle to both sides, rad.

    Raises:
        InputError: the span is not a positive angle, or the readings do not follow a
            line.
    """
    check_positive("calibration span", span, "rad")
    angle = np.linspace(-span, span, ANGLES)
    line = fit_line(replace(sensor, bias=0.0, gain_error=0.0).voltage(angle), angle)
    if line.r_squared < LEAST_R_SQUARED:
        raise InputError(
            f"this sensor cannot be calibrated over ±{span:g} rad: a line explains"
            f" {line.r_squared:.1%} of the variance, less than {LEAST_R_SQUARED:.0%};"
            " change its heights, distance or orientation"
        )
    return line
