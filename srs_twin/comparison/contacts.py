"""Contacts of a run with obstacles, from the recorded forces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srs_twin.trajectory import Trajectory

TOUCH_N = 1e-3
"""Forces below are none."""


_APART_S = 0.1
"""Touches closer together in time are one contact."""


@dataclass(frozen=True)
class Touch:
    """A contact with an obstacle.

    Attributes:
        begin: s.
        end: s.
        force: the largest on any connector, N.
        connector: where that was, 1 at the head.
    """

    begin: float
    end: float
    force: float
    connector: int


def touches(trajectory: Trajectory) -> list[Touch]:
    """Return a run's contacts with obstacles, in order; none where there was nothing to touch."""
    force = obstacle_force(trajectory)
    if force is None:
        return []
    rows = np.flatnonzero(force.max(axis=1) > TOUCH_N)
    apart = np.flatnonzero(np.diff(trajectory.time[rows]) > _APART_S) + 1
    found = []
    for each in np.split(rows, apart) if len(rows) else []:
        row, connector = np.unravel_index(force[each].argmax(), force[each].shape)
        begin, end = trajectory.time[each[[0, -1]]]
        found.append(Touch(float(begin), float(end), float(force[each][row, connector]), int(connector) + 1))
    return found


def obstacle_force(trajectory: Trajectory) -> np.ndarray | None:
    """Return the obstacles' force on each connector, shape (samples, N), N; None without obstacles."""
    if not trajectory.has("obstacle_force_x"):
        return None
    return np.hypot(trajectory.stack("obstacle_force_x"), trajectory.stack("obstacle_force_y"))
