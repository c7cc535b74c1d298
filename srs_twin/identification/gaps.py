"""Outliers taken out of tracks, and short gaps filled."""

from __future__ import annotations

import numpy as np

from srs_twin.errors import one_of

WAYS = ("spline", "linear")
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
    jump = np.nan_to_num(_jumps(points))
    usual = np.array([np.median(each[each > 0]) if (each > 0).any() else 0.0 for each in jump.T])
    limit = np.maximum(least, _TIMES * _NORMAL * usual)
    # To its neighbours, whose own neighbour it is, an outlier gives two thirds and a sixth of its jump.
    peak = jump.copy()
    for shift in (1, 2):
        np.maximum(peak[shift:], jump[:-shift], out=peak[shift:])
        np.maximum(peak[:-shift], jump[shift:], out=peak[:-shift])
    return np.asarray((jump > limit) & (jump >= peak))


def _jumps(points: np.ndarray) -> np.ndarray:
    """Return how far samples lie from the cubic through two neighbours on each side, (frames, tracks), m.

    Where one of the four was not seen, half of how far they lie from the middle between two.
    """
    jump = np.full(points.shape[:2], np.nan)
    jump[1:-1] = np.linalg.norm(points[1:-1] - (points[2:] + points[:-2]) / 2, axis=-1) / 2
    cubic = (4 * (points[3:-1] + points[1:-3]) - points[4:] - points[:-4]) / 6
    fine = np.linalg.norm(points[2:-2] - cubic, axis=-1)
    jump[2:-2] = np.where(np.isnan(fine), jump[2:-2], fine)
    return jump


def runs(missing: np.ndarray) -> np.ndarray:
    """Return begin and end (exclusive) of each stretch of True, shape (stretches, 2)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], missing, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2)


def longest_whole(time: np.ndarray, points: np.ndarray, longest: float) -> slice:
    """Return the longest stretch in which every track begins and ends seen and no gap is longer than allowed.

    Args:
        time: shape (frames,), s.
        points: shape (frames, tracks, 2), m.
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
        points: shape (frames, tracks, 2), m.
        way: "spline" (cubic, twice continuously differentiable) or "linear".

    Raises:
        InputError: another way.
    """
    one_of("fill", way, WAYS)
    whole = points.copy()
    for track in range(points.shape[1]):
        missing = np.isnan(points[:, track, 0])
        if not missing.any():
            continue
        seen = ~missing
        known = points[seen, track]
        if way == "spline" and seen.sum() > 3:
            from scipy.interpolate import CubicSpline

            whole[missing, track] = CubicSpline(time[seen], known)(time[missing])
        else:
            for axis in range(2):
                whole[missing, track, axis] = np.interp(time[missing], time[seen], known[:, axis])
    return whole
