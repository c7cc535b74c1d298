"""Qualisys Track Manager: 3D export (TSV, mm)."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import takewhile

import numpy as np

from srs_twin.io.files import escape_unprintable
from srs_twin.recordings.csv_table import MAX_HEADER_BYTES, RecordedFile
from srs_twin.recordings.formats.base import (
    Unstated,
    announced,
    frame_rate,
    marker_rows,
    marker_table,
)
from srs_twin.recordings.marker_table import MarkerTable

NAME = "Qualisys TSV"
_QTM_LINE = re.compile(rb"(?!NULL|NAN)[A-Z][A-Z0-9_]+[\t\r ]|Frame\t")
_MAX_HEADER_LINES = 1000
"""Largest number of lines of a header, which has one line per event."""


def recognizes(start: RecordedFile) -> bool:
    """Return whether a file starts with a key of a Qualisys header."""
    return bool(re.match(r"(NO_OF_\w+|FILE_VERSION|FREQUENCY|MARKER_NAMES)\t", start.first_line))


def read(file: RecordedFile, unstated: Unstated) -> MarkerTable:
    """Read a 3D export of Qualisys Track Manager (mm); 0,0,0 marks a missing marker.

    Args:
        file: tab-separated file with a header, with or without the columns Frame and Time.
        unstated: frames per second, if FREQUENCY is EXT and there is no column Time.

    Raises:
        InputError: the file is damaged or a 2D or 6D export; the message names file and line.
    """
    file = replace(file, separator="\t")
    lines = file.raw[:MAX_HEADER_BYTES].split(b"\n", _MAX_HEADER_LINES)
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
    points[(points == 0).all(axis=-1)] = np.nan
    notes.append("0,0,0 read as missing")
    frames = announced(fields.get("NO_OF_FRAMES", [""])[0])
    return marker_table(file, NAME, time, points, names, notes, unit="mm", header_frames=frames)
