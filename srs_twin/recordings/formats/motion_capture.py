"""Exports of motion capture systems: Motive, Vicon, Qualisys, and C3D files."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from io import BytesIO
from itertools import pairwise, takewhile
from typing import Any, NamedTuple, final

import numpy as np

from srs_twin.errors import did_you_mean
from srs_twin.io.files import escape_unprintable
from srs_twin.recordings.formats.base import (
    Format,
    MarkerTable,
    Unstated,
    announced,
    decoding,
    frame_rate,
    is_rate,
    length_unit,
    marker_rows,
    marker_table,
)
from srs_twin.recordings.recorded_file import MAX_HEADER_BYTES, RecordedFile
from srs_twin.recordings.signals.units import ANGLES

MOTIVE_LENGTHS = {"Meters": "m", "Centimeters": "cm", "Millimeters": "mm", "Inches": "in", "Feet": "ft"}
"""Words after 'Length Units' in a Motive export."""

MOTIVE_KINDS = ("Marker", "Rigid Body Marker", "Rigid Body")
"""Types of columns with positions on the robot; the first type that a file has is used."""

_MOTIVE_HEADER_LINES = 12


class _Column(NamedTuple):
    """First column, name and type of a group of columns X, Y, Z, or X, Y, Z, W."""

    place: int
    name: str
    kind: str


@final
class Motive(Format):
    """OptiTrack Motive: CSV export, formats 1.0 to 1.2x.

    The first line has pairs of key and value, followed by an empty line and by rows that describe the columns
    (Type, Name, ID, Parent from 1.24 on, and Position or Rotation). Then follow ``Frame,Time (Seconds),X,…``
    and the frames. An unlabeled marker that disappears comes back in another column.
    """

    name = "Motive CSV"

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether a file starts with the version of the Motive format."""
        return start.title == "Format Version"

    def read(self, file: RecordedFile, unstated: Unstated) -> MarkerTable:
        """Read the markers of an export.

        Columns of other types are skipped and counted. If there is no column of type Marker, the markers of
        rigid bodies are used, or else the rigid bodies with their quaternions.

        Raises:
            InputError: the file is damaged, or of another version; the message names file, line and column.
        """
        lines = file.head(_MOTIVE_HEADER_LINES)
        header = dict(pairwise(lines[0]))
        version = header.get("Format Version", "")
        if not re.fullmatch(r"1\.(0|1|2)\d?", version):
            allowed = "allowed: 1.0 to 1.29 (export again from Motive 2 or 3)"
            raise file.error(f"Format Version '{version[:20]}' cannot be read; {allowed}", 1, 2)
        top, positions, quaternions = _columns(file, lines)
        kind, notes = _kind_to_read(file, positions, top)
        unit = _motive_unit(file, header.get("Length Units", ""))
        rates = (header.get(f"{name} Frame Rate", "") for name in ("Export", "Capture"))
        rate = next((float(text) for text in rates if is_rate(text)), None)
        markers = [column for column in positions if column.kind == kind]
        rotation_columns = {
            column.name: column.place for column in quaternions if column.kind == kind == MOTIVE_KINDS[-1]
        }
        rotated = [k for k, column in enumerate(markers) if column.name in rotation_columns]
        others = [rotation_columns[markers[k].name] + axis for k in rotated for axis in range(4)]
        first, width = [column.place for column in markers], len(lines[top - 1])
        rows = marker_rows(file, top, width, first, clock=(0, 1), rate=rate, others=others)
        rotations = None
        if rotated:
            rotations = np.full((len(rows.time), len(markers), 4), np.nan)
            rotations[:, rotated] = rows.others.reshape(len(rows.time), -1, 4)
        frames = announced(header.get("Total Exported Frames", ""))
        names, notes = [column.name for column in markers], rows.notes + notes
        return marker_table(
            file, f"{self.name} {version}", rows.time, rows.points, names, notes, unit=unit,
            header_frames=frames, rotations=rotations,
        )  # fmt: skip


def _kind_to_read(file: RecordedFile, positions: list[_Column], top: int) -> tuple[str, list[str]]:
    """Return the type of the columns that are read, and notes on the others.

    Raises:
        InputError: no column has a type that can be on the robot.
    """
    kinds = Counter(column.kind or "no type" for column in positions)
    kind = next((name for name in MOTIVE_KINDS if name in kinds), None)
    if kind is None:
        types = ", ".join(sorted({column.kind for column in positions})) or "none"
        raise file.error(
            f"the header has no positions of markers (types with positions: {types}; allowed: "
            f"{', '.join(MOTIVE_KINDS)})",
            top,
        )
    skipped = sorted((other, count) for other, count in kinds.items() if other != kind)
    notes = [f"{count} columns of positions of type {other} skipped" for other, count in skipped]
    if kind != MOTIVE_KINDS[0]:
        notes.append(f"no columns of type {MOTIVE_KINDS[0]}: positions of type {kind} used")
    return kind, notes


def _motive_unit(file: RecordedFile, given: str) -> str:
    unit = MOTIVE_LENGTHS.get(given.capitalize())
    if unit is None:
        hint, allowed = did_you_mean(given, MOTIVE_LENGTHS), ", ".join(MOTIVE_LENGTHS)
        raise file.error(f"Length Units '{given[:20]}' is not known{hint}; allowed: {allowed}", 1)
    return unit


def _columns(file: RecordedFile, lines: list[list[str]]) -> tuple[int, list[_Column], list[_Column]]:
    """Return the number of header lines, and the columns of positions and of quaternions."""
    last = next((k for k, cells in enumerate(lines) if cells[:1] == ["Frame"]), None)
    if last is None:
        count = len(lines) if lines[-1] else len(lines) - 1
        raise file.error("the header is cut: no line 'Frame,Time (Seconds),X,Y,Z,…' in it", count + 1)
    axes, width = lines[last], len(lines[last])
    if width < 2 or not axes[1].startswith("Time"):
        raise file.error("'Time (Seconds)' is missing after 'Frame'", last + 1, 2)
    rows = [(cells + [""] * width)[:width] for cells in lines[1:last] if any(cells[:width])]
    if len(rows) < 2:
        raise file.error("the header is cut: it must have rows Type, Name, ID and Position", last + 1)
    # Older versions do not name the rows, so their order is used.
    kinds, names = (
        next((row for row in rows if name in row[:2]), rows[k]) for k, name in enumerate(("Type", "Name"))
    )
    positions, quaternions = (
        [
            _Column(k, names[k] or f"column {k + 1}", kinds[k])
            for k in range(2, width + 1 - len(group))
            if axes[k : k + len(group)] == list(group) and rows[-1][k] == quantity
        ]
        for group, quantity in (("XYZ", "Position"), ("XYZW", "Rotation"))
    )
    return last + 1, positions, quaternions


_SECTIONS = ("Trajectories", "Objects", "Devices", "Joints", "Segments", "Model Outputs", "Events", "Forces")
_VICON_AXES = {"Trajectories": ["X", "Y", "Z"], "Objects": ["TX", "TY", "TZ"]}
"""Section that is read → columns of a position; the first one that a file has is used."""
_SECTION = re.compile(rb'^"?(%s)"?[ \t,]*\r?$' % "|".join(_SECTIONS).encode(), re.MULTILINE)


@final
class Vicon(Format):
    """Vicon: Trajectories of a Nexus CSV export, or Objects of a Tracker export; frame 1 is at 0 s."""

    name = "Vicon CSV"

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether a file starts with the title of a section."""
        return start.title in _SECTIONS

    def read(self, file: RecordedFile, unstated: Unstated) -> MarkerTable:
        """Read Trajectories of a Nexus export, or Objects of a Tracker export with their rotations.

        Raises:
            InputError: the file cannot be read; the message names file, line, column and what is allowed.
        """
        section, above, notes = _vicon_section(file)
        position_axes = _VICON_AXES[section]
        lines = file.head(4, above)
        if len(lines) < 4 or lines[2][:2] != ["Frame", "Sub Frame"]:
            required = "must be followed by rate, names, 'Frame,Sub Frame,…' and units"
            raise file.error(f"the header is cut: '{section}' {required}", above + 1)
        rate = frame_rate(file, "".join(lines[0][:1]), above + 1)
        axes, width = lines[2], len(lines[2])
        names, units = ((line + [""] * width)[:width] for line in (lines[1], lines[3]))
        positions = [k for k in range(2, width - 2) if axes[k : k + 3] == position_axes]
        if not positions:
            raise file.error(f"no columns {','.join(position_axes)}", above + 3)
        lengths = [length_unit(file, units[k], above + 4, k + 1) for k in positions]
        # The rotation of an object precedes its position: RX, RY, RZ, or a quaternion with RW.
        rotation_starts = {
            k: axes.index("RX", max(k - 4, 2), k) for k in positions if "RX" in axes[max(k - 4, 2) : k]
        }
        others = [column for k, begin in rotation_starts.items() for column in range(begin, k)]
        rows = marker_rows(file, above + 4, width, positions, rate=1.0, others=others, section=True)
        rotations, notes = None, rows.notes + notes
        if rotation_starts:
            notes.append("RX, RY, RZ read as a rotation vector, or with RW as a quaternion")
            rotations, end = np.full((*rows.points.shape[:2], 4), np.nan), 0
            for k, begin in rotation_starts.items():
                rotation, end = rows.others[:, end : end + k - begin], end + k - begin
                rotations[:, positions.index(k)] = _quaternions(rotation, units[begin])
        labels = [
            names[rotation_starts.get(k, k)].removeprefix("Global Angle ") or f"column {k + 1}"
            for k in positions
        ]
        return marker_table(
            file, self.name, (rows.time - 1) / rate, rows.points, labels, notes, unit=lengths,
            rotations=rotations,
        )  # fmt: skip


def _vicon_section(file: RecordedFile) -> tuple[str, int, list[str]]:
    """Return the title of the section that is read, the number of its line, and notes on other sections."""
    sections = [(title[1].decode(), title.start()) for title in _SECTION.finditer(file.raw)]
    start_of_section = dict(reversed(sections))
    section = next((title for title in _VICON_AXES if title in start_of_section), None)
    if section is None:
        titles = ", ".join(dict.fromkeys(title for title, _ in sections))
        raise file.error(f"no section Trajectories (sections: {titles}); export trajectories from Nexus")
    begin = start_of_section[section]
    skipped = [f"section {title} skipped" for title, start in sections if start != begin]
    return section, file.raw.count(b"\n", 0, begin) + 1, skipped


def _quaternions(rotation: np.ndarray, unit: str) -> np.ndarray:
    """Return quaternions from rotation vectors in a unit, or from quaternions."""
    from scipy.spatial.transform import Rotation

    if rotation.shape[1] == 4:
        return rotation
    return np.asarray(Rotation.from_rotvec(rotation * ANGLES.get(unit.lower(), 1.0)).as_quat())


_QTM_LINE = re.compile(rb"(?!NULL|NAN)[A-Z][A-Z0-9_]+[\t\r ]|Frame\t")
_QTM_HEADER_LINES = 1000
"""Largest number of lines of a header, which has one line per event."""


@final
class Qualisys(Format):
    """Qualisys Track Manager: 3D export (TSV, mm)."""

    name = "Qualisys TSV"

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether a file starts with a key of a Qualisys header."""
        return bool(re.match(r"(NO_OF_\w+|FILE_VERSION|FREQUENCY|MARKER_NAMES)\t", start.first_line))

    def read(self, file: RecordedFile, unstated: Unstated) -> MarkerTable:
        """Read a 3D export of Qualisys Track Manager (mm); 0,0,0 marks a missing marker.

        Args:
            file: tab-separated file with a header, with or without the columns Frame and Time.
            unstated: frames per second, if FREQUENCY is EXT and there is no column Time.

        Raises:
            InputError: the file is damaged or a 2D or 6D export; the message names file and line.
        """
        file = replace(file, separator="\t")
        lines = file.raw[:MAX_HEADER_BYTES].split(b"\n", _QTM_HEADER_LINES)
        header = next((k for k, line in enumerate(lines) if not _QTM_LINE.match(line)), len(lines))
        *above, row = file.head(header + 1)
        fields = {cells[0]: [*cells[1:], ""] for cells in reversed(above)}
        kind = fields.get("DATA_INCLUDED", ["3D"])[0]
        if not fields.keys().isdisjoint({"NO_OF_BODIES", "BODY_NAMES"}):
            kind = "6D"
        if kind != "3D":
            description = escape_unprintable(f"{kind[:20]} exports of Qualisys cannot be read")
            raise file.error(f"{description}; export 3D data (File, Export, To TSV, 3D data)")
        names = list(takewhile(bool, fields.get("MARKER_NAMES", [])))
        if not names or len(row) < 3:
            raise file.error("the header is cut: MARKER_NAMES and rows of numbers are missing", header + 1)
        width, count = len(row), 3 * len(names)
        # A row may end in a tab, and begin with the frame and the time.
        first = {0: 0, 1: 0, 2: 2, 3: 2}.get(width - count)
        if first is None:
            required = f"rows must have {count} cells, or {count + 2} with Frame and Time"
            raise file.error(f"{width} cells for {len(names)} markers; {required}", header + 1)
        given = fields.get("FREQUENCY", [""])[0]
        if given in ("EXT", "") and unstated.rate_hz:
            given = str(unstated.rate_hz)
        rate = None if first and given == "EXT" else frame_rate(file, given)
        places, clock = range(first, first + count, 3), range(first)
        time, points, _, notes = marker_rows(file, header, width, places, clock=clock, rate=rate)
        points[(points == 0).all(axis=-1)] = np.nan  # also on a single frame, by the format's definition
        notes.append("0,0,0 read as missing")
        frames = announced(fields.get("NO_OF_FRAMES", [""])[0])
        return marker_table(file, self.name, time, points, names, notes, unit="mm", header_frames=frames)


_MAX_FRAMES = 1 << 22
"""Largest number of frames of a C3D file: an hour at 1 kHz."""

_MAX_COUNTED = 65_535
"""Largest number of frames in the 16 bits of the header."""

_BLOCK = 512
"""Size of a block, bytes."""

_OTHER_KINDS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
"""Parameters with labels of points that are not positions (of Vicon's models)."""


@final
class C3d(Format):
    """C3D: points of a file, read with the library `c3d`.

    The library reads the header and the parameters. The data section is read here in one piece, because the
    library reads it frame by frame and needs the scales of all analog channels, which are not used.
    """

    name = "C3D"
    binary = True

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether a file starts with the bytes of a C3D header."""
        raw = start.data
        return raw[1:2] == b"\x50" and raw[0] < 32 and raw[0] not in b"\0\t\n\r"

    def read(self, file: RecordedFile, unstated: Unstated) -> MarkerTable:
        """Read the points of a C3D file; frame 1 is at 0 s, and a residual below 0 marks a missing point.

        Raises:
            InputError: the file is damaged or has no points, rate or unit, or the library is not installed.
        """
        with decoding(file, self.name):
            import c3d

            class Reader(c3d.Reader):  # type: ignore[misc]  # c3d has no types
                """Reader that accepts files whose header and parameters differ in unused values."""

                def _check_metadata(self) -> None:
                    pass

            reader = Reader(BytesIO(file.data))
            rate = frame_rate(file, str(float(reader.point_rate) or unstated.rate_hz or 0))
            samples, first, announced = _samples(file, reader)
            count = samples.shape[1]
            keys = ["POINT:LABELS", *(f"POINT:LABELS{k}" for k in range(2, 2 + count // 255))]
            names = ([name for key in keys for name in _strings(reader, key)] + [""] * count)[:count]
            # One unit for all points, or one for each.
            stated = [unit.lower() for unit in _strings(reader, "POINT:UNITS") if unit]
            given = stated or [unstated.unit or "mm"]
            others = {label for kind in _OTHER_KINDS for label in _strings(reader, f"POINT:{kind}") if label}
            chosen = [k for k in range(count) if names[k] not in others] or list(range(count))
            units = [length_unit(file, given[k if len(given) >= count else 0]) for k in chosen]
        notes = [] if stated else [f"POINT:UNITS is missing: {given[0]} assumed"]
        if len(chosen) < count:
            notes.append(f"{count - len(chosen)} points with angles, forces or similar quantities skipped")
        if len(samples) < announced:
            notes.append(f"the file ends after {len(samples)} of {announced} frames")
        time = (np.arange(len(samples)) + max(first - 1, 0)) / rate
        points = np.where(samples[..., 3:] <= -1, np.nan, samples[..., :3])[:, chosen]
        labels = [names[k] for k in chosen]
        return marker_table(file, self.name, time, points, labels, notes, unit=units, header_frames=announced)


def _samples(file: RecordedFile, reader: Any) -> tuple[np.ndarray, int, int]:
    """Return samples (x, y, z, residual), shape (frames, points, 4), first frame and stated frame count.

    The frame numbers of the header have 16 bits. Longer recordings state their frames in
    TRIAL:ACTUAL_START_FIELD and ACTUAL_END_FIELD (two 16-bit words each) or in POINT:LONG_FRAMES, but some of
    these may be wrong. The largest number that fits into the file is used. If all of them are at most 65,535,
    the file is read to its end.
    """
    from c3d.c3d import DEC_to_IEEE_BYTES

    header, scale, dtypes = reader.header, float(reader.point_scale), reader._dtypes
    count, kind = int(reader.point_used), np.dtype(dtypes.float32 if scale < 0 else dtypes.int16)
    width = (4 * count + int(header.analog_count)) * kind.itemsize
    block = int(header.data_block) or _integer(reader, "POINT:DATA_START")
    data = file.data[max(block - 1, 1) * _BLOCK :]
    by_header = int(header.last_frame) - int(header.first_frame) + 1
    start, end, long, short = (
        _integer(reader, key)
        for key in ("TRIAL:ACTUAL_START_FIELD", "TRIAL:ACTUAL_END_FIELD", "POINT:LONG_FRAMES", "POINT:FRAMES")
    )
    stated = [by_header, end and end - start + 1, long, short]
    counts = [number for number in stated if number > 0]
    if not count or not counts:
        raise file.error("the C3D file has no points; export marker trajectories")
    room = len(data) // width
    announced = max((number for number in counts if number <= room), default=counts[0])
    overflow = header.last_frame == _MAX_COUNTED and announced in (by_header, _MAX_COUNTED)
    frames = room if overflow else min(announced, room)
    if not 0 < frames <= _MAX_FRAMES:
        raise file.error(
            f"the C3D file has {frames} whole frames; it must have 1 to {_MAX_FRAMES} (record or export it "
            "again)"
        )
    data = data[: frames * width]
    numbers = DEC_to_IEEE_BYTES(data) if dtypes.is_dec and scale < 0 else np.frombuffer(data, kind)
    samples = numbers.reshape(frames, -1)[:, : 4 * count].reshape(frames, count, 4).astype(float)
    samples[..., :3] *= max(scale, 0.0) or 1.0
    if overflow:  # the last block is padded with zeros
        padding = int(samples[::-1].any(axis=(1, 2)).argmax())
        samples = samples[: frames - min(padding, _BLOCK // width)]
        announced = max(announced, len(samples))
    return samples, start or int(header.first_frame), announced


def _integer(reader: Any, key: str) -> int:
    """Return an integer parameter, stored as a float or as 16-bit words; 0 if it is missing."""
    param = reader.get(key)
    if param is None or len(param.bytes) < 2:
        return 0
    if param.bytes_per_element == 4:
        value = float(param.float_value)
        return int(value) if 0 < value < 1e9 else 0
    words = np.frombuffer(param.bytes[:4], reader._dtypes.uint16)
    return int(words[0]) + (int(words[1]) << 16 if len(words) > 1 else 0)


def _strings(reader: Any, key: str) -> list[str]:
    """Return the strings of a parameter; empty if it is missing."""
    param = reader.get(key)
    if param is None or not param.dimensions:
        return []
    strings = param.string_array if len(param.dimensions) > 1 else [param.string_value]
    return [str(string).strip("\0 ") for string in strings]
