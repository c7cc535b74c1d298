"""The `compliant` model's body: bends that yield, as springs with dampers that the chambers pull."""

from __future__ import annotations

import numpy as np

from srs_twin.plants import compliant_kernels, kernels
from srs_twin.plants.base import Pose
from srs_twin.plants.floor import Floor
from srs_twin.plants.given import Body, Motion
from srs_twin.plants.kinematics import Solid
from srs_twin.pneumatics import Trace
from srs_twin.pneumatics.bending import air_bend
from srs_twin.spec import RobotSpec


class YieldingBends(Body):
    """Point masses on springs with dampers.

    A segment feels the moment that `bending` tells, k G (p⁺ − p⁻) where all is nominal and linear, against
    its stiffness k and damping c = k · damping_time, so that a massless free one obeys Eq. 14; masses and
    floor bend it further.
    """

    yields = True

    def __init__(self, spec: RobotSpec, solid: Solid, floor: Floor) -> None:
        super().__init__(solid, floor)
        bending = spec.bending
        self._spring = bending.stiffness, bending.damping
        self._spec, self._bias = spec, spec.modules.array("bias")
        self._segments = spec.segments

    def reset(self, pose: Pose) -> None:
        """See `Body.reset`."""
        self.state = np.zeros(compliant_kernels.BENDS + 2 * self._segments)
        self.state[:3] = pose
        self.state[compliant_kernels.BENDS :][: self._segments] = self._bias
        self.velocity = np.zeros(3 + self._segments)

    def move(self, steps: np.ndarray, trace: Trace, marks: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
        """See `Body.move`."""
        states = np.empty((len(marks), len(self.state)))
        velocities = np.empty((len(marks), len(self.velocity)))
        done: int = compliant_kernels.advance(
            self.state, steps, self._moments(trace)[1:].reshape(len(steps), 2, -1), marks, self.solid,
            self._spring, self.floor, self.velocity, states, velocities,
        )  # fmt: skip
        return done, states, velocities

    def bends(self) -> tuple[np.ndarray, np.ndarray]:
        """See `Body.bends`."""
        return self.state[compliant_kernels.BENDS :][: self._segments], self.velocity[3:]

    def look(self, states: np.ndarray, velocities: np.ndarray, trace: Trace) -> Motion:
        """See `Body.look`."""
        bend, rate = states[:, compliant_kernels.BENDS :][:, : self._segments], velocities[:, 3:]
        stiffness, damping = self._spring
        torque = self._moments(trace) - stiffness * bend - damping * rate
        return Motion(states[:, : kernels.STATES], velocities, bend, rate, torque)

    def _moments(self, trace: Trace) -> np.ndarray:
        """Return what chambers and bias exert on each segment, N·m."""
        moments: np.ndarray = self._spring[0] * (self._bias + air_bend(self._spec, trace.pressure))
        return moments
