"""HoldValves: the valves of all chambers in one state for ever, to see where that leads (Fig. 41)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from srs_twin.control.base import Controller
from srs_twin.errors import UnknownNameError
from srs_twin.pneumatics.schedule import LAYOUTS, Schedule
from srs_twin.spec import RobotSpec

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState

STATES = {"fill": 1, "hold": 0, "vent": -1}
"""Name of a valve state → the state."""


class HoldValves(Controller):
    """Open loop, all segments alike.

    Attributes:
        layouts: those that have both states; only separate valves can hold.
    """

    kind = "hold_valves"

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
        self.layouts = tuple(name for name, known in LAYOUTS.items() if set(self._states) <= set(known))

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`."""
        self._valves = np.tile(np.array(self._states, dtype=np.int8), (spec.segments, 1))

    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valves, shape (segments, 2)."""
        return self._valves

    def script(self, duration: float) -> Schedule:
        """Return the valves of a whole run."""
        return Schedule(duration, np.zeros(1), self._valves[None])
