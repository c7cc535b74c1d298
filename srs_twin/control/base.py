"""Base class of the controllers, and the sensor readings that closed-loop controllers share."""

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
    """Function of sensor readings and poses that returns the valve commands of one control tick.

    Controllers read `SnakeState.sensed` and poses from a camera, never the true `bend`.
    They do not know which plant they control.

    Attributes:
        kind: name of the controller in scenario files.
        frequency: gait frequency, Hz; None if the controller is not periodic.
        layouts: supported valve layouts, names in `LAYOUTS`.
        spatial: whether it commands the chambers of a spatial robot.
        finished: whether the controller has ended its task; the rollout ends after the
            tick in which it becomes True.
    """

    state_attributes: ClassVar[tuple[str, ...]] = ("finished",)

    kind: str = "own"
    frequency: float | None = None
    layouts: tuple[str, ...] = tuple(LAYOUTS)
    spatial: bool = False
    finished: bool = False
    _events: list[
        Event
    ]  # since the last call of `events`; `reset` creates it in controllers with events

    @abstractmethod
    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """Prepare for a run and initialise the state of the controller.

        Args:
            spec: the robot.
            tick: control tick, s.
            seed: random seed of the controller.

        Raises:
            InputError: the controller supports neither the valve layout nor the tick.
        """

    @abstractmethod
    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valve states of the next tick, shape (segments, 2) or (slots, segments, 2), int8."""

    def save(self) -> SavedState:
        """Return the state of the controller, for `restore` in this or another process.

        Raises:
            InputError: the class does not list its `state_attributes`.
        """
        self.check_saveable(Controller, f"controller '{self.kind}'")
        return SavedState(self.identity(), self.state_dict())

    def restore(self, state: SavedState) -> None:
        """Continue from a saved state; call `reset` with the same robot and tick first.

        Raises:
            InputError: the state belongs to another controller, or `reset` has not been
                called.
        """
        self.check_saveable(Controller, f"controller '{self.kind}'")
        state.check(f"controller '{self.kind}'", self.identity())
        self.load_state_dict(state.content)

    def identity(self) -> dict[str, object]:
        """Return the properties that a saved state must share with this controller, as JSON values."""
        return {"controller": self.kind, "class": type(self).__name__}

    def script(self, duration: float) -> Schedule | None:
        """Return the valve states of the whole run if they do not depend on measurements, else None.

        It is called after `reset`. A controller with a script has constant signals and
        no events.

        Args:
            duration: s, a whole number of ticks.
        """
        return None

    def signals(self) -> dict[str, Any]:
        """Return the signals to record: name → number, or array whose elements are numbered from 1."""
        return {}

    def events(self) -> list[Event]:
        """Return the events since the last call."""
        events = getattr(self, "_events", [])
        self._events = []
        return events

    def describe(self) -> dict[str, object]:
        """Return the settings and results to record, as JSON values."""
        return {}


MAX_READING_RAD = 2 * math.pi
"""Magnitude above which readings count as lost, rad: no segment bends by a full turn.
"""


class SensorReadings(Stateful):
    """Latest valid bend readings of all segments.

    A reading is lost if it is not finite or larger than a full turn. The previous valid
    reading (0 before the first) is used in its place, and an event records the loss.

    Attributes:
        value: latest valid readings, shape (segments,), rad.
        lost: whether the latest reading of each segment was lost, shape (segments,).
    """

    state_attributes = ("value", "lost")

    def __init__(self, segments: int) -> None:
        """Initialise all readings to 0.

        Args:
            segments: number of segments.
        """
        self.value: np.ndarray = np.zeros(segments)
        self.lost: np.ndarray = np.zeros(segments, dtype=bool)

    def update(self, time: float, sensed: np.ndarray) -> list[Event]:
        """Store the readings of one tick and return the events of lost and recovered readings.

        Args:
            time: s.
            sensed: bends reported by the sensors, shape (segments,), rad.
        """
        sensed = np.asarray(sensed, dtype=float)
        lost = ~(np.abs(sensed) <= MAX_READING_RAD)
        self.value = np.where(lost, self.value, sensed)
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
