"""Sensor: what turns a segment's bend into what its controller is told of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np


class Sensor(ABC):
    """Tells the bend of each segment, with its own errors.

    Sensors hold no state: a reading depends on the arguments of `read` alone, so it is the same whoever
    asks, in whichever order, one moment or a whole run at a time.

    Attributes:
        kind: short name.
    """

    kind: str

    @abstractmethod
    def read(self, bend: np.ndarray, time: np.ndarray | float, seed: int) -> np.ndarray:
        """Return the sensed bends, rad, shape (…, segments).

        Args:
            bend: actual bends, shape (…, segments), rad. A bend that is NaN is sensed as NaN: a lost
                reading, for the controller to deal with.
            time: s, shape (…,).
            seed: of the noise.

        Raises:
            InputError: a time that is not finite, from a sensor with noise.
        """

    def describe(self) -> dict[str, Any]:
        """Return the settings worth recording (JSON values)."""
        return {"kind": self.kind}


class IdealSensor(Sensor):
    """Tells the bend as it is."""

    kind = "ideal"

    def read(self, bend: np.ndarray, time: np.ndarray | float, seed: int) -> np.ndarray:
        """See `Sensor.read`."""
        return np.array(bend, dtype=float)
