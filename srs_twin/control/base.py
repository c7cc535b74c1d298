"""Base class of the controllers, and replacement of lost sensor readings."""

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
    """Controller that computes the valve commands of one control tick.

    A controller reads the sensed bends in `SnakeState.measured_bend` and poses from a
    camera. A controller never reads the true `bend`, and does not know which plant it
    controls.

    Attributes:
        kind: name of the controller in scenario files.
        frequency: gait frequency, Hz, or None if the controller is not periodic.
        layouts: names of the supported valve layouts, a subset of `LAYOUTS`.
        spatial: whether the controller commands the chambers of a spatial robot.
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
            InputError: the controller does not support the valve layout or the tick of
                the robot.
        """

    @abstractmethod
    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valve states of the next tick.

        The array has the dtype int8 and the shape (segments, 2), or (slots, segments,
        2) if the states change within the tick.
        """

    def save(self) -> SavedState:
        """Return the controller's state, which `restore` accepts in any process.

        Raises:
            InputError: the class does not list its `state_attributes`.
        """
        self.check_saveable(Controller, f"controller '{self.kind}'")
        return SavedState(self.identity(), self.state_dict())

    def restore(self, state: SavedState) -> None:
        """Continue from a saved state.

        Before this call, the controller must be reset with an equal robot and an equal
        tick.

        Raises:
            InputError: the state belongs to another controller, or `reset` has not been
                called.
        """
        self.check_saveable(Controller, f"controller '{self.kind}'")
        state.check(f"controller '{self.kind}'", self.identity())
        self.load_state_dict(state.content)

    def identity(self) -> dict[str, object]:
        """Return the properties, as JSON values, that a saved state must match."""
        return {"controller": self.kind, "class": type(self).__name__}

    def script(self, duration: float) -> Schedule | None:
        """Return the valve states of the whole run, or None in closed loop.

        The rollout calls this method after `reset`. A controller that returns a
        schedule must have constant signals and must not record events.

        Args:
            duration: duration of the run, s, which is a whole number of ticks.
        """
        return None

    def signals(self) -> dict[str, Any]:
        """Return the signals to record, keyed by name.

        Each value is a number or an array. The recorded names of array elements are
        numbered from 1.
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
    is replaced by the previous valid reading, which is initially 0. Events record when
    readings are lost and recovered.

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
        """Store the readings (rad) of one tick, and return loss and recovery events."""
        measured_bend = np.asarray(measured_bend, dtype=float)
        lost = ~(np.abs(measured_bend) <= MAX_READING_RAD)
        self.value = np.where(lost, self.value, measured_bend)
        if (lost == self.lost).all():
            return []
        events = []
        for j in np.flatnonzero(lost & ~self.lost):
            text = (
                f"segment {j + 1}: reading lost; the last good one, {self.value[j]:.4g}"
                " rad, is held"
            )
            events.append(Event(time, "reading_lost", text))
        for j in np.flatnonzero(self.lost & ~lost):
            events.append(
                Event(time, "reading_back", f"segment {j + 1}: readings are back")
            )
        self.lost = lost
        return events
