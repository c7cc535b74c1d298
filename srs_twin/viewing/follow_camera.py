"""A camera that goes along with a snake, steadily: it does not sway with the body."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from srs_twin.trajectory import Trajectory
from srs_twin.viewing.signals import gait_period

_STEADY_S = 0.5  # a mean over this much where there is no gait period
_AHEAD_DEG = 25.0  # how far it looks ahead of straight across the snake
_ON_A_BENCH = (-60.0, 2.6)
_ON_THE_FLOOR = (-35.0, 1.7)


class FollowCamera:
    """Looks at the centre of mass from the snake's right, smoothed over a gait period.

    What hangs on a bench is looked at from above, always at the same place.
    """

    def __init__(self, run: Trajectory, body_length: float, *, bench: bool) -> None:
        """Prepare for a run.

        Args:
            run: what is seen.
            body_length: of the snake, m; how far away the camera is goes with it.
            bench: whether it hangs at its head.
        """
        elevation, lengths = _ON_A_BENCH if bench else _ON_THE_FLOOR
        self._at = np.tile(run.position[0].mean(axis=0), (len(run), 1)) if bench else _steady(run)
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._camera.azimuth = math.degrees(float(run["heading"][0])) + 90.0 - _AHEAD_DEG
        self._camera.elevation, self._camera.distance = elevation, lengths * body_length

    def at(self, row: int) -> mujoco.MjvCamera:
        """Return the camera as it stands at a sample."""
        self._camera.lookat = [*self._at[row], 0.0]
        return self._camera


def _steady(run: Trajectory) -> np.ndarray:
    """Return the centre of mass averaged over a gait period around each sample, shape (samples, 2), m."""
    span = gait_period(run) or _STEADY_S
    time, whole = run.time, float(run.time[-1] - run.time[0])
    half = min(span, whole) / 2
    if half <= 0:
        return run.com
    # The integral of the path, so that samples need not be equally spaced.
    steps = np.diff(time)[:, None] * (run.com[1:] + run.com[:-1]) / 2
    area = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    begin, end = np.clip(time - half, time[0], None), np.clip(time + half, None, time[-1])
    mean = [np.interp(end, time, a) - np.interp(begin, time, a) for a in area.T]
    return np.column_stack(mean) / (end - begin)[:, None]
