"""What a scenario file says of a recording that is replayed."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from srs_twin.io.validation import Strict
from srs_twin.scenario.fields import quantity, section

Path = Annotated[str, Field(min_length=1, max_length=1000)]


class RecordingFile(Strict):
    """What was measured of a robot and the log of its air (docs/logs.md); paths from the current folder."""

    motion: Path = section(
        "What cameras saw, a Motive or plain CSV file; on a bench also a CSV file of time,bend_1,…."
    )
    valves: Path | None = section(
        "Log of valves or pressures; a plain CSV file (default: NAME.valves.csv beside the motion).", None
    )
    offset_s: float | None = quantity(
        "What to add to the log's times (default: estimated)", "s", -1e9, 1e9, None
    )
    gait_frequency_hz: float | None = quantity(
        "Gait frequency (default: as the valves repeat themselves)", "Hz", 0.01, 50.0, None
    )
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = section("Axis of the file that points up.", "auto")
    layout: Literal["auto", "single", "head", "pair"] = section("Where the markers are.", "auto")
    head: Annotated[str, Field(min_length=1, max_length=200)] | None = section(
        "Column of the marker at the head; the end towards which it crawls where there is none.", None
    )
    longest_gap_s: float = quantity("Longest gap that is filled", "s", 0.0, 10.0, 0.2)
