"""Curvature sensors of a scenario, and what breaks: dead sensors, stuck valves."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from srs_twin.pneumatics.valves import StuckValve
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.fields import Section, quantity, section
from srs_twin.sensing import DeadSensor, HallSensor, Sensor, Strip, make_sensor


class SensorFile(Section):
    """What controllers are told of the bends."""

    constructors = (make_sensor, Strip, HallSensor)

    kind: Literal["ideal", "hall"] = section(
        "ideal: the bend as it is; hall: magnet and Hall element on a strip, amplifier, converter, straight "
        "line (docs/sensor.md).",
        "ideal",
    )
    span_rad: float | None = quantity(
        "Bends to both sides over which it is trimmed and calibrated (hall; default {default:.4g})",
        0.1,
        1.6,
        None,
    )
    distance_mm: float | None = quantity(
        "From the magnet to the element, along the strip (hall; default {default:g})", 1.0, 50.0, None
    )
    orientation: Literal["up", "side"] | None = section("Of the magnet's north (hall; default up).", None)
    chamber: Literal["semicircular", "rectangular"] | None = section(
        "Cross-section of the pressure chambers (hall; default semicircular); a rectangular one presses on "
        "the strip.",
        None,
    )
    noise_uv: float | None = quantity(
        "RMS noise of the element that the amplifier passes (hall; default {default:g})", 0.0, 1e5, None
    )
    bits: int | None = quantity("Of the converter (hall; default {default})", 1, 32, None)
    bias_v: float | None = quantity(
        "Drift of the output since the calibration (hall; default {default:g})", -5.0, 5.0, None
    )
    gain_error: float | None = quantity(
        "Drift of the gain since the calibration, as a share of it (hall; default {default:g})",
        -0.9,
        10.0,
        None,
    )

    @model_validator(mode="after")
    def _what_belongs_together(self) -> SensorFile:
        given = [name for name in HALL_ONLY if getattr(self, name) is not None]
        if given and self.kind != "hall":
            raise ValueError(f"{given[0]} belongs to kind: hall; set that, or take {given[0]} out")
        return self

    def resolved(self) -> SensorFile:
        """Return the section with all defaults written out."""
        return self.with_defaults(*HALL_ONLY) if self.kind == "hall" else self

    def sensor(self, robot: RobotSpec) -> Sensor:
        """Return the sensors of a robot.

        Raises:
            InputError: a sensor that cannot be trimmed or calibrated.
        """
        return make_sensor(spec=robot, **self.arguments())


HALL_ONLY = tuple(name for name in SensorFile.model_fields if name != "kind")


class _FaultFile(Section):
    segment: int = quantity("Which segment, counted from the head", 1, 63)
    from_s: float = quantity("Since when", 0.0, 3600.0, 0.0)


class DeadSensorFile(_FaultFile):
    """A curvature sensor that tells nothing more."""

    kind: Literal["dead_sensor"] = section("What breaks.")
    reading_rad: float | None = quantity("What it says instead (default: no reading at all)", -6.3, 6.3, None)

    def build(self) -> DeadSensor:
        """Return it in SI."""
        reading = math.nan if self.reading_rad is None else self.reading_rad
        return DeadSensor(self.segment, reading, self.from_s)


class StuckValveFile(_FaultFile):
    """A chamber's inlet that no longer obeys."""

    kind: Literal["stuck_valve"] = section("What breaks.")
    chamber: Literal["plus", "minus"] = section("Of which chamber.")
    stuck: Literal["open", "closed"] = section("open: fills its chamber for ever; closed: vents it.")

    def build(self) -> StuckValve:
        """Return it in SI."""
        side = 0 if self.chamber == "plus" else 1
        return StuckValve(self.segment, side, 1 if self.stuck == "open" else -1, self.from_s)


FaultFile = Annotated[DeadSensorFile | StuckValveFile, Field(discriminator="kind")]
