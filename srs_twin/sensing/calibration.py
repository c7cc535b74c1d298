r"""Calibration of a curvature sensor: the straight line from its voltage to the bend.

As in the dissertation (Section 3.4.3, a line fit to the bending angle against the voltage), the module is
held at evenly spaced angles over ± span. The reading at each angle is averaged until the noise vanishes, and
the angle is regressed on the voltage by least squares:

$$ q \approx a V + b. $$

All nonlinearity of the sensor (field, rails, a pressing chamber) remains in the readings as an error; its
largest value is `worst_error`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from srs_twin.errors import InputError
from srs_twin.sensing.hall import SPAN, HallSensor

ANGLES = 181
"""Number of angles in a calibration: one per degree over ±90°."""

LEAST_R_SQUARED = 0.5
"""Smallest fraction of the variance that a line must explain, 1; a worse sensor is useless for control."""


@dataclass(frozen=True)
class Calibration:
    """Straight line from voltage to bend, with its quality.

    Attributes:
        slope: a, rad/V.
        intercept: b, rad.
        r_squared: fraction of the variance that the line explains, 1.
        span: largest angle to both sides, rad.
        voltage_range: lowest and highest voltage, V.
        worst_error: largest difference between line and angle, rad.
        monotonic: whether the voltage is monotonic in the angle.
    """

    slope: float
    intercept: float
    r_squared: float
    span: float
    voltage_range: tuple[float, float]
    worst_error: float
    monotonic: bool

    def angle(self, voltage: np.ndarray | float) -> np.ndarray:
        """Return the bends for voltages (V, any shape), rad; the line continues beyond the span."""
        return self.slope * np.asarray(voltage) + self.intercept


def fit_line(voltage: np.ndarray, angle: np.ndarray) -> Calibration:
    """Fit a line to measured pairs of voltage and angle.

    Args:
        voltage: in the order of the angles, shape (angles,), V.
        angle: ascending, shape (angles,), rad.

    Raises:
        InputError: there are fewer than 3 pairs, a value is not finite, or all voltages are equal.
    """
    voltage, angle = np.asarray(voltage, dtype=float), np.asarray(angle, dtype=float)
    if voltage.ndim != 1 or voltage.shape != angle.shape or len(voltage) < 3:
        raise InputError(
            f"a calibration needs 3 or more pairs of voltage and angle, not {voltage.shape} and {angle.shape}"
        )
    if not (np.isfinite(voltage).all() and np.isfinite(angle).all()):
        raise InputError("voltages and angles of a calibration must be finite")
    low, high = float(voltage.min()), float(voltage.max())
    if low == high or (np.diff(angle) <= 0).any():
        raise InputError(
            f"voltages from {low:g} to {high:g} V do not give a line: the voltage must change, and the "
            "angles must ascend"
        )
    v, q = voltage - voltage.mean(), angle - angle.mean()
    slope = float(v @ q / (v @ v))
    intercept = float(angle.mean() - slope * voltage.mean())
    steps = np.diff(voltage)
    return Calibration(
        slope,
        intercept,
        r_squared=float((v @ q) ** 2 / ((v @ v) * (q @ q))),
        span=float(np.abs(angle).max()),
        voltage_range=(low, high),
        worst_error=float(np.abs(slope * voltage + intercept - angle).max()),
        monotonic=bool((steps >= 0).all() or (steps <= 0).all()),
    )


def calibrate(sensor: HallSensor, span: float = SPAN) -> Calibration:
    """Calibrate a sensor in its state before it drifted (module docstring).

    Args:
        sensor: sensor; its `bias` and `gain_error`, which arise after the calibration, are ignored.
        span: largest angle to both sides, rad.

    Raises:
        InputError: the span is not a positive angle, or the readings do not follow a line.
    """
    if not (math.isfinite(span) and span > 0):
        raise InputError(f"calibration span {span!r} rad is not allowed; it must be finite and above 0")
    angle = np.linspace(-span, span, ANGLES)
    line = fit_line(replace(sensor, bias=0.0, gain_error=0.0).voltage(angle), angle)
    if line.r_squared < LEAST_R_SQUARED:
        raise InputError(
            f"this sensor cannot be calibrated over ±{span:g} rad: a line explains {line.r_squared:.1%} of "
            f"the variance, less than {LEAST_R_SQUARED:.0%}; change its heights, distance or orientation"
        )
    return line
