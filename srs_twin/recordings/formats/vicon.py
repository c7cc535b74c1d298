"""Vicon: Trajectories in the CSV export of Nexus, or Objects in that of Tracker; frame 1 is at 0 s."""

from __future__ import annotations

import re

import numpy as np

from srs_twin.recordings.csv_table import RecordedFile
from srs_twin.recordings.formats.base import (
    Unstated,
    frame_rate,
    length_unit,
    marker_rows,
    marker_table,
)
from srs_twin.recordings.marker_table import MarkerTable
from srs_twin.recordings.signals.units import ANGLES

NAME = "Vicon CSV"
_SECTIONS = ("Trajectories", "Objects", "Devices", "Joints", "Segments", "Model Outputs", "Events", "Forces")
_SECTION = re.compile(rb'^"?(%s)"?[ \t,]*\r?$' % "|".join(_SECTIONS).encode(), re.MULTILINE)


def recognizes(start: RecordedFile) -> bool:
    """Say whether a file starts with the title of a section."""
    return start.title in _SECTIONS


def read(file: RecordedFile, unstated: Unstated) -> MarkerTable:
    """Read the section Trajectories of a Nexus export, or Objects of Tracker's with their rotations.

    Raises:
        InputError: with file, line and column, and what is allowed.
    """
    from scipy.spatial.transform import Rotation

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
    if len(lines) < 4 or lines[2][:2] != ["Frame", "Sub Frame"]:
        lacking = f"rate, names, 'Frame,Sub Frame,…' and units are wanted below '{section}'"
        raise file.error(f"the header is cut: {lacking}", above + 1)
    rate = frame_rate(file, "".join(lines[0][:1]), above + 1)
    axes, width = lines[2], len(lines[2])
    names, units = ((line + [""] * width)[:width] for line in (lines[1], lines[3]))
    places = [k for k in range(2, width - 2) if axes[k : k + 3] == wanted]
    if not places:
        raise file.error(f"no columns {','.join(wanted)}", above + 3)
    lengths = [length_unit(file, units[k], above + 4, k + 1) for k in places]
    # Before an object's place stands its rotation: RX, RY, RZ, or a quaternion with RW.
    turns = {k: axes.index("RX", max(k - 4, 2), k) for k in places if "RX" in axes[max(k - 4, 2) : k]}
    others = [each for k, begin in turns.items() for each in range(begin, k)]
    frame, points, angles, notes = marker_rows(
        file, above + 4, width, places, rate=1.0, others=others, section=True
    )
    rotations, end = np.full((*points.shape[:2], 4), np.nan), 0
    for k, begin in turns.items():
        turn, end = angles[:, end : end + k - begin], end + k - begin
        if turn.shape[1] < 4:
            turn = Rotation.from_rotvec(turn * ANGLES.get(units[begin].lower(), 1.0)).as_quat()
        rotations[:, places.index(k)] = turn
    notes += [f"section {title} skipped" for title, start in sections if start != at]
    if turns:
        notes.append("RX, RY, RZ taken as a rotation vector, or with RW as a quaternion")
    labels = [names[turns.get(k, k)].removeprefix("Global Angle ") or f"column {k + 1}" for k in places]
    turned, time = rotations if turns else None, (frame - 1) / rate
    return marker_table(file, NAME, time, points, labels, notes, unit=lengths, rotations=turned)
