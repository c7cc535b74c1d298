"""Events of a run for reports and recordings: controller, contacts with obstacles, and the end."""

from __future__ import annotations

from collections.abc import Iterator

from srs_twin.comparison.contacts import touches
from srs_twin.trajectory import Event, Trajectory


def events_of(run: Trajectory) -> list[Event]:
    """Return the events of a run and its contacts with obstacles, ordered by time."""
    return sorted([*run.events, *_contacts(run), *_end(run)], key=lambda event: event.time)


def _contacts(run: Trajectory) -> Iterator[Event]:
    for touch in touches(run):
        # The duration of a contact in a single sample is unknown.
        duration = f", for {touch.end - touch.begin:.2g} s" if touch.end > touch.begin else ""
        text = f"connector {touch.connector}, at most {touch.force:.2g} N{duration}"
        yield Event(touch.begin, "contact", text)


def _end(run: Trajectory) -> Iterator[Event]:
    by = run.metadata.get("ended_by")
    if by is not None:
        yield Event(float(run.time[-1]), "ended", f"the run, by its {by}")
