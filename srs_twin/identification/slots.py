"""Slots: columns in which markers were never seen at the same time, laid side by side into one.

A take in which markers came and went has a column for each appearance; a few slots hold them all.
"""

from __future__ import annotations

import heapq

import numpy as np

from srs_twin.errors import InputError

MOST = 64
"""Slots: markers and reflections at the same time."""


def packed(name: str, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return markers in as few slots as there were columns in use at the same time.

    Args:
        name: of the file.
        points: shape (frames, columns, 2), m.

    Returns:
        Shape (frames, slots, 2), m; from which column each comes, −1 where nothing is, shape (frames, slots).

    Raises:
        InputError: no marker at all, or more than `MOST` slots.
    """
    seen = ~np.isnan(points[..., 0])
    used = np.flatnonzero(seen.any(axis=0))
    if not used.size:
        raise InputError(f"{name}: no marker was seen on any frame")
    first = seen[:, used].argmax(axis=0)
    last = len(seen) - 1 - seen[::-1, used].argmax(axis=0)
    # (last frame, slot) of those in use; the slot that is free the longest comes first.
    ends: list[tuple[int, int]] = []
    slot_of = np.empty(len(used), dtype=int)
    for k in np.lexsort((used, first)):
        if ends and ends[0][0] < first[k]:
            _, slot = heapq.heappop(ends)
        else:
            slot = len(ends)
        slot_of[k] = slot
        heapq.heappush(ends, (int(last[k]), slot))
    if len(ends) > MOST:
        raise InputError(f"{name}: {len(ends)} markers at the same time; at most {MOST} are followed")
    slots = np.full((len(points), len(ends), 2), np.nan)
    columns = np.full((len(points), len(ends)), -1)
    for k, slot in enumerate(slot_of):
        stretch = slice(first[k], last[k] + 1)
        slots[stretch, slot] = points[stretch, used[k]]
        columns[stretch, slot] = used[k]
    return slots, columns
