"""Curvature sensors with noise and faults.

`IdealSensor` returns the true bends, and `CurvatureSensor` models a calibrated Hall
sensor in each segment. `DriftedSensor` and `FaultySensor` add drift and faults to the
sensors of individual segments.

**Noise without state.** The noise of a reading depends only on the seed, the segment
and the time. A controller that reads the sensors in every tick and a recorder that
reads them after the run therefore obtain equal readings. Time is divided into slots of
0.1 ms. The noise in slot n is computed from the outputs 2n and 2n + 1 of a SplitMix64
sequence (Steele, Lea, Flood, 2014). The Box-Muller transform converts these uniform
numbers to a normally distributed number. Each combination of seed and segment starts at
a different position in the sequence.

The numbers are computed and cached in blocks of slots, because computing a thousand
numbers at once takes as long as computing a single number.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from functools import lru_cache

import numpy as np

from srs_twin.errors import InputError
from srs_twin.sensing.hall import SPAN, HallCalibration, HallSensor, calibrate


class Sensor(ABC):
    """Abstract base class of curvature sensors.

    Sensors have no state, so `read` may be called for times in any order.

    Attributes:
        kind: short name of the sensor type.
        axes: number of readings per segment, 1 or 2. If it is 2, arrays of bends and
            readings have an additional last axis for the leftward and upward
            components.
    """

    kind: str = "own"
    axes: int = 1

    @abstractmethod
    def read(self, bend: np.ndarray, time: np.ndarray | float, seed: int) -> np.ndarray:
        """Return sensor readings, shape (…, segments), rad.

        Args:
            bend: actual bends, shape (…, segments), rad. A NaN bend gives a NaN
                reading, which the controller must handle as a lost reading.
            time: times of the readings, shape (…,), s.
            seed: noise seed.

        Raises:
            InputError: the sensor is noisy and a time is not finite.
        """

    def describe(self) -> dict[str, object]:
        """Return the settings of the sensor as JSON values."""
        return {"kind": self.kind}


class IdealSensor(Sensor):
    """Sensor without errors."""

    kind = "ideal"

    def read(self, bend: np.ndarray, time: np.ndarray | float, seed: int) -> np.ndarray:
        """See `Sensor.read`."""
        return np.array(bend, dtype=float)


SLOT = 1e-4
"""Duration of a noise slot, s.

All readings in a slot have equal noise.
"""

# Increment of the state and multipliers of the output in SplitMix64.
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)

_SEED_STEP = 2**63
"""Difference between the noise seeds of the two axes."""

_MAX_TIME = 2.0**53 * SLOT
"""Maximum time at which slot numbers are exact in double precision, s."""
_BLOCK = 1024
"""Number of slots per cached block."""


def standard_normal(seed: int, time: np.ndarray | float, segments: int) -> np.ndarray:
    """Return standard normal random numbers, shape (…, segments).

    Args:
        seed: any integer. Seeds that are equal modulo 2⁶⁴ produce equal numbers.
        time: times, shape (…,), s. Times are rounded to the nearest slot.
        segments: number of segments. The random numbers of a segment do not depend on
            the number of segments.

    Raises:
        InputError: a time is not finite, or is too large for exact slot numbers.
    """
    time = np.asarray(time, dtype=float)
    if not (np.abs(time) < _MAX_TIME).all():
        raise InputError(
            f"the times of sensor noise must be finite and at most {_MAX_TIME:g} s"
        )
    seed = int(seed) % 2**64
    slot = np.rint(time / SLOT).astype(np.int64)
    if slot.size == 1:
        number, place = divmod(slot.item(), _BLOCK)
        numbers: np.ndarray = _block(seed, number, segments)[place]
        return numbers.reshape(*slot.shape, segments)
    return _normal_numbers(seed, slot, segments)


@lru_cache(maxsize=64)
def _block(seed: int, number: int, segments: int) -> np.ndarray:
    numbers = _normal_numbers(
        seed, np.arange(number * _BLOCK, (number + 1) * _BLOCK), segments
    )
    numbers.setflags(write=False)
    return numbers


def _normal_numbers(seed: int, slot: np.ndarray, segments: int) -> np.ndarray:
    start = _splitmix(np.full(segments, seed, dtype=np.uint64) + _GOLDEN)
    start = _splitmix(start ^ (np.arange(1, segments + 1, dtype=np.uint64) * _GOLDEN))
    place = start + (slot.view(np.uint64)[..., None] << np.uint64(1)) * _GOLDEN
    radius = (_splitmix(place) >> np.uint64(11)).astype(float) + 1
    angle = (_splitmix(place + _GOLDEN) >> np.uint64(11)).astype(float)
    return np.asarray(
        np.sqrt(-2 * np.log(radius * 2.0**-53)) * np.cos(2 * np.pi * 2.0**-53 * angle)
    )


def _splitmix(word: np.ndarray) -> np.ndarray:
    word = (word ^ (word >> np.uint64(30))) * _FIRST
    word = (word ^ (word >> np.uint64(27))) * _SECOND
    mixed: np.ndarray = word ^ (word >> np.uint64(31))
    return mixed


@dataclass(frozen=True)
class CurvatureSensor(Sensor):
    """Curvature sensor of the dissertation (Section 2.2.2).

    Attributes:
        hall: Hall sensor in each segment.
        calibration: linear calibration from voltage to bend.
    """

    hall: HallSensor
    calibration: HallCalibration

    kind = "hall"

    @classmethod
    def calibrated(cls, hall: HallSensor, span: float = SPAN) -> CurvatureSensor:
        """Create a sensor that is calibrated for bends of up to ±`span` (rad).

        Raises:
            InputError: the sensor cannot be calibrated.
        """
        return cls(hall, calibrate(hall, span))

    def read(self, bend: np.ndarray, time: np.ndarray | float, seed: int) -> np.ndarray:
        """See `Sensor.read`."""
        bend = np.asarray(bend, dtype=float)
        noise = np.zeros(())
        if self.hall.noise > 0:
            noise = standard_normal(seed, time, bend.shape[-1])
        return self.calibration.angle(self.hall.voltage(bend, noise))

    def describe(self) -> dict[str, object]:
        """See `Sensor.describe`."""
        return super().describe() | asdict(self)


@dataclass(frozen=True)
class _AlteredSensor(Sensor):
    sensor: Sensor

    @property
    def kind(self) -> str:  # type: ignore[override]
        return self.sensor.kind

    @property
    def axes(self) -> int:  # type: ignore[override]
        return self.sensor.axes


@dataclass(frozen=True)
class TwoAxisSensor(_AlteredSensor):
    """Pair of sensors in each segment of a spatial robot, one per bending direction.

    The two strips lie on the neutral axis at right angles, so each strip measures one
    component of the bend. The two sensors have independent noise and equal drift. The
    noise of the first sensor equals the noise in a planar robot with the same seed.
    """

    @property
    def axes(self) -> int:  # type: ignore[override]
        """Number of readings per segment, which is 2."""
        return 2

    def read(self, bend: np.ndarray, time: np.ndarray | float, seed: int) -> np.ndarray:
        """See `Sensor.read`."""
        bend = np.asarray(bend, dtype=float)
        readings = [
            self.sensor.read(bend[..., axis], time, seed + axis * _SEED_STEP)
            for axis in range(2)
        ]
        return np.stack(readings, axis=-1)

    def describe(self) -> dict[str, object]:
        """See `Sensor.describe`."""
        return self.sensor.describe() | {"axes": 2}


@dataclass(frozen=True)
class DriftedSensor(_AlteredSensor):
    """Sensors whose gains and offsets have drifted since their calibration.

    Attributes:
        gain: factor by which a reading is multiplied, shape (segments,), dimensionless.
        bias: offset that is added to a reading, shape (segments,), rad.
    """

    gain: tuple[float, ...]
    bias: tuple[float, ...]

    def read(self, bend: np.ndarray, time: np.ndarray | float, seed: int) -> np.ndarray:
        """See `Sensor.read`."""
        return np.asarray(
            np.array(self.gain) * self.sensor.read(bend, time, seed)
            + np.array(self.bias)
        )

    def describe(self) -> dict[str, object]:
        """See `Sensor.describe`."""
        return self.sensor.describe() | {
            "drift_gain": list(self.gain),
            "drift_bias_rad": list(self.bias),
        }


@dataclass(frozen=True)
class DeadSensor:
    """Fault of one segment's sensor, which no longer responds to the bend.

    Attributes:
        segment: segment number, counted from 1 at the head.
        reading: constant reading, rad, or NaN if the sensor returns no reading.
        since: time of the fault, s.
    """

    segment: int
    reading: float = 0.0
    since: float = 0.0


@dataclass(frozen=True)
class FaultySensor(_AlteredSensor):
    """Sensors that have failed in some segments.

    Attributes:
        dead: faults of individual sensors.
    """

    dead: tuple[DeadSensor, ...]

    def read(self, bend: np.ndarray, time: np.ndarray | float, seed: int) -> np.ndarray:
        """See `Sensor.read`."""
        measured_bend = self.sensor.read(bend, time, seed)
        for fault in self.dead:
            # The tolerance covers rounding errors in sums of time steps.
            failed = np.asarray(time) >= fault.since - 1e-9
            segments = (
                measured_bend if self.axes == 1 else np.moveaxis(measured_bend, -1, 0)
            )
            reading = segments[..., fault.segment - 1]
            reading[...] = np.where(failed, fault.reading, reading)
        return measured_bend

    def describe(self) -> dict[str, object]:
        """See `Sensor.describe`."""
        dead = [asdict(fault) for fault in self.dead]
        for fault in dead:
            fault["reading"] = None if np.isnan(fault["reading"]) else fault["reading"]
        return self.sensor.describe() | {"dead_sensors": dead}
