"""Open loop: recorded valves commanded again (`Replay`), or one state for ever (`HoldValves`, Fig. 41)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from srs_twin.control.base import Controller
from srs_twin.errors import InputError, UnknownNameError, count_steps
from srs_twin.plants.base import SnakeState
from srs_twin.pneumatics.valves import LAYOUTS, SLOT_S, Schedule
from srs_twin.robot.spec import RobotSpec

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState


class Replay(Controller):
    """Open loop: a schedule of valve states from the start of the run on, the last of them held.

    Attributes:
        schedule: what was recorded.
        frequency: of the gait that was recorded, Hz; None where nothing was periodic.
        layouts: those that have all of its states; only separate valves can hold.
    """

    kind = "replay"
    state_attributes = ()

    def __init__(self, schedule: Schedule, frequency: float | None = None) -> None:
        self.schedule, self.frequency = schedule, frequency
        self.layouts = layouts_for(schedule.states)

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
        slots = count_steps("tick", tick, "valve slot", SLOT_S) if tick > SLOT_S else 1
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
        return schedule.slice(0.0, duration)


STATES = {"fill": 1, "hold": 0, "vent": -1}
"""Name of a valve state → the state."""


def layouts_for(states: ArrayLike) -> tuple[str, ...]:
    """Return the valve layouts that have these states."""
    needed = set(np.unique(states).tolist())
    return tuple(name for name, known in LAYOUTS.items() if needed <= set(known))


class HoldValves(Controller):
    """Open loop, all segments alike.

    Attributes:
        layouts: those that have both states; only separate valves can hold.
    """

    kind = "hold_valves"
    state_attributes = ()

    def __init__(self, plus: str = "fill", minus: str = "vent") -> None:
        """Make the controller.

        Args:
            plus: what the valves of the + chambers do, a name in `STATES`.
            minus: what those of the − chambers do.

        Raises:
            UnknownNameError: another name.
        """
        for name in (plus, minus):
            if name not in STATES:
                raise UnknownNameError("valve state", name, STATES)
        self._states = STATES[plus], STATES[minus]
        self.layouts = layouts_for(self._states)

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`."""
        self._valves = np.tile(np.array(self._states, dtype=np.int8), (spec.segments, 1))

    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valves, shape (segments, 2)."""
        return self._valves

    def script(self, duration: float) -> Schedule:
        """Return the valves of a whole run."""
        return Schedule(duration, np.zeros(1), self._valves[None])
