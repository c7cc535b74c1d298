"""Readers for text exports of the motion capture systems Motive, Vicon and Qualisys."""

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
    Rows,
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
"""Types of position columns, in order of preference."""

_MOTIVE_HEADER_LINES = 12


class _Column(NamedTuple):
    place: int
    name: str
    kind: str


@final
class Motive(Format):
    """CSV export of OptiTrack Motive in the format versions 1.0 to 1.2x.

    The first line contains key-value pairs. The rows after an empty line describe the
    columns by Type, Name, ID, Position or Rotation, and since version 1.24 also by
    Parent. The last header row is ``Frame,Time (Seconds),X,…``. A reappearing
    unlabelled marker is stored in a new column.
    """

    name = "Motive CSV"

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether a file starts with the cell `Format Version`."""
        return start.title == "Format Version"

    def read(self, file: RecordedFile, unstated: Unstated) -> MarkerTable:
        """Read the markers or rigid bodies of an export.

        Only columns of the first type in `MOTIVE_KINDS` that the file contains are
        read. Rigid bodies are read with their quaternions.
        """
        lines = file.head(_MOTIVE_HEADER_LINES)
        header = dict(pairwise(lines[0]))
        version = header.get("Format Version", "")
        if not re.fullmatch(r"1\.(0|1|2)\d?", version):
            allowed = "supported: 1.0 to 1.29 (export again from Motive 2 or 3)"
            raise file.error(
                f"the format version '{version[:20]}' cannot be read; {allowed}", 1, 2
            )
        columns = _columns(file, lines)
        kind, notes = _kind_to_read(file, columns)
        unit = length_unit(file, header.get("Length Units", ""), 1)
        stated = header.get("Export Frame Rate") or header.get("Capture Frame Rate")
        markers = [column for column in columns.positions if column.kind == kind]
        quaternions = {
            column.name: column.place
            for column in columns.quaternions
            if column.kind == kind == MOTIVE_KINDS[-1]
        }
        rotated = [k for k, column in enumerate(markers) if column.name in quaternions]
        first_cells = (quaternions[markers[k].name] for k in rotated)
        rows = marker_rows(
            file,
            columns.header_lines,
            len(lines[columns.header_lines - 1]),
            [column.place for column in markers],
            clock=(0, 1),
            rate=frame_rate(file, stated, 1) if stated else None,
            others=[first + axis for first in first_cells for axis in range(4)],
        )
        rotations = None
        if rotated:
            rotations = np.full((*rows.points.shape[:2], 4), np.nan)
            rotations[:, rotated] = rows.others.reshape(len(rows.time), -1, 4)
        table = marker_table(
            file,
            f"{self.name} {version}",
            rows.time,
            rows.points,
            [column.name for column in markers],
            rows.notes + notes,
            unit=unit,
            rotations=rotations,
        )
        frames = announced(header.get("Total Exported Frames", ""))
        return replace(table, header_frames=frames)


class _Columns(NamedTuple):
    header_lines: int
    positions: list[_Column]
    quaternions: list[_Column]


def _kind_to_read(file: RecordedFile, columns: _Columns) -> tuple[str, list[str]]:
    kinds = Counter(column.kind or "no type" for column in columns.positions)
    kind = next((name for name in MOTIVE_KINDS if name in kinds), None)
    if kind is None:
        types = ", ".join(sorted(kinds)) or "none"
        raise file.error(
            "the header contains no positions of markers; export one of the types"
            f" {', '.join(MOTIVE_KINDS)} (the file has positions of the types {types})",
            columns.header_lines,
        )
    notes = [
        f"{count} columns with positions of type {other} were skipped"
        for other, count in sorted(kinds.items())
        if other != kind
    ]
    if kind != MOTIVE_KINDS[0]:
        notes.append(
            f"the file has no columns of type {MOTIVE_KINDS[0]}, so positions of type"
            f" {kind} are used"
        )
    return kind, notes


def _columns(file: RecordedFile, lines: list[list[str]]) -> _Columns:
    last = next((k for k, cells in enumerate(lines) if cells[:1] == ["Frame"]), None)
    if last is None:
        count = len(lines) if lines[-1] else len(lines) - 1
        raise file.error(
            "the header is incomplete, because the line 'Frame,Time"
            " (Seconds),X,Y,Z,…' is missing; export the file again",
            count + 1,
        )
    axes = lines[last]
    width = len(axes)
    if width < 2 or not axes[1].startswith("Time"):
        raise file.error(
            "the cell 'Time (Seconds)' is missing after 'Frame'; export the file again",
            last + 1,
            2,
        )
    rows = [
        (cells + [""] * width)[:width] for cells in lines[1:last] if any(cells[:width])
    ]
    if len(rows) < 2:
        raise file.error(
            "the header is incomplete; it must have the rows Type, Name, ID and"
            " Position",
            last + 1,
        )
    # Older versions do not name the header rows, so the rows are identified by their
    # order.
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
    return _Columns(last + 1, positions, quaternions)


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
"""Axis names of each section that contains positions, in order of preference."""
_SECTION = re.compile(
    rb'^"?(%s)"?[ \t,]*\r?$' % "|".join(_SECTIONS).encode(), re.MULTILINE
)


@final
class Vicon(Format):
    """CSV export of Vicon Nexus (Trajectories) or Vicon Tracker (Objects).

    The time of frame 1 is 0 s.
    """

    name = "Vicon CSV"

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether a file starts with a section title."""
        return start.title in _SECTIONS

    def read(self, file: RecordedFile, unstated: Unstated) -> MarkerTable:
        """Read the section Trajectories, or Objects if the file has no Trajectories."""
        section, above, notes = _vicon_section(file)
        position_axes = _VICON_AXES[section]
        lines = file.head(4, above)
        if len(lines) < 4 or lines[2][:2] != ["Frame", "Sub Frame"]:
            required = (
                "must be followed by the rate, the names, 'Frame,Sub Frame,…' and"
                " the units"
            )
            raise file.error(
                f"the header is incomplete: '{section}' {required}", above + 1
            )
        rate = frame_rate(file, "".join(lines[0][:1]), above + 1)
        axes = lines[2]
        width = len(axes)
        names, units = ((line + [""] * width)[:width] for line in (lines[1], lines[3]))
        positions = [k for k in range(2, width - 2) if axes[k : k + 3] == position_axes]
        if not positions:
            raise file.error(
                f"the columns {','.join(position_axes)} are missing; export them"
                " from Nexus",
                above + 3,
            )
        lengths = [length_unit(file, units[k], above + 4, k + 1) for k in positions]
        rotations = _rotation_columns(axes, positions)
        rows = marker_rows(
            file,
            above + 4,
            width,
            positions,
            rate=1.0,
            others=[column for columns in rotations.values() for column in columns],
            section=True,
        )
        notes = rows.notes + notes
        if rotations:
            notes.append(
                "RX, RY and RZ are read as a rotation vector, or together with RW as"
                " a quaternion"
            )
        firsts = [rotations[k].start if k in rotations else k for k in positions]
        labels = [
            names[first].removeprefix("Global Angle ") or f"column {k + 1}"
            for first, k in zip(firsts, positions, strict=True)
        ]
        return marker_table(
            file,
            self.name,
            (rows.time - 1) / rate,
            rows.points,
            labels,
            notes,
            unit=lengths,
            rotations=_object_rotations(rows, positions, rotations, units),
        )


def _object_rotations(
    rows: Rows, positions: list[int], rotations: dict[int, range], units: list[str]
) -> np.ndarray | None:
    if not rotations:
        return None
    quaternions = np.full((*rows.points.shape[:2], 4), np.nan)
    first = 0
    for k, columns in rotations.items():
        rotation = rows.others[:, first : first + len(columns)]
        unit = units[columns.start]
        quaternions[:, positions.index(k)] = _quaternions(rotation, unit)
        first += len(columns)
    return quaternions


def _rotation_columns(axes: list[str], positions: list[int]) -> dict[int, range]:
    return {
        k: range(axes.index("RX", max(k - 4, 2), k), k)
        for k in positions
        if "RX" in axes[max(k - 4, 2) : k]
    }


def _vicon_section(file: RecordedFile) -> tuple[str, int, list[str]]:
    sections = [
        (title[1].decode(), title.start()) for title in _SECTION.finditer(file.raw)
    ]
    start_of_section = dict(reversed(sections))
    section = next((title for title in _VICON_AXES if title in start_of_section), None)
    if section is None:
        titles = ", ".join(dict.fromkeys(title for title, _ in sections))
        raise file.error(
            "the section Trajectories is missing (the file has the sections"
            f" {titles}); export trajectories from Nexus"
        )
    begin = start_of_section[section]
    skipped = [
        f"the section {title} was skipped"
        for title, start in sections
        if start != begin
    ]
    return section, file.raw.count(b"\n", 0, begin) + 1, skipped


def _quaternions(rotation: np.ndarray, unit: str) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    if rotation.shape[1] == 4:
        return rotation
    return np.asarray(
        Rotation.from_rotvec(rotation * ANGLES.get(unit.lower(), 1.0)).as_quat()
    )


def _qtm_header_lines(file: RecordedFile) -> int:
    lines = file.raw[:MAX_HEADER_BYTES].split(b"\n", _QTM_HEADER_LINES)
    rows = (k for k, line in enumerate(lines) if not _QTM_LINE.match(line))
    return next(rows, len(lines))


_QTM_LINE = re.compile(rb"(?!NULL|NAN)[A-Z][A-Z0-9_]+[\t\r ]|Frame\t")
_QTM_HEADER_LINES = 1000
"""Maximum number of header lines, including one line per event."""


@final
class Qualisys(Format):
    """3D export of Qualisys Track Manager (TSV, mm)."""

    name = "Qualisys TSV"

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether a file starts with a key of a Qualisys header."""
        return bool(
            re.match(
                r"(NO_OF_\w+|FILE_VERSION|FREQUENCY|MARKER_NAMES)\t", start.first_line
            )
        )

    def read(self, file: RecordedFile, unstated: Unstated) -> MarkerTable:
        """Read a 3D export, in which the position 0,0,0 denotes a missing marker.

        The columns Frame and Time are optional. If FREQUENCY is EXT or missing, the
        frame rate in `unstated` is used. If FREQUENCY is EXT and no rate is given, the
        times are read from the column Time.
        """
        file = replace(file, separator="\t")
        *above, row = file.head(_qtm_header_lines(file) + 1)
        header = len(above)
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
                "the header is incomplete, because MARKER_NAMES or the rows of"
                " numbers are missing; export the file again",
                header + 1,
            )
        width = len(row)
        count = 3 * len(names)
        # A row may begin with the frame number and the time, and may end with a tab.
        if not 0 <= width - count <= 3:
            required = (
                f"each row must have {count} cells, or {count + 2} with Frame and Time"
            )
            raise file.error(
                f"the row has {width} cells for {len(names)} markers; {required}",
                header + 1,
            )
        first = 2 if width - count >= 2 else 0
        given = fields.get("FREQUENCY", [""])[0]
        if given in ("EXT", "") and unstated.rate_hz:
            given = str(unstated.rate_hz)
        timed = first and given == "EXT"
        time, points, _, notes = marker_rows(
            file,
            header,
            width,
            range(first, first + count, 3),
            clock=range(first),
            rate=None if timed else frame_rate(file, given),
        )
        # In Qualisys files, 0,0,0 denotes a missing marker even in a single frame.
        points[(points == 0).all(axis=-1)] = np.nan
        notes.append("positions 0,0,0 are read as missing")
        table = marker_table(file, self.name, time, points, names, notes, unit="mm")
        frames = announced(fields.get("NO_OF_FRAMES", [""])[0])
        return replace(table, header_frames=frames)
