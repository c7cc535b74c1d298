"""TRC: marker positions over time of OpenSim, Cortex and others (tab-separated, five lines of header)."""

from __future__ import annotations

import os
from dataclasses import replace

from srs_twin.recordings.csv_table import read_file
from srs_twin.recordings.formats.base import (
    Start,
    Unstated,
    announced,
    converted,
    counted_times,
    frame_rate,
    length_unit,
    marker_table,
    numbered,
)
from srs_twin.recordings.marker_table import MarkerTable

NAME = "TRC"
_AXES = 5  # line of X1, Y1, Z1, …; an empty one may follow


def recognizes(start: Start) -> bool:
    """Say whether a file starts with the type of its path."""
    return start.title == "PathFileType"


def read(path: str | os.PathLike[str], unstated: Unstated) -> MarkerTable:
    """Read the markers of a TRC file; an empty cell is a marker not seen.

    Raises:
        InputError: damaged, or of an unknown unit; with file and line.
    """
    file = replace(read_file(path), separator="\t")
    lines = [[cell.strip() for cell in cells] for cells in file.head(_AXES + 2)]
    if len(lines) <= _AXES or lines[3][:1] != ["Frame#"]:
        raise file.error("the header is cut: 'Frame#', 'Time' and names of markers are wanted in line 4", 4)
    header = _AXES + (not any(lines[_AXES]))
    about = dict(zip(lines[1], lines[2], strict=False))
    names = [name for name in lines[3][2:] if name]
    width = len(lines[min(header, len(lines) - 1)])
    if not names or not 0 <= width - 2 - 3 * len(names) <= 1:  # a row may end in a tab
        wanted = f"{2 + 3 * len(names)} are wanted"
        raise file.error(f"{width} cells for {len(names)} markers; {wanted}", header + 1)
    values, notes = file.rows(header, range(2 + 3 * len(names)), width)
    time = numbered(file, values[:, 1], header, "time")
    if rate := about.get("DataRate"):
        time = counted_times(values[:, 0], time, frame_rate(file, rate, 3))
    unit = about.get("Units") or unstated.unit or ""
    points = values[:, 2:].reshape(len(values), -1, 3) * length_unit(file, unit, 3)
    frames, notes = announced(about.get("NumFrames", "")), [*notes, *converted([unit])]
    return marker_table(file, NAME, time, points, names, notes, frames=frames)
