"""Camera: what motion capture tells of a snake, and its mean over a gait period.

A snake that undulates swings about its path: the mean heading of its connectors by some tenths of a radian.
Where it is going is seen in means over exactly one gait period, which the gait itself does not move. Such a
mean belongs to the middle of its period: it is half a period old.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.io.saved_state import Stateful
from srs_twin.robot.world import Pose

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


class CameraFrames(Stateful):
    """The frames of one run."""

    state_attributes = ("_taken", "_noise")

    def __init__(self, camera: Camera, seed: int) -> None:
        self._camera = camera
        self._rng = np.random.default_rng((seed, 0x5EE))
        self._taken = 0

    def begin(self) -> None:
        """Have a frame due at time 0 again."""
        self._taken = 0

    @property
    def _noise(self) -> dict[str, Any]:
        return dict(self._rng.bit_generator.state)

    @_noise.setter
    def _noise(self, state: dict[str, Any]) -> None:
        self._rng.bit_generator.state = state

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


class PeriodMean(Stateful):
    """Running mean of poses over one period, exact for what is linear between frames.

    Attributes:
        middle: the time to which `pose` belongs, s.
        pose: the mean; None before the first frame.
        whole: whether a whole period has been seen.
    """

    state_attributes = ("_sums", "_last", "middle", "pose", "whole")

    def __init__(self, period: float) -> None:
        self._period = period
        # Time, and the integrals of x, y and heading up to it.
        self._sums: deque[tuple[float, np.ndarray]] = deque()
        self._last = np.zeros(3)
        self.middle = 0.0
        self.pose: Pose | None = None
        self.whole = False

    def add(self, time: float, pose: Pose) -> None:
        """Take a frame; headings are counted on from the last one, whatever turn they come in."""
        sums, last, since = self._sums, self._last, time - self._period
        if not sums:
            sums.append((time, np.zeros(3)))
            self._last, self.pose, self.middle = np.array([*pose]), pose, time
            return
        turned = math.remainder(pose.heading - float(last[2]), 2 * math.pi)
        self._last = np.array([pose.x, pose.y, last[2] + turned])
        before, integral = sums[-1]
        whole = integral + (time - before) / 2 * (last + self._last)
        sums.append((time, whole))
        while len(sums) > 2 and sums[1][0] <= since:
            sums.popleft()
        begin, start = sums[0]
        if begin < since:
            # Between frames the integral is taken as linear.
            after, further = sums[1]
            start = start + (since - begin) / (after - begin) * (further - start)
            begin = since
        self.whole = self.whole or begin <= since + _ROUNDING
        span = time - begin
        self.middle = begin + span / 2
        self.pose = Pose(*map(float, (whole - start) / span))
