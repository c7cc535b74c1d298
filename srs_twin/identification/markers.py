"""MarkerTable: what a motion capture file says before anything is made of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

FARTHEST = 1e3
"""Markers farther than this from the origin are no marker positions, m."""


@dataclass(frozen=True)
class MarkerTable:
    """Markers over time, in the file's own axes, SI.

    Attributes:
        kind: of the file: "Motive CSV 1.21" or "plain CSV".
        time: shape (frames,), s, as the file counts it.
        points: NaN where a marker was not seen, shape (frames, columns, 3), or (…, 2) in a plane, m.
        labels: names of the columns.
        connectors: which connector a column is on, from 1 at the head, where the file says so; else empty.
        header_frames: how many frames the header announces; None where it does not.
        sha256: of the file.
        name: of the file, as messages show it.
        corrections: what was converted, left out or skipped, in words.
    """

    kind: str
    time: np.ndarray
    points: np.ndarray
    labels: tuple[str, ...]
    connectors: tuple[int, ...]
    header_frames: int | None
    sha256: str
    name: str
    corrections: tuple[str, ...]


def believable(points: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return points without those that lie beyond any room or lack a coordinate, and words on them."""
    partly = ~np.isfinite(points).all(axis=-1) & np.isfinite(points).any(axis=-1)
    with np.errstate(invalid="ignore"):
        far = (np.abs(points) > FARTHEST).any(axis=-1)
    said = []
    if partly.any():
        said.append(f"{int(partly.sum())} positions lacked a coordinate: taken as not seen")
    if far.any():
        said.append(f"{int(far.sum())} positions lay over {FARTHEST:g} m away: taken as not seen")
    return np.where((partly | far)[..., None], np.nan, points), tuple(said)
