"""Curvature sensors with noise and faults.

`IdealSensor` returns the true bend, and `CurvatureSensor` models a calibrated Hall
sensor in each segment. `DriftedSensor` adds the drift of individual sensors, and
`FaultySensor` adds faults of individual sensors.

**Noise without state.** The noise of a reading depends only on the seed, the segment
and the time. A controller that reads the sensors in every tick and a recorder that
evaluates a whole run at once therefore obtain the same readings, regardless of the
number of threads. The noise of a segment is computed from the outputs 2n and 2n + 1 of
a SplitMix64 sequence (Steele, Lea, Flood, 2014), where n is the time in slots of 0.1
ms. The Box-Muller transform converts the uniform outputs to a normally distributed
number. Each combination of seed and segment starts at a different position in the
sequence.

A vectorised computation of a thousand numbers takes as long as the computation of a
single number. Because a controller reads one time after another, numbers are computed
and cached in blocks of slots.
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

    Sensors have no state. Readings depend only on the arguments of `read`, so callers
    may request times in any order.

    Attributes:
        kind: short name of the sensor.
        axes: number of readings per segment, 1 or 2. With 2 readings, arrays of bends
            and readings have an additional last axis with the components to the left
            and upwards.
    """

    kind: str = "own"
    axes: int = 1

    @abstractmethod
    def read(self, bend: np.ndarray, time: np.ndarray | float, seed: int) -> np.ndarray:
        """Return sensor readings, shape (…, segments), rad.

        Args:
            bend: actual bends, shape (…, segments), rad. If a bend is NaN, the reading
                is NaN, which the controller must handle as a lost reading.
            time: times of the readings, shape (…,), s.
            seed: noise seed.

        Raises:
            InputError: the sensor is noisy and a time is not finite.
        """

    def describe(self) -> dict[str, object]:
        """Return the settings to record, as JSON values."""
        return {"kind": self.kind}


class IdealSensor(Sensor):
    """Sensor without errors."""

    kind = "ideal"

    def read(self, bend: np.ndarray, time: np.ndarray | float, seed: int) -> np.ndarray:
        """See `Sensor.read`."""
        return np.array(bend, dtype=float)


SLOT = 1e-4
"""Duration of a noise slot, s.

Readings within a slot have equal noise, and the noise of different slots is
independent.
"""

# The following constants of SplitMix64 are the increment of the state and the
# multipliers of the output function.
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)

_SEED_STEP = 2**63
"""Difference between the seeds of the two axes."""

_MAX_TIME = 2.0**53 * SLOT
"""Maximum time at which slot numbers are exact in double precision, s."""
_BLOCK = 1024
"""Number of slots per cached block."""


def standard_normal(seed: int, time: np.ndarray | float, segments: int) -> np.ndarray:
    """Return standard normal random numbers, shape (…, segments).

    Args:
        seed: any integer. Seeds that are equal modulo 2⁶⁴ produce equal numbers.
        time: times, shape (…,), s. Times are rounded to the nearest slot.
        segments: number of segments. Additional segments do not change the random
            numbers of the first segments.

    Raises:
        InputError: a time is not finite, or is too large for exact slot numbers.
    """
    time = np.asarray(time, dtype=float)
    if not (np.abs(time) < _MAX_TIME).all():
        raise InputError(
            f"the times of sensor noise must be finite and at most {_MAX_TIME:g} s"
        )
    slot = np.rint(time / SLOT).astype(np.int64)
    if slot.size == 1:
        number, place = divmod(slot.item(), _BLOCK)
        numbers: np.ndarray = _block(int(seed) % 2**64, number, segments)[place]
        return numbers.reshape(*slot.shape, segments)
    return _normal_numbers(int(seed) % 2**64, slot, segments)


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
    # Two uniform 53-bit integers per number enter the Box-Muller transform.
    radius = (_splitmix(place) >> np.uint64(11)).astype(float) + 1
    angle = (_splitmix(place + _GOLDEN) >> np.uint64(11)).astype(float)
    return np.asarray(
        np.sqrt(-2 * np.log(radius * 2.0**-53)) * np.cos(2 * np.pi * 2.0**-53 * angle)
    )


def _splitmix(word: np.ndarray) -> np.ndarray:
    """Return the output of SplitMix64, in which each bit depends on every state bit."""
    word = (word ^ (word >> np.uint64(30))) * _FIRST
    word = (word ^ (word >> np.uint64(27))) * _SECOND
    mixed: np.ndarray = word ^ (word >> np.uint64(31))
    return mixed


@dataclass(frozen=True)
class CurvatureSensor(Sensor):
    """Curvature sensor of the dissertation (Section 2.2.2).

    The sensor model combines the magnetic field, the amplifier, the converter and the
    linear calibration.

    Attributes:
        hall: Hall sensor in each segment.
        calibration: linear calibration from voltage to bend.
    """

    hall: HallSensor
    calibration: HallCalibration

    kind = "hall"

    @classmethod
    def calibrated(cls, hall: HallSensor, span: float = SPAN) -> CurvatureSensor:
        """Return a sensor that is calibrated for bends up to the angle `span` (rad).

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
    """Two equal sensors per segment of a spatial robot, one for each bending direction.

    The strips lie on the neutral axis at right angles, so each strip measures one
    component of the bend. The two sensors have independent noise and equal drift. For
    equal seeds, the first sensor has the same noise as the sensor of a planar robot.
    """

    @property
    def axes(self) -> int:  # type: ignore[override]
        """Number of readings per segment."""
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
    """Sensors that have drifted by individual amounts since their calibration.

    Attributes:
        gain: factor that multiplies the reading, shape (segments,), dimensionless.
        bias: offset added to the reading, shape (segments,), rad.
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
    """Failure of one segment's sensor, which no longer responds to the bend.

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
        dead: faults of individual segments.
    """

    dead: tuple[DeadSensor, ...]

    def read(self, bend: np.ndarray, time: np.ndarray | float, seed: int) -> np.ndarray:
        """See `Sensor.read`."""
        measured_bend = self.sensor.read(bend, time, seed)
        for fault in self.dead:
            # The start time of a tick and a sum of time steps may differ due to
            # rounding.
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
