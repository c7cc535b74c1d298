"""Markers of a file over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class MarkerTable:
    """Markers of a file over time, in the axes of the file and SI units.

    Attributes:
        name: name of the file for messages.
        sha256: checksum of the file.
        kind: file format as returned by `formats.identify`, with its version if it has one.
        time: times of the file, shape (frames,), s.
        points: NaN where a marker is hidden, shape (frames, columns, 3), or (…, 2) in a plane, m.
        labels: names of the columns.
        corrections: texts on conversions and skipped data.
        places: station on the body and side of each column (`body.markers.Places`), if its name contains
            them; else empty.
        header_frames: number of frames that the header states; None if it states none.
        rotations: quaternions x, y, z, w of rigid bodies in the axes of the file, NaN for other columns,
            shape (frames, columns, 4); None without rigid bodies.
        epoch_ns: time since 1970 at 0 s, ns; None if the clock of the file is another one.
        unit: unit of length of the file, as stated, given or assumed.
    """

    name: str
    sha256: str
    kind: str
    time: np.ndarray
    points: np.ndarray
    labels: tuple[str, ...]
    corrections: tuple[str, ...]
    places: tuple[tuple[int, str], ...] = ()
    header_frames: int | None = None
    rotations: np.ndarray | None = None
    epoch_ns: int | None = None
    unit: str = "m"

    @property
    def usual_up(self) -> str:
        """Axis that is usually vertical in such files."""
        return "y" if self.kind.startswith("Motive") else "z"
