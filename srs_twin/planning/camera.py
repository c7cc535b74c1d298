"""Motion capture of the snake's pose, and averaging over one gait period.

As the body undulates, the measured heading oscillates by several tenths of a radian
about the direction of travel. Averaging over exactly one gait period removes this
oscillation, but delays the pose by half a period.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.io.saved_state import Stateful
from srs_twin.robot.world import Pose

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState

_TIME_ROUNDING = 1e-9
"""Tolerance for rounding errors in times (s) and in frame numbers."""


@dataclass(frozen=True)
class Camera:
    """Frame rate and measurement noise of a motion capture system.

    Attributes:
        rate_hz: frame rate, Hz.
        position_noise: RMS noise of each coordinate of the centre of mass, m.
        heading_noise: RMS noise of the heading, rad.
    """

    rate_hz: float = 120.0
    position_noise: float = 0.0
    heading_noise: float = 0.0


class CameraFrames(Stateful):
    """Simulated camera that captures frames with reproducible noise."""

    state_attributes = ("_next_frame", "_noise_state")

    def __init__(self, camera: Camera, seed: int) -> None:
        self._camera = camera
        self._rng = np.random.default_rng((seed, 0x5EE))
        self._next_frame = 0

    def restart(self) -> None:
        """Restart the frame times at 0, but continue the noise sequence."""
        self._next_frame = 0

    @property
    def _noise_state(self) -> dict[str, object]:
        return dict(self._rng.bit_generator.state)

    @_noise_state.setter
    def _noise_state(self, state: dict[str, object]) -> None:
        self._rng.bit_generator.state = state

    def capture(self, state: SnakeState) -> Pose | None:
        """Return the measured pose if a frame is due, otherwise None."""
        frame = float(state.time) * self._camera.rate_hz
        if frame < self._next_frame - _TIME_ROUNDING:
            return None
        # At most one frame is captured per time step, because further frames would show
        # the same state.
        self._next_frame = math.floor(frame + _TIME_ROUNDING) + 1
        error = self._rng.standard_normal(3)
        noise = self._camera.position_noise
        x, y = state.com
        return Pose(
            float(x) + noise * float(error[0]),
            float(y) + noise * float(error[1]),
            float(state.heading) + self._camera.heading_noise * float(error[2]),
        )


class PeriodMean(Stateful):
    """Running mean of the pose over one period, with linear interpolation.

    Attributes:
        time: midpoint of the averaging interval, s.
        pose: mean pose, or None before the first frame.
        complete: whether the averaging interval covers a whole period.
    """

    state_attributes = ("_integrals", "_last", "time", "pose", "complete")

    def __init__(self, period: float) -> None:
        self._period = period
        # Each entry contains a frame time, and the integrals of x, y and heading from
        # the first frame to this time.
        self._integrals: deque[tuple[float, np.ndarray]] = deque()
        self._last = np.zeros(3)
        self.time = 0.0
        self.pose: Pose | None = None
        self.complete = False

    def add(self, time: float, pose: Pose) -> None:
        """Add the pose measured at a time (s), and unwrap the heading."""
        integrals = self._integrals
        last = self._last
        period_start = time - self._period
        if not integrals:
            integrals.append((time, np.zeros(3)))
            self._last = np.array([*pose])
            self.pose = pose
            self.time = time
            return
        turn = math.remainder(pose.heading - float(last[2]), 2 * math.pi)
        self._last = np.array([pose.x, pose.y, last[2] + turn])
        # The trapezoidal rule is exact for a linearly interpolated pose.
        last_time, integral = integrals[-1]
        end_integral = integral + (time - last_time) / 2 * (last + self._last)
        integrals.append((time, end_integral))
        while len(integrals) > 2 and integrals[1][0] <= period_start:
            integrals.popleft()
        begin, begin_integral = integrals[0]
        if begin < period_start:
            # The averaging interval begins between two frames, so the integral is
            # interpolated.
            next_time, next_integral = integrals[1]
            fraction = (period_start - begin) / (next_time - begin)
            begin_integral = begin_integral + fraction * (
                next_integral - begin_integral
            )
            begin = period_start
        self.complete = self.complete or begin <= period_start + _TIME_ROUNDING
        duration = time - begin
        self.time = begin + duration / 2
        self.pose = Pose(*map(float, (end_integral - begin_integral) / duration))
