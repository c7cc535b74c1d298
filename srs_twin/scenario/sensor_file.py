"""What a scenario file says of the curvature sensors."""

from __future__ import annotations

from typing import Literal

from pydantic import model_validator

from srs_twin.io.validation import Strict
from srs_twin.scenario.fields import quantity, section


class SensorFile(Strict):
    """What controllers are told of the bends."""

    kind: Literal["ideal", "hall"] = section(
        "ideal: the bend as it is; hall: magnet and Hall element on a strip, amplifier, converter, straight "
        "line (docs/sensor.md).",
        "ideal",
    )
    span_rad: float | None = quantity(
        "Bends to both sides over which it is trimmed and calibrated (hall; default 90 degrees)",
        "rad", 0.1, 1.6, None,
    )  # fmt: skip
    distance_mm: float | None = quantity(
        "From the magnet to the element, along the strip (hall; default 3.1)", "mm", 1.0, 50.0, None
    )
    orientation: Literal["up", "side"] | None = section("Of the magnet's north (hall; default up).", None)
    chamber: Literal["semicircular", "rectangular"] | None = section(
        "Cross-section of the pressure chambers (hall; default semicircular); a rectangular one presses on "
        "the strip.",
        None,
    )
    noise_uv: float | None = quantity(
        "RMS noise of the element that the amplifier passes (hall; default 25)", "µV", 0.0, 1e5, None
    )
    bits: int | None = quantity("Of the converter (hall; default 10)", "", 1, 32, None)
    bias_v: float | None = quantity(
        "Drift of the output since the calibration (hall; default 0)", "V", -5.0, 5.0, None
    )
    gain_error: float | None = quantity(
        "Drift of the gain since the calibration, as a share of it (hall; default 0)", "", -0.9, 10.0, None
    )

    @model_validator(mode="after")
    def _what_belongs_together(self) -> SensorFile:
        given = [name for name in HALL_ONLY if getattr(self, name) is not None]
        if given and self.kind != "hall":
            raise ValueError(f"{given[0]} belongs to kind: hall; set that, or take {given[0]} out")
        return self


HALL_ONLY = tuple(name for name in SensorFile.model_fields if name != "kind")
