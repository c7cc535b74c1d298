"""OptiTrack Motive: its CSV export, formats 1.0 to 1.2x.

The first line holds pairs of key and value, then comes an empty one, then rows that say what a column is
(Type, Name, ID, from 1.24 on Parent, and Position or Rotation), then ``Frame,Time (Seconds),X,Y,Z,…`` and the
frames. An unlabeled marker that vanishes comes back in a column of its own.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from srs_twin.errors import InputError, did_you_mean
from srs_twin.recordings.csv_table import RecordedFile, read_file
from srs_twin.recordings.formats.base import (
    Start,
    Unstated,
    announced,
    converted,
    counted_times,
    frame_rate,
    marker_table,
    numbered,
)
from srs_twin.recordings.marker_table import MarkerTable
from srs_twin.recordings.signals.units import LENGTHS

NAME = "Motive CSV"
MOTIVE_LENGTHS = {"Meters": "m", "Centimeters": "cm", "Millimeters": "mm", "Inches": "in", "Feet": "ft"}
"""Words after 'Length Units' in a Motive export."""

KINDS = ("Marker", "Rigid Body Marker", "Rigid Body")
"""Types of columns with positions of something on the robot; the first that a file has counts."""

_HEADER_LINES = 12
_KEYS = ("Length Units", "Export Frame Rate", "Capture Frame Rate", "Total Exported Frames")


def recognizes(start: Start) -> bool:
    """Say whether a file starts with Motive's version."""
    return start.title == "Format Version"


class _Position(NamedTuple):
    """First column, name and type of a group of columns X, Y, Z, or X, Y, Z, W."""

    column: int
    name: str
    kind: str


@dataclass(frozen=True)
class _Header:
    """Version, values by key, number of lines, cells a row, groups of positions and of quaternions."""

    version: str
    about: dict[str, str]
    lines: int
    width: int
    positions: list[_Position]
    quaternions: list[_Position]


def read(path: str | os.PathLike[str], unstated: Unstated) -> MarkerTable:
    """Read the markers of a take.

    Columns of other types are skipped and counted; where a take has no column of type Marker, the markers of
    its rigid bodies count, or else the rigid bodies themselves, with their quaternions.
    """
    file = read_file(path)
    header = _header(file)
    kinds = Counter(each.kind or "no type" for each in header.positions)
    kind = next((each for each in KINDS if each in kinds), None)
    if kind is None:
        found = ", ".join(sorted({each.kind for each in header.positions})) or "none"
        wanted = f"types with positions: {found}; wanted: {', '.join(KINDS)}"
        raise file.error(f"no positions of markers in the header ({wanted})", header.lines)
    given = header.about.get("Length Units", "").strip()
    unit = MOTIVE_LENGTHS.get(given.capitalize())
    if unit is None:
        hint, allowed = did_you_mean(given, MOTIVE_LENGTHS), ", ".join(MOTIVE_LENGTHS)
        raise file.error(f"Length Units '{given[:20]}' is not known{hint}; allowed: {allowed}", 1)
    markers = [each for each in header.positions if each.kind == kind]
    # Where a body has no quaternion, or nobody asks for it, its place says so.
    turns = {each.name: each.column for each in header.quaternions if each.kind == kind == KINDS[-1]}
    turned = [k for k, each in enumerate(markers) if each.name in turns]
    columns = [0, 1] + [each.column + axis for each in markers for axis in range(3)]
    columns += [turns[markers[k].name] + axis for k in turned for axis in range(4)]
    values, notes = file.rows(header.lines, columns, header.width)
    notes += converted([unit])
    skipped = sorted((other, count) for other, count in kinds.items() if other != kind)
    notes += [f"{count} columns of positions of type {other} skipped" for other, count in skipped]
    if kind != KINDS[0]:
        notes.append(f"no columns of type {KINDS[0]}: positions of type {kind} taken")
    end = 2 + 3 * len(markers)
    points = values[:, 2:end].reshape(len(values), -1, 3) * LENGTHS[unit]
    rotations = np.full((len(values), len(markers), 4), np.nan) if turned else None
    if rotations is not None:
        rotations[:, turned] = values[:, end:].reshape(len(values), -1, 4)
    time = _times(file, header, values[:, 0], values[:, 1])
    version, names = f"{NAME} {header.version}", [each.name for each in markers]
    frames = announced(header.about.get("Total Exported Frames", ""))
    return marker_table(file, version, time, points, names, notes, frames=frames, rotations=rotations)


def _header(file: RecordedFile) -> _Header:
    lines = file.head(_HEADER_LINES)
    first = lines[0]
    version = first[1].strip() if len(first) > 1 else ""
    if not re.fullmatch(r"1\.(0|1|2)\d?", version):
        allowed = "allowed: 1.0 to 1.29 (export anew from Motive 2 or 3)"
        raise file.error(f"Format Version '{version[:20]}' is not read; {allowed}", 1, 2)
    last = next((k for k, cells in enumerate(lines) if cells and cells[0].strip() == "Frame"), None)
    if last is None:
        below = len(lines) if lines[-1] else len(lines) - 1
        raise file.error("the header is cut: no line 'Frame,Time (Seconds),X,Y,Z,…' in it", below + 1)
    axes, width = [cell.strip() for cell in lines[last]], len(lines[last])
    if width < 2 or not axes[1].startswith("Time"):
        raise file.error("'Time (Seconds)' is wanted after 'Frame'", last + 1, 2)
    stripped = [[cell.strip() for cell in (cells + [""] * width)[:width]] for cells in lines[1:last]]
    rows = [cells for cells in stripped if any(cells)]
    if len(rows) < 2:
        raise file.error("the header is cut: rows Type, Name, ID and Position are wanted", last + 1)
    # Older writers do not name the rows; then their order counts.
    kinds, names = (
        next((row for row in rows if name in row[:2]), rows[k]) for k, name in enumerate(("Type", "Name"))
    )
    positions, quaternions = (
        [
            _Position(k, names[k] or f"column {k + 1}", kinds[k])
            for k in range(2, width + 1 - len(group))
            if axes[k : k + len(group)] == list(group) and rows[-1][k] == what
        ]
        for group, what in (("XYZ", "Position"), ("XYZW", "Rotation"))
    )
    about = {key: first[first.index(key) + 1] for key in _KEYS if key in first[:-1]}
    return _Header(version, about, last + 1, width, positions, quaternions)


def _times(file: RecordedFile, header: _Header, frame: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return the times, from the frame's number where the rate is known: printed times are rounded.

    Raises:
        InputError: a row without a time.
    """
    time = numbered(file, time, header.lines, "time", 2)
    for key in ("Export Frame Rate", "Capture Frame Rate"):
        with suppress(InputError):
            return counted_times(frame, time, frame_rate(file, header.about.get(key, "")))
    return time
