"""Base class `Controller`, and a filter that replaces lost bend readings."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from srs_twin.compute.claims import Claimable
from srs_twin.io.saved_state import SavedState, Stateful
from srs_twin.pneumatics.valves import LAYOUTS, Schedule
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Event

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState


class Controller(Claimable, Stateful, ABC):
    """Base class of controllers, which compute valve commands once per control tick.

    A controller may use the measured bends (`SnakeState.measured_bend`) and the camera
    poses, but not the true bends (`SnakeState.bend`).

    Attributes:
        kind: name of this type of controller in scenario files.
        frequency: gait frequency, or None if the controller is not periodic, Hz.
        layouts: names of the supported valve layouts, which are keys of `LAYOUTS`.
        spatial: whether the controller supports robots whose segments bend in two
            directions.
        finished: whether the task of the controller is complete. The rollout ends after
            the control tick in which this attribute becomes True.
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
        """Prepare the controller for a new run.

        Args:
            spec: robot to control.
            tick: control tick, s.
            seed: random seed of the controller.

        Raises:
            InputError: the controller does not support the robot or the control tick.
        """

    @abstractmethod
    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valve states for the next control tick.

        The result is an int8 array of shape (segments, chambers per segment). An
        optional leading axis divides the tick into time slots of equal length. The
        arrays in `state` are the recorded ones, so they are read-only in a rollout. To
        modify an array, copy it.
        """

    def save(self) -> SavedState:
        """Return the complete state of the controller.

        Raises:
            InputError: the class of the controller does not define `state_attributes`,
                or `reset` has not been called.
        """
        self.check_saveable(Controller, f"controller '{self.kind}'")
        return SavedState(self.identity(), self.state_dict())

    def restore(self, state: SavedState) -> None:
        """Restore a saved state.

        Call `reset` beforehand, with the robot and the control tick of the saved run.
        The saved values of `state_attributes`, such as the frequency of a gait, replace
        those of this object.

        Raises:
            InputError: the state belongs to another controller, or `reset` has not been
                called.
        """
        self.check_saveable(Controller, f"controller '{self.kind}'")
        state.check(f"controller '{self.kind}'", self.identity())
        self.load_state_dict(state.content)

    def identity(self) -> dict[str, object]:
        """Return the settings that a saved state must share, as JSON values."""
        return {"controller": self.kind, "class": type(self).__name__}

    def script(self, duration: float) -> Schedule | None:
        """Return the valve states of the whole run, or None for closed-loop control.

        The rollout calls this method after `reset`. A controller that returns a
        schedule must have constant signals and no events.

        Args:
            duration: duration of the run, a whole number of control ticks, s.
        """
        return None

    def signals(self) -> Mapping[str, float | np.ndarray]:
        """Return the signals to record, keyed by signal name.

        Each signal is a number or an array, whose elements are recorded under the
        signal name followed by the element number, counted from 1. The names must be
        the same at every tick and differ from the plant's columns.
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
"""Maximum plausible magnitude of a bend reading, equal to one full turn, rad."""


class SensorReadings(Stateful):
    """Latest valid bend reading of each segment.

    A reading is considered lost if it is not finite or its magnitude exceeds a full
    turn. A lost reading is replaced by the last valid reading of the segment, or by 0
    if there is no valid reading yet.

    Attributes:
        value: latest valid reading of each segment, shape (segments,), rad.
        lost: whether the latest reading of each segment is lost, shape (segments,).
    """

    state_attributes = ("value", "lost")

    def __init__(self, segments: int) -> None:
        """Initialise all readings to 0."""
        self.value: np.ndarray = np.zeros(segments)
        self.lost: np.ndarray = np.zeros(segments, dtype=bool)

    def update(self, time: float, measured_bend: np.ndarray) -> list[Event]:
        """Store new bend readings (rad), and return events about lost readings."""
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
