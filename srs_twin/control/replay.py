"""Replay: valves that were recorded, commanded again."""

from __future__ import annotations

import numpy as np

from srs_twin.control.base import Controller
from srs_twin.control.gait import SLOT_S
from srs_twin.errors import InputError, whole_steps
from srs_twin.plants.base import SnakeState
from srs_twin.pneumatics.schedule import LAYOUTS, Schedule
from srs_twin.spec import RobotSpec


class Replay(Controller):
    """Open loop: a schedule of valve states from the start of the run on, the last of them held.

    Attributes:
        schedule: what was recorded.
        frequency: of the gait that was recorded, Hz; None where nothing was periodic.
        layouts: those that have all of its states; only separate valves can hold.
    """

    kind = "replay"

    def __init__(self, schedule: Schedule, frequency: float | None = None) -> None:
        self.schedule, self.frequency = schedule, frequency
        states = set(np.unique(schedule.states).tolist())
        self.layouts = tuple(name for name, known in LAYOUTS.items() if states <= set(known))

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`.

        Raises:
            InputError: valves of another robot.
        """
        segments = self.schedule.states.shape[1]
        if segments != spec.segments:
            raise InputError(
                f"the recorded valves are of {segments} segments; {spec.name} has {spec.segments}"
            )
        slots = whole_steps("tick", tick, "valve slot", SLOT_S) if tick > SLOT_S else 1
        self._middle = tick * (np.arange(slots) + 0.5) / slots

    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valves of the coming tick; with slots only where one changes inside it."""
        schedule = self.schedule
        runs = np.searchsorted(schedule.starts, float(state.time) + self._middle, side="right") - 1
        states = schedule.states[np.maximum(runs, 0)]
        return np.asarray(states[0] if runs[0] == runs[-1] else states)

    def script(self, duration: float) -> Schedule:
        """Return the valves of a whole run."""
        schedule = self.schedule
        if duration > schedule.span:
            return Schedule(duration, schedule.starts, schedule.states)
        return schedule.part(0.0, duration)
