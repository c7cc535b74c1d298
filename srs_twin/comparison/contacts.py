"""Contacts with obstacles and objects, and object displacements.

In most analytical models, the body passes through obstacles. For these models, overlaps
between body and obstacles are reported instead of contacts.
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
contacts: number of contacts with obstacles and objects, or of overlaps if the plant ignores obstacles
contact_time_s: total time of these contacts or overlaps
clearance_m: minimum distance between the body and obstacles or objects; negative for an overlap
""")
CONTACT_UNITS = units_of(CONTACT_MEANINGS)
OBJECT_MEANINGS = meanings_of("""
object_moved_m: distance between initial and final position of an object, maximum over all objects
""")
OBJECT_UNITS = units_of(OBJECT_MEANINGS)

CONTACT = "contact"
OVERLAP = "overlap"
CONTACT_EVENTS = (CONTACT, OVERLAP)
"""Event kinds: contacts, or overlaps if the plant ignores obstacles."""

TOUCH_N = 1e-3
"""Minimum contact force, N. Smaller forces are numerical errors."""
_MAX_INTERRUPTION_S = 0.1
"""Maximum gap between two contacts that count as one contact, s."""


@dataclass(frozen=True)
class ContactInterval:
    """Contact with an obstacle.

    Attributes:
        begin: start time, s.
        end: end time, s.
        force: maximum force, N.
        connector: connector with the maximum force, counted from 1 at the head.
    """

    begin: float
    end: float
    force: float
    connector: int


def touches(trajectory: Trajectory) -> list[ContactInterval]:
    """Return the contacts of a run in chronological order."""
    force = obstacle_force(trajectory)
    if force is None:
        return []
    contacts = []
    for group in _spells(trajectory):
        largest = force[group].max(axis=0)
        connector = int(largest.argmax())
        begin, end = map(float, trajectory.time[group[[0, -1]]])
        contacts.append(
            ContactInterval(begin, end, float(largest[connector]), connector + 1)
        )
    return contacts


def contact_events(trajectory: Trajectory) -> list[Event]:
    """Return contacts as events, or overlaps if the plant ignores obstacles."""
    events = []
    for touch in touches(trajectory):
        text = f"connector {touch.connector}, up to {touch.force:.2g} N"
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
    # If a contact lasts for a single sample, the duration is unknown.
    if end > begin:
        return f", for {end - begin:.2g} s"
    return ""


def contact_metrics(trajectory: Trajectory) -> dict[str, float | None]:
    """Return the metrics in `CONTACT_UNITS`, or None in a world without obstacles.

    The clearance is the minimum distance, over all samples, between the body's
    collision geoms and obstacles or objects (`plants.clearance`). If there was a
    contact, the clearance is at most 0, even if the contact fell between two samples.
    """
    metrics: dict[str, float | None] = dict.fromkeys(CONTACT_UNITS)
    touching = _touching(trajectory)
    if touching is not None:
        steps = np.diff(trajectory.time, prepend=trajectory.time[0])
        metrics["contacts"] = len(_spells(trajectory))
        metrics["contact_time_s"] = float(steps[touching].sum())
    if trajectory.has("clearance"):
        least = float(trajectory["clearance"].min())
        # A contact between two samples shows only in the force.
        if metrics["contacts"]:
            least = min(least, 0.0)
        metrics["clearance_m"] = least
    return metrics


def ignores_obstacles(trajectory: Trajectory) -> bool:
    """Return whether the plant of a run passes through obstacles."""
    return trajectory.has("clearance") and not trajectory.has("obstacle_force_x")


def contact_free_s(runs: Iterable[Trajectory]) -> float:
    """Return the time of the last sample before the first contact in any run, s.

    The time is infinite if there are no contacts. Overlaps are ignored, because they do
    not affect the motion.
    """
    end = math.inf
    for run in runs:
        for touch in touches(run)[:1]:
            # A sample contains the mean force since the previous sample, so the contact
            # began after the previous sample.
            before = max(int(np.searchsorted(run.time, touch.begin)) - 1, 0)
            end = min(end, float(run.time[before]))
    return end


def _touching(trajectory: Trajectory) -> np.ndarray | None:
    force = obstacle_force(trajectory)
    if force is not None:
        return np.asarray(force.max(axis=1) > TOUCH_N)
    if trajectory.has("clearance"):
        return trajectory["clearance"] < -TOUCHING_M
    return None


def _spells(trajectory: Trajectory) -> list[np.ndarray]:
    """Return the sample indices of each contact."""
    touching = _touching(trajectory)
    if touching is None or not touching.any():
        return []
    rows = np.flatnonzero(touching)
    breaks = np.flatnonzero(np.diff(trajectory.time[rows]) > _MAX_INTERRUPTION_S) + 1
    return np.split(rows, breaks)


def obstacle_force(trajectory: Trajectory) -> np.ndarray | None:
    """Return obstacle forces on the connectors, shape (samples, N), N, or None."""
    if not trajectory.has("obstacle_force_x"):
        return None
    return np.hypot(
        trajectory.stack("obstacle_force_x"), trajectory.stack("obstacle_force_y")
    )


def object_metrics(trajectory: Trajectory) -> dict[str, float]:
    """Return ``object_moved_m``, the maximum displacement of an object, or {}."""
    if not trajectory.has("object_x"):
        return {}
    place = np.stack([trajectory.stack("object_x"), trajectory.stack("object_y")])
    return {"object_moved_m": float(np.hypot(*(place[:, -1] - place[:, 0])).max())}
