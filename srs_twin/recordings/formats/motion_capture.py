"""Exports of motion capture systems as text: Motive, Vicon and Qualisys."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from itertools import pairwise, takewhile
from typing import NamedTuple, final

import numpy as np

from srs_twin.io.files import escape_unprintable
from srs_twin.recordings.formats.base import (
    Format,
    MarkerTable,
    Unstated,
    announced,
    frame_rate,
    length_unit,
    marker_rows,
    marker_table,
)
from srs_twin.recordings.recorded_file import MAX_HEADER_BYTES, RecordedFile
from srs_twin.recordings.signals.units import ANGLES

MOTIVE_KINDS = ("Marker", "Rigid Body Marker", "Rigid Body")
"""Types of columns with positions on the robot; the first type that a file has is used.
"""

_MOTIVE_HEADER_LINES = 12


class _Column(NamedTuple):
    """First column, name and type of a group of columns X, Y, Z, or X, Y, Z, W."""

    place: int
    name: str
    kind: str


@final
class Motive(Format):
    """OptiTrack Motive: CSV export, formats 1.0 to 1.2x.

    The first line has pairs of key and value, followed by an empty line and by rows
    that describe the columns (Type, Name, ID, Parent from 1.24 on, and Position or
    Rotation). Then follow ``Frame,Time (Seconds),X,…`` and the frames. An unlabeled
    marker that disappears comes back in another column.
    """

    name = "Motive CSV"

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether a file starts with the version of the Motive format."""
        return start.title == "Format Version"

    def read(self, file: RecordedFile, unstated: Unstated) -> MarkerTable:
        """Read the markers of an export.

        Columns of other types are skipped and counted. If there is no column of type
        Marker, the markers of rigid bodies are used, or else the rigid bodies with
        their quaternions.

        Raises:
            InputError: the file is damaged, or of another version; the message names
                file, line and column.
        """
        lines = file.head(_MOTIVE_HEADER_LINES)
        header = dict(pairwise(lines[0]))
        version = header.get("Format Version", "")
        if not re.fullmatch(r"1\.(0|1|2)\d?", version):
            allowed = "allowed: 1.0 to 1.29 (export again from Motive 2 or 3)"
            raise file.error(
                f"Format Version '{version[:20]}' cannot be read; {allowed}", 1, 2
            )
        top, positions, quaternions = _columns(file, lines)
        kind, notes = _kind_to_read(file, positions, top)
        unit = length_unit(file, header.get("Length Units", ""), 1)
        stated = header.get("Export Frame Rate") or header.get("Capture Frame Rate")
        rate = frame_rate(file, stated, 1) if stated else None
        markers = [column for column in positions if column.kind == kind]
        rotation_columns = {
            column.name: column.place
            for column in quaternions
            if column.kind == kind == MOTIVE_KINDS[-1]
        }
        rotated = [
            k for k, column in enumerate(markers) if column.name in rotation_columns
        ]
        others = [
            rotation_columns[markers[k].name] + axis
            for k in rotated
            for axis in range(4)
        ]
        first = [column.place for column in markers]
        width = len(lines[top - 1])
        rows = marker_rows(
            file, top, width, first, clock=(0, 1), rate=rate, others=others
        )
        rotations = None
        if rotated:
            rotations = np.full((len(rows.time), len(markers), 4), np.nan)
            rotations[:, rotated] = rows.others.reshape(len(rows.time), -1, 4)
        frames = announced(header.get("Total Exported Frames", ""))
        names = [column.name for column in markers]
        notes = rows.notes + notes
        return marker_table(
            file,
            f"{self.name} {version}",
            rows.time,
            rows.points,
            names,
            notes,
            unit=unit,
            header_frames=frames,
            rotations=rotations,
        )


def _kind_to_read(
    file: RecordedFile, positions: list[_Column], top: int
) -> tuple[str, list[str]]:
    """Return the type of the columns that are read, and notes on the others.

    Raises:
        InputError: no column has a type that can be on the robot.
    """
    kinds = Counter(column.kind or "no type" for column in positions)
    kind = next((name for name in MOTIVE_KINDS if name in kinds), None)
    if kind is None:
        types = ", ".join(sorted({column.kind for column in positions})) or "none"
        raise file.error(
            f"the header has no positions of markers (types with positions: {types};"
            f" allowed: {', '.join(MOTIVE_KINDS)})",
            top,
        )
    skipped = sorted((other, count) for other, count in kinds.items() if other != kind)
    notes = [
        f"{count} columns of positions of type {other} skipped"
        for other, count in skipped
    ]
    if kind != MOTIVE_KINDS[0]:
        notes.append(
            f"no columns of type {MOTIVE_KINDS[0]}: positions of type {kind} used"
        )
    return kind, notes


def _columns(
    file: RecordedFile, lines: list[list[str]]
) -> tuple[int, list[_Column], list[_Column]]:
    """Return the number of header lines, and the columns of positions and of quaternions."""
    last = next((k for k, cells in enumerate(lines) if cells[:1] == ["Frame"]), None)
    if last is None:
        count = len(lines) if lines[-1] else len(lines) - 1
        raise file.error(
            "the header is cut: no line 'Frame,Time (Seconds),X,Y,Z,…' in it", count + 1
        )
    axes = lines[last]
    width = len(lines[last])
    if width < 2 or not axes[1].startswith("Time"):
        raise file.error("'Time (Seconds)' is missing after 'Frame'", last + 1, 2)
    rows = [
        (cells + [""] * width)[:width] for cells in lines[1:last] if any(cells[:width])
    ]
    if len(rows) < 2:
        raise file.error(
            "the header is cut: it must have rows Type, Name, ID and Position", last + 1
        )
    # Older versions do not name the rows, so their order is used.
    kinds, names = (
        next((row for row in rows if name in row[:2]), rows[k])
        for k, name in enumerate(("Type", "Name"))
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


_SECTIONS = (
    "Trajectories",
    "Objects",
    "Devices",
    "Joints",
    "Segments",
    "Model Outputs",
    "Events",
    "Forces",
)
_VICON_AXES = {"Trajectories": ["X", "Y", "Z"], "Objects": ["TX", "TY", "TZ"]}
"""Section that is read → columns of a position; the first one that a file has is used.
"""
_SECTION = re.compile(
    rb'^"?(%s)"?[ \t,]*\r?$' % "|".join(_SECTIONS).encode(), re.MULTILINE
)


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
            InputError: the file cannot be read; the message names file, line, column
                and what is allowed.
        """
        section, above, notes = _vicon_section(file)
        position_axes = _VICON_AXES[section]
        lines = file.head(4, above)
        if len(lines) < 4 or lines[2][:2] != ["Frame", "Sub Frame"]:
            required = "must be followed by rate, names, 'Frame,Sub Frame,…' and units"
            raise file.error(f"the header is cut: '{section}' {required}", above + 1)
        rate = frame_rate(file, "".join(lines[0][:1]), above + 1)
        axes = lines[2]
        width = len(lines[2])
        names, units = ((line + [""] * width)[:width] for line in (lines[1], lines[3]))
        positions = [k for k in range(2, width - 2) if axes[k : k + 3] == position_axes]
        if not positions:
            raise file.error(f"no columns {','.join(position_axes)}", above + 3)
        lengths = [length_unit(file, units[k], above + 4, k + 1) for k in positions]
        # The rotation of an object precedes its position: RX, RY, RZ, or a quaternion
        # with RW.
        rotation_starts = {
            k: axes.index("RX", max(k - 4, 2), k)
            for k in positions
            if "RX" in axes[max(k - 4, 2) : k]
        }
        others = [
            column for k, begin in rotation_starts.items() for column in range(begin, k)
        ]
        rows = marker_rows(
            file, above + 4, width, positions, rate=1.0, others=others, section=True
        )
        rotations = None
        notes = rows.notes + notes
        if rotation_starts:
            notes.append(
                "RX, RY, RZ read as a rotation vector, or with RW as a quaternion"
            )
            rotations = np.full((*rows.points.shape[:2], 4), np.nan)
            end = 0
            for k, begin in rotation_starts.items():
                rotation = rows.others[:, end : end + k - begin]
                end = end + k - begin
                rotations[:, positions.index(k)] = _quaternions(rotation, units[begin])
        labels = [
            names[rotation_starts.get(k, k)].removeprefix("Global Angle ")
            or f"column {k + 1}"
            for k in positions
        ]
        return marker_table(
            file,
            self.name,
            (rows.time - 1) / rate,
            rows.points,
            labels,
            notes,
            unit=lengths,
            rotations=rotations,
        )


def _vicon_section(file: RecordedFile) -> tuple[str, int, list[str]]:
    """Return the title of the section that is read, the number of its line, and notes on other sections."""
    sections = [
        (title[1].decode(), title.start()) for title in _SECTION.finditer(file.raw)
    ]
    start_of_section = dict(reversed(sections))
    section = next((title for title in _VICON_AXES if title in start_of_section), None)
    if section is None:
        titles = ", ".join(dict.fromkeys(title for title, _ in sections))
        raise file.error(
            f"no section Trajectories (sections: {titles}); export trajectories from"
            " Nexus"
        )
    begin = start_of_section[section]
    skipped = [
        f"section {title} skipped" for title, start in sections if start != begin
    ]
    return section, file.raw.count(b"\n", 0, begin) + 1, skipped


def _quaternions(rotation: np.ndarray, unit: str) -> np.ndarray:
    """Return quaternions from rotation vectors in a unit, or from quaternions."""
    from scipy.spatial.transform import Rotation

    if rotation.shape[1] == 4:
        return rotation
    return np.asarray(
        Rotation.from_rotvec(rotation * ANGLES.get(unit.lower(), 1.0)).as_quat()
    )


_QTM_LINE = re.compile(rb"(?!NULL|NAN)[A-Z][A-Z0-9_]+[\t\r ]|Frame\t")
_QTM_HEADER_LINES = 1000
"""Largest number of lines of a header, which has one line per event."""


@final
class Qualisys(Format):
    """Qualisys Track Manager: 3D export (TSV, mm)."""

    name = "Qualisys TSV"

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether a file starts with a key of a Qualisys header."""
        return bool(
            re.match(
                r"(NO_OF_\w+|FILE_VERSION|FREQUENCY|MARKER_NAMES)\t", start.first_line
            )
        )

    def read(self, file: RecordedFile, unstated: Unstated) -> MarkerTable:
        """Read a 3D export of Qualisys Track Manager (mm); 0,0,0 marks a missing marker.

        Args:
            file: tab-separated file with a header, with or without the columns Frame
                and Time.
            unstated: frames per second, if FREQUENCY is EXT and there is no column
                Time.

        Raises:
            InputError: the file is damaged or a 2D or 6D export; the message names file
                and line.
        """
        file = replace(file, separator="\t")
        lines = file.raw[:MAX_HEADER_BYTES].split(b"\n", _QTM_HEADER_LINES)
        header = next(
            (k for k, line in enumerate(lines) if not _QTM_LINE.match(line)), len(lines)
        )
        *above, row = file.head(header + 1)
        fields = {cells[0]: [*cells[1:], ""] for cells in reversed(above)}
        kind = fields.get("DATA_INCLUDED", ["3D"])[0]
        if not fields.keys().isdisjoint({"NO_OF_BODIES", "BODY_NAMES"}):
            kind = "6D"
        if kind != "3D":
            description = escape_unprintable(
                f"{kind[:20]} exports of Qualisys cannot be read"
            )
            raise file.error(
                f"{description}; export 3D data (File, Export, To TSV, 3D data)"
            )
        names = list(takewhile(bool, fields.get("MARKER_NAMES", [])))
        if not names or len(row) < 3:
            raise file.error(
                "the header is cut: MARKER_NAMES and rows of numbers are missing",
                header + 1,
            )
        width = len(row)
        count = 3 * len(names)
        # A row may end in a tab, and begin with the frame and the time.
        first = {0: 0, 1: 0, 2: 2, 3: 2}.get(width - count)
        if first is None:
            required = (
                f"rows must have {count} cells, or {count + 2} with Frame and Time"
            )
            raise file.error(
                f"{width} cells for {len(names)} markers; {required}", header + 1
            )
        given = fields.get("FREQUENCY", [""])[0]
        if given in ("EXT", "") and unstated.rate_hz:
            given = str(unstated.rate_hz)
        if first and given == "EXT":
            rate = None
        else:
            rate = frame_rate(file, given)
        places = range(first, first + count, 3)
        clock = range(first)
        time, points, _, notes = marker_rows(
            file, header, width, places, clock=clock, rate=rate
        )
        points[(points == 0).all(axis=-1)] = (
            np.nan
        )  # also on a single frame, by the format's definition
        notes.append("0,0,0 read as missing")
        frames = announced(fields.get("NO_OF_FRAMES", [""])[0])
        return marker_table(
            file, self.name, time, points, names, notes, unit="mm", header_frames=frames
        )
