"""Markers over time, as a file has them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class MarkerTable:
    """Markers over time, in the file's own axes, SI.

    Attributes:
        name: of the file, as messages show it.
        sha256: of the file.
        kind: of the file, as `formats.identify` names it, with its version where it has one.
        time: shape (frames,), s, as the file counts it.
        points: NaN where a marker was not seen, shape (frames, columns, 3), or (…, 2) in a plane, m.
        labels: names of the columns.
        corrections: what was converted, left out or skipped, in words.
        places: station on the body and side of each column (`body.Places`), where its name says so; else
            empty.
        header_frames: how many frames the header announces; None where it does not.
        rotations: of rigid bodies, quaternions x, y, z, w in the file's axes, NaN where there are none,
            shape (frames, columns, 4); None for markers alone.
        epoch_ns: time since 1970 at 0 s, ns; None where the file's clock does not tell.
        unit: unit of the file's lengths, as stated, given or assumed.
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
        """The axis that such files usually have upwards."""
        return "y" if self.kind.startswith("Motive") else "z"
