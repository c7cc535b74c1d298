"""The `compliant` model's body: bends that yield, as springs with dampers that the chambers pull."""

from __future__ import annotations

from typing import Any

import numpy as np

from srs_twin.plants import compliant_kernels, kernels
from srs_twin.plants.base import Pose
from srs_twin.plants.given import Body
from srs_twin.pneumatics import Trace
from srs_twin.spec import RobotSpec


class YieldingBends(Body):
    """Point masses on springs with dampers.

    A segment feels the moment k G (p⁺ − p⁻) against its stiffness k and damping c = k · damping_time, so
    that a massless free one obeys Eq. 14; masses and floor bend it further.
    """

    def __init__(self, spec: RobotSpec, constants: tuple[Any, ...]) -> None:
        mass, length, gap, *floor = constants
        bending = spec.bending
        self._solid = mass, np.zeros_like(mass), length, gap, bending.stiffness, bending.damping
        self._floor = tuple(floor)
        self._moment_per_pascal = bending.stiffness * spec.actuator.gain
        self._segments = spec.segments

    def reset(self, pose: Pose) -> None:
        """See `Body.reset`."""
        self._full = np.zeros(compliant_kernels.BENDS + 2 * self._segments)
        self._full[:3] = pose
        self._rates = np.zeros(3 + self._segments)
        self.state, self.velocity = self._full[: kernels.MOMENT + 1], self._rates[:3]

    def move(self, steps: np.ndarray, trace: Trace, stages: slice) -> int:
        """See `Body.move`."""
        pressure = trace.pressure[stages]
        moments = self._moment_per_pascal * (pressure[..., 0] - pressure[..., 1])
        failed: int = compliant_kernels.advance(
            self._full, steps, moments.reshape(len(steps), 2, -1), self._solid, self._floor, self._rates
        )
        bends = self._full[compliant_kernels.BENDS :][: self._segments]
        trace.bend[stages.stop - 1], trace.bend_rate[stages.stop - 1] = bends, self._rates[3:]
        return failed
