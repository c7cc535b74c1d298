"""Facts of a recording: the output of `srs-twin inspect --json`, one object per file that can be read.

Keys that do not apply to a file are left out. `srs-twin schema inspect` prints the JSON Schema of the list.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, TypeAdapter

from srs_twin.io.validation import StrictModel


def _unit(unit: str) -> Any:
    return Field(json_schema_extra={"unit": unit})


Count = Annotated[int, _unit("1")]
Hertz = Annotated[float, _unit("Hz")]
Metres = Annotated[float, _unit("m")]
Millimetres = Annotated[float, _unit("mm")]
Radians = Annotated[float, _unit("rad")]
Ratio = Annotated[float, _unit("1")]
Seconds = Annotated[float, _unit("s")]


Pair = Annotated[list[str], Field(min_length=2, max_length=2)]


class _Facts(StrictModel):
    # Converts the numbers of NumPy to those of Python.
    model_config = ConfigDict(strict=False)


class MarkerFacts(_Facts):
    """Detected marker or rigid body, on the robot or not."""

    name: str
    """Name of the column."""
    rigid_body: bool
    """Whether it is a rigid body with a rotation; the position is then that of the body."""
    coverage: Ratio
    """Fraction of the frames on which it was detected."""
    gaps: Count
    """Number of gaps between its first and its last detection."""
    longest_gap_s: Seconds
    """Duration of the longest gap."""
    noise_mm: Millimetres | None
    """Standard deviation of the noise of a coordinate; null for a marker that was never detected."""
    noise_m: Metres | None
    """Standard deviation of the noise of a coordinate in m."""
    height_mm: Millimetres | None
    """Median height above the origin of the file."""


class DistanceFacts(_Facts):
    """Distance of two neighbours along the body."""

    markers: Pair
    """Names of the markers."""
    median_mm: Millimetres
    """Median distance."""
    spread_mm: Millimetres
    """Standard deviation of the distance, from its quartiles."""


class HeadFacts(_Facts):
    """An end of the body that may be the head."""

    marker: str
    """Name of the marker."""
    why: str
    """Reason."""


class SignalFacts(_Facts):
    """Column or topic with numbers over time."""

    name: str
    """Name of the column or topic."""
    looks_like: str
    """Quantity suggested by its name and values."""
    understood: bool
    """Whether its name is known without a map."""
    low: Annotated[float, _unit("of the file")] | None = None
    """Lowest value."""
    high: Annotated[float, _unit("of the file")] | None = None
    """Highest value."""
    distinct: Count | None = None
    """Number of different values."""
    openings_per_s: Hertz | None = None
    """Rate at which a signal with two or three values reaches its highest one."""


class RobotFacts(_Facts):
    """Result of reading the file as a recording of the robot in `--robot`."""

    name: str
    """Name of the robot."""
    reads: bool
    """Whether it is a recording of this robot."""
    says: str
    """Summary of the recording, or the reason why it cannot be read."""
    layout: str | None = None
    """Layout of the markers."""
    bend_error_rad: Radians | None = None
    """Root mean square of the standard errors of the bends."""
    length_mm: list[Millimetres] | None = None
    """Median arc length of each segment, head first."""
    stretch: list[Ratio] | None = None
    """Range of each length (98 % minus 2 % quantile) relative to that of the robot, head first."""


class RecordingFacts(_Facts):
    """Facts of one file."""

    file: str
    """Path as given."""
    format: str
    """File format, with its version where it has one."""
    content: Literal["markers", "log"]
    """Whether the file has positions or other numbers over time."""
    sha256: str
    """Checksum of the file."""
    rate_hz: Hertz | None = None
    """Frames or rows per second, from the median step; null if the time does not increase."""
    duration_s: Seconds | None = None
    """Time from the first frame or row to the last."""
    starts_s: Seconds | None = None
    """Time of a log's first row."""
    rows: Count | None = None
    """Rows of a log."""
    steps_back: Count | None = None
    """Number of rows of a log with an earlier time than the previous row."""
    frames: Count | None = None
    """Frames in the file."""
    frames_missing: Count | None = None
    """Frames that the file skips."""
    announced_frames: Count | None = None
    """Number of frames that the header states; null if it states none."""
    units: str | None = None
    """Unit of length of the file, as stated, given or assumed. The lengths below are in the units of their
    keys."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """Axis of the file that points up."""
    markers: list[MarkerFacts] | None = None
    """All columns of positions."""
    bodies: list[str] | None = None
    """Names of the rigid bodies with a rotation."""
    tracks: Count | None = None
    """Number of markers that may belong to the robot and were detected on at least 20 % of the frames."""
    positions_of_nothing: Count | None = None
    """Number of positions that do not belong to a tracked marker."""
    noise_mm: Millimetres | None = None
    """Standard deviation of the noise of a coordinate over all these markers."""
    rigid_pairs: list[Pair] | None = None
    """Pairs of markers on one rigid part."""
    order: list[str] | None = None
    """Markers from one end of the body to the other; empty if they are not along one line."""
    distances: list[DistanceFacts] | None = None
    """Distances of neighbours in this order."""
    layouts: dict[str, Count] | None = None
    """Marker layout → number of connectors of a robot with this number of markers."""
    head: list[HeadFacts] | None = None
    """Ends that may be the head, in order of likelihood."""
    signals: list[SignalFacts] | None = None
    """Signals of a log, or those in a file with positions."""
    robot: RobotFacts | None = None
    """Only with `--robot`."""
    proposals: list[str]
    """Lines of a proposed map (YAML), to be checked."""
    notes: list[str]
    """Notes on results, conversions, assumptions and data that were left out."""


def plain_facts(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return validated facts in plain Python types, for JSON."""
    return RecordingFacts.model_validate(facts).model_dump(mode="json", exclude_unset=True)


def facts_json_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of `inspect --json`, with descriptions and units."""
    schema = TypeAdapter(list[RecordingFacts]).json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | schema
