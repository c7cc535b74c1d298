"""Contacts of a run with obstacles and objects, and motion of objects.

On a plant that ignores obstacles, such as most analytical models, the body passes
through them. Its overlaps with them then take the place of contacts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from srs_twin.comparison.sampling import meanings_of, units_of
from srs_twin.plants.clearance import TOUCHING_M
from srs_twin.trajectory import Event, Trajectory

CONTACT_MEANINGS = meanings_of("""
contacts: number of contacts with obstacles and objects, or of overlaps on a plant that ignores them
contact_time_s: total time of these contacts or overlaps
clearance_m: smallest distance of the body from obstacles and objects; negative for an overlap
""")
CONTACT_UNITS = units_of(CONTACT_MEANINGS)
OBJECT_MEANINGS = meanings_of("""
object_moved_m: distance of an object at the end from its place at the start, the largest of all objects
""")
OBJECT_UNITS = units_of(OBJECT_MEANINGS)

CONTACT = "contact"
OVERLAP = "overlap"
CONTACT_EVENTS = (CONTACT, OVERLAP)
"""Kinds of the events of contacts, and of overlaps on a plant that ignores obstacles.
"""

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
    """Return the contacts of a run with obstacles in order of time; none on a plant that ignores them."""
    force = obstacle_force(trajectory)
    if force is None:
        return []
    contacts = []
    for group in _spells(trajectory):
        largest = force[group].max(axis=0)
        connector = int(largest.argmax())
        begin, end = map(float, trajectory.time[group[[0, -1]]])
        contacts.append(Touch(begin, end, float(largest[connector]), connector + 1))
    return contacts


def contact_events(trajectory: Trajectory) -> list[Event]:
    """Return the contacts of a run as events, or the overlaps on a plant that ignores obstacles."""
    events = []
    for touch in touches(trajectory):
        text = f"connector {touch.connector}, at most {touch.force:.2g} N"
        text += _duration(touch.begin, touch.end)
        events.append(Event(touch.begin, CONTACT, text))
    for group in _spells(trajectory) if ignores_obstacles(trajectory) else ():
        begin, end = map(float, trajectory.time[group[[0, -1]]])
        depth = -1e3 * trajectory["clearance"][group].min()
        text = f"the body passes through an obstacle, at least {depth:.2g} mm deep"
        text += _duration(begin, end)
        events.append(Event(begin, OVERLAP, text))
    return events


def _duration(begin: float, end: float) -> str:
    # The duration of a contact in a single sample is unknown.
    if end > begin:
        return f", for {end - begin:.2g} s"
    return ""


def contact_metrics(trajectory: Trajectory) -> dict[str, float | None]:
    """Return the metrics of contacts with obstacles and objects; all None in a world without them.

    - ``contacts``, ``contact_time_s``: number and duration of contacts. On a plant that
      ignores obstacles, they are those of the overlaps of its body with obstacles.
    - ``clearance_m``: smallest distance of the collision hull from obstacles and
      objects at the samples (`plants.clearance`), at most 0 after a contact, also one
      between two samples.
    """
    metrics: dict[str, float | None] = dict.fromkeys(CONTACT_UNITS)
    touching = _touching(trajectory)
    if touching is not None:
        steps = np.diff(trajectory.time, prepend=trajectory.time[0])
        metrics["contacts"] = len(_spells(trajectory))
        metrics["contact_time_s"] = float(steps[touching].sum())
    if trajectory.has("clearance"):
        least = float(trajectory["clearance"].min())
        # Only the force shows a contact between two samples.
        if metrics["contacts"]:
            least = min(least, 0.0)
        metrics["clearance_m"] = least
    return metrics


def ignores_obstacles(trajectory: Trajectory) -> bool:
    """Return whether the plant of a run passes through the obstacles of its world."""
    return trajectory.has("clearance") and not trajectory.has("obstacle_force_x")


def contact_free_s(runs: Iterable[Trajectory]) -> float:
    """Return the time of the last sample before the first contact in one of the runs, s; inf without one.

    Overlaps on a plant that ignores obstacles do not affect its motion and do not
    count.
    """
    end = math.inf
    for run in runs:
        for touch in touches(run)[:1]:
            # The force at a sample is the mean since the sample before, at which the
            # contact had not begun.
            before = max(int(np.searchsorted(run.time, touch.begin)) - 1, 0)
            end = min(end, float(run.time[before]))
    return end


def _touching(trajectory: Trajectory) -> np.ndarray | None:
    """Return at which samples the body touches an obstacle, or overlaps one that its plant ignores."""
    force = obstacle_force(trajectory)
    if force is not None:
        return np.asarray(force.max(axis=1) > TOUCH_N)
    if trajectory.has("clearance"):
        return trajectory["clearance"] < -TOUCHING_M
    return None


def _spells(trajectory: Trajectory) -> list[np.ndarray]:
    """Return the samples of each contact or overlap."""
    touching = _touching(trajectory)
    if touching is None or not touching.any():
        return []
    rows = np.flatnonzero(touching)
    breaks = np.flatnonzero(np.diff(trajectory.time[rows]) > _MAX_INTERRUPTION_S) + 1
    return np.split(rows, breaks)


def obstacle_force(trajectory: Trajectory) -> np.ndarray | None:
    """Return the force of obstacles on each connector, shape (samples, N), N; None without obstacles."""
    if not trajectory.has("obstacle_force_x"):
        return None
    return np.hypot(
        trajectory.stack("obstacle_force_x"), trajectory.stack("obstacle_force_y")
    )


def object_metrics(trajectory: Trajectory) -> dict[str, float]:
    """Return ``object_moved_m``, the largest displacement of an object; empty without objects."""
    if not trajectory.has("object_x"):
        return {}
    place = np.stack([trajectory.stack("object_x"), trajectory.stack("object_y")])
    return {"object_moved_m": float(np.hypot(*(place[:, -1] - place[:, 0])).max())}
