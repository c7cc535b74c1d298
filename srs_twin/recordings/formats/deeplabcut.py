"""DeepLabCut CSV of one animal (3 header rows) or several (4), in pixels or lengths."""

from __future__ import annotations

from dataclasses import replace

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
from srs_twin.recordings.signals.units import LENGTHS

NAME = "DeepLabCut CSV"
MIN_LIKELIHOOD = 0.6
"""Smallest likelihood of a sample that is used, 1: the default of DeepLabCut (`pcutoff`)."""


def recognizes(start: RecordedFile) -> bool:
    """Return whether a file starts with the row of the scorer."""
    return start.title.lower() == "scorer"


def read(file: RecordedFile, unstated: Unstated) -> MarkerTable:
    """Read the tracks of DeepLabCut in a plane.

    Args:
        file: CSV file.
        unstated: frames per second of the video; unit of the coordinates if they are lengths (None or "px":
            pixels); size of a pixel.

    Raises:
        InputError: rate or scale are not given, or the file is damaged; the message names line and column.
    """
    rate_hz, unit, scale_m, _ = unstated
    missing = [] if rate_hz else ["`rate_hz` (frames per second of the video)"]
    pixels = unit in (None, "px")
    if pixels and not scale_m:
        missing.append("`scale_m` (m per pixel; or `unit`, if the coordinates are lengths)")
    if missing:
        raise file.error(f"DeepLabCut files have frames and pixels only; give {' and '.join(missing)}")
    rate = frame_rate(file, str(rate_hz))
    factor = float(scale_m or 0.0) if pixels else LENGTHS[length_unit(file, unit or "")]
    if not 0 < factor < 1e3:
        raise file.error(f"scale_m {factor:g} is not allowed; it must be m per pixel")
    lines = {cells[0]: cells for cells in file.head(4) if cells}
    if not {"bodyparts", "coords"} <= lines.keys():
        raise file.error(
            "the header is cut: it must have rows scorer, (individuals,) bodyparts and coords", 2
        )
    top, coords = 4 if "individuals" in lines else 3, lines["coords"]
    width = len(coords)
    if width < 4 or coords[1:] != ["x", "y", "likelihood"] * (width // 3):
        raise file.error("each body part must have the columns x,y,likelihood", top)
    time, samples, _, notes = marker_rows(file, top, width, range(1, width, 3), rate=rate)
    points = samples[..., :2] * [factor, -factor]
    unlikely = ~(samples[..., 2] >= MIN_LIKELIHOOD) & np.isfinite(points).all(axis=-1)
    points[unlikely] = np.nan
    notes += [
        f"{int(unlikely.sum())} samples with a likelihood below {MIN_LIKELIHOOD} read as missing",
        "y reversed, because it points down in images",
        f"coordinates multiplied by {factor:g} to m",
    ]
    parts, animals = lines["bodyparts"], lines.get("individuals")
    if len(parts) != width or (animals and len(animals) != width):
        raise file.error(f"the rows of the header must have {width} cells", top)
    names = [f"{animals[k]}:{parts[k]}" if animals else parts[k] for k in range(1, width, 3)]
    return replace(marker_table(file, NAME, time, points, names, notes), unit=unit or "px")
