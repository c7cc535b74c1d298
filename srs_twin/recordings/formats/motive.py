"""OptiTrack Motive: its CSV export, formats 1.0 to 1.2x.

The first line holds pairs of key and value, then comes an empty one, then rows that say what a column is
(Type, Name, ID, from 1.24 on Parent, and Position or Rotation), then ``Frame,Time (Seconds),X,Y,Z,…`` and the
frames. An unlabeled marker that vanishes comes back in a column of its own.
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
"""Types of columns with positions of something on the robot; the first that a file has counts."""

_HEADER_LINES = 12


def recognizes(start: RecordedFile) -> bool:
    """Say whether a file starts with Motive's version."""
    return start.title == "Format Version"


class _Column(NamedTuple):
    """First column, name and type of a group of columns X, Y, Z, or X, Y, Z, W."""

    place: int
    name: str
    kind: str


def read(file: RecordedFile, unstated: Unstated) -> MarkerTable:
    """Read the markers of a take.

    Columns of other types are skipped and counted; where a take has no column of type Marker, the markers of
    its rigid bodies count, or else the rigid bodies themselves, with their quaternions.

    Raises:
        InputError: damaged, or of another version; with file, line and column.
    """
    lines = file.head(_HEADER_LINES)
    about = dict(pairwise(lines[0]))
    version = about.get("Format Version", "")
    if not re.fullmatch(r"1\.(0|1|2)\d?", version):
        allowed = "allowed: 1.0 to 1.29 (export anew from Motive 2 or 3)"
        raise file.error(f"Format Version '{version[:20]}' is not read; {allowed}", 1, 2)
    top, positions, quaternions = _columns(file, lines)
    kinds = Counter(each.kind or "no type" for each in positions)
    kind = next((each for each in KINDS if each in kinds), None)
    if kind is None:
        found = ", ".join(sorted({each.kind for each in positions})) or "none"
        wanted = f"types with positions: {found}; wanted: {', '.join(KINDS)}"
        raise file.error(f"no positions of markers in the header ({wanted})", top)
    given = about.get("Length Units", "")
    unit = MOTIVE_LENGTHS.get(given.capitalize())
    if unit is None:
        hint, allowed = did_you_mean(given, MOTIVE_LENGTHS), ", ".join(MOTIVE_LENGTHS)
        raise file.error(f"Length Units '{given[:20]}' is not known{hint}; allowed: {allowed}", 1)
    rates = (about.get(f"{which} Frame Rate", "") for which in ("Export", "Capture"))
    rate = next((float(each) for each in rates if is_rate(each)), None)
    markers = [each for each in positions if each.kind == kind]
    turns = {each.name: each.place for each in quaternions if each.kind == kind == KINDS[-1]}
    turned = [k for k, each in enumerate(markers) if each.name in turns]
    others = [turns[markers[k].name] + axis for k in turned for axis in range(4)]
    time, points, found_turns, notes = marker_rows(
        file,
        top,
        len(lines[top - 1]),
        [each.place for each in markers],
        clock=(0, 1),
        rate=rate,
        others=others,
    )
    rotations = np.full((len(time), len(markers), 4), np.nan) if turned else None
    if rotations is not None:
        rotations[:, turned] = found_turns.reshape(len(time), -1, 4)
    skipped = sorted((other, count) for other, count in kinds.items() if other != kind)
    notes += [f"{count} columns of positions of type {other} skipped" for other, count in skipped]
    if kind != KINDS[0]:
        notes.append(f"no columns of type {KINDS[0]}: positions of type {kind} taken")
    frames, names = announced(about.get("Total Exported Frames", "")), [each.name for each in markers]
    return marker_table(
        file, f"{NAME} {version}", time, points, names, notes, unit=unit, header_frames=frames,
        rotations=rotations,
    )  # fmt: skip


def _columns(file: RecordedFile, lines: list[list[str]]) -> tuple[int, list[_Column], list[_Column]]:
    """Return the number of lines of the header, and the columns of positions and of quaternions in it."""
    last = next((k for k, cells in enumerate(lines) if cells[:1] == ["Frame"]), None)
    if last is None:
        below = len(lines) if lines[-1] else len(lines) - 1
        raise file.error("the header is cut: no line 'Frame,Time (Seconds),X,Y,Z,…' in it", below + 1)
    axes, width = lines[last], len(lines[last])
    if width < 2 or not axes[1].startswith("Time"):
        raise file.error("'Time (Seconds)' is wanted after 'Frame'", last + 1, 2)
    rows = [(cells + [""] * width)[:width] for cells in lines[1:last] if any(cells[:width])]
    if len(rows) < 2:
        raise file.error("the header is cut: rows Type, Name, ID and Position are wanted", last + 1)
    # Older writers do not name the rows; then their order counts.
    kinds, names = (
        next((row for row in rows if name in row[:2]), rows[k]) for k, name in enumerate(("Type", "Name"))
    )
    positions, quaternions = (
        [
            _Column(k, names[k] or f"column {k + 1}", kinds[k])
            for k in range(2, width + 1 - len(group))
            if axes[k : k + len(group)] == list(group) and rows[-1][k] == what
        ]
        for group, what in (("XYZ", "Position"), ("XYZW", "Rotation"))
    )
    return last + 1, positions, quaternions
