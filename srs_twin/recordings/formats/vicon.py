"""Vicon: Trajectories of a Nexus CSV export, or Objects of a Tracker export; frame 1 is at 0 s."""

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
    """Return whether a file starts with the title of a section."""
    return start.title in _SECTIONS


def read(file: RecordedFile, unstated: Unstated) -> MarkerTable:
    """Read Trajectories of a Nexus export, or Objects of a Tracker export with their rotations.

    Raises:
        InputError: the file cannot be read; the message names file, line, column and what is allowed.
    """
    from scipy.spatial.transform import Rotation

    sections = [(title[1].decode(), title.start()) for title in _SECTION.finditer(file.raw)]
    start_of_section = dict(reversed(sections))
    axes_of_section = {"Trajectories": ["X", "Y", "Z"], "Objects": ["TX", "TY", "TZ"]}
    section = next((title for title in axes_of_section if title in start_of_section), None)
    if section is None:
        titles = ", ".join(dict.fromkeys(title for title, _ in sections))
        raise file.error(f"no section Trajectories (sections: {titles}); export trajectories from Nexus")
    section_start, position_axes = start_of_section[section], axes_of_section[section]
    above = file.raw.count(b"\n", 0, section_start) + 1
    lines = file.head(4, above)
    if len(lines) < 4 or lines[2][:2] != ["Frame", "Sub Frame"]:
        required = f"'{section}' must be followed by rate, names, 'Frame,Sub Frame,…' and units"
        raise file.error(f"the header is cut: {required}", above + 1)
    rate = frame_rate(file, "".join(lines[0][:1]), above + 1)
    axes, width = lines[2], len(lines[2])
    names, units = ((line + [""] * width)[:width] for line in (lines[1], lines[3]))
    positions = [k for k in range(2, width - 2) if axes[k : k + 3] == position_axes]
    if not positions:
        raise file.error(f"no columns {','.join(position_axes)}", above + 3)
    lengths = [length_unit(file, units[k], above + 4, k + 1) for k in positions]
    # The rotation of an object precedes its position: RX, RY, RZ, or a quaternion with RW.
    rotation_starts = {
        k: axes.index("RX", max(k - 4, 2), k) for k in positions if "RX" in axes[max(k - 4, 2) : k]
    }
    others = [column for k, begin in rotation_starts.items() for column in range(begin, k)]
    frame, points, angles, notes = marker_rows(
        file, above + 4, width, positions, rate=1.0, others=others, section=True
    )
    rotations, end = np.full((*points.shape[:2], 4), np.nan), 0
    for k, begin in rotation_starts.items():
        rotation, end = angles[:, end : end + k - begin], end + k - begin
        if rotation.shape[1] < 4:
            rotation = Rotation.from_rotvec(rotation * ANGLES.get(units[begin].lower(), 1.0)).as_quat()
        rotations[:, positions.index(k)] = rotation
    notes += [f"section {title} skipped" for title, start in sections if start != section_start]
    if rotation_starts:
        notes.append("RX, RY, RZ read as a rotation vector, or with RW as a quaternion")
    labels = [
        names[rotation_starts.get(k, k)].removeprefix("Global Angle ") or f"column {k + 1}" for k in positions
    ]
    time = (frame - 1) / rate
    return marker_table(
        file,
        NAME,
        time,
        points,
        labels,
        notes,
        unit=lengths,
        rotations=rotations if rotation_starts else None,
    )
