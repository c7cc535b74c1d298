"""C3D: points of a file; frame 1 is at 0 s, and a residual below 0 is not seen. Needs the library `c3d`."""

from __future__ import annotations

import os
from io import BytesIO

import numpy as np

from srs_twin.io.files import printable
from srs_twin.recordings.csv_table import read_bytes
from srs_twin.recordings.formats.base import Start, Unstated, decoding, frame_rate, length_unit
from srs_twin.recordings.marker_table import MarkerTable, plausible

NAME = "C3D"
_MOST_FRAMES = 1 << 22  # of a C3D file: an hour at 1 kHz


def recognizes(start: Start) -> bool:
    """Say whether a file starts with the bytes of a C3D header."""
    raw = start.raw
    return raw[1:2] == b"\x50" and raw[0] < 32 and raw[0] not in b"\0\t\n\r"


def read(path: str | os.PathLike[str], unstated: Unstated) -> MarkerTable:
    """Read the points of a C3D file; frame 1 is at 0 s, and a residual below 0 is not seen.

    Raises:
        InputError: damaged, without points, rate or unit, or the library is not installed.
    """
    file = read_bytes(path)
    with decoding(file, NAME):
        import c3d

        class Reader(c3d.Reader):
            """Takes files whose header and parameters differ in what is not read here."""

            def _check_metadata(self) -> None:
                pass

        reader = Reader(BytesIO(file.data))
        count, announced = reader.point_used, reader.frame_count
        if not count or announced < 1:
            raise file.error("no points in this C3D file; export marker trajectories")
        if announced > _MOST_FRAMES:
            raise file.error(f"{announced} frames; at most {_MOST_FRAMES} are read (export a shorter take)")
        rate = frame_rate(file, str(reader.point_rate))
        text = reader.get("POINT:UNITS")
        unit = text.string_value.strip("\0 ").lower() if text else ""
        factor = length_unit(file, unit or "mm")
        frames = (points[:, :4] for _, points, _ in reader.read_frames(copy=False))
        samples = np.fromiter(frames, np.dtype((np.float32, (count, 4)))).astype(float)
        time = (np.arange(len(samples)) + reader.first_frame - 1) / rate
        keys = ["LABELS", *(f"LABELS{k}" for k in range(2, 2 + count // 255))]
        texts = [reader.get(f"POINT:{key}") for key in keys]
        names = [str(name).strip("\0 ") for each in texts if each is not None for name in each.string_array]
    if not len(samples):
        raise file.error("a damaged C3D file (it ends before its first frame)")
    points = np.where(samples[..., 3:] < 0, np.nan, samples[..., :3] * factor)
    points, implausible = plausible(points)
    notes = []
    if unit != "m":
        notes.append(f"lengths converted from {unit} to m" if unit else "POINT:UNITS is not given: mm taken")
    if len(samples) < announced:
        notes.append(f"the file ends after {len(samples)} of {announced} frames")
    names += [""] * count
    labels = tuple(printable(names[k]) or f"point {k + 1}" for k in range(count))
    corrections = (*notes, *implausible)
    return MarkerTable(file.name, file.sha256, NAME, time, points, labels, corrections, (), announced)
