"""Where the body is, for drawing: the whole centre line, and the wheels."""

from __future__ import annotations

import numpy as np

from srs_twin.comparison.centre_line import centre_lines
from srs_twin.spec import Geometry
from srs_twin.trajectory import Trajectory


def body_line(trajectory: Trajectory, geometry: Geometry, pieces: int = 8) -> np.ndarray:
    """Return the whole centre line, head to tail, shape (samples, points, 2), m."""
    lines = centre_lines(trajectory, geometry, pieces)
    # Without a gap the ends of the arc are the connectors: every point stands once.
    once = slice(0, -1) if geometry.rigid_gap else slice(1, -2)
    inner = lines[:, :, once].reshape(len(lines), -1, 2)
    return np.concatenate([inner, lines[:, -1, -1:]], axis=1)


def wheel_centres(trajectory: Trajectory, geometry: Geometry) -> np.ndarray:
    """Return the wheels at ± half the track, shape (samples, N, 2, 2), m: left, then right."""
    theta = trajectory.stack("theta")
    left = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
    side = np.array([1.0, -1.0])[:, None] * geometry.half_track
    return trajectory.position[:, :, None] + side * left[:, :, None]


def wheel_turns(trajectory: Trajectory, geometry: Geometry) -> np.ndarray:
    """Return how far each wheel has rolled without slip, shape (samples, N, 2), rad, forward positive."""
    centres, theta = wheel_centres(trajectory, geometry), trajectory.stack("theta")
    middle = (theta[1:] + theta[:-1]) / 2
    ahead = np.stack([np.cos(middle), np.sin(middle)], axis=-1)[:, :, None]
    rolled = (np.diff(centres, axis=0) * ahead).sum(axis=-1) / geometry.wheel_radius
    return np.concatenate([np.zeros((1, *rolled.shape[1:])), np.cumsum(rolled, axis=0)])
