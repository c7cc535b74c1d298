"""Base class for controllers, and a filter that replaces lost sensor readings."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from srs_twin.compute.claims import Claimable
from srs_twin.io.saved_state import SavedState, Stateful
from srs_twin.pneumatics.valves import LAYOUTS, Schedule
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Event

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState


class Controller(Claimable, Stateful, ABC):
    """Base class for controllers, which compute valve commands once per control tick.

    A controller reads the sensed bends in `SnakeState.measured_bend` and the camera
    poses, but never the true `bend`. It works with any plant.

    Attributes:
        kind: name of the controller in scenario files.
        frequency: gait frequency, Hz, or None if the controller is not periodic.
        layouts: names of the supported valve layouts, a subset of `LAYOUTS`.
        spatial: whether the controller commands a spatial robot.
        finished: whether the controller has ended its task. The rollout ends after the
            tick in which `finished` becomes True.
    """

    state_attributes: ClassVar[tuple[str, ...]] = ("finished",)

    kind: str = "own"
    frequency: float | None = None
    layouts: tuple[str, ...] = tuple(LAYOUTS)
    spatial: bool = False
    finished: bool = False
    _events: list[Event]

    @abstractmethod
    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """Initialise the controller for a run.

        Args:
            spec: robot to control.
            tick: control tick, s.
            seed: random seed of the controller.

        Raises:
            InputError: the controller does not support the valve layout of the robot,
                or the control tick.
        """

    @abstractmethod
    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valve states of the next tick.

        The result is an int8 array of shape (segments, 2), or of shape (slots,
        segments, 2) if states change within the tick.
        """

    def save(self) -> SavedState:
        """Return the controller state, which `restore` also accepts in another process.

        Raises:
            InputError: the class does not list its `state_attributes`.
        """
        self.check_saveable(Controller, f"controller '{self.kind}'")
        return SavedState(self.identity(), self.state_dict())

    def restore(self, state: SavedState) -> None:
        """Continue from a saved state.

        Call `reset` first, with the robot and the tick that the saved controller used.

        Raises:
            InputError: the state belongs to another controller, or `reset` has not been
                called.
        """
        self.check_saveable(Controller, f"controller '{self.kind}'")
        state.check(f"controller '{self.kind}'", self.identity())
        self.load_state_dict(state.content)

    def identity(self) -> dict[str, object]:
        """Return JSON values that a saved state and this controller must share."""
        return {"controller": self.kind, "class": type(self).__name__}

    def script(self, duration: float) -> Schedule | None:
        """Return the valve states of the whole run, or None for closed-loop control.

        The rollout calls this method after `reset`. A controller that returns a
        schedule must have constant signals and must not record events.

        Args:
            duration: duration of the run, a whole number of ticks, s.
        """
        return None

    def signals(self) -> dict[str, Any]:
        """Return the signals to record, keyed by name.

        Each value is a number or an array. Array elements are recorded under the name
        followed by the element number, counted from 1.
        """
        return {}

    def events(self) -> list[Event]:
        """Return the events since the last call."""
        events = getattr(self, "_events", [])
        self._events = []
        return events

    def describe(self) -> dict[str, object]:
        """Return the settings and results to record, as JSON-compatible values."""
        return {}


MAX_READING_RAD = 2 * math.pi
"""Maximum plausible magnitude of a bend reading, rad. No segment bends by a full turn.
"""


class SensorReadings(Stateful):
    """Latest valid bend readings of all segments.

    A reading counts as lost if it is not finite or exceeds a full turn. A lost reading
    is replaced by the previous valid reading, which is initially 0.

    Attributes:
        value: latest valid readings, shape (segments,), rad.
        lost: whether the latest reading of each segment was lost, shape (segments,).
    """

    state_attributes = ("value", "lost")

    def __init__(self, segments: int) -> None:
        """Initialise all readings to 0."""
        self.value: np.ndarray = np.zeros(segments)
        self.lost: np.ndarray = np.zeros(segments, dtype=bool)

    def update(self, time: float, measured_bend: np.ndarray) -> list[Event]:
        """Store the readings of one tick (rad), and return events for lost readings."""
        measured_bend = np.asarray(measured_bend, dtype=float)
        lost = ~(np.abs(measured_bend) <= MAX_READING_RAD)
        self.value = np.where(lost, self.value, measured_bend)
        if (lost == self.lost).all():
            return []
        events = []
        for j in np.flatnonzero(lost & ~self.lost):
            text = (
                f"segment {j + 1}: reading lost; the last valid reading,"
                f" {self.value[j]:.4g} rad, is used instead"
            )
            events.append(Event(time, "reading_lost", text))
        for j in np.flatnonzero(self.lost & ~lost):
            events.append(
                Event(
                    time, "reading_back", f"segment {j + 1}: readings are valid again"
                )
            )
        self.lost = lost
        return events
