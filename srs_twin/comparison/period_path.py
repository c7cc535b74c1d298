"""How far a gait period carries a snake, and by how much it turns it."""

from __future__ import annotations

import numpy as np

from srs_twin.comparison.gait_window import GaitWindow
from srs_twin.trajectory import Trajectory

LEAST_WAY = 1e-3
"""A snake that gets less far than this in a period has no path, body lengths."""


def carried(trajectory: Trajectory, window: GaitWindow) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much a period carries the centre of mass (m, backward negative) and turns it (rad).

    Both are means over all periods that begin within one: at one phase alone, what the body sways to the side
    would be taken for a part of the radius. K periods give K − 1 numbers of each.
    """
    heading, turning = window.running(trajectory, trajectory["heading"])
    _, velocity = window.running(trajectory, trajectory.com)
    along = velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)
    apart = np.copysign(window.period, along.mean()) * np.hypot(velocity[:, 0], velocity[:, 1])
    each = (window.periods - 1, window.instants)
    return apart.reshape(each).mean(axis=1), window.period * turning.reshape(each).mean(axis=1)
