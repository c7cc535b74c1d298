"""Controller: what decides the valves. It never knows which plant it drives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.pneumatics.schedule import LAYOUTS, Schedule
from srs_twin.spec import RobotSpec
from srs_twin.trajectory import Event

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState


class Controller(ABC):
    """Maps what can be sensed to valve commands, once a tick.

    Controllers read `SnakeState.sensed` and what a camera would give, never `bend`.

    Attributes:
        kind: the name of this controller in scenario files.
        frequency: gait frequency in Hz, None where nothing is periodic.
        layouts: the valve layouts that it can drive, of `LAYOUTS`.
        finished: whether it has nothing more to do; a rollout ends after the tick in which this turns True.
    """

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
