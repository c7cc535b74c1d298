"""Recordings of a scenario: what was measured of a robot, to replay and to hold the plants against."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from srs_twin.identification.takes import RecordingReader
from srs_twin.scenario.fields import Line, Section, constructor_default, quantity

FilePath = Annotated[str, Field(min_length=1, max_length=1000)]


class RecordingFile(Section):
    """What was measured of a robot and the log of its air (docs/logs.md); paths from the current folder."""

    constructors = (RecordingReader,)

    motion: FilePath
    """What cameras saw, a Motive or plain CSV file; on a bench also a CSV file of time,bend_1,…."""
    valves: FilePath | None = None
    """Log of valves or pressures; a plain CSV file (default: NAME.valves.csv beside the motion)."""
    offset_s: float | None = quantity(-1e9, 1e9)
    """What to add to the log's times (default: estimated)."""
    gait_frequency_hz: float | None = quantity(0.01, 50.0)
    """Gait frequency (default: as the valves repeat themselves)."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = constructor_default()
    """Axis of the file that points up."""
    layout: Literal["auto", "single", "head", "pair"] = constructor_default()
    """Where the markers are."""
    head: Line | None = constructor_default()
    """Column of the marker at the head; the end towards which it crawls where there is none."""
    longest_gap_s: float = quantity(0.0, 10.0)
    """Longest gap that is filled."""
