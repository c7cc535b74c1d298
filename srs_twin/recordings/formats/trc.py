"""TRC: marker positions over time, tab-separated with five header lines (OpenSim, Cortex)."""

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
_AXES_LINE = 5
"""Line of X1, Y1, Z1, …, which may be followed by an empty one."""


def recognizes(start: RecordedFile) -> bool:
    """Return whether a file starts with the key PathFileType."""
    return start.title == "PathFileType"


def read(file: RecordedFile, unstated: Unstated) -> MarkerTable:
    """Read the markers of a TRC file; an empty cell is a missing marker.

    Raises:
        InputError: the file is damaged, or its unit is unknown; the message names file and line.
    """
    file = replace(file, separator="\t")
    lines = file.head(_AXES_LINE + 2)
    if len(lines) <= _AXES_LINE or lines[3][:1] != ["Frame#"]:
        raise file.error("the header is cut: line 4 must have 'Frame#', 'Time' and names of markers", 4)
    header = _AXES_LINE + (not any(lines[_AXES_LINE]))
    fields = dict(zip(lines[1], lines[2], strict=False))
    names = [name for name in lines[3][2:] if name]
    width, required = len(lines[min(header, len(lines) - 1)]), 2 + 3 * len(names)
    if not names or not 0 <= width - required <= 1:  # a row may end in a tab
        raise file.error(
            f"{width} cells for {len(names)} markers; rows must have {required} cells", header + 1
        )
    rate = frame_rate(file, fields["DataRate"], 3) if fields.get("DataRate") else None
    unit = length_unit(file, fields.get("Units") or unstated.unit or "", 3)
    time, points, _, notes = marker_rows(file, header, width, range(2, required, 3), clock=(0, 1), rate=rate)
    frames = announced(fields.get("NumFrames", ""))
    return marker_table(file, NAME, time, points, names, notes, unit=unit, header_frames=frames)
