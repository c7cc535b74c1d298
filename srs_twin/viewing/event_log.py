"""What happened in a run, as a text log of a recording: a controller's events, and touching obstacles."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import rerun as rr

from srs_twin.comparison.following import touches
from srs_twin.trajectory import Event, Trajectory
from srs_twin.viewing.blueprint import TIMELINE
from srs_twin.viewing.colors import Style

_WARNINGS = ("saturation", "fault", "reading_lost", "no_new_plan", "contact", "ended")


def events_of(run: Trajectory) -> list[Event]:
    """Return a run's events and its contacts with obstacles, in order of time."""
    return sorted([*run.events, *_contacts(run), *_end(run)], key=lambda event: event.time)


def send_events(log: rr.RecordingStream, plant: str, run: Trajectory, style: Style) -> None:
    """Log a run's events as `events/<plant>`; nothing where there are none."""
    events = events_of(run)
    if not events:
        return
    columns = rr.TextLog.columns(
        text=[f"{event.kind}: {event.text}" for event in events],
        level=["WARN" if event.kind in _WARNINGS else "INFO" for event in events],
        color=[style.rgb] * len(events),
    )
    times = np.array([event.time for event in events])
    log.send_columns(f"events/{plant}", [rr.TimeColumn(TIMELINE, duration=times)], columns)


def _contacts(run: Trajectory) -> Iterator[Event]:
    for touch in touches(run):
        # One that a single sample saw is shorter than what lies between samples.
        lasted = f", for {touch.end - touch.begin:.2g} s" if touch.end > touch.begin else ""
        text = f"connector {touch.connector}, at most {touch.force:.2g} N{lasted}"
        yield Event(touch.begin, "contact", text)


def _end(run: Trajectory) -> Iterator[Event]:
    by = run.metadata.get("ended_by")
    if by is not None:
        yield Event(float(run.time[-1]), "ended", f"the run, by its {by}")
