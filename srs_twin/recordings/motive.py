"""OptiTrack Motive's CSV export, format 1.2x.

The first line holds pairs of key and value, then comes an empty one, then rows that say what a column is
(Type, Name, ID, from 1.24 on Parent, and Position or Rotation), then ``Frame,Time (Seconds),X,Y,Z,…`` and
the frames. An unlabeled marker that vanishes comes back in a column of its own.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from dataclasses import dataclass

import numpy as np

from srs_twin.errors import did_you_mean
from srs_twin.recordings.source import Source
from srs_twin.recordings.tables import LENGTHS, MOTIVE_LENGTHS, read_rows
from srs_twin.recordings.tracking import MarkerTable, believable

FIRST = "Format Version"
_HEADER_LINES = 12
_KEYS = ("Length Units", "Export Frame Rate", "Capture Frame Rate", "Total Exported Frames", "Take Name")

KINDS = ("Marker", "Rigid Body Marker", "Rigid Body")
"""Types of columns with positions of something on the robot; the first that a file has counts."""


@dataclass(frozen=True)
class _Header:
    """Version, values by key, number of lines, cells a row; first column, name and type of X,Y,Z groups."""

    version: str
    about: dict[str, str]
    lines: int
    width: int
    groups: tuple[tuple[int, str, str], ...]


def parse_motive(source: Source) -> MarkerTable:
    """Read the markers of a take.

    Columns of other types, and rotations, are skipped and counted; where a take has no column of type Marker,
    the markers of its rigid bodies count, or else the rigid bodies themselves.

    Raises:
        InputError: another format version, no header, no markers, an unknown unit of length, or as
            `read_rows`.
    """
    header = _header(source)
    kind, groups = _chosen(source, header)
    unit = _length_unit(source, header)
    columns = [0, 1] + [start + axis for start, _, _ in groups for axis in range(3)]
    rows = read_rows(source, header.lines, columns, header.width)
    said = [*rows.corrections]
    time = _times(source, header, rows.values, rows.first_line)
    points = rows.values[:, 2:].reshape(len(time), len(groups), 3) * LENGTHS[unit]
    if unit != "m":
        said.append(f"lengths converted from {unit} to m")
    said += _skipped(header, kind)
    points, unbelievable = believable(points)
    return MarkerTable(
        kind=f"Motive CSV {header.version}",
        time=time,
        points=points,
        labels=tuple(name for _, name, _ in groups),
        connectors=(),
        header_frames=_whole(header.about.get("Total Exported Frames")),
        sha256=source.sha256,
        name=source.name,
        corrections=(*said, *unbelievable),
    )


def _header(source: Source) -> _Header:
    lines = [_cells(source, k, line) for k, line in enumerate(source.head(_HEADER_LINES), start=1)]
    first = lines[0]
    version = first[1].strip() if len(first) > 1 else ""
    if not re.fullmatch(r"1\.2\d?", version):
        raise source.error(
            f"Format Version '{version[:20]}' is not read; allowed: 1.2 to 1.29 (export anew from Motive 2 "
            "or 3)",
            1,
            2,
        )
    last = next((k for k, cells in enumerate(lines) if cells and cells[0].strip() == "Frame"), None)
    if last is None:
        raise source.error("the header is cut: no line 'Frame,Time (Seconds),X,Y,Z,…' in it", len(lines) + 1)
    if len(lines[last]) < 2 or not lines[last][1].startswith("Time"):
        raise source.error("'Time (Seconds)' is wanted after 'Frame'", last + 1, 2)
    about = {key: first[first.index(key) + 1] for key in _KEYS if key in first[:-1]}
    rows = [cells for cells in lines[1:last] if any(cell.strip() for cell in cells)]
    if len(rows) < 2:
        raise source.error("the header is cut: rows Type, Name, ID and Position are wanted", last + 1)
    axes, width = lines[last], len(lines[last])
    types, names = _named(rows, "Type", 0, width), _named(rows, "Name", 1, width)
    quantity = (rows[-1] + [""] * width)[:width]
    groups = tuple(
        (k, names[k].strip() or f"column {k + 1}", types[k].strip())
        for k in range(2, width - 2)
        if [axis.strip() for axis in axes[k : k + 3]] == ["X", "Y", "Z"] and quantity[k].strip() == "Position"
    )
    return _Header(version, about, last + 1, width, groups)


def _cells(source: Source, number: int, line: str) -> list[str]:
    try:
        return next(csv.reader([line], strict=True), [])
    except csv.Error as error:
        raise source.error(f"no line of a CSV file ({error})", number) from error


def _named(rows: list[list[str]], name: str, place: int, width: int) -> list[str]:
    """Return the header row of that name; older writers name none, then the place counts."""
    row = next((each for each in rows if name in (cell.strip() for cell in each[:2])), rows[place])
    return (row + [""] * width)[:width]


def _chosen(source: Source, header: _Header) -> tuple[str, list[tuple[int, str, str]]]:
    for kind in KINDS:
        groups = [each for each in header.groups if each[2] == kind]
        if groups:
            return kind, groups
    found = ", ".join(sorted({kind for _, _, kind in header.groups})) or "none"
    raise source.error(
        f"no positions of markers in the header (types with positions: {found}; wanted: {', '.join(KINDS)})",
        header.lines,
    )


def _length_unit(source: Source, header: _Header) -> str:
    given = header.about.get("Length Units", "").strip()
    unit = MOTIVE_LENGTHS.get(given.lower())
    if unit is None:
        allowed = [word.capitalize() for word in MOTIVE_LENGTHS]
        raise source.error(
            f"Length Units '{given[:20]}' is not known{did_you_mean(given, allowed)}; "
            f"allowed: {', '.join(allowed)}",
            1,
        )
    return unit


def _times(source: Source, header: _Header, values: np.ndarray, first_line: int) -> np.ndarray:
    """Return the times, from the frame's number where the rate is known: printed times are rounded.

    Raises:
        InputError: a row without a time.
    """
    frame, time = values[:, 0], values[:, 1]
    rate = _positive(header.about.get("Export Frame Rate")) or _positive(
        header.about.get("Capture Frame Rate")
    )
    missing = np.flatnonzero(np.isnan(time))
    if missing.size:
        raise source.error("a row without a time", first_line + int(missing[0]), 2)
    if rate is not None and np.isfinite(frame).all():
        counted = time[0] + (frame - frame[0]) / rate
        # A take exported from its middle counts frames or time from elsewhere; half a frame is rounding.
        if np.abs(counted - time).max() < 0.5 / rate:
            return np.asarray(counted)
    return time


def _skipped(header: _Header, kind: str) -> list[str]:
    others = Counter(each[2] or "no type" for each in header.groups if each[2] != kind)
    said = [f"{count} columns of positions of type {name} skipped" for name, count in sorted(others.items())]
    if kind != KINDS[0]:
        said.append(f"no columns of type {KINDS[0]}: positions of type {kind} taken")
    return said


def _positive(text: str | None) -> float | None:
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if 0 < value < 1e6 else None


def _whole(text: str | None) -> int | None:
    return int(text) if text is not None and text.isdecimal() and len(text) < 10 else None
