"""What moves an analytical snake: `Body`, and the `complete` model's, whose bends are given."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from srs_twin.plants import kernels
from srs_twin.plants.base import Pose
from srs_twin.pneumatics import Trace


class Body(ABC):
    """The mechanics of an analytical model, driven by what the chambers do.

    Attributes:
        state: pose, velocity and moment of momentum by the indices in `kernels`, shape (6,).
        velocity: of the centre of mass in the mean-heading frame (m/s) and yaw rate (rad/s), shape (3,).
    """

    state: np.ndarray
    velocity: np.ndarray

    @abstractmethod
    def reset(self, pose: Pose) -> None:
        """Lie straight, at rest, with the centre of mass at x, y (m) and that heading (rad)."""

    @abstractmethod
    def move(self, steps: np.ndarray, trace: Trace, stages: slice) -> int:
        """Advance by some steps.

        Args:
            steps: step lengths, shape (steps,), s.
            trace: what the chambers do; a body whose bends are not the free ones writes its own over them
                in the row of the last stage.
            stages: rows of the trace, two for each step.

        Returns:
            The number of steps that found no solution.
        """


class GivenBends(Body):
    """The `complete` model: the bends are the free ones of Eq. 14, whatever the load."""

    def __init__(self, constants: tuple[Any, ...]) -> None:
        self._constants = constants

    def reset(self, pose: Pose) -> None:
        """See `Body.reset`."""
        self.state = np.array([*pose, 0.0, 0.0, 0.0])
        self.velocity = np.zeros(3)

    def move(self, steps: np.ndarray, trace: Trace, stages: slice) -> int:
        """See `Body.move`."""
        bends, rates = (values[stages].reshape(len(steps), 2, -1) for values in (trace.bend, trace.bend_rate))
        failed: int = kernels.advance(  # type: ignore[call-arg]  # numba's stub knows no signatures
            self.state, steps, bends, rates, *self._constants, self.velocity
        )
        return failed
