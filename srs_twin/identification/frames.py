"""Frames in order: rows sorted, duplicates dropped, missing ones put in as empty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srs_twin.errors import InputError

LEAST_FRAMES = 12
"""One more than the moving line takes."""

_GRID = 0.2  # of a frame's time: times this near to whole frames lie on a grid
_MOST_MISSING = 10  # times as many frames as there are rows
_LONGEST = 1e7  # s


@dataclass(frozen=True)
class Frames:
    """Frames that follow each other.

    Attributes:
        time: ascending, shape (frames,), s.
        rows: which row of the file each is, −1 for one that was missing, shape (frames,).
        period: time from frame to frame, their median, s.
        corrections: what was done, in words.
    """

    time: np.ndarray
    rows: np.ndarray
    period: float
    corrections: tuple[str, ...]


def in_order(name: str, time: np.ndarray) -> Frames:
    """Bring rows into the order of their times.

    Args:
        name: of the file.
        time: one a row, finite, shape (rows,), s.

    Raises:
        InputError: too few frames, or times that no recording has.
    """
    if np.abs(time).max() > _LONGEST:
        raise InputError(f"{name}: times up to {np.abs(time).max():.3g} s; is the unit right?")
    said = []
    order = np.argsort(time, kind="stable")
    moved = int((np.diff(time) < 0).sum())
    if moved:
        said.append(f"rows were not in the order of time ({moved} steps back): sorted")
    ordered = time[order]
    step = np.diff(ordered)
    period = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
    kept = np.concatenate([[True], step > 1e-3 * period])
    if not kept.all():
        said.append(f"{int((~kept).sum())} rows repeat the time of another: the first of each kept")
    rows, ordered = order[kept], ordered[kept]
    if len(rows) < LEAST_FRAMES:
        raise InputError(f"{name}: {len(rows)} frames; a recording has {LEAST_FRAMES} or more")
    return _on_grid(name, ordered, rows, period, said)


def _on_grid(name: str, time: np.ndarray, rows: np.ndarray, period: float, said: list[str]) -> Frames:
    steps = np.diff(time)
    whole = np.rint(steps / period)
    if np.abs(steps - whole * period).max() > _GRID * period:
        if np.abs(steps / period - 1).max() > _GRID:
            said.append("frames are not evenly spaced in time: left as they are")
        return Frames(time, rows, period, tuple(said))
    index = np.concatenate([[0.0], np.cumsum(whole)])
    count = int(index[-1]) + 1
    if count > _MOST_MISSING * len(rows):
        worst = int(np.argmax(steps))
        raise InputError(
            f"{name}: from {time[worst]:g} s to {time[worst + 1]:g} s nothing was recorded, and little "
            "elsewhere "
            f"({len(rows)} frames of {count}); cut the recording"
        )
    if count == len(rows):
        return Frames(time, rows, period, tuple(said))
    said.append(f"{count - len(rows)} frames missing in the file: put in as frames in which nothing was seen")
    places = index.astype(int)
    full_rows = np.full(count, -1)
    full_rows[places] = rows
    return Frames(np.interp(np.arange(count), places, time), full_rows, period, tuple(said))


def taken(values: np.ndarray, frames: Frames) -> np.ndarray:
    """Return a value for every frame, NaN where it was missing."""
    picked = values[frames.rows]
    picked[frames.rows < 0] = np.nan
    return np.asarray(picked)
