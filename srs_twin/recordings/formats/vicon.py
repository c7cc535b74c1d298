"""Vicon: Trajectories in the CSV export of Nexus, or Objects in that of Tracker; frame 1 is at 0 s."""

from __future__ import annotations

import os
import re

import numpy as np

from srs_twin.recordings.csv_table import read_file
from srs_twin.recordings.formats.base import (
    Start,
    Unstated,
    converted,
    frame_rate,
    length_unit,
    marker_table,
    numbered,
)
from srs_twin.recordings.marker_table import MarkerTable
from srs_twin.recordings.signals.units import ANGLES

NAME = "Vicon CSV"
_SECTIONS = ("Trajectories", "Objects", "Devices", "Joints", "Segments", "Model Outputs", "Events", "Forces")
_SECTION = re.compile(rb'^"?(%s)"?[ \t,]*\r?$' % "|".join(_SECTIONS).encode(), re.MULTILINE)


def recognizes(start: Start) -> bool:
    """Say whether a file starts with the title of a section."""
    return start.title in _SECTIONS


def read(path: str | os.PathLike[str], unstated: Unstated) -> MarkerTable:
    """Read the section Trajectories of a Nexus export, or Objects of Tracker's with their rotations.

    Raises:
        InputError: with file, line and column, and what is allowed.
    """
    from scipy.spatial.transform import Rotation

    file = read_file(path)
    sections = [(found[1].decode(), found.start()) for found in _SECTION.finditer(file.raw)]
    places_of = dict(reversed(sections))
    axes_of = {"Trajectories": ["X", "Y", "Z"], "Objects": ["TX", "TY", "TZ"]}
    section = next((title for title in axes_of if title in places_of), None)
    if section is None:
        titles = ", ".join(dict.fromkeys(title for title, _ in sections))
        raise file.error(f"no section Trajectories (sections: {titles}); export trajectories from Nexus")
    at, wanted = places_of[section], axes_of[section]
    above = file.raw.count(b"\n", 0, at) + 1
    lines = file.head(4, above)
    if len(lines) < 4 or [cell.strip() for cell in lines[2][:2]] != ["Frame", "Sub Frame"]:
        lacking = f"rate, names, 'Frame,Sub Frame,…' and units are wanted below '{section}'"
        raise file.error(f"the header is cut: {lacking}", above + 1)
    rate = frame_rate(file, lines[0][0] if lines[0] else "", above + 1)
    axes = [cell.strip() for cell in lines[2]]
    width = len(axes)
    names, units = ([cell.strip() for cell in (line + [""] * width)[:width]] for line in (lines[1], lines[3]))
    places = [k for k in range(2, width - 2) if axes[k : k + 3] == wanted]
    if not places:
        raise file.error(f"no columns {','.join(wanted)}", above + 3)
    columns = [k + axis for k in places for axis in range(3)]
    factors = [length_unit(file, units[k], above + 4, k + 1) for k in columns]
    # Before an object's place stands its rotation: RX, RY, RZ, or a quaternion with RW.
    turns = {k: axes.index("RX", max(k - 4, 2), k) for k in places if "RX" in axes[max(k - 4, 2) : k]}
    columns += [each for k, begin in turns.items() for each in range(begin, k)]
    values, notes = file.rows(above + 4, [0, *columns], width, section=True)
    frame = numbered(file, values[:, 0], above + 4, "frame number")
    points = (values[:, 1 : 1 + len(factors)] * factors).reshape(len(values), -1, 3)
    rotations, end = np.full((*points.shape[:2], 4), np.nan), 1 + len(factors)
    for k, begin in turns.items():
        turn, end = values[:, end : end + k - begin], end + k - begin
        if turn.shape[1] < 4:
            turn = Rotation.from_rotvec(turn * ANGLES.get(units[begin].lower(), 1.0)).as_quat()
        rotations[:, places.index(k)] = turn
    notes += [f"section {title} skipped" for title, start in sections if start != at]
    notes += converted(units[k + each] for k in places for each in range(3))
    if turns:
        notes.append("RX, RY, RZ taken as a rotation vector, or with RW as a quaternion")
    labels = [names[turns.get(k, k)].removeprefix("Global Angle ") or f"column {k + 1}" for k in places]
    turned, time = rotations if turns else None, (frame - 1) / rate
    return marker_table(file, NAME, time, points, labels, notes, rotations=turned)
