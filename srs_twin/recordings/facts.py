"""Facts about recordings, and their output as JSON, text and a proposed map.

The JSON output of `srs-twin inspect` is a list with one object per readable file. Each
object omits the keys that do not apply to the file. `srs-twin schema inspect` prints
the JSON Schema of this output.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, TypeAdapter

from srs_twin.io.validation import StrictModel
from srs_twin.recordings.body.floor import Up
from srs_twin.recordings.recording_map import canonical_key, log_meaning


def _unit(unit: str) -> object:
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
    # Validation converts NumPy scalars, which JSON does not support, to Python numbers.
    model_config = ConfigDict(strict=False, frozen=False, validate_assignment=True)


class MarkerFacts(_Facts):
    """Facts about a marker or a rigid body in a file."""

    name: str
    """Name of the column."""
    rigid_body: bool
    """Whether the column is a rigid body with an orientation."""
    coverage: Ratio
    """Fraction of the frames in which the marker was detected."""
    gaps: Count
    """Number of gaps between the first and the last detection of the marker."""
    longest_gap_s: Seconds
    """Time between the detections before and after the longest gap of the marker."""
    noise_mm: Millimetres | None
    """Standard deviation of the noise in a marker coordinate (null if the marker is
    never detected)."""
    noise_m: Metres | None
    """Standard deviation of the noise in a marker coordinate, in m."""
    height_mm: Millimetres | None
    """Median height of the marker above the origin of the file."""


class DistanceFacts(_Facts):
    """Distance between two markers that are adjacent along the body."""

    markers: Pair
    """Names of the two markers."""
    median_mm: Millimetres
    """Median distance between the markers."""
    spread_mm: Millimetres
    """Standard deviation of the distance, estimated from quartiles."""


class HeadFacts(_Facts):
    """End of the body that may be the head."""

    marker: str
    """Name of the marker at this end."""
    why: str
    """Reason why this end may be the head."""


class SignalFacts(_Facts):
    """Facts about a signal in a column or topic."""

    name: str
    """Name of the column or topic."""
    looks_like: str
    """Quantity that the name, the unit or the map indicates, or "unknown"."""
    understood: bool
    """Whether the name or the map states the meaning of the signal."""
    low: Annotated[float, _unit("of the file")] | None = None
    """Lowest value of the signal."""
    high: Annotated[float, _unit("of the file")] | None = None
    """Highest value of the signal."""
    distinct: Count | None = None
    """Number of distinct values of the signal."""
    openings_per_s: Hertz | None = None
    """Rate at which a signal with at most three values rises to its maximum."""


class RobotFacts(_Facts):
    """Result of reading a file for the robot that `--robot` names."""

    name: str
    """Name of the robot."""
    reads: bool
    """Whether the file can be read as a recording or log of this robot."""
    says: str
    """Summary of the recording, or the reason why the file cannot be read."""
    layout: str | None = None
    """Layout of the markers on the body."""
    bend_error_rad: Radians | None = None
    """RMS standard error of the bends."""
    length_mm: list[Millimetres] | None = None
    """Median arc length of each segment, in order from the head."""
    stretch: list[Ratio] | None = None
    """Difference between the 98 % and 2 % quantiles of each segment's arc length,
    relative to the nominal length."""


class RecordingFacts(_Facts):
    """Facts about one file."""

    file: str
    """Path of the file, as given by the user."""
    format: str
    """Name of the file format, including the version if there are several versions."""
    content: Literal["markers", "log"]
    """Whether the file contains marker positions or a log of other signals."""
    sha256: str
    """SHA-256 checksum of the file."""
    rate_hz: Hertz | None = None
    """Frame rate from the median time step, or mean row rate of a log with increasing
    times."""
    duration_s: Seconds | None = None
    """Duration from the first to the last frame or row."""
    starts_s: Seconds | None = None
    """Time of the first row of a log."""
    rows: Count | None = None
    """Number of rows in a log."""
    steps_back: Count | None = None
    """Number of log rows with an earlier time than the previous row."""
    repeated_times: Count | None = None
    """Number of log rows with the same time as the previous row."""
    frames: Count | None = None
    """Number of frames in the file."""
    frames_missing: Count | None = None
    """Number of frames that are missing in the file."""
    announced_frames: Count | None = None
    """Number of frames stated in the header (null if the header states none)."""
    units: str | None = None
    """Unit of length in the file, which is stated, given by the user or assumed."""
    up: Up | None = None
    """Axis of the file that points up."""
    markers: list[MarkerFacts] | None = None
    """Markers and rigid bodies in the file."""
    bodies: list[str] | None = None
    """Names of the rigid bodies with an orientation."""
    tracks: Count | None = None
    """Number of markers that may belong to the robot and are visible in at least 20 %
    of the frames."""
    positions_of_nothing: Count | None = None
    """Number of positions that do not belong to any tracked marker."""
    in_other_columns: Ratio | None = None
    """Fraction of the robot marker positions outside the usual column of the marker."""
    noise_mm: Millimetres | None = None
    """Standard deviation of the noise in the coordinates of all tracked markers."""
    rigid_pairs: list[Pair] | None = None
    """Pairs of markers at a constant distance from each other."""
    order: list[str] | None = None
    """Markers in order along the body, or an empty list if they do not form a line."""
    distances: list[DistanceFacts] | None = None
    """Distances between adjacent markers, in order along the body."""
    layouts: dict[str, Count] | None = None
    """Number of connectors in each marker layout that fits the number of markers."""
    head: list[HeadFacts] | None = None
    """Ends of the body that may be the head, with the most likely end first."""
    signals: list[SignalFacts] | None = None
    """Signals in the file other than positions."""
    robot: RobotFacts | None = None
    """Result of reading a file for the robot that `--robot` names."""
    proposals: list[str]
    """Lines of a proposed recording map (YAML), which the user should check."""
    notes: list[str]
    """Notes on results, conversions, assumptions and ignored data."""

    def document(self) -> dict[str, object]:
        """Return the facts as plain data, without the keys that do not apply."""
        return self.model_dump(mode="json", exclude_unset=True)


def facts_json_schema() -> dict[str, object]:
    """Return the JSON Schema (draft 2020-12) for the output of `inspect --json`."""
    schema = TypeAdapter(list[RecordingFacts]).json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | schema


def proposed_map(facts: Sequence[RecordingFacts]) -> str:
    """Return a proposed map for the files of one recording as commented YAML."""
    lines = ["# Proposed by srs-twin inspect: check it, then use it as --map."]
    for file in facts:
        if file.content != "markers":
            continue
        lines.append(f"# {file.file}: {file.format}, {file.rate_hz:.4g} Hz")
        if file.up is not None:
            lines.append(f"up: {json.dumps(file.up)}")
        if file.in_other_columns:
            lines += [
                f"# {100 * file.in_other_columns:.2g} % of the positions are not in the"
                " columns of their markers,",
                "# because markers switch columns. The map therefore states no places,"
                " and the markers",
                "# are identified by their motion. Use --layout and --head if the"
                " motion does not",
                "# determine the layout and the head.",
            ]
        else:
            lines += _marker_lines(file)
    logged = [
        signal
        for file in facts
        for signal in file.signals or ()
        if signal.looks_like != "text"
    ]
    keys = [canonical_key(signal.name) for signal in logged]
    if any(map(log_meaning, keys)):
        lines.append("log:")
    elif logged:
        lines.append(
            "# log:  # assign valve_plus_1, pressure_kpa_plus_1, … of each segment"
        )
    bends = sum(key.startswith("bend") for key in keys)
    for key, signal in zip(keys, logged, strict=True):
        proposed = key
        if not log_meaning(key):
            proposed = "# valve_plus_1"
            if signal.looks_like.startswith("angle"):
                bends += 1
                proposed = f"# bend_{bends}"
        comment = f"{signal.looks_like}, {signal.low or 0:g} to {signal.high or 0:g}"
        lines.append(f"  {proposed}: {json.dumps(signal.name)}  # {comment}")
    return "\n".join(lines) + "\n"


def _marker_lines(facts: RecordingFacts) -> list[str]:
    order = list(facts.order or ())
    heads = facts.head or ()
    markers = facts.markers or ()
    if not order:
        return [
            "# markers: their order is not known; give their places: {connector: 1},"
            " {middle: 1}, …"
        ]
    reason = "the head is not known: reverse the numbers if it is at the other end"
    if heads:
        reason = heads[0].why
        if heads[0].marker == order[-1]:
            order.reverse()
    if any(marker.rigid_body for marker in markers):
        named = enumerate(dict.fromkeys(order), start=1)
        places = [f"  {json.dumps(name)}: {{connector: {k}}}" for k, name in named]
        return [f"bodies:  # head: {reason}", *places]
    pairs = {frozenset(pair) for pair in facts.rigid_pairs or ()}
    in_pairs = len(order) % 2 == 0 and pairs >= set(
        map(frozenset, zip(order[::2], order[1::2], strict=True))
    )
    ahead = not in_pairs and len(order) > 2 and frozenset(order[:2]) in pairs
    lines = [f"markers:  # head: {reason}"]
    for k, name in enumerate(order):
        connector = k // 2 + 1 if in_pairs else max(1, k + 1 - ahead)
        side = ", side: ahead" if ahead and k == 0 else ""
        lines.append(f"  {json.dumps(name)}: {{connector: {connector}{side}}}")
    others = (marker.name for marker in markers if marker.name not in order)
    return lines + [f"  {json.dumps(name)}: ignore" for name in others]


def in_words(facts: RecordingFacts) -> str:
    """Return the facts as text, one fact per line."""
    lines = [f"{facts.file}: {facts.format}, {facts.content}"]
    if facts.rate_hz:
        count = f"{facts.frames} frames, {facts.rate_hz:.4g} Hz"
        if facts.frames is None:
            count = f"{facts.rows} rows, {facts.rate_hz:.4g} rows per second"
        lines.append(f"{count}, {facts.duration_s:.4g} s")
    if facts.up is not None:
        summary = f"up: {facts.up}"
        if facts.noise_mm is not None:
            summary += f"; noise {facts.noise_mm:.2g} mm"
        lines.append(f"{summary}; {facts.tracks or 0} persistent markers")
    lines += [f"  {_marker_text(marker)}" for marker in (facts.markers or ())[:40]]
    rigid_pairs = [set(pair) for pair in facts.rigid_pairs or ()]
    for distance in facts.distances or ():
        text = (
            f"  {' to '.join(distance.markers)}: {distance.median_mm:.1f} mm, varies by"
            f" {distance.spread_mm:.2g} mm"
        )
        if set(distance.markers) in rigid_pairs:
            text += ", one rigid part"
        lines.append(text)
    if facts.layouts is not None:
        fitting = [
            f"{name} ({count} connectors)"
            for name, count in facts.layouts.items()
            if count > 1
        ]
        lines.append(f"layouts with this number of markers: {', '.join(fitting)}")
        heads = "; ".join(f"{head.marker} ({head.why})" for head in facts.head or ())
        lines.append(f"head: {heads or 'not determined by the markers; give --head'}")
    lines += [f"  {_signal_text(signal)}" for signal in facts.signals or ()]
    if (robot := facts.robot) is not None:
        lines.append(f"as a recording or log of {robot.name}:")
        lines += [f"  {line}" for line in robot.says.split("\n")]
    return "\n".join([*lines, *(f"note: {note}" for note in facts.notes)])


def _marker_text(marker: MarkerFacts) -> str:
    text = (
        f"{marker.name}: seen in {100 * marker.coverage:.1f} % of the frames,"
        f" {marker.gaps} gaps up to {marker.longest_gap_s:.3g} s"
    )
    if marker.noise_mm is None:
        text += ", never seen"
    else:
        text += f", noise {marker.noise_mm:.2g} mm, {marker.height_mm:.0f} mm high"
    if marker.rigid_body:
        text += ", rigid body"
    return text


def _signal_text(signal: SignalFacts) -> str:
    text = f"{signal.name}: {signal.looks_like}"
    if signal.low is not None:
        text += f", {signal.low:g} to {signal.high:g}"
    if signal.openings_per_s:
        text += f", {signal.openings_per_s:.3g} openings per second"
    if not signal.understood:
        text += " (needs a map)"
    return text
