"""Curvature sensors of a scenario, and what breaks: dead sensors, stuck valves."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field

from srs_twin.pneumatics.valves import StuckValve
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.fields import Section, quantity
from srs_twin.sensing import DeadSensor, HallSensor, Sensor, Strip, make_sensor


class SensorFile(Section):
    """What controllers are told of the bends."""

    constructors = (make_sensor, Strip, HallSensor)
    only = {}  # of kind hall, all other keys: below

    kind: Literal["ideal", "hall"] = "ideal"
    """ideal: the bend as it is; hall: magnet and Hall element on a strip, amplifier, converter, straight
    line (docs/sensor.md)."""
    span_rad: float | None = quantity(0.1, 1.6, None)
    """Bends to both sides over which it is trimmed and calibrated (hall; default {default:.4g})."""
    distance_mm: float | None = quantity(1.0, 50.0, None)
    """From the magnet to the element, along the strip (hall; default {default:g})."""
    orientation: Literal["up", "side"] | None = None
    """Of the magnet's north (hall; default up)."""
    chamber: Literal["semicircular", "rectangular"] | None = None
    """Cross-section of the pressure chambers (hall; default semicircular); a rectangular one presses on
    the strip."""
    noise_uv: float | None = quantity(0.0, 1e5, None)
    """RMS noise of the element that the amplifier passes (hall; default {default:g})."""
    bits: int | None = quantity(1, 32, None)
    """Of the converter (hall; default {default})."""
    bias_v: float | None = quantity(-5.0, 5.0, None)
    """Drift of the output since the calibration (hall; default {default:g})."""
    gain_error: float | None = quantity(-0.9, 10.0, None)
    """Drift of the gain since the calibration, as a share of it (hall; default {default:g})."""

    def resolved(self) -> SensorFile:
        """Return the section with all defaults written out."""
        return self.with_defaults(*self.only["kind", "hall"]) if self.kind == "hall" else self

    def sensor(self, robot: RobotSpec) -> Sensor:
        """Return the sensors of a robot.

        Raises:
            InputError: a sensor that cannot be trimmed or calibrated.
        """
        return make_sensor(spec=robot, **self.arguments())


SensorFile.only["kind", "hall"] = tuple(key for key in SensorFile.model_fields if key != "kind")


class _FaultFile(Section):
    segment: int = quantity(1, 63)
    """Which segment, counted from the head."""
    from_s: float = quantity(0.0, 3600.0, 0.0)
    """Since when."""


class DeadSensorFile(_FaultFile):
    """A curvature sensor that tells nothing more."""

    kind: Literal["dead_sensor"]
    """What breaks."""
    reading_rad: float | None = quantity(-6.3, 6.3, None)
    """What it says instead (default: no reading at all)."""

    def build(self) -> DeadSensor:
        """Return it in SI."""
        reading = math.nan if self.reading_rad is None else self.reading_rad
        return DeadSensor(self.segment, reading, self.from_s)


class StuckValveFile(_FaultFile):
    """A chamber's inlet that no longer obeys."""

    kind: Literal["stuck_valve"]
    """What breaks."""
    chamber: Literal["plus", "minus"]
    """Of which chamber."""
    stuck: Literal["open", "closed"]
    """open: fills its chamber for ever; closed: vents it."""

    def build(self) -> StuckValve:
        """Return it in SI."""
        side = 0 if self.chamber == "plus" else 1
        return StuckValve(self.segment, side, 1 if self.stuck == "open" else -1, self.from_s)


FaultFile = Annotated[DeadSensorFile | StuckValveFile, Field(discriminator="kind")]
