"""Gaits steered by external commands or by a schedule of steering offsets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.control.base import Controller
from srs_twin.control.gait import Gait, PitchWave
from srs_twin.control.learning import ILC
from srs_twin.errors import InputError
from srs_twin.io.saved_state import Stateful
from srs_twin.pneumatics import Pneumatics
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Event

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState


Range = tuple[float, float]
"""Minimum and maximum allowed value of a gait parameter."""

MAX_OFFSET = 0.4
"""Maximum magnitude of the steering offset φ, dimensionless (Section 3.4.2 for
generation 2)."""
FREQUENCY_RANGE_HZ = (1.0, 2.0)
"""Minimum and maximum gait frequency, Hz (Section 3.4.2 for generation 2)."""
RELATIVE_PRESSURE_RANGE = (0.85, 1.15)
"""Minimum and maximum supply pressure relative to the nominal pressure.

For robots of generation 2, the limits are 41 and 55 kPa (Section 3.4.2).
"""
_TIME_ROUNDING_S = 1e-9


@dataclass(frozen=True)
class GaitCommand:
    """Gait parameters for the next control ticks.

    Attributes:
        offset: steering offset φ, positive to the left, dimensionless.
        frequency: gait frequency, Hz.
        pressure: gauge supply pressure, Pa.
    """

    offset: float
    frequency: float
    pressure: float


@dataclass(frozen=True)
class GaitLimits:
    """Allowed range of each parameter of a `GaitCommand`."""

    offset: Range
    frequency: Range
    pressure: Range

    @classmethod
    def for_robot(cls, spec: RobotSpec) -> GaitLimits:
        """Return the allowed ranges for a robot."""
        low, high = (ratio * spec.supply.nominal for ratio in RELATIVE_PRESSURE_RANGE)
        return cls(
            (-MAX_OFFSET, MAX_OFFSET),
            FREQUENCY_RANGE_HZ,
            (low, min(high, spec.supply.pulsed_limit)),
        )

    def clipped(self, command: GaitCommand) -> GaitCommand:
        """Return the command with each parameter clipped to its allowed range."""
        pairs = zip(astuple(command), astuple(self), strict=True)
        return GaitCommand(
            *(min(max(value, low), high) for value, (low, high) in pairs)
        )


class CommandedGait(Stateful):
    """Open-loop gait whose parameters are set by a `GaitCommand` in each tick."""

    state_attributes = ("gait", "command")

    def __init__(
        self, spec: RobotSpec, tick: float, pneumatics: Pneumatics, command: GaitCommand
    ) -> None:
        """Start the gait at time 0.

        The pneumatics must have been constructed with the highest supply pressure of
        all commands.

        Raises:
            InputError: a gait parameter or the supply pressure is out of range.
        """
        self._pneumatics = pneumatics
        self.command = command
        self.gait = Gait(command.frequency, command.offset)
        self.gait.reset(spec, tick)
        pneumatics.set_supply_pressure(command.pressure)

    def valves(
        self, time: float, command: GaitCommand, pitch: PitchWave | None = None
    ) -> np.ndarray:
        """Apply a command and return the valve states for the tick at `time` (s).

        The pitch wave is ignored for robots that are not spatial.

        Raises:
            InputError: a gait parameter or the supply pressure is out of range.
        """
        if command.frequency != self.gait.frequency:
            self.gait.change_frequency(command.frequency, time)
        self.gait.offset = command.offset
        self.gait.pitch = pitch
        self._pneumatics.set_supply_pressure(command.pressure)
        self.command = command
        return self.gait.valves_at(time)


class ScheduledOffset(Controller):
    """Controller whose steering offset changes at given times."""

    state_attributes = ("_inner", "_applied", "_events")

    def __init__(
        self, controller: Gait | ILC, changes: Sequence[tuple[float, float]]
    ) -> None:
        """Schedule offset changes for a controller.

        Args:
            controller: controller to steer, which keeps its current offset until the
                first change.
            changes: pairs of time (s) and new steering offset. A new offset takes
                effect in the first control tick that begins at or after its time.

        Raises:
            InputError: the times are not positive and strictly increasing.
        """
        times = [0.0, *(time for time, _ in changes)]
        if not all(b > a for a, b in zip(times, times[1:], strict=False)):
            raise InputError(
                f"the times of the offset changes {times[1:]} s are not allowed; they"
                " must be positive and strictly increasing"
            )
        self.kind = controller.kind
        self.frequency = controller.frequency
        self.layouts = controller.layouts
        self.changes = tuple(changes)
        self._inner = controller
        self._initial_offset = controller.offset

    @property
    def offset(self) -> float:
        """Current steering offset φ, positive to the left."""
        return self._inner.offset

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`."""
        self._inner.offset = self._initial_offset
        self._inner.reset(spec, tick, seed=seed)
        self._applied = 0
        self._events = list[Event]()

    def step(self, state: SnakeState) -> np.ndarray:
        """See `Controller.step`."""
        time = float(state.time)
        for start, after in self.changes[self._applied :]:
            if time < start - _TIME_ROUNDING_S:
                break
            before = self._inner.offset
            self._inner.offset = after
            self._events.append(
                Event(time, "offset", f"offset {before:g} to {after:g}")
            )
            self._applied += 1
        valves = self._inner.step(state)
        self.finished = self._inner.finished
        return valves

    def signals(self) -> Mapping[str, float | np.ndarray]:
        """See `Controller.signals`."""
        return self._inner.signals()

    def events(self) -> list[Event]:
        """Return the offset changes and the events of the steered controller."""
        return super().events() + self._inner.events()

    def describe(self) -> dict[str, object]:
        """See `Controller.describe`."""
        return self._inner.describe() | {
            "changes": [list(change) for change in self.changes]
        }
