"""OptiTrack Motive: CSV export, formats 1.0 to 1.2x.

The first line has pairs of key and value, followed by an empty line and by rows that describe the columns
(Type, Name, ID, Parent from 1.24 on, and Position or Rotation). Then follow ``Frame,Time (Seconds),X,Y,Z,…``
and the frames. An unlabeled marker that disappears comes back in another column.
"""

from __future__ import annotations

import re
from collections import Counter
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from srs_twin.errors import did_you_mean
from srs_twin.recordings.csv_table import RecordedFile
from srs_twin.recordings.formats.base import (
    Unstated,
    announced,
    is_rate,
    marker_rows,
    marker_table,
)
from srs_twin.recordings.marker_table import MarkerTable

NAME = "Motive CSV"
MOTIVE_LENGTHS = {"Meters": "m", "Centimeters": "cm", "Millimeters": "mm", "Inches": "in", "Feet": "ft"}
"""Words after 'Length Units' in a Motive export."""

KINDS = ("Marker", "Rigid Body Marker", "Rigid Body")
"""Types of columns with positions on the robot; the first type that a file has is used."""

_HEADER_LINES = 12


def recognizes(start: RecordedFile) -> bool:
    """Return whether a file starts with the version of the Motive format."""
    return start.title == "Format Version"


class _Column(NamedTuple):
    """First column, name and type of a group of columns X, Y, Z, or X, Y, Z, W."""

    place: int
    name: str
    kind: str


def read(file: RecordedFile, unstated: Unstated) -> MarkerTable:
    """Read the markers of an export.

    Columns of other types are skipped and counted. If there is no column of type Marker, the markers of rigid
    bodies are used, or else the rigid bodies with their quaternions.

    Raises:
        InputError: the file is damaged, or of another version; the message names file, line and column.
    """
    lines = file.head(_HEADER_LINES)
    header = dict(pairwise(lines[0]))
    version = header.get("Format Version", "")
    if not re.fullmatch(r"1\.(0|1|2)\d?", version):
        allowed = "allowed: 1.0 to 1.29 (export again from Motive 2 or 3)"
        raise file.error(f"Format Version '{version[:20]}' cannot be read; {allowed}", 1, 2)
    top, positions, quaternions = _columns(file, lines)
    kinds = Counter(column.kind or "no type" for column in positions)
    kind = next((name for name in KINDS if name in kinds), None)
    if kind is None:
        types = ", ".join(sorted({column.kind for column in positions})) or "none"
        raise file.error(
            f"the header has no positions of markers (types with positions: {types}; allowed: "
            f"{', '.join(KINDS)})",
            top,
        )
    given = header.get("Length Units", "")
    unit = MOTIVE_LENGTHS.get(given.capitalize())
    if unit is None:
        hint, allowed = did_you_mean(given, MOTIVE_LENGTHS), ", ".join(MOTIVE_LENGTHS)
        raise file.error(f"Length Units '{given[:20]}' is not known{hint}; allowed: {allowed}", 1)
    rates = (header.get(f"{name} Frame Rate", "") for name in ("Export", "Capture"))
    rate = next((float(text) for text in rates if is_rate(text)), None)
    markers = [column for column in positions if column.kind == kind]
    rotation_columns = {
        column.name: column.place for column in quaternions if column.kind == kind == KINDS[-1]
    }
    rotated = [k for k, column in enumerate(markers) if column.name in rotation_columns]
    others = [rotation_columns[markers[k].name] + axis for k in rotated for axis in range(4)]
    time, points, quaternion_values, notes = marker_rows(
        file,
        top,
        len(lines[top - 1]),
        [column.place for column in markers],
        clock=(0, 1),
        rate=rate,
        others=others,
    )
    rotations = np.full((len(time), len(markers), 4), np.nan) if rotated else None
    if rotations is not None:
        rotations[:, rotated] = quaternion_values.reshape(len(time), -1, 4)
    skipped = sorted((other, count) for other, count in kinds.items() if other != kind)
    notes += [f"{count} columns of positions of type {other} skipped" for other, count in skipped]
    if kind != KINDS[0]:
        notes.append(f"no columns of type {KINDS[0]}: positions of type {kind} used")
    frames, names = announced(header.get("Total Exported Frames", "")), [column.name for column in markers]
    return marker_table(
        file, f"{NAME} {version}", time, points, names, notes, unit=unit, header_frames=frames,
        rotations=rotations,
    )  # fmt: skip


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
