r"""Calibration: the straight line from a sensor's voltage to the segment's angle.

As the text calibrates (Section 3.4.3: a line fit to the bending angle against the voltage): the module is
held at evenly spaced angles over ± span, the reading at each is averaged until the noise is gone, and the
angle is regressed on the voltage by least squares,

$$ q \approx a V + b. $$

All that is not a straight line in the sensor (its field, the rails, a pressing chamber) stays in the
readings as an error; `worst_error` says how much.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from srs_twin.errors import InputError
from srs_twin.sensing.hall import SPAN, HallSensor

ANGLES = 181
"""Angles held during a calibration: one a degree over ±90°."""

LEAST_R_SQUARED = 0.5
"""A line that explains less of the angle is refused: nothing can be controlled with it."""


@dataclass(frozen=True)
class Calibration:
    """A straight line from voltage to angle, and how good it is.

    Attributes:
        slope: a, rad/V.
        intercept: b, rad.
        r_squared: share of the variance that the line explains.
        span: largest angle held, to both sides, rad.
        voltage_range: V, lowest and highest voltage read.
        worst_error: largest difference of line and angle, rad.
        monotonic: whether the voltage never turns back as the angle grows.
    """

    slope: float
    intercept: float
    r_squared: float
    span: float
    voltage_range: tuple[float, float]
    worst_error: float
    monotonic: bool

    def angle(self, voltage: np.ndarray | float) -> np.ndarray:
        """Return the angle that voltages (V, any shape) stand for, rad, beyond the span as well."""
        return self.slope * np.asarray(voltage) + self.intercept


def fit_line(voltage: np.ndarray, angle: np.ndarray) -> Calibration:
    """Fit a line to measured pairs.

    Args:
        voltage: in the order of the angles, shape (angles,), V.
        angle: ascending, shape (angles,), rad.

    Raises:
        InputError: fewer than 3 pairs, something not finite, or voltages that are all the same.
    """
    voltage, angle = np.asarray(voltage, dtype=float), np.asarray(angle, dtype=float)
    if voltage.ndim != 1 or voltage.shape != angle.shape or len(voltage) < 3:
        raise InputError(f"a line needs 3 or more pairs; given: {voltage.shape} and {angle.shape}")
    if not (np.isfinite(voltage).all() and np.isfinite(angle).all()):
        raise InputError("a line can be fitted to finite voltages and angles only")
    low, high = float(voltage.min()), float(voltage.max())
    if low == high or (np.diff(angle) <= 0).any():
        raise InputError(
            f"no line from {low:g} to {high:g} V to these angles: the voltage must change, the angles ascend"
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
    """Calibrate a sensor as it was before it drifted (module docstring).

    Args:
        sensor: its `bias` and `gain_error` come later, so they are left out.
        span: largest angle to both sides, rad.

    Raises:
        InputError: a span that is no angle, or a reading that does not follow it.
    """
    if not (math.isfinite(span) and span > 0):
        raise InputError(f"calibration span {span!r} rad is not allowed; it must be finite and above 0")
    angle = np.linspace(-span, span, ANGLES)
    line = fit_line(replace(sensor, bias=0.0, gain_error=0.0).voltage(angle), angle)
    if line.r_squared < LEAST_R_SQUARED:
        raise InputError(
            f"this sensor cannot be calibrated over ±{span:g} rad: a line explains {line.r_squared:.1%} of "
            f"the angle, less than {LEAST_R_SQUARED:.0%}; change its heights, distance or orientation"
        )
    return line
