"""Qualisys Track Manager: its 3D export (TSV, mm)."""

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
_MOST_EVENTS = 1000  # lines of a Qualisys header; each event has one


def recognizes(start: RecordedFile) -> bool:
    """Say whether a file starts with a key of Qualisys."""
    return bool(re.match(r"(NO_OF_\w+|FILE_VERSION|FREQUENCY|MARKER_NAMES)\t", start.first_line))


def read(file: RecordedFile, unstated: Unstated) -> MarkerTable:
    """Read a 3D export of Qualisys Track Manager (mm); 0,0,0 is not seen.

    Args:
        file: tab-separated, with its header; with or without the columns Frame and Time.
        unstated: frames a second, where FREQUENCY is EXT and there is no column Time.

    Raises:
        InputError: a 2D or 6D export, or damaged; with file and line.
    """
    file = replace(file, separator="\t")
    lines = file.raw[:MAX_HEADER_BYTES].split(b"\n", _MOST_EVENTS)
    header = next((k for k, line in enumerate(lines) if not _QTM_LINE.match(line)), len(lines))
    *above, row = file.head(header + 1)
    about = {cells[0]: [*cells[1:], ""] for cells in reversed(above)}
    kind = about.get("DATA_INCLUDED", ["3D"])[0]
    if not about.keys().isdisjoint({"NO_OF_BODIES", "BODY_NAMES"}):
        kind = "6D"
    if kind != "3D":
        what = escape_unprintable(f"a {kind[:20]} export of Qualisys")
        raise file.error(f"{what}; 3D is read (File, Export, To TSV, 3D data)")
    names = list(takewhile(bool, about.get("MARKER_NAMES", [])))
    if not names or len(row) < 3:
        raise file.error("the header is cut: MARKER_NAMES and rows of numbers are wanted", header + 1)
    width, count = len(row), 3 * len(names)
    # A row may end in a tab, and begin with the frame and the time.
    first = {0: 0, 1: 0, 2: 2, 3: 2}.get(width - count)
    if first is None:
        wanted = f"{count}, or {count + 2} with Frame and Time, are wanted"
        raise file.error(f"{width} cells for {len(names)} markers; {wanted}", header + 1)
    given = about.get("FREQUENCY", [""])[0]
    if given in ("EXT", "") and unstated.rate_hz:
        given = str(unstated.rate_hz)
    rate = None if first and given == "EXT" else frame_rate(file, given)
    places, clock = range(first, first + count, 3), range(first)
    time, points, _, notes = marker_rows(file, header, width, places, clock=clock, rate=rate)
    points[(points == 0).all(axis=-1)] = np.nan
    notes.append("0,0,0 taken as not seen")
    frames = announced(about.get("NO_OF_FRAMES", [""])[0])
    return marker_table(file, NAME, time, points, names, notes, unit="mm", header_frames=frames)
