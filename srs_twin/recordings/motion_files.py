"""Files with positions of markers: OptiTrack Motive's CSV export, and plain CSV.

Motive's format 1.2x: the first line holds pairs of key and value, then comes an empty one, then rows that say
what a column is (Type, Name, ID, from 1.24 on Parent, and Position or Rotation), then
``Frame,Time (Seconds),X,Y,Z,…`` and the frames. An unlabeled marker that vanishes comes back in a column of
its own.

Plain CSV: ``time`` and ``x_1,y_1…`` (head first) in the first line. A unit stands in the name: ``time_ms``,
``x_1_mm`` or ``x_1 (mm)``; without one it is s and m. ``z_1`` may be there as well. Two markers on a
connector are ``x_1a,y_1a,x_1b,y_1b``.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from srs_twin.errors import did_you_mean
from srs_twin.recordings.csv_table import (
    CLOCK,
    LENGTHS,
    CsvColumn,
    CsvTable,
    RecordedFile,
    read_file,
    read_table,
)
from srs_twin.recordings.tracking import MarkerTable, plausible

MOTIVE_LENGTHS = {"Meters": "m", "Centimeters": "cm", "Millimeters": "mm", "Inches": "in", "Feet": "ft"}
"""Words after 'Length Units' in a Motive export."""

KINDS = ("Marker", "Rigid Body Marker", "Rigid Body")
"""Types of columns with positions of something on the robot; the first that a file has counts."""

_FIRST = b"Format Version"
_HEADER_LINES = 12
_KEYS = ("Length Units", "Export Frame Rate", "Capture Frame Rate", "Total Exported Frames")


def read_markers(path: str | os.PathLike[str]) -> MarkerTable:
    """Read a Motive export or a plain CSV file as it is.

    Raises:
        InputError: with file, line and column, and what is allowed.
    """
    file = read_file(path)
    return _motive(file) if file.raw.startswith(_FIRST) else _plain(file)


class _Position(NamedTuple):
    """First column, name and type of a group of columns X, Y, Z."""

    column: int
    name: str
    kind: str


@dataclass(frozen=True)
class _Header:
    """Version, values by key, number of lines, cells a row, and the groups of positions."""

    version: str
    about: dict[str, str]
    lines: int
    width: int
    positions: list[_Position]


def _motive(file: RecordedFile) -> MarkerTable:
    """Read the markers of a take.

    Columns of other types, and rotations, are skipped and counted; where a take has no column of type Marker,
    the markers of its rigid bodies count, or else the rigid bodies themselves.
    """
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
    columns = [0, 1] + [each.column + axis for each in markers for axis in range(3)]
    values, notes = file.rows(header.lines, columns, header.width)
    if unit != "m":
        notes.append(f"lengths converted from {unit} to m")
    skipped = sorted((other, count) for other, count in kinds.items() if other != kind)
    notes += [f"{count} columns of positions of type {other} skipped" for other, count in skipped]
    if kind != KINDS[0]:
        notes.append(f"no columns of type {KINDS[0]}: positions of type {kind} taken")
    points, implausible = plausible(values[:, 2:].reshape(len(values), -1, 3) * LENGTHS[unit])
    time = _times(file, header, values[:, 0], values[:, 1])
    labels, corrections = tuple(each.name for each in markers), (*notes, *implausible)
    announced = header.about.get("Total Exported Frames", "")
    frames = int(announced) if announced.isdecimal() and len(announced) < 10 else None
    version = f"Motive CSV {header.version}"
    return MarkerTable(file.name, file.sha256, version, time, points, labels, corrections, (), frames)


def _header(file: RecordedFile) -> _Header:
    lines = file.head(_HEADER_LINES)
    first = lines[0]
    version = first[1].strip() if len(first) > 1 else ""
    if not re.fullmatch(r"1\.2\d?", version):
        allowed = "allowed: 1.2 to 1.29 (export anew from Motive 2 or 3)"
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
    positions = [
        _Position(k, names[k] or f"column {k + 1}", kinds[k])
        for k in range(2, width - 2)
        if axes[k : k + 3] == ["X", "Y", "Z"] and rows[-1][k] == "Position"
    ]
    about = {key: first[first.index(key) + 1] for key in _KEYS if key in first[:-1]}
    return _Header(version, about, last + 1, width, positions)


def _times(file: RecordedFile, header: _Header, frame: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return the times, from the frame's number where the rate is known: printed times are rounded.

    Raises:
        InputError: a row without a time.
    """
    if (missing := np.isnan(time)).any():
        raise file.error("a row without a time", header.lines + 1 + int(missing.argmax()), 2)
    for key in ("Export Frame Rate", "Capture Frame Rate"):
        try:
            rate = float(header.about.get(key, ""))
        except ValueError:
            continue
        if 0 < rate < 1e6 and np.isfinite(frame).all():
            counted = time[0] + (frame - frame[0]) / rate
            # A take exported from its middle counts frames or time from elsewhere; half a frame is rounding.
            return np.asarray(counted) if np.abs(counted - time).max() < 0.5 / rate else time
    return time


def _plain(file: RecordedFile) -> MarkerTable:
    """Read the markers of a plain CSV file."""
    table = read_table(file, CLOCK | dict.fromkeys("xyz", LENGTHS))
    clock = table.clock(
        "neither a Motive export (its first line begins 'Format Version,1.2') nor a plain CSV file "
        "(its first line names the columns: time,x_1,y_1,x_2,y_2,…)"
    )
    marks = _marks(table)
    chosen = [column for mark in marks.values() for column in mark]
    time, values, notes = table.read_timed(clock, chosen)
    units = sorted({each.unit for each in [clock, *chosen] if each.unit not in ("", "m", "s")})
    if units:
        notes.append(f"converted from {', '.join(units)} to SI")
    unstated = [each.text for each in [clock, *chosen] if not each.unit]
    if unstated:
        notes.append(f"{len(unstated)} columns without a unit taken as s and m ({unstated[0]}, …)")
    points, implausible = plausible(values.reshape(len(time), len(marks), -1))
    labels = tuple(f"{number}{letter}" for number, letter in marks)
    corrections = (*notes, *table.unused_columns(), *implausible)
    places = tuple((2 * (number - 1), "") for number, _ in marks)
    return MarkerTable(file.name, file.sha256, "plain CSV", time, points, labels, corrections, places)


def _marks(table: CsvTable) -> dict[tuple[int, str], list[CsvColumn]]:
    """Return the columns of each marker's coordinates, head first."""
    marks: dict[tuple[int, str], list[CsvColumn]] = {}
    for each in sorted(table.columns, key=lambda column: (column.number, column.letter, column.name)):
        if each.name in CLOCK:
            continue
        if each.number == 0:
            raise table.error(each, f"{each.text}: a number is wanted: {each.name}_1 at the head")
        marks.setdefault((each.number, each.letter), []).append(each)
    if not marks:
        raise table.file.error("no positions: columns x_1,y_1,x_2,y_2,… are wanted, head first", 1)
    axes = "xyz" if any(len(mark) == 3 for mark in marks.values()) else "xy"
    for (number, letter), mark in marks.items():
        missing = [axis for axis in axes if axis not in [each.name for each in mark]]
        if missing:
            raise table.error(mark[0], f"{mark[0].text}: {missing[0]}_{number}{letter} is missing")
    numbers = {number for number, _ in marks}
    hole = next(k for k in range(1, len(numbers) + 2) if k not in numbers)
    if hole <= len(numbers):
        raise table.file.error(f"x_{hole} is missing; connectors are numbered from 1 at the head", 1)
    return marks
