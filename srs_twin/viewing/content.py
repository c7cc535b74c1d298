"""Data shown in reports and recordings, and events of runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from srs_twin.comparison.compare import Comparison, MeasuredDifference
from srs_twin.comparison.contacts import contact_events
from srs_twin.errors import InputError
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import World
from srs_twin.trajectory import Event, Trajectory


@dataclass(frozen=True)
class RunContent:
    """Data shown in the report and the recording of a run.

    Attributes:
        trajectories: non-empty trajectories, keyed by plant.
        comparison: differences between the plants over time, or None.
        measured: differences between plants and the measured robot, keyed by plant.
    """

    spec: RobotSpec
    trajectories: Mapping[str, Trajectory]
    comparison: Comparison | None = None
    measured: Mapping[str, MeasuredDifference] = field(default_factory=dict)
    world: World = field(default_factory=World)

    def __post_init__(self) -> None:
        if not self.trajectories:
            raise InputError("there is no trajectory to draw; run the scenario first")
        for plant, run in self.trajectories.items():
            if not len(run):
                raise InputError(
                    f"the trajectory of '{plant}' has no samples to draw; run the"
                    " scenario again"
                )


def events_of(run: Trajectory) -> list[Event]:
    """Return the events and contacts of a run, sorted by time."""
    return sorted(
        [*run.events, *contact_events(run), *end_event(run)],
        key=lambda event: event.time,
    )


def end_event(run: Trajectory) -> list[Event]:
    """Return a list that contains the end event if a run ended early."""
    by = run.metadata.get("ended_by")
    if by is None:
        return []
    return [Event(float(run.time[-1]), "ended", f"the run, by its {by}")]
