"""Files with positions of markers: one call for all formats; OptiTrack Motive's CSV export, and plain CSV.

Motive's formats 1.0 to 1.2x: the first line holds pairs of key and value, then comes an empty one, then rows
that say what a column is (Type, Name, ID, from 1.24 on Parent, and Position or Rotation), then
``Frame,Time (Seconds),X,Y,Z,…`` and the frames. An unlabeled marker that vanishes comes back in a column of
its own. Other formats are read in `formats`.

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

from srs_twin.errors import InputError, did_you_mean
from srs_twin.recordings import formats
from srs_twin.recordings.csv_table import (
    CLOCK,
    LENGTHS,
    TIMES,
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

_HEADER_LINES = 12
_TIME = re.compile(
    r"\W*(?:t|time|timestamp|seconds|secs?)(?:[ _]*[\[(]?(?P<unit>s|ms|us)[\])]?)?\W*", re.IGNORECASE
)
_KEYS = ("Length Units", "Export Frame Rate", "Capture Frame Rate", "Total Exported Frames")


def read_markers(
    path: str | os.PathLike[str],
    *,
    rate_hz: float | None = None,
    unit: str | None = None,
    scale_m: float | None = None,
) -> MarkerTable:
    """Read a recording as it is, in any of `formats.FORMATS`.

    Args:
        path: of the file.
        rate_hz: frames a second, where the file does not say (DeepLabCut, plain CSV without a time, Qualisys
            with an external clock).
        unit: of lengths, where the file does not say (DeepLabCut, plain CSV).
        scale_m: size of a pixel, m (DeepLabCut).

    Raises:
        InputError: with file, line and column, and what is allowed.
    """
    kind = formats.identify(path)
    if kind == formats.C3D:
        return formats.read_c3d(path)
    if kind == formats.MCAP:
        topics = formats.read_mcap(path, signals=False)
        if topics.markers is None:
            wanted = "geometry_msgs/PoseStamped, PoseArray or PointStamped are wanted"
            there = "".join(f"; {note}" for note in topics.notes[:3])
            raise InputError(f"{topics.name}: no topic with positions; {wanted}{there}")
        return topics.markers
    file = read_file(path)
    if kind == formats.DEEPLABCUT:
        return formats.read_deeplabcut(file, rate_hz, unit, scale_m)
    if kind == formats.QUALISYS:
        return formats.read_qualisys(file, rate_hz)
    if kind == formats.PLAIN:
        return _plain(file, rate_hz, unit)
    return _motive(file) if kind == formats.MOTIVE else formats.read_vicon(file)


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


def _motive(file: RecordedFile) -> MarkerTable:
    """Read the markers of a take.

    Columns of other types are skipped and counted; where a take has no column of type Marker, the markers of
    its rigid bodies count, or else the rigid bodies themselves, with their quaternions.
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
    # Where a body has no quaternion, or nobody asks for it, its place says so.
    turns = {each.name: each.column for each in header.quaternions if each.kind == kind == KINDS[-1]}
    turned = [k for k, each in enumerate(markers) if each.name in turns]
    columns = [0, 1] + [each.column + axis for each in markers for axis in range(3)]
    columns += [turns[markers[k].name] + axis for k in turned for axis in range(4)]
    values, notes = file.rows(header.lines, columns, header.width)
    if unit != "m":
        notes.append(f"lengths converted from {unit} to m")
    skipped = sorted((other, count) for other, count in kinds.items() if other != kind)
    notes += [f"{count} columns of positions of type {other} skipped" for other, count in skipped]
    if kind != KINDS[0]:
        notes.append(f"no columns of type {KINDS[0]}: positions of type {kind} taken")
    end = 2 + 3 * len(markers)
    points, implausible = plausible(values[:, 2:end].reshape(len(values), -1, 3) * LENGTHS[unit])
    rotations = np.full((len(values), len(markers), 4), np.nan) if turned else None
    if rotations is not None:
        rotations[:, turned] = values[:, end:].reshape(len(values), -1, 4)
        rotations[np.isnan(rotations).any(axis=-1) | np.isnan(points[..., 0])] = np.nan
    time = _times(file, header, values[:, 0], values[:, 1])
    labels, corrections = tuple(each.name for each in markers), (*notes, *implausible)
    announced = header.about.get("Total Exported Frames", "")
    frames = int(announced) if announced.isdecimal() and len(announced) < 10 else None
    version = f"{formats.MOTIVE} {header.version}"
    return MarkerTable(
        file.name, file.sha256, version, time, points, labels, corrections, (), frames, rotations
    )


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
    if (missing := np.isnan(time)).any():
        raise file.error("a row without a time", header.lines + 1 + int(missing.argmax()), 2)
    for key in ("Export Frame Rate", "Capture Frame Rate"):
        try:
            rate = float(header.about.get(key, ""))
        except ValueError:
            continue
        if 0 < rate < 1e6:
            return formats.counted_times(frame, time, rate)
    return time


def _plain(file: RecordedFile, rate_hz: float | None, unit: str | None) -> MarkerTable:
    """Read the markers of a plain CSV file."""
    table = read_table(file, CLOCK | dict.fromkeys("xyz", LENGTHS))
    if all(each.name in CLOCK or not each.number for each in table.columns):
        return _foreign(file, rate_hz, unit)
    clock = table.clock(
        "no column 'time' (the first line of a plain CSV file names the columns: time,x_1,y_1,x_2,y_2,…)"
    )
    marks = _marks(table)
    chosen = [column for mark in marks.values() for column in mark]
    time, values, notes = table.read_timed(clock, chosen)
    if unit:
        values = values * np.array([1.0 if each.unit else LENGTHS[unit] for each in chosen])
    units = sorted({each.unit or unit or "" for each in [clock, *chosen]} - {"", "m", "s"})
    if units:
        notes.append(f"converted from {', '.join(units)} to SI")
    unstated = [each.text for each in [clock, *chosen] if not each.unit]
    if unstated and not unit:
        notes.append(f"{len(unstated)} columns without a unit taken as s and m ({unstated[0]}, …)")
    points, implausible = plausible(values.reshape(len(time), len(marks), -1))
    labels = tuple(f"{number}{letter}" for number, letter in marks)
    corrections = (*notes, *table.unused_columns(), *implausible)
    places = tuple((2 * (number - 1), "") for number, _ in marks)
    return MarkerTable(file.name, file.sha256, formats.PLAIN, time, points, labels, corrections, places)


def _foreign(file: RecordedFile, rate_hz: float | None, unit: str | None) -> MarkerTable:
    """Read a plain CSV file whose columns are named by anybody: NAME_x, NAME_y, and z where it is there."""
    (cells,) = file.head(1)
    marks = formats.axis_columns(cells)
    if not marks:
        raise file.error(
            "no positions: columns x_1,y_1,x_2,y_2,… (head first) or NAME_x,NAME_y are wanted", 1
        )
    clock = next(((k, match) for k, cell in enumerate(cells) if (match := _TIME.fullmatch(cell))), None)
    if clock is None and not rate_hz:
        raise file.error("no column 'time', and no rate_hz (frames a second) in a map or by --rate", 1)
    axes = "xyz" if any("z" in each for each in marks.values()) else "xy"
    flat = [(name, axis, *each.get(axis, (-1, ""))) for name, each in marks.items() for axis in axes]
    if (short := next((each for each in flat if each[2] < 0), None)) is not None:
        raise file.error(f"{short[0]}_z is missing, other markers have one", 1)
    columns = ([] if clock is None or rate_hz else [clock[0]]) + [place for _, _, place, _ in flat]
    values, notes = file.rows(1, columns, len(cells))
    if clock is None or rate_hz:
        time = np.arange(len(values)) / float(rate_hz or 1.0)
        notes.append(f"frames counted, {rate_hz:g} a second")
    else:
        time, values = values[:, 0] * TIMES[(clock[1]["unit"] or "s").lower()], values[:, 1:]
        if (missing := np.isnan(time)).any():
            raise file.error("a row without a time", 2 + int(missing.argmax()), clock[0] + 1)
    given = [each or unit or "m" for *_, each in flat]
    if not unit and not all(each for *_, each in flat):
        notes.append("columns without a unit taken as m")
    notes += [f"converted from {each} to m" for each in sorted({*given} - {"m"})]
    scaled = values * np.array([LENGTHS[each] for each in given])
    points, implausible = plausible(scaled.reshape(len(time), len(marks), -1))
    corrections = (*notes, *implausible)
    return MarkerTable(file.name, file.sha256, formats.PLAIN, time, points, tuple(marks), corrections)


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
