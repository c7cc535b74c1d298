"""Steering from outside: commands that a crawling gait obeys, and offsets that change at given times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.control.base import Controller
from srs_twin.control.gait import Gait
from srs_twin.control.learning import ILC
from srs_twin.errors import InputError
from srs_twin.io.saved_state import Stateful
from srs_twin.pneumatics import Pneumatics
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Event

if TYPE_CHECKING:
    import numpy as np

    from srs_twin.plants.base import SnakeState


Range = tuple[float, float]

OFFSET = 0.4
"""Section 3.4.2 steers generation 2 with φ up to 0.4, the other robots with less."""
FREQUENCY_HZ = (1.0, 2.0)
"""Generation 2's gaits in Section 3.4.2; those of generation 3 and 4 lie inside or near."""
PRESSURE_SHARE = (0.85, 1.15)
"""Of the robot's nominal supply pressure: 41 to 55 kPa of generation 2 (Section 3.4.2)."""


@dataclass(frozen=True)
class GaitCommand:
    """What a gait is to be from now on.

    Attributes:
        offset: φ, positive to the left.
        frequency: Hz.
        pressure: of the supply, Pa.
    """

    offset: float
    frequency: float
    pressure: float


@dataclass(frozen=True)
class GaitLimits:
    """Smallest and largest of each part of a command.

    Attributes:
        offset: φ.
        frequency: Hz.
        pressure: Pa.
    """

    offset: Range
    frequency: Range
    pressure: Range

    @classmethod
    def of(cls, spec: RobotSpec) -> GaitLimits:
        """Return the limits of a robot; no pressure is above its pulsed limit."""
        low, high = (share * spec.supply.nominal for share in PRESSURE_SHARE)
        return cls((-OFFSET, OFFSET), FREQUENCY_HZ, (low, min(high, spec.supply.pulsed_limit)))

    def clipped(self, command: GaitCommand) -> GaitCommand:
        """Return a command with each part inside its limits."""
        parts = zip(astuple(command), astuple(self), strict=True)
        return GaitCommand(*(min(max(value, low), high) for value, (low, high) in parts))


class CommandedGait(Stateful):
    """A gait and its supply, both of which obey commands.

    Attributes:
        gait: for what is to be known of it.
        command: the one that holds.
    """

    state_attributes = ("gait", "command")

    def __init__(self, spec: RobotSpec, tick: float, pneumatics: Pneumatics, command: GaitCommand) -> None:
        """Begin a gait.

        Args:
            spec: the robot.
            tick: of its plant, s.
            pneumatics: the plant's, made for the largest pressure that will be commanded.
            command: the first one.

        Raises:
            InputError: a command that gait or supply cannot follow.
        """
        self._pneumatics, self.command = pneumatics, command
        self.gait = Gait(command.frequency, command.offset)
        self.gait.reset(spec, tick)
        pneumatics.set_supply_pressure(command.pressure)

    def valves(self, time: float, command: GaitCommand) -> np.ndarray:
        """Obey a command and return the valves of the tick that begins at `time` (s).

        The wave goes on where it is; the chambers fill from the new pressure at once.

        Raises:
            InputError: a command that gait or supply cannot follow.
        """
        if command.frequency != self.gait.frequency:
            self.gait.change_frequency(command.frequency, time)
        self.gait.offset = command.offset
        self._pneumatics.set_supply_pressure(command.pressure)
        self.command = command
        return self.gait.valves_at(time)


_SAME_S = 1e-9
"""Ticks add up with rounding."""


class Steered(Controller):
    """A gait or iterative learning that is told a new offset from time to time; else as if it were alone.

    Attributes:
        changes: (time in s, offset) of each change, in order of time.
    """

    state_attributes = ("_inner", "_done", "_events")

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
