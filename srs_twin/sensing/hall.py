r"""Hall sensor on the neutral axis of a segment, and its calibration.

**Strip and field.** The strip bends with constant curvature κ = q/l. The coordinate
frame has its origin on the neutral axis at the magnet. The x axis points along the
strip towards the Hall element and the head, and the y axis points to the left. At an
arc length L from the magnet, the strip has turned by θ = κL. The Hall element and the
centre of the magnet have offsets h_s and h_m from the neutral axis, which are positive
to the left. The positions S of the element and M of the magnet are

$$ S = \begin{pmatrix} \sin\theta/\kappa - h_s \sin\theta \\
(1 - \cos\theta)/\kappa + h_s \cos\theta \end{pmatrix}, \qquad
M = \begin{pmatrix} 0 \\ h_m \end{pmatrix}. $$

The magnet is modelled as a point dipole with moment m along y (`up`) or x (`side`).
With r = S − M, the field of the magnet is

$$ B = \frac{\mu_0}{4\pi}\left(\frac{3\,(m\cdot r)\,r}{|r|^5} - \frac{m}{|r|^3}\right), $$

and the element measures the normal component of the field, B_n = B_y cos θ − B_x sin θ
(Eq. 1). The angle θ in Eq. 1 is interpreted as the local angle κL. If θ were the bend q
of the whole segment, the reading would be neither linear nor monotonic over ±90°
(docs/module.md#the-curvature-sensor).

**Chambers.** A rectangular chamber becomes round when it is filled, and presses on the
adjacent strip (Section 2.2.2, Fig. 14a, c). The filled chamber is on the outside of the
bend, so it bends the strip in the opposite direction. Once the chamber is round, it
displaces the strip no further. The bend of the strip is

$$ q_s = q - b\,q_c \tanh(q / q_c) , $$

where b is the dimensionless strength of this effect, and q_c is the bend at which the
chamber is nearly round. At q = 0, the derivative dq_s/dq is 1 − b, which is negative
for b > 1. For |q| ≫ q_c, the derivative is 1. The dissertation states that readings
with rectangular chambers are not monotonic at small angles. The figure with the values
is not available, so b and q_c are estimates. This model depends on the bend, but not on
the chamber pressure.

**Electronics.** The reading is produced by a Hall element, an amplifier and an
analogue-to-digital converter:

- The output of the element is s B_n + n, where s is the sensitivity and n is the noise.
- The output of the amplifier is V = V₀ + bias + G (1 + e) (s (B_n − B_n(0)) + n),
  limited to the rails. G is the gain, and V₀ is the output for a straight strip.
- The converter divides its range into 2^bits quantisation steps and returns the centre
  of the step that contains V.

The amplifier is balanced for a straight strip. Otherwise, the amplified field at rest
(54 gauss) would far exceed the rails. The `bias` and the gain error e are changes since
the calibration that are caused by temperature, supply voltage or displacement of the
magnet.

**Calibration.** As in Section 3.4.3, the bending angle is approximated by a linear
function of the voltage, which is fitted by least squares:

$$ q \approx a V + b. $$

The angles are evenly spaced from −span to +span. The readings contain no noise, as if
they were averaged over a long time. Nonlinearities due to the field, the rails and the
chambers remain as errors of the readings. The maximum error is stored in
`HallCalibration.worst_error`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from srs_twin.compute.arrays import Array, check_positive
from srs_twin.errors import InputError, UnknownNameError

STRIP_PRESSURE_FACTOR = {"semicircular": 0.0, "rectangular": 2.0}
"""Factor b for each chamber cross-section, dimensionless.

The estimated factor of 2 reverses the sign of dq_s/dq at q = 0.
"""

ROUNDING_BEND_RAD = 0.15
"""Bend q_c at which a rectangular chamber is nearly round, rad.

The value of 8.6° is an estimate.
"""


def strip_bend(bend: Array, chamber: str) -> Array:
    """Return the bend q_s of the strip, rad.

    Args:
        bend: bend q of the segment, any shape, rad. A NaN bend gives a NaN result.
        chamber: name of the chamber cross-section, a key of `STRIP_PRESSURE_FACTOR`.
    """
    factor = STRIP_PRESSURE_FACTOR[chamber]
    if factor == 0.0:
        return bend
    bend_of_strip: Array = bend - factor * ROUNDING_BEND_RAD * np.tanh(
        bend / ROUNDING_BEND_RAD
    )
    return bend_of_strip


ORIENTATIONS = ("up", "side")
"""Directions of the north pole: normal to the strip ("up") or along it ("side").

The dissertation uses a magnet with its north pole normal to the strip.
"""

_MU0_4PI = 1e-7  # μ₀/4π, T·m/A

INCH = 0.0254

MAGNET_HEIGHT = INCH / 32
"""Height of the cylindrical magnet, m (Section 2.2.2)."""

MAGNET_DIAMETER = INCH / 16
"""Diameter of the magnet, m.

The dissertation does not state the diameter, so the value is a commercial size for
magnets of the known height.
"""

REMANENCE = 1.32
"""Remanence of the magnet, T, estimated for NdFeB of grade N42 (1.29 to 1.33 T)."""

MOMENT = (
    REMANENCE
    * math.pi
    / 4
    * MAGNET_DIAMETER**2
    * MAGNET_HEIGHT
    / (4 * math.pi * _MU0_4PI)
)
"""Magnetic moment of the magnet (remanence times volume divided by μ₀), A·m²."""


@dataclass(frozen=True)
class Strip:
    """Strip with a magnet and a Hall element, as described in the module docstring.

    The dissertation does not state the heights of the magnet and the element, so both
    are estimates. The surface of the flexible board is 0.05 mm from the neutral axis.
    The magnet lies on this surface, and the element lies 0.65 mm above it in a SOT-23
    package.

    Attributes:
        segment_length: length l of the segment, m.
        distance: arc length L from the magnet to the element, m. The dissertation
            compares distances of 3.1 to 4.6 mm and uses 3.1 mm.
        orientation: orientation of the magnet, one of `ORIENTATIONS`.
        moment: magnetic moment |m|, A·m².
        magnet_height: height h_m of the magnet's centre above the neutral axis, m.
        element_height: height h_s of the element above the neutral axis, m.
        chamber: name of the chamber cross-section, a key of `STRIP_PRESSURE_FACTOR`.
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
                f"`distance` {self.distance:g} m from magnet to element is not"
                " allowed; it must be at most the length of the segment,"
                f" {self.segment_length:g} m"
            )
        for name in ("magnet_height", "element_height"):
            value = getattr(self, name)
            if not abs(value) < self.distance / math.pi:
                raise InputError(
                    f"`{name}` {value!r} m is not allowed; at this distance it must be"
                    f" within ±{self.distance / math.pi:.3g} m, so that magnet and"
                    " element never touch"
                )


def dipole(x: Array, y: Array, m_x: float, m_y: float) -> tuple[Array, Array]:
    """Return the field B_x and B_y (T) of a dipole in the plane of its moment.

    Args:
        x: x coordinate relative to the dipole, any shape, m.
        y: y coordinate relative to the dipole, with the shape of x, m. The coordinates
            x and y must not both be 0.
        m_x: x component of the dipole moment, A·m².
        m_y: y component of the dipole moment, A·m².
    """
    square = x * x + y * y
    cube = square * np.sqrt(square)
    along = 3 * (m_x * x + m_y * y) / square
    return _MU0_4PI * (along * x - m_x) / cube, _MU0_4PI * (along * y - m_y) / cube


def element_place(bend: Array | float, strip: Strip) -> tuple[Array, Array, Array]:
    """Return the element's position x, y relative to the magnet (m), and θ (rad)."""
    theta = strip_bend(np.asarray(bend, dtype=float), strip.chamber) * (
        strip.distance / strip.segment_length
    )
    theta = np.where(np.abs(theta) <= math.pi, theta, np.nan)
    # The vector (sin θ, 1 − cos θ)/κ is a chord in the direction θ/2. Its length is
    # computed with np.sinc(x) = sin(πx)/(πx), which is smooth at κ = 0.
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
        bend: bend q of the segment, any shape, rad. The result is NaN if the bend is
            NaN or if the strip turns by more than half a revolution between magnet and
            element.
        strip: strip with magnet and Hall element.
    """
    x, y, theta = element_place(bend, strip)
    m_x, m_y = (0.0, strip.moment) if strip.orientation == "up" else (strip.moment, 0.0)
    b_x, b_y = dipole(x, y, m_x, m_y)
    normal: Array = b_y * np.cos(theta) - b_x * np.sin(theta)
    return normal


GAUSS = 1e-4

SPAN = math.pi / 2
"""Maximum bend to either side in the dissertation, rad (Section 2.2.2)."""

RAIL_FRACTION = 0.8
"""Fraction of the rail-to-rail voltage that the output of a trimmed amplifier covers.
"""


@dataclass(frozen=True)
class HallSensor:
    """Hall sensor with its electronics, as described in the module docstring.

    The sensitivity and the noise are estimated from data sheets of Hall sensors of type
    49E, such as the AH49E in the dissertation. The data sheets state a sensitivity of
    1.6 to 2.0 mV/G at 5 V. The stated noise of 90 µV in a bandwidth of 10 kHz
    corresponds to 25 µV in the amplifier's bandwidth of 500 Hz. The 5 V rails and the
    10-bit converter match the Arduino Pro Mini in generation 3 (Section 2.3.2).

    Attributes:
        strip: strip with magnet and Hall element.
        gain: gain G of the amplifier, dimensionless.
        sensitivity: sensitivity s of the element, V/T.
        offset: output V₀ of the amplifier for a straight segment, V.
        rails: minimum and maximum output of the amplifier, V.
        noise: RMS noise at the output of the element within the amplifier's bandwidth,
            V.
        bits: number of bits of the converter, or None if the output is not quantised.
        converter_range: minimum and maximum input voltage of the converter, V.
        bias: change of the amplifier's output since the calibration, V.
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
        _check("noise", self.noise, self.noise >= 0, "at least 0 V")
        _check("bias", self.bias, True, "a voltage")
        _check("gain_error", self.gain_error, self.gain_error > -1, "above -1")
        for name in ("rails", "converter_range"):
            low, high = getattr(self, name)
            if not -math.inf < low < high < math.inf:
                raise InputError(
                    f"`{name}` {low!r} to {high!r} V is not allowed; it must be a"
                    " finite range in ascending order"
                )
        low, high = self.rails
        _check(
            "offset",
            self.offset,
            low < self.offset < high,
            f"between the rails {low:g} and {high:g} V",
        )
        if self.bits is not None and not 1 <= self.bits <= 32:
            raise InputError(
                f"`bits` {self.bits!r} is not allowed; it must be between 1 and 32, or"
                " None"
            )

    @classmethod
    def trimmed(
        cls, strip: Strip, *, span: float = SPAN, **electronics: object
    ) -> HallSensor:
        """Create a sensor whose output covers `RAIL_FRACTION` of its full range.

        Args:
            strip: strip with magnet and Hall element.
            span: maximum bend to either side, rad.
            **electronics: further attributes of the sensor.

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
                "no gain is suitable for this sensor. The output of the element"
                f" changes by {swing:g} V over ±{span:g} rad, but the output of the"
                f" amplifier may change by at most {allowed:g} V about {unit.offset:g}"
                " V"
            )
        return replace(unit, gain=allowed / swing)

    @property
    def step(self) -> float:
        """Quantisation step of the converter, or 0 without quantisation, V."""
        low, high = self.converter_range
        return 0.0 if self.bits is None else (high - low) / 2**self.bits

    @cached_property
    def _field_at_rest(self) -> Array:
        return field(0.0, self.strip)

    def field_change(self, bend: Array | float) -> Array:
        """Return the field change B_n − B_n(0) (T) for an array of bends (rad)."""
        return field(bend, self.strip) - self._field_at_rest

    def voltage(self, bend: Array | float, noise: Array | float = 0.0) -> Array:
        """Return the voltage that the controller reads, V.

        Args:
            bend: bend q of the segment, any shape, rad. A NaN bend gives a NaN voltage,
                so that a diverged state does not look valid.
            noise: standard normal random numbers, broadcast with the bends.
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
    """Clip values to a range, three times as fast as `np.clip`."""
    clipped: Array = np.minimum(np.maximum(values, low), high)
    return clipped


def _check(name: str, value: float, ok: bool, allowed: str) -> None:
    if not (math.isfinite(value) and ok):
        raise InputError(
            f"`{name}` {value!r} is not allowed; it must be finite and {allowed}"
        )


ANGLES = 181
"""Number of angles in a calibration, which is one per degree for ±90°."""

LEAST_R_SQUARED = 0.5
"""Minimum fraction of the variance that a calibration line must explain."""


@dataclass(frozen=True)
class HallCalibration:
    """Linear calibration of a Hall sensor.

    Attributes:
        slope: slope a of the calibration line, rad/V.
        intercept: intercept b of the calibration line, rad.
        r_squared: fraction of the variance that the line explains, dimensionless.
        span: maximum absolute angle in the calibration, rad.
        voltage_range: minimum and maximum voltage in the calibration, V.
        worst_error: maximum absolute difference between the line and the angle, rad.
        monotonic: whether the voltage is a monotonic function of the angle.
    """

    slope: float
    intercept: float
    r_squared: float
    span: float
    voltage_range: tuple[float, float]
    worst_error: float
    monotonic: bool

    def angle(self, voltage: Array | float) -> Array:
        """Convert voltages (V) of any shape to bends (rad).

        The line is extrapolated beyond the calibrated span.
        """
        return self.slope * np.asarray(voltage) + self.intercept


def fit_line(voltage: Array, angle: Array) -> HallCalibration:
    """Fit a calibration line to measured voltages and angles.

    Args:
        voltage: voltage at each angle, shape (angles,), V.
        angle: ascending angles, shape (angles,), rad.

    Raises:
        InputError: there are fewer than 3 angles, a value is not finite, all voltages
            are equal, or the angles are not ascending.
    """
    voltage = np.asarray(voltage, dtype=float)
    angle = np.asarray(angle, dtype=float)
    if voltage.ndim != 1 or voltage.shape != angle.shape or len(voltage) < 3:
        raise InputError(
            "a calibration needs 3 or more pairs of voltage and angle, but the given"
            f" arrays have the shapes {voltage.shape} and {angle.shape}"
        )
    if not (np.isfinite(voltage).all() and np.isfinite(angle).all()):
        raise InputError("the voltages and angles of a calibration must be finite")
    low = float(voltage.min())
    high = float(voltage.max())
    if low == high or (np.diff(angle) <= 0).any():
        raise InputError(
            f"a calibration line cannot be fitted to voltages between {low:g} and"
            f" {high:g} V; the voltages must differ, and each angle must be larger than"
            " the angle before it"
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
    """Calibrate a Hall sensor for bends of up to ±`span`.

    Args:
        sensor: Hall sensor. Its `bias` and `gain_error` are ignored, because they
            describe drift after the calibration.
        span: maximum angle to either side, rad.

    Raises:
        InputError: the span is not positive, or a line does not fit the readings.
    """
    check_positive("calibration span", span, "rad")
    angle = np.linspace(-span, span, ANGLES)
    line = fit_line(replace(sensor, bias=0.0, gain_error=0.0).voltage(angle), angle)
    if line.r_squared < LEAST_R_SQUARED:
        raise InputError(
            f"this sensor cannot be calibrated over ±{span:g} rad, because a line"
            f" explains only {line.r_squared:.1%} of the variance, less than"
            f" {LEAST_R_SQUARED:.0%}; change its heights, distance or orientation"
        )
    return line
