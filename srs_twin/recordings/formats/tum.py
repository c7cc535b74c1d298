"""TUM trajectory: lines ``timestamp tx ty tz qx qy qz qw`` of one body, in s and m, as SLAM tools write."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from srs_twin.recordings.csv_table import read_file
from srs_twin.recordings.formats.base import Start, Unstated, marker_table, numbered
from srs_twin.recordings.marker_table import MarkerTable

NAME = "TUM trajectory"
_COMMENTS = re.compile(rb"(?:[ \t]*#[^\n]*\n|[ \t\r]*\n)*")
_EPOCH = 1e8  # s: later times are counted from 1970, or from a clock like it


def recognizes(start: Start) -> bool:
    """Say whether the first line below comments has a time, a place and a quaternion, without commas."""
    raw = start.raw.removeprefix(b"\xef\xbb\xbf")
    comments = _COMMENTS.match(raw)
    line = raw[comments.end() if comments else 0 :].split(b"\n", 1)[0]
    try:
        numbers = [float(each) for each in line.split()]
    except ValueError:
        return False
    return len(numbers) == 8 and abs(float(np.linalg.norm(numbers[4:])) - 1) < 0.01


def read(path: str | os.PathLike[str], unstated: Unstated) -> MarkerTable:
    """Read the poses of one body.

    Raises:
        InputError: damaged; with line and cell.
    """
    file = read_file(path)
    comments = _COMMENTS.match(file.raw)
    header = file.raw.count(b"\n", 0, comments.end() if comments else 0)
    cells = re.sub(rb"[ \t]+", b",", re.sub(rb"(?m)^[ \t]+|[ \t]+(?=\r?$)", b"", file.raw))
    values, notes = replace(file, data=cells).rows(header, range(8), 8)
    time = numbered(file, values[:, 0], header, "time")
    if time.min() > _EPOCH:
        notes.append(f"times counted from the first, {time[0]:.3f} s")
        time = time - time[0]
    points, turns = values[:, None, 1:4], values[:, None, 4:]
    return marker_table(file, NAME, time, points, [Path(file.name).stem], notes, rotations=turns)
