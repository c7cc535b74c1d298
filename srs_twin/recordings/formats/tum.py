"""TUM trajectory: lines ``timestamp tx ty tz qx qy qz qw`` of one body, in s and m, as SLAM tools write."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from srs_twin.recordings.csv_table import Dialect, RecordedFile, laid_out
from srs_twin.recordings.formats.base import Unstated, marker_rows, marker_table
from srs_twin.recordings.marker_table import MarkerTable

NAME = "TUM trajectory"
_COMMENTS = re.compile(rb"(?:[ \t]*#[^\n]*\n|[ \t\r]*\n)*")
_START = re.compile(_COMMENTS.pattern + rb"[ \t]*(?:[-+.\deE]+[ \t]+){7}[-+.\deE]+[ \t\r]*\n")
_POSE = Dialect(("time", "x", "y", "z", "qx", "qy", "qz", "qw"), " ")
_UNIT = 0.01  # from the length of a quaternion
_EPOCH = 1e8  # s: later times are counted from 1970, or from a clock like it


def recognizes(start: RecordedFile) -> bool:
    """Say whether the first line below comments has eight numbers without commas."""
    return bool(_START.match(start.data.removeprefix(b"\xef\xbb\xbf")))


def read(file: RecordedFile, unstated: Unstated) -> MarkerTable:
    """Read the poses of one body.

    Raises:
        InputError: damaged; with line and cell.
    """
    file = laid_out(file, _POSE)
    time, points, turns, notes = marker_rows(file, file.header_lines, 8, [1], others=range(4, 8))
    epoch = None
    if time.min() > _EPOCH:
        epoch = round(1e9 * time[0])
        notes.append(f"times counted from the first, {time[0]:.3f} s")
        time = time - time[0]
    if (np.abs(np.linalg.norm(turns, axis=-1) - 1) > _UNIT).any():
        raise file.error(
            "eight numbers a line are read as time, x, y, z and a quaternion, which has length 1"
        )
    turned, names = turns[:, None], [Path(file.name).stem]
    return marker_table(file, NAME, time, points, names, notes, rotations=turned, epoch_ns=epoch)
