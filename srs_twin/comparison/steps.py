"""The step response of a recorded bend: rise, overshoot, settling."""

from __future__ import annotations

import numpy as np


def step_response(time: np.ndarray, bend: np.ndarray, before: float, after: float) -> dict[str, float | None]:
    """Return how a bend answers a step of its reference; between samples it goes straight.

    Args:
        time: since the step, shape (samples,), s.
        bend: shape (samples,), rad.
        before: reference before the step, rad.
        after: reference after it, rad.

    Returns:
        ``rise_time_s`` from 10 to 90 %, ``overshoot_rel`` and ``overshoot_rad`` (0 where it never goes
        beyond), ``settling_2_s`` and ``settling_5_s``; None for what is not reached before the run ends.
    """
    share = (bend - before) / (after - before)
    low, high = _first(time, share, 0.1), _first(time, share, 0.9)
    beyond = max(0.0, float(share.max()) - 1.0)
    return {
        "rise_time_s": None if low is None or high is None else high - low,
        "overshoot_rel": beyond,
        "overshoot_rad": beyond * abs(after - before),
        "settling_2_s": _settling(time, share, 0.02),
        "settling_5_s": _settling(time, share, 0.05),
    }


def _first(time: np.ndarray, share: np.ndarray, level: float) -> float | None:
    """Return when a level is first reached from below."""
    above = np.flatnonzero(share >= level)
    if not len(above):
        return None
    return _between(time, share, int(above[0]), level)


def _settling(time: np.ndarray, share: np.ndarray, band: float) -> float | None:
    """Return when the band about 1 is entered for good."""
    outside = np.flatnonzero(np.abs(share - 1.0) > band)
    if not len(outside):
        return 0.0
    last = int(outside[-1])
    if last + 1 == len(share):
        return None
    return _between(time, share, last + 1, 1.0 + np.copysign(band, share[last] - 1.0))


def _between(time: np.ndarray, share: np.ndarray, k: int, level: float) -> float:
    """Return when the straight line from the sample before k to k crosses a level; at k = 0 its time."""
    if k == 0:
        return float(time[0])
    part = (level - share[k - 1]) / (share[k] - share[k - 1])
    return float(time[k - 1] + part * (time[k] - time[k - 1]))
