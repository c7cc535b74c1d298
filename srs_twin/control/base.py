"""Controller: what decides the valves; it never knows which plant it drives. Readings: what it senses."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from srs_twin.io.saved_state import SavedState, Stateful
from srs_twin.pneumatics.valves import LAYOUTS, Schedule
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Event

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState


class Controller(Stateful, ABC):
    """Maps what can be sensed to valve commands, once a tick.

    Controllers read `SnakeState.sensed` and what a camera would give, never `bend`.

    Attributes:
        kind: the name of this controller in scenario files.
        frequency: gait frequency in Hz, None where nothing is periodic.
        layouts: the valve layouts that it can drive, of `LAYOUTS`.
        finished: whether it has nothing more to do; a rollout ends after the tick in which this turns True.
    """

    state_attributes: ClassVar[tuple[str, ...]] = ("finished",)

    kind: str
    frequency: float | None = None
    layouts: tuple[str, ...] = tuple(LAYOUTS)
    finished: bool = False

    @abstractmethod
    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """Prepare for a run: all that the controller remembers begins here.

        Args:
            spec: the robot.
            tick: control tick, s.
            seed: for whatever is random in the controller.

        Raises:
            InputError: a valve layout or tick it cannot drive.
        """

    @abstractmethod
    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valves for the coming tick, (segments, 2) or (slots, segments, 2), int8."""

    def save(self) -> SavedState:
        """Return all that decides what comes next, for `restore` here or in another process.

        Raises:
            InputError: a controller that does not say what it remembers (`memory`).
        """
        self.check_saveable(Controller, f"controller '{self.kind}'")
        return SavedState(self.identity(), self.state_dict())

    def restore(self, state: SavedState) -> None:
        """Go on from a saved state: after `reset`, with its robot and tick, which only prepares here.

        Raises:
            InputError: a state of another controller, or no `reset` before.
        """
        self.check_saveable(Controller, f"controller '{self.kind}'")
        state.check(f"controller '{self.kind}'", self.identity())
        self.load_state_dict(state.content)

    def identity(self) -> dict[str, Any]:
        """Return what a saved state must share with the controller, JSON values."""
        return {"controller": self.kind, "class": type(self).__name__}

    def script(self, duration: float) -> Schedule | None:
        """Return what it will command over the coming run whatever it senses; None from one that senses.

        Called after `reset`. Signals of a controller with a script stay as they are, and it has no events.

        Args:
            duration: s, a whole number of ticks.
        """
        return None

    def signals(self) -> dict[str, Any]:
        """Return what is worth recording now: name → float or array (numbered from 1 when recorded)."""
        return {}

    def events(self) -> list[Event]:
        """Return the events since the last call."""
        return []

    def describe(self) -> dict[str, Any]:
        """Return the settings, and what it found out, that are worth recording (JSON values)."""
        return {}


LARGEST_READING = 2 * math.pi
"""No segment bends further, rad: a reading beyond is a lost one."""


class Readings(Stateful):
    """The sensed bends of a controller, tick by tick.

    A reading that is not finite, or larger than a full turn, is a lost one: the last good one stands for it
    (0 before the first), and an event says so.

    Attributes:
        value: the last good readings, shape (segments,), rad.
        lost: whose last reading was lost, shape (segments,).
    """

    state_attributes = ("value", "lost")

    def __init__(self, segments: int) -> None:
        """Make the readings of so many segments, none of them read yet."""
        self.value: np.ndarray = np.zeros(segments)
        self.lost: np.ndarray = np.zeros(segments, dtype=bool)

    def take(self, time: float, sensed: np.ndarray) -> list[Event]:
        """Take the readings of a tick, shape (segments,), and return what is to be told of them.

        Args:
            time: s.
            sensed: rad, shape (segments,).
        """
        sensed = np.asarray(sensed, dtype=float)
        lost = ~(np.abs(sensed) <= LARGEST_READING)
        self.value = np.where(lost, self.value, sensed)
        if (lost == self.lost).all():
            return []
        events = []
        for j in np.flatnonzero(lost & ~self.lost):
            text = f"segment {j + 1}: reading lost; the last good one, {self.value[j]:.4g} rad, is held"
            events.append(Event(time, "reading_lost", text))
        for j in np.flatnonzero(self.lost & ~lost):
            events.append(Event(time, "reading_back", f"segment {j + 1}: readings are back"))
        self.lost = lost
        return events
