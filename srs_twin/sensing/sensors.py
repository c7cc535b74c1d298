"""Sensors: what controllers are told of the bends, with noise and faults.

`IdealSensor` tells the bend as it is, `CurvatureSensor` reads a Hall sensor in each segment through its
calibration; `DriftedSensor` and `FaultySensor` add what is wrong with the sensors of single modules.

Noise has no state: a number depends on the seed, the segment and the time, and on nothing else, so a sensor
says the same to a controller that reads it once a tick and to a recorder that reads a whole run at once, on
one thread or many. The numbers of one segment are SplitMix64 (Steele, Lea, Flood, 2014), read at the places
2n and 2n + 1 of its sequence, n the time in slots of 0.1 ms, and made normal by Box and Muller's transform.
Each (seed, segment) starts elsewhere in the sequence. A controller asks for one moment after another, each
of which would cost as much as a thousand at once, so single moments are looked up in blocks of slots that
are kept.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from srs_twin.errors import InputError
from srs_twin.sensing.calibration import Calibration, calibrate
from srs_twin.sensing.hall import SPAN, HallSensor


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


SLOT = 1e-4
"""Readings within a slot are the same, those of different slots independent, s."""

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_LATEST = 2.0**53 * SLOT
_BLOCK = 1024  # slots


def standard_normal(seed: int, time: np.ndarray | float, segments: int) -> np.ndarray:
    """Return standard normal numbers, shape (…, segments).

    Args:
        seed: any whole number; equal ones modulo 2⁶⁴ give the same.
        time: s, shape (…,), taken to the nearest slot.
        segments: how many; the first ones do not depend on it.

    Raises:
        InputError: a time that is not finite, or too long for whole slots.
    """
    time = np.asarray(time, dtype=float)
    if not (np.abs(time) < _LATEST).all():
        raise InputError(f"sensor noise has no time that is not finite or beyond {_LATEST:g} s")
    slot = np.rint(time / SLOT).astype(np.int64)
    if slot.size == 1:
        number, place = divmod(slot.item(), _BLOCK)
        return _block(int(seed) % 2**64, number, segments)[place].reshape(*slot.shape, segments)
    return _at(int(seed) % 2**64, slot, segments)


@lru_cache(maxsize=64)
def _block(seed: int, number: int, segments: int) -> np.ndarray:
    """Return the numbers of the slots of a block, shape (_BLOCK, segments)."""
    found = _at(seed, np.arange(number * _BLOCK, (number + 1) * _BLOCK), segments)
    found.setflags(write=False)  # the next who asks gets the same
    return found


def _at(seed: int, slot: np.ndarray, segments: int) -> np.ndarray:
    """Return the numbers of slots, int64 of shape (…,); shape (…, segments)."""
    # Arrays, not scalars: NumPy warns of a scalar's overflow, which is meant here.
    start = _mixed(np.full(segments, seed, dtype=np.uint64) + _GOLDEN)
    start = _mixed(start ^ (np.arange(1, segments + 1, dtype=np.uint64) * _GOLDEN))
    place = start + (slot.view(np.uint64)[..., None] << np.uint64(1)) * _GOLDEN
    radius = (_mixed(place) >> np.uint64(11)).astype(float) + 1  # 1 … 2⁵³, never 0
    turn = (_mixed(place + _GOLDEN) >> np.uint64(11)).astype(float)
    return np.asarray(np.sqrt(-2 * np.log(radius * 2.0**-53)) * np.cos(2 * np.pi * 2.0**-53 * turn))


def _mixed(word: np.ndarray) -> np.ndarray:
    """Return SplitMix64's output for a state: each bit of it depends on each bit of the state."""
    word = (word ^ (word >> np.uint64(30))) * _FIRST
    word = (word ^ (word >> np.uint64(27))) * _SECOND
    return word ^ (word >> np.uint64(31))


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


@dataclass(frozen=True)
class _AlteredSensor(Sensor):
    """Sensors that say something else than they would: `sensor` is what they would say."""

    sensor: Sensor

    @property
    def kind(self) -> str:  # type: ignore[override]
        """Short name of what is altered."""
        return self.sensor.kind


@dataclass(frozen=True)
class DriftedSensor(_AlteredSensor):
    """Sensors that have each drifted by themselves since their calibration.

    Attributes:
        sensor: what they would say without.
        gain: what they say over that, shape (segments,).
        bias: what they say besides, shape (segments,), rad.
    """

    gain: tuple[float, ...]
    bias: tuple[float, ...]

    def read(self, bend: np.ndarray, time: np.ndarray | float, seed: int) -> np.ndarray:
        """See `Sensor.read`."""
        return np.asarray(np.array(self.gain) * self.sensor.read(bend, time, seed) + np.array(self.bias))

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
class FaultySensor(_AlteredSensor):
    """Sensors some of which are dead from some time on.

    Attributes:
        sensor: what they would say without.
        dead: which, and since when.
    """

    dead: tuple[DeadSensor, ...]

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
        dead = [asdict(each) for each in self.dead]
        for each in dead:
            each["reading"] = None if np.isnan(each["reading"]) else each["reading"]
        return self.sensor.describe() | {"dead_sensors": dead}
