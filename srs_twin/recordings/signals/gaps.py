"""Frames in the order of time, outliers taken out of tracks, short gaps filled.

Errors raised here do not name the file; `read_motion` puts its name before them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from srs_twin.errors import InputError

LEAST_FRAMES = 12
"""One more than the moving line takes."""

_GRID = 0.2  # of a frame's time: times this near to whole frames lie on a grid
_MOST_MISSING = 10  # times as many frames as there are rows
_LONGEST = 1e7  # s


@dataclass(frozen=True)
class FrameGrid:
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


def time_order(time: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Return the order of rows by their times, and what is to be noted of it."""
    moved = int((np.diff(time) < 0).sum())
    notes = [f"rows were not in the order of time ({moved} steps back): sorted"] if moved else []
    return np.argsort(time, kind="stable"), notes


def frame_grid(time: np.ndarray) -> FrameGrid:
    """Bring rows into the order of their times.

    Args:
        time: one a row, finite, shape (rows,), s.

    Raises:
        InputError: too few frames, or times that no recording has.
    """
    if np.abs(time).max() > _LONGEST:
        raise InputError(f"times up to {np.abs(time).max():.3g} s; is the unit right?")
    order, notes = time_order(time)
    ordered = time[order]
    step = np.diff(ordered)
    period = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
    kept = np.concatenate([[True], step > 1e-3 * period])
    if not kept.all():
        notes.append(f"{int((~kept).sum())} rows repeat the time of another: the first of each kept")
    rows, ordered = order[kept], ordered[kept]
    if len(rows) < LEAST_FRAMES:
        raise InputError(f"{len(rows)} frames; a recording has {LEAST_FRAMES} or more")
    return FrameGrid(*_on_grid(ordered, rows, period, notes), period, tuple(notes))


def _on_grid(
    time: np.ndarray, rows: np.ndarray, period: float, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return times and rows with the frames that a file skips; note what was done."""
    steps = np.diff(time)
    whole = np.rint(steps / period)
    if np.abs(steps - whole * period).max() > _GRID * period:
        if np.abs(steps / period - 1).max() > _GRID:
            notes.append("frames are not evenly spaced in time: left as they are")
        return time, rows
    places = np.append(0, np.cumsum(whole)).astype(int)
    count = int(places[-1]) + 1
    if count > _MOST_MISSING * len(rows):
        worst = int(np.argmax(steps))
        raise InputError(
            f"from {time[worst]:g} s to {time[worst + 1]:g} s nothing was recorded, and little elsewhere "
            f"({len(rows)} frames of {count}); cut the recording"
        )
    if missing := count - len(rows):
        notes.append(f"{missing} frames missing in the file: put in as frames in which nothing was seen")
        every = np.full(count, -1)
        every[places] = rows
        time, rows = np.interp(np.arange(count), places, time), every
    return time, rows


def at_frames(values: np.ndarray, frames: FrameGrid) -> np.ndarray:
    """Return a value for every frame, NaN where it was missing."""
    picked = values[frames.rows]
    picked[frames.rows < 0] = np.nan
    return np.asarray(picked)


WAYS = ("spline", "linear")
_NEAR = np.array([-2, -1, 1, 2])  # samples beside one that tell where it should be
_TIMES = 8.0  # times as far from where its neighbours have it as most samples: no place of a marker
_NORMAL = 1.4826  # standard deviation over median absolute deviation of a normal distribution


def outliers(points: np.ndarray, least: float) -> np.ndarray:
    """Say which samples jump out of their track and back.

    Args:
        points: shape (frames, tracks, 2), m.
        least: no smaller jump is one, m.

    Returns:
        Shape (frames, tracks).
    """
    found = np.zeros(points.shape[:2], dtype=bool)
    for track in range(points.shape[1]):
        frames = np.flatnonzero(~np.isnan(points[:, track, 0]))
        if len(frames) > 2 * len(_NEAR):
            found[frames, track] = _leaps(frames, points[frames, track], least)
    return found


def _leaps(frames: np.ndarray, seen: np.ndarray, least: float) -> np.ndarray:
    """Say which samples of one track are outliers, shape (samples,).

    Residuals r = A p are those from the cubics through the two samples before and the two after each; their
    rows count less where gaps make cubics inexact, whose error grows with the product of the four distances
    in time (4 frames⁴ without gaps). An outlier by d at sample k adds d a_k to them, a_k column k of A, so
    |a_k·r| / |a_k| is largest at the outlier itself, and |a_k·r| / |a_k|² its size.
    """
    from scipy.sparse import csr_array

    middle = np.arange(2, len(frames) - 2)
    near = middle[:, None] + _NEAR
    time = (frames[near] - frames[middle, None]).astype(float)
    weight = -np.ones_like(time)
    for k, other in permutations(range(len(_NEAR)), 2):
        weight[:, k] *= time[:, other] / (time[:, other] - time[:, k])
    rows = np.column_stack([weight, np.ones(len(middle))]) * (4 / np.abs(time.prod(axis=1)))[:, None]
    places = np.column_stack([near, middle])
    cubics = csr_array(
        (rows.ravel(), places.ravel(), 5 * np.arange(len(middle) + 1)), (len(middle), len(frames))
    )
    share = np.linalg.norm(cubics.T @ (cubics @ seen), axis=1)
    size = np.sqrt((cubics**2).sum(axis=0))
    score = share / size
    usual = np.median(score[score > 0]) if (score > 0).any() else 0.0
    padded = np.pad(score, 4)
    peak = np.max([padded[shift : len(padded) - 8 + shift] for shift in range(9)], axis=0)
    leaps = (share > least * size**2) & (score > _TIMES * _NORMAL * usual) & (score >= peak)
    # Of the outermost only a small part shows: they are not judged, but keep others from being blamed.
    leaps[[0, 1, -2, -1]] = False
    return np.asarray(leaps)


def runs(missing: np.ndarray) -> np.ndarray:
    """Return begin and end (exclusive) of each stretch of True, shape (stretches, 2)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], missing, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2)


def longest_complete(time: np.ndarray, points: np.ndarray, longest: float) -> slice:
    """Return the longest stretch in which every track begins and ends seen and no gap is longer than allowed.

    Args:
        time: shape (frames,), s.
        points: NaN where they are not known, shape (frames, tracks, axes).
        longest: longest gap, from the last sample before it to the first after it, s.
    """
    allowed = np.ones(len(time), dtype=bool)
    seen = ~np.isnan(points[..., 0])
    for column in seen.T:
        for begin, end in runs(~column):
            inner = begin > 0 and end < len(time)
            if not inner or time[end] - time[begin - 1] > longest + 1e-9:
                allowed[begin:end] = False
    whole = seen.all(axis=1)
    best = slice(0, 0)
    for begin, end in runs(allowed):
        full = np.flatnonzero(whole[begin:end])
        if full.size and full[-1] - full[0] + 1 > best.stop - best.start:
            best = slice(int(begin + full[0]), int(begin + full[-1]) + 1)
    return best


def filled(time: np.ndarray, points: np.ndarray, way: str) -> np.ndarray:
    """Return tracks with their gaps filled; the first and the last frame have to be seen.

    Args:
        time: shape (frames,), s.
        points: NaN where they are not known, shape (frames, tracks, axes).
        way: "spline" (cubic, twice continuously differentiable) or "linear".
    """
    from scipy.interpolate import make_interp_spline

    whole = points.copy()
    for track, missing in zip(whole.swapaxes(0, 1), np.isnan(points[..., 0]).T, strict=True):
        if missing.any():
            degree = 3 if way == "spline" and (~missing).sum() > 3 else 1
            track[missing] = make_interp_spline(time[~missing], track[~missing], degree)(time[missing])
    return whole
