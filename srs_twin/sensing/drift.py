"""DriftedSensor and FaultySensor: what is wrong with the sensors of single modules."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from srs_twin.sensing.base import Sensor


@dataclass(frozen=True)
class DriftedSensor(Sensor):
    """Sensors that have each drifted by themselves since their calibration.

    Attributes:
        sensor: what they would say without.
        gain: what they say over that, shape (segments,).
        bias: what they say besides, shape (segments,), rad.
    """

    sensor: Sensor
    gain: tuple[float, ...]
    bias: tuple[float, ...]

    @property
    def kind(self) -> str:  # type: ignore[override]
        """Short name of what has drifted."""
        return self.sensor.kind

    def read(self, bend: np.ndarray, time: np.ndarray | float, seed: int) -> np.ndarray:
        """See `Sensor.read`."""
        drifted: np.ndarray = np.array(self.gain) * self.sensor.read(bend, time, seed) + np.array(self.bias)
        return drifted

    def describe(self) -> dict[str, Any]:
        """See `Sensor.describe`."""
        return self.sensor.describe() | {"drift_gain": list(self.gain), "drift_bias_rad": list(self.bias)}


@dataclass(frozen=True)
class DeadSensor:
    """A sensor that tells nothing more.

    Attributes:
        segment: from 1, at the head.
        reading: what it says instead of the bend, rad; NaN: nothing at all.
        since: s.
    """

    segment: int
    reading: float = 0.0
    since: float = 0.0


@dataclass(frozen=True)
class FaultySensor(Sensor):
    """Sensors some of which are dead from some time on.

    Attributes:
        sensor: what they would say without.
        dead: which, and since when.
    """

    sensor: Sensor
    dead: tuple[DeadSensor, ...]

    @property
    def kind(self) -> str:  # type: ignore[override]
        """Short name of what is faulty."""
        return self.sensor.kind

    def read(self, bend: np.ndarray, time: np.ndarray | float, seed: int) -> np.ndarray:
        """See `Sensor.read`."""
        sensed = self.sensor.read(bend, time, seed)
        for each in self.dead:
            # A tick's begin and its sum of steps may differ by rounding.
            gone = np.asarray(time) >= each.since - 1e-9
            column = sensed[..., each.segment - 1]
            sensed[..., each.segment - 1] = np.where(gone, each.reading, column)
        return sensed

    def describe(self) -> dict[str, Any]:
        """See `Sensor.describe`."""
        return self.sensor.describe() | {"dead_sensors": [_plain(each) for each in self.dead]}


def _plain(dead: DeadSensor) -> dict[str, Any]:
    values = asdict(dead)
    return values | {"reading": None if np.isnan(dead.reading) else dead.reading}
