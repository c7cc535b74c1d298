"""What a scenario file says of what breaks, and when."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from srs_twin.io.validation import Strict
from srs_twin.pneumatics.valves import StuckValve
from srs_twin.scenario.fields import quantity, section
from srs_twin.sensing import DeadSensor

_KIND = "What breaks."
_CHAMBERS = ("plus", "minus")
_STATES = {"open": 1, "closed": -1}


class _FaultFile(Strict):
    segment: int = quantity("Which segment, counted from the head", "", 1, 63)
    from_s: float = quantity("Since when", "s", 0.0, 3600.0, 0.0)


class DeadSensorFile(_FaultFile):
    """A curvature sensor that tells nothing more."""

    kind: Literal["dead_sensor"] = section(_KIND)
    reading_rad: float | None = quantity(
        "What it says instead (default: no reading at all)", "rad", -6.3, 6.3, None
    )

    def make(self) -> DeadSensor:
        """Return it in SI."""
        reading = float("nan") if self.reading_rad is None else self.reading_rad
        return DeadSensor(self.segment, reading, self.from_s)


class StuckValveFile(_FaultFile):
    """A chamber's inlet that no longer obeys."""

    kind: Literal["stuck_valve"] = section(_KIND)
    chamber: Literal["plus", "minus"] = section("Of which chamber.")
    stuck: Literal["open", "closed"] = section("open: fills its chamber for ever; closed: vents it.")

    def make(self) -> StuckValve:
        """Return it in SI."""
        return StuckValve(self.segment, _CHAMBERS.index(self.chamber), _STATES[self.stuck], self.from_s)


FaultFile = Annotated[DeadSensorFile | StuckValveFile, Field(discriminator="kind")]
