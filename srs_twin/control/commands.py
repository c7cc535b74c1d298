"""GaitCommand: what steers a crawling snake from outside, and how it takes effect while the snake crawls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from srs_twin.control.gait import Gait
from srs_twin.pneumatics import Pneumatics
from srs_twin.spec import RobotSpec

if TYPE_CHECKING:
    import numpy as np

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
        return GaitCommand(
            _between(command.offset, self.offset),
            _between(command.frequency, self.frequency),
            _between(command.pressure, self.pressure),
        )


class CommandedGait:
    """A gait and its supply, both of which obey commands.

    Attributes:
        gait: for what is to be known of it.
        command: the one that holds.
    """

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
        pneumatics.regulate(command.pressure)

    def valves(self, time: float, command: GaitCommand) -> np.ndarray:
        """Obey a command and return the valves of the tick that begins at `time` (s).

        The wave goes on where it is; the chambers fill from the new pressure at once.

        Raises:
            InputError: a command that gait or supply cannot follow.
        """
        if command.frequency != self.gait.frequency:
            self.gait.change_frequency(command.frequency, time)
        self.gait.offset = command.offset
        self._pneumatics.regulate(command.pressure)
        self.command = command
        return self.gait.valves_at(time)


def _between(value: float, limits: Range) -> float:
    return min(max(value, limits[0]), limits[1])
