"""Layout: how many markers a robot carries and where, and which tracks they are.

``single``: one at each connector. ``head``: one more ahead of the head's, so that its heading is measured.
``pair``: two at each connector, along or across the body, as the dissertation's first and third robots had
them (Sections 2.3.1 and 2.3.2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srs_twin.errors import InputError, UnknownNameError

LAYOUTS = ("auto", "single", "head", "pair")

_SOLID = 0.2  # of the frames a marker of the robot is seen on, or more
_APART = 2.0  # times the length of a segment: farther from all others nothing is on the robot


@dataclass(frozen=True)
class Chosen:
    """Tracks that are the robot's markers.

    Attributes:
        layout: one of `LAYOUTS`, not "auto".
        tracks: their numbers.
        left: samples of other tracks, which were left out.
    """

    layout: str
    tracks: np.ndarray
    left: int


def markers_of(layout: str, connectors: int) -> int:
    """Return how many markers a layout has."""
    return {"single": connectors, "head": connectors + 1, "pair": 2 * connectors}[layout]


def choose(name: str, points: np.ndarray, connectors: int, pitch: float, layout: str) -> Chosen:
    """Choose the robot's markers.

    Args:
        name: of the file.
        points: of all tracks, shape (frames, tracks, 2), m.
        connectors: N.
        pitch: length of a straight segment, m.
        layout: one of `LAYOUTS`; "auto" takes the one that has as many markers as are there.

    Raises:
        InputError: too few or too many markers.
        UnknownNameError: another layout.
    """
    if layout not in LAYOUTS:
        raise UnknownNameError("layout", layout, LAYOUTS)
    seen = ~np.isnan(points[..., 0])
    share = seen.mean(axis=0)
    solid = np.flatnonzero(share >= _SOLID)
    solid = solid[_near_others(points[:, solid], _APART * pitch)] if len(solid) > connectors else solid
    layouts = {each: markers_of(each, connectors) for each in LAYOUTS[1:]}
    if layout == "auto":
        # At once: a marker that was lost for long may have become two tracks.
        together = int(np.quantile(seen[:, solid].sum(axis=1), 0.95, method="lower")) if solid.size else 0
        layout = next((each for each, count in layouts.items() if count == together), "")
    wanted = layouts.get(layout, -1)
    if wanted < 0 or len(solid) < wanted:
        listed = ", ".join(f"{count} ({each})" for each, count in layouts.items())
        shares = ", ".join(f"{100 * each:.0f} %" for each in sorted(share, reverse=True)[:12])
        raise InputError(
            f"{name}: {len(solid)} markers that could be the robot's; {connectors} connectors carry "
            f"{listed}. "
            f"Seen on these shares of the frames: {shares}. Give layout, or export without the others"
        )
    tracks = np.sort(solid[np.argsort(-share[solid], kind="stable")[:wanted]])
    return Chosen(layout, tracks, int(seen.sum() - seen[:, tracks].sum()))


def _near_others(points: np.ndarray, limit: float) -> np.ndarray:
    """Say which tracks have another one near, on most frames."""
    some = points[:: len(points) // 300 + 1]
    apart = np.linalg.norm(some[:, :, None] - some[:, None], axis=-1)
    apart[:, np.arange(apart.shape[1]), np.arange(apart.shape[1])] = np.nan
    with np.errstate(invalid="ignore"):
        near = (apart < limit).any(axis=2)
    there = ~np.isnan(some[..., 0])
    return np.asarray(near.sum(axis=0) > 0.5 * there.sum(axis=0))
