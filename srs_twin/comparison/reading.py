r"""Metrics of a curvature sensor: its reading as a function of the bend (Fig. 13, 14).

The bend of a run is not distributed evenly, and single readings are noisy. Readings and bends are therefore
averaged over bins of 1° of bend. Each bin with samples counts once, as in a calibration at evenly spaced
angles.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from srs_twin.comparison.sampling import check_columns, units_of
from srs_twin.trajectory import Trajectory

READING_UNITS = units_of("""
    reading_r_squared reading_error_rad reading_backstep_rad reading_backstep_at_rad reading_range_t
""")
"""Metrics of a run with a non-ideal sensor; each is one number or None."""

BIN_RAD = math.radians(1.0)
"""Width of a bin of bends, rad: the step of a usual calibration."""

_MIN_BINS = 3
"""Smallest number of bins: a line through two points fits them exactly."""


@dataclass(frozen=True)
class ReadingCurve:
    """Mean reading and mean bend of each bin that has samples; lost readings (NaN) are left out.

    Attributes:
        bend: ascending, shape (bins,), rad.
        reading: shape (bins,), rad.
    """

    bend: np.ndarray
    reading: np.ndarray

    @classmethod
    def from_trajectory(cls, trajectory: Trajectory) -> ReadingCurve | None:
        """Return the curve of the first segment; None if the run has no sensor, or an ideal one.

        Raises:
            InputError: columns are missing or unusable.
        """
        if not (trajectory.has("sensed_1") and _sensor(trajectory).get("kind", "ideal") != "ideal"):
            return None
        check_columns(trajectory, "bend_1")
        read = np.isfinite(trajectory["sensed_1"])
        bend, sensed = trajectory["bend_1"][read], trajectory["sensed_1"][read]
        # Rounding centres a bin at 0, so that bends to both sides are treated alike.
        _, bins, samples = np.unique(np.round(bend / BIN_RAD), return_inverse=True, return_counts=True)
        return cls(np.bincount(bins, bend) / samples, np.bincount(bins, sensed) / samples)

    @property
    def r_squared(self) -> float | None:
        """Fraction of the variance of the bend that a linear function of the reading explains."""
        if len(self.bend) < _MIN_BINS or np.ptp(self.reading) == 0:
            return None
        return float(np.corrcoef(self.bend, self.reading)[0, 1] ** 2)

    @property
    def backstep(self) -> tuple[float, float | None]:
        """Largest decrease of the reading with increasing bend, and the bend in its middle, rad.

        It is (0, None) for a monotonic reading.
        """
        decrease = np.maximum.accumulate(self.reading) - self.reading
        low = int(decrease.argmax())
        if decrease[low] == 0:
            return 0.0, None
        high = int(self.reading[: low + 1].argmax())
        return float(decrease[low]), float(self.bend[high] + self.bend[low]) / 2


def reading_metrics(trajectory: Trajectory) -> dict[str, float | None]:
    """Compute the metrics of the first segment's sensor; None without a sensor or with an ideal one.

    - ``reading_r_squared``: R² of a linear relation between reading and bend.
    - ``reading_error_rad``: largest magnitude of mean reading minus mean bend, in which noise is averaged
      out.
    - ``reading_backstep_rad``: largest decrease of the reading with increasing bend. It is 0, apart from
      noise, if the reading is unique.
    - ``reading_backstep_at_rad``: bend in the middle of that decrease.
    - ``reading_range_t``: change of the field at the Hall element from the smallest to the largest bend.

    The metrics depend on the bends that occur in the run, but not on their cause.

    Args:
        trajectory: run with ``bend_1``, ``sensed_1`` and the sensor in its metadata.

    Returns:
        Metrics by the names above; their units are in `READING_UNITS`.

    Raises:
        InputError: columns are missing or unusable.
    """
    metrics: dict[str, float | None] = dict.fromkeys(READING_UNITS)
    curve = ReadingCurve.from_trajectory(trajectory)
    if curve is None or len(curve.bend) < _MIN_BINS:
        return metrics
    metrics["reading_r_squared"] = curve.r_squared
    metrics["reading_error_rad"] = float(np.abs(curve.reading - curve.bend).max())
    metrics["reading_backstep_rad"], metrics["reading_backstep_at_rad"] = curve.backstep
    field = _field_per_rad(_sensor(trajectory))
    if field is not None:
        metrics["reading_range_t"] = float(abs(curve.reading[-1] - curve.reading[0])) * field
    return metrics


def _sensor(trajectory: Trajectory) -> Mapping[str, Any]:
    return _mapping(trajectory.metadata.get("sensor"))


def _field_per_rad(sensor: Mapping[str, Any]) -> float | None:
    """Return the change of the field at the Hall element per sensed bend, T/rad; None if it is not known."""
    hall, line = _mapping(sensor.get("hall")), _mapping(sensor.get("calibration"))
    values = (hall.get("gain"), hall.get("gain_error"), hall.get("sensitivity"), line.get("slope"))
    numbers = [float(value) for value in values if isinstance(value, int | float)]
    if len(numbers) < len(values):
        return None
    gain, drift, sensitivity, slope = numbers
    rad_per_tesla = gain * (1 + drift) * sensitivity * slope
    return abs(1 / rad_per_tesla) if rad_per_tesla else None


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
