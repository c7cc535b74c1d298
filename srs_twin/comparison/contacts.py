"""Contacts of a run with obstacles, from the recorded forces, and motion of objects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srs_twin.comparison.sampling import meanings_of, units_of
from srs_twin.trajectory import Trajectory

OBJECT_MEANINGS = meanings_of("""
object_moved_m: distance of an object at the end from its place at the start, the largest of all objects
""")
OBJECT_UNITS = units_of(OBJECT_MEANINGS)

TOUCH_N = 1e-3
"""Smallest force of a contact, N; smaller ones are numerical."""
_MAX_INTERRUPTION_S = 0.1
"""Largest interruption of a contact, s."""


@dataclass(frozen=True)
class Touch:
    """Contact with an obstacle.

    Attributes:
        begin: start, s.
        end: end, s.
        force: largest force on a connector, N.
        connector: connector with the largest force, 1 at the head.
    """

    begin: float
    end: float
    force: float
    connector: int


def touches(trajectory: Trajectory) -> list[Touch]:
    """Return the contacts of a run with obstacles in order of time; none without obstacles."""
    force = obstacle_force(trajectory)
    if force is None:
        return []
    rows = np.flatnonzero(force.max(axis=1) > TOUCH_N)
    breaks = np.flatnonzero(np.diff(trajectory.time[rows]) > _MAX_INTERRUPTION_S) + 1
    contacts = []
    for group in np.split(rows, breaks) if len(rows) else []:
        row, connector = np.unravel_index(force[group].argmax(), force[group].shape)
        begin, end = trajectory.time[group[[0, -1]]]
        contacts.append(
            Touch(float(begin), float(end), float(force[group][row, connector]), int(connector) + 1)
        )
    return contacts


def obstacle_force(trajectory: Trajectory) -> np.ndarray | None:
    """Return the force of obstacles on each connector, shape (samples, N), N; None without obstacles."""
    if not trajectory.has("obstacle_force_x"):
        return None
    return np.hypot(trajectory.stack("obstacle_force_x"), trajectory.stack("obstacle_force_y"))


def object_metrics(trajectory: Trajectory) -> dict[str, float]:
    """Return ``object_moved_m``, the largest displacement of an object; empty without objects."""
    if not trajectory.has("object_x"):
        return {}
    place = np.stack([trajectory.stack("object_x"), trajectory.stack("object_y")])
    return {"object_moved_m": float(np.hypot(*(place[:, -1] - place[:, 0])).max())}
