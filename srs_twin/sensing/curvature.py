"""CurvatureSensor: a Hall sensor in each segment, read through its calibration."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from srs_twin.sensing.base import Sensor
from srs_twin.sensing.calibration import Calibration, calibrate
from srs_twin.sensing.hall import SPAN, HallSensor
from srs_twin.sensing.noise import standard_normal


@dataclass(frozen=True)
class CurvatureSensor(Sensor):
    """The dissertation's sensor (Section 2.2.2): field, amplifier, converter, straight line.

    Attributes:
        hall: from bend to voltage, the same in all segments.
        calibration: from voltage to angle.
    """

    hall: HallSensor
    calibration: Calibration

    kind = "hall"

    @classmethod
    def calibrated(cls, hall: HallSensor, span: float = SPAN) -> CurvatureSensor:
        """Return a sensor with the calibration that the documented routine finds.

        Args:
            hall: the sensor.
            span: largest angle held, rad.

        Raises:
            InputError: as in `calibrate`.
        """
        return cls(hall, calibrate(hall, span))

    def read(self, bend: np.ndarray, time: np.ndarray | float, seed: int) -> np.ndarray:
        """See `Sensor.read`."""
        bend = np.asarray(bend, dtype=float)
        noise = standard_normal(seed, time, bend.shape[-1]) if self.hall.noise > 0 else 0.0
        return self.calibration.angle(self.hall.voltage(bend, noise))

    def describe(self) -> dict[str, Any]:
        """See `Sensor.describe`."""
        return super().describe() | asdict(self)
