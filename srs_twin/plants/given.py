"""What moves an analytical snake: `Body`, and the models' whose bends are given."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from srs_twin.plants import kernels, step_control
from srs_twin.plants.base import Pose
from srs_twin.plants.floor import Floor
from srs_twin.plants.inverse_dynamics import inverse_dynamics
from srs_twin.plants.kinematics import Solid
from srs_twin.pneumatics import Trace


@dataclass(frozen=True)
class Motion:
    """What a body did at some moments.

    Attributes:
        states: by the indices in `kernels`, shape (samples, STATES or more).
        velocities: of the centre of mass in the mean-heading frame (m/s), yaw rate (rad/s) and, where they
            are not given, bend rates, shape (samples, 3 or more).
        bend: shape (samples, segments), rad.
        bend_rate: same shape, rad/s.
        torque: net moment of each segment, same shape, N·m.
    """

    states: np.ndarray
    velocities: np.ndarray
    bend: np.ndarray
    bend_rate: np.ndarray
    torque: np.ndarray


class Body(ABC):
    """The mechanics of an analytical model, driven by what the chambers do.

    Attributes:
        state: pose, velocity, moment of momentum and more by the indices in `kernels`.
        velocity: what `Motion.velocities` holds, now.
        solid: for the kernels.
        floor: for the kernels.
    """

    state: np.ndarray
    velocity: np.ndarray

    yields = False
    """Whether the bends are the body's own, not the free ones that the chambers would give."""

    def __init__(self, solid: Solid, floor: Floor) -> None:
        self.solid, self.floor = solid, floor

    def bends(self) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
        """Return the bends (rad) and their rates (rad/s) now; None from a body that has none of its own."""
        return None, None

    @abstractmethod
    def reset(self, pose: Pose) -> None:
        """Lie straight, at rest, with the centre of mass at x, y (m) and that heading (rad)."""

    @abstractmethod
    def move(self, steps: np.ndarray, trace: Trace, marks: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
        """Advance by some steps.

        Args:
            steps: step lengths, shape (steps,), s.
            trace: what the chambers do at the start and at each step's two stages, 1 + 2 · steps rows.
            marks: numbers of steps after which to look, ascending, shape (samples,).

        Returns:
            How many steps were made, fewer than asked if one failed; the states and velocities of `Motion`
            at the marks, filled as far as they were reached.
        """

    @abstractmethod
    def look(self, states: np.ndarray, velocities: np.ndarray, trace: Trace) -> Motion:
        """Return the motion at moments for which the trace has one row each."""


class GivenBends(Body):
    """`complete` and `simplified`: the bends are the free ones of Eq. 14, whatever the load."""

    def __init__(self, solid: Solid, floor: Floor, *, turning: bool, tolerance: float) -> None:
        super().__init__(solid, floor)
        self._turning, self._tolerance = turning, tolerance

    def reset(self, pose: Pose) -> None:
        """See `Body.reset`."""
        self.state = np.zeros(kernels.STATES)
        self.state[:3] = pose
        self.velocity = np.zeros(3)
        self._slope = np.zeros(kernels.STATES)

    def move(self, steps: np.ndarray, trace: Trace, marks: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
        """See `Body.move`."""
        states, velocities = np.empty((len(marks), kernels.STATES)), np.empty((len(marks), 3))
        done, _ = step_control.advance(
            self.state, self._slope, steps, trace.bend, trace.bend_rate, marks, self.solid, self.floor,
            self._turning, self._tolerance, self.velocity, states, velocities,
        )  # fmt: skip
        return done, states, velocities

    def look(self, states: np.ndarray, velocities: np.ndarray, trace: Trace) -> Motion:
        """See `Body.look`."""
        torque = np.empty_like(trace.bend)
        inverse_dynamics(
            velocities, trace.bend, trace.bend_rate, trace.bend_acceleration, self.solid, self.floor,
            self._turning, torque,
        )  # fmt: skip
        return Motion(states, velocities, trace.bend, trace.bend_rate, torque)
