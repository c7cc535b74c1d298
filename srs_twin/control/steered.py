"""Steered: a controller whose offset changes at given times, to see what a change of offset does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.control.base import Controller
from srs_twin.control.gait import Gait
from srs_twin.control.learning import ILC
from srs_twin.errors import InputError
from srs_twin.spec import RobotSpec
from srs_twin.trajectory import Event

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState

_SAME_S = 1e-9
"""Ticks add up with rounding."""


class Steered(Controller):
    """A gait or iterative learning that is told a new offset from time to time; else as if it were alone.

    Attributes:
        changes: (time in s, offset) of each change, in order of time.
    """

    def __init__(self, controller: Gait | ILC, changes: Sequence[tuple[float, float]]) -> None:
        """Make the controller.

        Args:
            controller: what is steered; the offset that it has now is the first one.
            changes: (time in s, offset). A change counts from the first tick on that begins then or later.

        Raises:
            InputError: times that do not rise, or that begin before the run.
        """
        times = [0.0, *(time for time, _ in changes)]
        if not all(b > a for a, b in zip(times, times[1:], strict=False)):
            raise InputError(f"times of changes {times[1:]} s are not allowed; they must rise, from above 0")
        self.kind, self.frequency, self.layouts = controller.kind, controller.frequency, controller.layouts
        self.changes = tuple(changes)
        self._inner, self._first = controller, controller.offset

    @property
    def offset(self) -> float:
        """The offset of now."""
        return self._inner.offset

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`."""
        self._inner.offset = self._first
        self._inner.reset(spec, tick, seed=seed)
        self._done, self._events = 0, list[Event]()

    def step(self, state: SnakeState) -> np.ndarray:
        """See `Controller.step`."""
        time = float(state.time)
        while self._done < len(self.changes) and time >= self.changes[self._done][0] - _SAME_S:
            before, after = self._inner.offset, self.changes[self._done][1]
            self._inner.offset = after
            self._events.append(Event(time, "offset", f"offset {before:g} to {after:g}"))
            self._done += 1
        valves = self._inner.step(state)
        self.finished = self._inner.finished
        return valves

    def signals(self) -> dict[str, Any]:
        """See `Controller.signals`."""
        return self._inner.signals()

    def events(self) -> list[Event]:
        """Return the changes of offset, and what the controller itself has to tell."""
        events, self._events = self._events + self._inner.events(), []
        return events

    def describe(self) -> dict[str, Any]:
        """See `Controller.describe`."""
        return self._inner.describe() | {"changes": [list(change) for change in self.changes]}
