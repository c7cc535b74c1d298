"""Untangling: slots of a file that lists its markers in another order on every frame, put back in line.

A marker goes on in the slot whose sample is nearest to where it was, if each is the other's nearest and
within the gate. Velocities are not needed: this is a first pass, and what it leaves to be told is left to
tracking.
"""

from __future__ import annotations

import numpy as np

_AT_ONCE = 2000  # frames


def untangled(points: np.ndarray, columns: np.ndarray, gate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return slots in which markers stay as far as that is plain, and where each sample came from.

    Args:
        points: shape (frames, slots, 2), m.
        columns: from which column each sample came, shape (frames, slots).
        gate: m.
    """
    frames, slots = points.shape[:2]
    following = np.concatenate(
        [_following(points[k : k + _AT_ONCE + 1], gate) for k in range(0, frames - 1, _AT_ONCE)]
    )
    order = np.empty((frames, slots), dtype=int)
    row = list(range(slots))
    order[0] = row
    for k, links in enumerate(following.tolist(), start=1):
        new = [links[slot] for slot in row]
        taken = set(new)
        # A marker that is not seen now keeps its slot, where no other has come to it.
        for place, slot in enumerate(row):
            if new[place] < 0 and slot not in taken:
                new[place] = slot
                taken.add(slot)
        free = iter(slot for slot in range(slots) if slot not in taken)
        row = [slot if slot >= 0 else next(free) for slot in new]
        order[k] = row
    return (
        np.take_along_axis(points, order[..., None], axis=1),
        np.take_along_axis(np.ascontiguousarray(columns), order, axis=1),
    )


def _following(points: np.ndarray, gate: float) -> np.ndarray:
    """Return in which slot each marker surely is on the next frame, −1 where that is not sure."""
    apart = np.hypot(*np.moveaxis(points[:-1, :, None] - points[1:, None], -1, 0))
    apart = np.where(np.isnan(apart), np.inf, apart)
    ahead, back = apart.argmin(axis=2), apart.argmin(axis=1)
    mutual = np.take_along_axis(back, ahead, axis=1) == np.arange(points.shape[1])
    return np.asarray(np.where(mutual & (apart.min(axis=2) < gate), ahead, -1))
