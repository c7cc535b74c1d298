"""Open-loop controllers that apply recorded or constant valve states (Fig. 41)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from srs_twin.control.base import Controller
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.plants.base import SnakeState
from srs_twin.pneumatics.valves import LAYOUTS, Schedule, count_slots
from srs_twin.robot.spec import RobotSpec


class Replay(Controller):
    """Controller that replays a recorded schedule of valve states from time 0.

    After the end of the schedule, the valves remain in their last states.

    Attributes:
        schedule: recorded valve states.
        frequency: gait frequency of the recording, or None if the recording is not
            periodic, Hz.
    """

    kind = "replay"
    state_attributes = ()

    def __init__(self, schedule: Schedule, frequency: float | None = None) -> None:
        self.schedule = schedule
        self.frequency = frequency
        self.layouts = layouts_for(schedule.states)

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`.

        Raises:
            InputError: the schedule and the robot have different numbers of segments.
        """
        segments = self.schedule.states.shape[1]
        if segments != spec.segments:
            raise InputError(
                f"the recorded valves belong to {segments} segments, but {spec.name}"
                f" has {spec.segments} segments; use a log of this robot"
            )
        slots = count_slots(tick, spec.scale)
        self._slot_centres = tick * (np.arange(slots) + 0.5) / slots

    def step(self, state: SnakeState) -> np.ndarray:
        """See `Controller.step`."""
        schedule = self.schedule
        time = float(state.time) + self._slot_centres
        runs = np.searchsorted(schedule.starts, time, side="right") - 1
        states: np.ndarray = schedule.states[np.maximum(runs, 0)]
        return states[0] if runs[0] == runs[-1] else states

    def script(self, duration: float) -> Schedule:
        """See `Controller.script`."""
        schedule = self.schedule
        if duration > schedule.span:
            return Schedule(duration, schedule.starts, schedule.states)
        return schedule.slice(0.0, duration)


STATES = {"fill": 1, "hold": 0, "vent": -1}
"""Valve states, keyed by name."""


def layouts_for(states: ArrayLike) -> tuple[str, ...]:
    """Return the names of the valve layouts that support all given states."""
    needed = set(np.unique(states).tolist())
    return tuple(name for name, allowed in LAYOUTS.items() if needed <= set(allowed))


class HoldValves(Controller):
    """Controller that keeps the valves of each side in a constant state."""

    kind = "hold_valves"
    state_attributes = ()

    def __init__(self, plus: str = "fill", minus: str = "vent") -> None:
        """Create the controller from two keys of `STATES`, one for each side.

        Raises:
            UnknownNameError: an argument is not a key of `STATES`.
        """
        for name in (plus, minus):
            if name not in STATES:
                raise UnknownNameError("valve state", name, STATES)
        self._states = STATES[plus], STATES[minus]
        self.layouts = layouts_for(self._states)

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`."""
        self._valves = np.tile(
            np.array(self._states, dtype=np.int8), (spec.segments, 1)
        )

    def step(self, state: SnakeState) -> np.ndarray:
        """See `Controller.step`."""
        return self._valves

    def script(self, duration: float) -> Schedule:
        """See `Controller.script`."""
        return Schedule(duration, np.zeros(1), self._valves[None])
