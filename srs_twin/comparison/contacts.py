"""Contacts with obstacles and objects, and displacements of objects.

Most analytical models ignore obstacles, so that the body passes through them. For these
models, overlaps between the body and obstacles are reported instead of contacts.
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
"""Kinds of contact events, with overlaps for plants that ignore obstacles."""

TOUCH_N = 1e-3
"""Minimum force of a contact, N. Smaller forces are numerical errors."""
_MAX_INTERRUPTION_S = 0.1
"""Maximum interruption within a single contact, s."""


@dataclass(frozen=True)
class ContactInterval:
    """Contact between the body and obstacles or objects.

    Attributes:
        begin: start time, s.
        end: end time, s.
        force: maximum force on a connector, N.
        connector: number of the connector with the maximum force, counted from 1 at the
            head.
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
    """Return the contacts of a run as events, or overlaps if obstacles are ignored."""
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
    # The duration of a contact in a single sample is unknown.
    if end > begin:
        return f", for {end - begin:.2g} s"
    return ""


def contact_metrics(trajectory: Trajectory) -> dict[str, float | None]:
    """Compute the contact metrics of a run (`CONTACT_MEANINGS`).

    The metrics are None if the world has neither obstacles nor objects. The clearance
    is the minimum distance between the body's collision geoms and obstacles or objects
    over all samples (`plants.clearance`). If there is a contact, the clearance is at
    most 0, even if the contact occurs between two samples.
    """
    metrics: dict[str, float | None] = dict.fromkeys(CONTACT_UNITS)
    touching = _touching(trajectory)
    if touching is not None:
        steps = np.diff(trajectory.time, prepend=trajectory.time[0])
        metrics["contacts"] = len(_spells(trajectory))
        metrics["contact_time_s"] = float(steps[touching].sum())
    if trajectory.has("clearance"):
        least = float(trajectory["clearance"].min())
        # A contact between two samples is visible only in the contact force.
        if metrics["contacts"]:
            least = min(least, 0.0)
        metrics["clearance_m"] = least
    return metrics


def ignores_obstacles(trajectory: Trajectory) -> bool:
    """Return whether the plant of a run ignores obstacles."""
    return trajectory.has("clearance") and not trajectory.has("obstacle_force_x")


def contact_free_s(runs: Iterable[Trajectory]) -> float:
    """Return the time of the last sample before the first contact in any run, s.

    The result is infinite if there are no contacts. Overlaps do not count as contacts,
    because they do not affect the motion.
    """
    end = math.inf
    for run in runs:
        for touch in touches(run)[:1]:
            # A sample contains the mean force since the previous sample, so the contact
            # may have begun immediately after the previous sample.
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
    """Return the sample indices of each contact or overlap."""
    touching = _touching(trajectory)
    if touching is None or not touching.any():
        return []
    rows = np.flatnonzero(touching)
    breaks = np.flatnonzero(np.diff(trajectory.time[rows]) > _MAX_INTERRUPTION_S) + 1
    return np.split(rows, breaks)


def obstacle_force(trajectory: Trajectory) -> np.ndarray | None:
    """Return obstacle forces (N), shape (samples, connectors), or None if unknown."""
    if not trajectory.has("obstacle_force_x"):
        return None
    return np.hypot(
        trajectory.stack("obstacle_force_x"), trajectory.stack("obstacle_force_y")
    )


def object_metrics(trajectory: Trajectory) -> dict[str, float]:
    """Compute ``object_moved_m``, or return {} for a world without objects."""
    if not trajectory.has("object_x"):
        return {}
    place = np.stack([trajectory.stack("object_x"), trajectory.stack("object_y")])
    return {"object_moved_m": float(np.hypot(*(place[:, -1] - place[:, 0])).max())}
