"""Odometry: motion of the members' bodies due to the change of their bends."""

from __future__ import annotations

import copy
import math

import numpy as np

from srs_twin.live.connection import LocalConnection

_LONGEST_FRAME_INTERVAL_S = 0.2
"""Interval between frames above which the connection is not fitted."""


class Odometry:
    """Motion of bodies by the local connection, which is fitted to frames of motion capture.

    All members move by the change of the mean bends, plus a random displacement from the uncertainty of the
    connection. The bends of single members fluctuate and would turn the bodies at random; so would model
    errors between two corrections. Therefore the motion is integrated along a straight line between corrected
    mean bends.

    Attributes:
        connection: local connection of the robot.
        twist: forward and lateral velocity (m/s) and yaw rate (rad/s) of the last step.
    """

    def __init__(self, connection: LocalConnection, bends: np.ndarray, rng: np.random.Generator) -> None:
        """Create an odometry at the bends of the members, shape (members, segments), rad."""
        self.connection, self.twist = connection, np.zeros(3)
        self._features = np.zeros(len(connection.weights))
        draws = rng.normal(size=(len(bends), len(self._features), 3))
        self._draws = draws - draws.mean(axis=0)
        self._forecasting = False
        # Bends at the last step, and the time since.
        self._bends, self._elapsed = bends.copy(), 0.0
        self._frame_age = math.inf

    def advance(self, dt: float) -> None:
        """Add a time step (s) to the elapsed time; `apply` moves the bodies."""
        self._elapsed += dt
        self._frame_age += dt

    def apply(self, pose: np.ndarray, bends: np.ndarray) -> None:
        """Move the bodies by the change of the bends since the last call.

        Args:
            pose: x, y (m) and heading (rad) of the members, in place.
            bends: bends of the members, rad.
        """
        if not self._elapsed:
            return
        before, after = self._bends.mean(axis=0), bends.mean(axis=0)
        features = self.connection.features(before, after)
        change = bends - self._bends if self._forecasting else after - before
        step = change @ self.connection.matrix((before + after) / 2).T
        step = step + self.connection.sample_model_error(features, self._draws)
        # The heading in the middle of the step makes the integration second-order accurate.
        heading = pose[:, 2] + step[:, 2] / 2
        c, s, x, y = np.cos(heading), np.sin(heading), step[:, 0], step[:, 1]
        pose += np.column_stack([c * x - s * y, s * x + c * y, step[:, 2]])
        self.twist = step.mean(axis=0) / self._elapsed
        self._features = self._features + features
        self._bends, self._elapsed = bends.copy(), 0.0

    def learn(self, pose: np.ndarray, bend: np.ndarray, poses: np.ndarray, bends: np.ndarray) -> None:
        """Fit the connection to a frame.

        Args:
            pose: mean pose before the correction by the frame.
            bend: mean bends before the correction, rad.
            poses: poses of the members after the correction.
            bends: bends of the members after the correction, rad.
        """
        connection, now = self.connection, bends.mean(axis=0)
        if self._frame_age < _LONGEST_FRAME_INTERVAL_S:
            x, y, turn = poses.mean(axis=0) - pose
            c, s = math.cos(pose[2]), math.sin(pose[2])
            residual = np.array([c * x + s * y, c * y - s * x, turn])
            # Add the learnt part again, because the fit concerns the whole motion since the last frame.
            residual += self._features @ connection.weights
            residual -= connection.kinematic_matrix((bend + now) / 2) @ (now - bend)
            connection.learn(self._features + connection.features(bend, now), residual)
        self._features, self._frame_age = np.zeros_like(self._features), 0.0
        self._bends[:] = bends

    def interrupt(self) -> None:
        """Exclude the motion since the last frame from the fit of the connection."""
        self._frame_age = math.inf

    def restart(self, bends: np.ndarray) -> None:
        """Continue from other bends (rad) without motion."""
        self._bends = bends.copy()
        self.interrupt()

    def forecaster(self, before: np.ndarray, bends: np.ndarray) -> Odometry:
        """Return the odometry of the first members for predictions, in which each follows its own bends.

        Args:
            before: bends of these members in the filter, rad.
            bends: bends of these members in the prediction, rad.
        """
        other = copy.copy(self)
        other.connection, other._forecasting = self.connection.snapshot(), True
        other._draws = self._draws[: len(bends)]
        other._bends = self._bends[: len(bends)] + bends - before
        return other
