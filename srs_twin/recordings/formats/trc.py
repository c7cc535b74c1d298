"""TRC: marker positions over time of OpenSim, Cortex and others (tab-separated, five lines of header)."""

from __future__ import annotations

from dataclasses import replace

from srs_twin.recordings.csv_table import RecordedFile
from srs_twin.recordings.formats.base import (
    Unstated,
    announced,
    frame_rate,
    length_unit,
    marker_rows,
    marker_table,
)
from srs_twin.recordings.marker_table import MarkerTable

NAME = "TRC"
_AXES = 5  # line of X1, Y1, Z1, …; an empty one may follow


def recognizes(start: RecordedFile) -> bool:
    """Say whether a file starts with the type of its path."""
    return start.title == "PathFileType"


def read(file: RecordedFile, unstated: Unstated) -> MarkerTable:
    """Read the markers of a TRC file; an empty cell is a marker not seen.

    Raises:
        InputError: damaged, or of an unknown unit; with file and line.
    """
    file = replace(file, separator="\t")
    lines = file.head(_AXES + 2)
    if len(lines) <= _AXES or lines[3][:1] != ["Frame#"]:
        raise file.error("the header is cut: 'Frame#', 'Time' and names of markers are wanted in line 4", 4)
    header = _AXES + (not any(lines[_AXES]))
    about = dict(zip(lines[1], lines[2], strict=False))
    names = [name for name in lines[3][2:] if name]
    width, wanted = len(lines[min(header, len(lines) - 1)]), 2 + 3 * len(names)
    if not names or not 0 <= width - wanted <= 1:  # a row may end in a tab
        raise file.error(f"{width} cells for {len(names)} markers; {wanted} are wanted", header + 1)
    rate = frame_rate(file, about["DataRate"], 3) if about.get("DataRate") else None
    unit = length_unit(file, about.get("Units") or unstated.unit or "", 3)
    time, points, _, notes = marker_rows(file, header, width, range(2, wanted, 3), clock=(0, 1), rate=rate)
    frames = announced(about.get("NumFrames", ""))
    return marker_table(file, NAME, time, points, names, notes, unit=unit, header_frames=frames)
