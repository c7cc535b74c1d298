"""Vicon Nexus: the section Trajectories of its CSV export; frame 1 is at 0 s."""

from __future__ import annotations

import os
import re

from srs_twin.io.files import printable
from srs_twin.recordings.csv_table import read_file
from srs_twin.recordings.formats.base import Start, Unstated, frame_rate, length_unit, numbered
from srs_twin.recordings.marker_table import MarkerTable, plausible

NAME = "Vicon CSV"
_SECTIONS = ("Trajectories", "Devices", "Joints", "Segments", "Model Outputs", "Events", "Forces")
_SECTION = re.compile(rb'^"?(%s)"?[ \t,]*\r?$' % "|".join(_SECTIONS).encode(), re.MULTILINE)


def recognizes(start: Start) -> bool:
    """Say whether a file starts with the title of a section."""
    return start.title in _SECTIONS


def read(path: str | os.PathLike[str], unstated: Unstated) -> MarkerTable:
    """Read the section Trajectories of a Vicon Nexus export; frame 1 is at 0 s.

    Raises:
        InputError: with file, line and column, and what is allowed.
    """
    file = read_file(path)
    sections = [(found[1].decode(), found.start()) for found in _SECTION.finditer(file.raw)]
    at = next((start for title, start in sections if title == "Trajectories"), None)
    if at is None:
        titles = ", ".join(dict.fromkeys(title for title, _ in sections))
        raise file.error(f"no section Trajectories (sections: {titles}); export trajectories from Nexus")
    above = file.raw.count(b"\n", 0, at) + 1
    lines = file.head(4, above)
    if len(lines) < 4 or [cell.strip() for cell in lines[2][:2]] != ["Frame", "Sub Frame"]:
        wanted = "rate, names, 'Frame,Sub Frame,X,Y,Z,…' and units are wanted below 'Trajectories'"
        raise file.error(f"the header is cut: {wanted}", above + 1)
    rate = frame_rate(file, lines[0][0] if lines[0] else "", above + 1)
    axes = [cell.strip() for cell in lines[2]]
    width = len(axes)
    names, units = ([cell.strip() for cell in (line + [""] * width)[:width]] for line in (lines[1], lines[3]))
    places = [k for k in range(2, width - 2) if axes[k : k + 3] == ["X", "Y", "Z"]]
    if not places:
        raise file.error("no columns X,Y,Z", above + 3)
    columns = [k + axis for k in places for axis in range(3)]
    factors = [length_unit(file, units[k], above + 4, k + 1) for k in columns]
    values, notes = file.rows(above + 4, [0, *columns], width, section=True)
    frame = numbered(file, values[:, 0], above + 4, "frame number")
    points, implausible = plausible((values[:, 1:] * factors).reshape(len(values), -1, 3))
    skipped = [title for title, start in sections if start != at]
    notes += [f"section {title} skipped" for title in skipped]
    if other := sorted({units[k] for k in columns} - {"m"}):
        notes.append(f"lengths converted from {', '.join(other)} to m")
    labels = tuple(printable(names[k]) or f"column {k + 1}" for k in places)
    corrections = (*notes, *implausible)
    return MarkerTable(file.name, file.sha256, NAME, (frame - 1) / rate, points, labels, corrections)
