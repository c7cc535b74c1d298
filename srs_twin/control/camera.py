"""Camera: what motion capture tells of a snake, and its mean over a gait period.

A snake that undulates swings about its path: the mean heading of its connectors by some tenths of a radian.
Where it is going is seen in means over exactly one gait period, which the gait itself does not move. Such a
mean belongs to the middle of its period: it is half a period old.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.world import Pose

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState

_ROUNDING = 1e-9


@dataclass(frozen=True)
class Camera:
    """Motion capture.

    Attributes:
        rate_hz: frames a second.
        position_noise: RMS of x and of y of the centre of mass, m.
        heading_noise: RMS of the mean heading, rad.
    """

    rate_hz: float = 120.0
    position_noise: float = 0.0
    heading_noise: float = 0.0


class CameraFrames:
    """The frames of one run."""

    def __init__(self, camera: Camera, seed: int) -> None:
        self._camera = camera
        self._rng = np.random.default_rng((seed, 0x5EE))
        self._taken = 0

    def take(self, state: SnakeState) -> Pose | None:
        """Return the pose of the centre of mass where a frame is due; None between frames."""
        if float(state.time) * self._camera.rate_hz < self._taken - _ROUNDING:
            return None
        # CameraFrames that fell into one tick are one.
        self._taken = math.floor(float(state.time) * self._camera.rate_hz + _ROUNDING) + 1
        error = self._rng.standard_normal(3)
        noise = self._camera.position_noise
        x, y = state.com
        return Pose(
            float(x) + noise * float(error[0]),
            float(y) + noise * float(error[1]),
            float(state.heading) + self._camera.heading_noise * float(error[2]),
        )


class PeriodMean:
    """Running mean of poses over one period, exact for what is linear between frames.

    Attributes:
        middle: the time to which `pose` belongs, s.
        pose: the mean; None before the first frame.
        whole: whether a whole period has been seen.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        # time, and the integrals of x, y and heading up to it
        self._sums: deque[tuple[float, float, float, float]] = deque()
        self._last: Pose | None = None
        self.middle = 0.0
        self.pose: Pose | None = None
        self.whole = False

    def add(self, time: float, pose: Pose) -> None:
        """Take a frame; headings are counted on from the last one, whatever turn they come in."""
        if self._last is None:
            self._sums.append((time, 0.0, 0.0, 0.0))
            self._last = self.pose = pose
            self.middle = time
            return
        last = self._last
        heading = last.heading + math.remainder(pose.heading - last.heading, 2 * math.pi)
        before, x, y, turn = self._sums[-1]
        half = (time - before) / 2
        x += half * (last.x + pose.x)
        y += half * (last.y + pose.y)
        turn += half * (last.heading + heading)
        self._sums.append((time, x, y, turn))
        self._last = Pose(pose.x, pose.y, heading)
        sums, since = self._sums, time - self._period
        while len(sums) > 2 and sums[1][0] <= since:
            sums.popleft()
        begin, x0, y0, turn0 = sums[0]
        if begin < since:
            # Between frames the integral is taken as linear.
            part = (since - begin) / (sums[1][0] - begin)
            x0 += part * (sums[1][1] - x0)
            y0 += part * (sums[1][2] - y0)
            turn0 += part * (sums[1][3] - turn0)
            begin = since
        self.whole = self.whole or begin <= since + _ROUNDING
        span = time - begin
        self.middle = begin + span / 2
        self.pose = Pose((x - x0) / span, (y - y0) / span, (turn - turn0) / span)
