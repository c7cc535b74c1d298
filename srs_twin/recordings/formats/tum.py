"""TUM trajectory: lines ``timestamp tx ty tz qx qy qz qw`` of one body from SLAM tools, in s and m."""

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
_MAX_NORM_ERROR = 0.01
"""Largest deviation of the norm of a quaternion from 1."""
_MIN_EPOCH = 1e8
"""Smallest time that counts as a time since 1970, or of a similar clock, s."""


def recognizes(start: RecordedFile) -> bool:
    """Return whether the first line after comments has eight numbers without commas."""
    return bool(_START.match(start.data.removeprefix(b"\xef\xbb\xbf")))


def read(file: RecordedFile, unstated: Unstated) -> MarkerTable:
    """Read the poses of one body.

    Raises:
        InputError: the file is damaged; the message names line and cell.
    """
    file = laid_out(file, _POSE)
    time, points, quaternions, notes = marker_rows(file, file.header_lines, 8, [1], others=range(4, 8))
    epoch = None
    if time.min() > _MIN_EPOCH:
        epoch = round(1e9 * time[0])
        notes.append(f"times are relative to the first one, {time[0]:.3f} s")
        time = time - time[0]
    if (np.abs(np.linalg.norm(quaternions, axis=-1) - 1) > _MAX_NORM_ERROR).any():
        raise file.error(
            "eight numbers per line are read as time, x, y, z and a quaternion, but its norm is not 1"
        )
    rotations, names = quaternions[:, None], [Path(file.name).stem]
    return marker_table(file, NAME, time, points, names, notes, rotations=rotations, epoch_ns=epoch)
