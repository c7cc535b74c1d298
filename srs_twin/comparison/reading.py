r"""Metrics of a curvature sensor: what it read over what the segment was bent by (Fig. 13, 14).

A run dwells at some bends and rushes through others, and single readings are noisy. So both are averaged
over bins of 1° of bend, as a sensor is calibrated at evenly spaced angles, and each bin that was visited
counts once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from srs_twin.comparison.sampling import require, units_of
from srs_twin.trajectory import Trajectory

READING_UNITS = units_of("""
    reading_r_squared reading_error_rad reading_backstep_rad reading_backstep_at_rad reading_range_t
""")
"""Metrics of a run with a sensor that is not ideal, each one number or None."""

BIN_RAD = math.radians(1.0)
"""Width of a bin, rad."""

# A line through fewer points says nothing.
_LEAST_BINS = 3


@dataclass(frozen=True)
class ReadingCurve:
    """Mean reading over mean bend, a point a bin that was visited; lost readings (NaN) are left out.

    Attributes:
        bend: ascending, shape (bins,), rad.
        reading: the sensor's, shape (bins,), rad.
    """

    bend: np.ndarray
    reading: np.ndarray

    @classmethod
    def of(cls, trajectory: Trajectory) -> ReadingCurve | None:
        """Return the curve of the first segment; None of a run without a sensor, or with an ideal one.

        Raises:
            InputError: columns are missing or unusable.
        """
        if not (trajectory.has("sensed_1") and _sensor(trajectory).get("kind", "ideal") != "ideal"):
            return None
        require(trajectory, "bend_1")
        read = np.isfinite(trajectory["sensed_1"])
        bend, sensed = trajectory["bend_1"][read], trajectory["sensed_1"][read]
        # Bins lie evenly about 0, so that equal bends to both sides are treated alike.
        _, which, visits = np.unique(np.round(bend / BIN_RAD), return_inverse=True, return_counts=True)
        return cls(np.bincount(which, bend) / visits, np.bincount(which, sensed) / visits)

    @property
    def r_squared(self) -> float | None:
        """Share of the variance of the bend that a straight line from the reading explains."""
        if len(self.bend) < _LEAST_BINS or np.ptp(self.reading) == 0:
            return None
        return float(np.corrcoef(self.bend, self.reading)[0, 1] ** 2)

    @property
    def backstep(self) -> tuple[float, float | None]:
        """How far the reading falls at most while the bend grows, rad, and the bend amid that fall, rad.

        0 and None of a reading that never turns back.
        """
        fall = np.maximum.accumulate(self.reading) - self.reading
        low = int(fall.argmax())
        if fall[low] == 0:
            return 0.0, None
        high = int(self.reading[: low + 1].argmax())
        return float(fall[low]), float(self.bend[high] + self.bend[low]) / 2


def reading_metrics(trajectory: Trajectory) -> dict[str, float | None]:
    """Measure what the first segment's sensor tells of its bend; all None without one, or with an ideal one.

    - ``reading_r_squared``: of the straight line between reading and bend.
    - ``reading_error_rad``: largest mean reading less bend, noise averaged out.
    - ``reading_backstep_rad``: how far the reading falls while the bend grows, 0 where it never does: a
      reading that is injective has none beyond its noise. ``reading_backstep_at_rad``: the bend amid that.
    - ``reading_range_t``: change of the field at the Hall element from the lowest to the highest bend.

    They depend on the bends alone, not on what made them; only the bends that the run went through count.

    Args:
        trajectory: a run with ``bend_1``, ``sensed_1`` and the sensor in its metadata.

    Returns:
        Numbers by the names above; units in `READING_UNITS`.

    Raises:
        InputError: columns are missing or unusable.
    """
    metrics: dict[str, float | None] = dict.fromkeys(READING_UNITS)
    curve = ReadingCurve.of(trajectory)
    if curve is None or len(curve.bend) < _LEAST_BINS:
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
    """Return the change of field at the element that a sensed rad stands for, T; None where none is told."""
    hall, line = _mapping(sensor.get("hall")), _mapping(sensor.get("calibration"))
    told = (hall.get("gain"), hall.get("gain_error"), hall.get("sensitivity"), line.get("slope"))
    numbers = [float(each) for each in told if isinstance(each, int | float)]
    if len(numbers) < len(told):
        return None
    gain, drift, sensitivity, slope = numbers
    rad_per_tesla = gain * (1 + drift) * sensitivity * slope
    return abs(1 / rad_per_tesla) if rad_per_tesla else None


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
