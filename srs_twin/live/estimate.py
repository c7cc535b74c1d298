"""Estimate: estimated state of a robot at one time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from srs_twin.plants.base import SnakeState


@dataclass(frozen=True)
class Estimate:
    """Estimated state of a robot, with standard deviations.

    Attributes:
        time: time of the estimate, our clock, s. The state is predicted from the last used message to this
            time.
        bend: bend of each segment, rad.
        bend_sd: standard deviation of the bends, rad.
        pose: x, y (m) of the centre of mass, mean heading (rad).
        pose_sd: standard deviation of the pose.
        velocity: velocity of the centre of mass in the world frame, m/s, and yaw rate, rad/s.
        connectors: x, y (m), heading (rad), shape (connectors, 3).
        parameters: values and standard deviations of "gain", of each chamber as a multiple of that in the
            robot file, and "bias_rad", the bend of each module without pressure.
        faults: detected faults as (part, fault, probability); part is a segment, "supply" or a connector.
        off: RMS innovation of the last measurements of each kind, in standard deviations.
        lost: reason why the position is unknown; empty if it is known.
    """

    time: float
    bend: np.ndarray
    bend_sd: np.ndarray
    pose: np.ndarray
    pose_sd: np.ndarray
    velocity: np.ndarray
    connectors: np.ndarray
    parameters: Mapping[str, tuple[np.ndarray, np.ndarray]]
    faults: tuple[tuple[str, str, float], ...]
    off: Mapping[str, float]
    lost: str

    def state(self, time: float, pressure: np.ndarray) -> SnakeState:
        """Return the state for a controller.

        Args:
            time: time on the controller's clock, s.
            pressure: pressures of the chambers, shape (segments, 2), Pa.
        """
        n, still = len(self.connectors), np.zeros_like(self.bend)
        return SnakeState(
            time=np.float64(time), com=self.pose[:2], com_velocity=self.velocity[:2], heading=self.pose[2],
            position=self.connectors[:, :2], theta=self.connectors[:, 2], bend=self.bend, bend_rate=still,
            pressure=pressure, valves=np.zeros_like(pressure, dtype=np.int8), sensed=self.bend,
            contact_force=np.zeros((n, 2)), obstacle_force=np.zeros((n, 2)), torque=still,
            work=np.float64(0.0), internal_loss=np.float64(0.0), air=np.float64(0.0), qpos=np.empty(0),
        )  # fmt: skip
