"""Drive: how a snake is driven while its footprint is measured, and the runs that this takes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from srs_twin.control.gait import Gait
from srs_twin.control.learning import ILC, TARGETS
from srs_twin.control.steered import Steered
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.plants.base import Plant
from srs_twin.rollouts import Job
from srs_twin.spec import RobotSpec

PLANTS = ("twin", "analytical")
CONTROLLERS = ("gait", "ilc")
TICK = 0.005
"""Control tick, s: learning has to see the ripple's peaks, and changes of offset fall on ticks."""
RECORD_HZ = 100.0
_LEAST_SAMPLES = 25
"""Samples in a gait period, fewer do not show the edges."""


@dataclass(frozen=True)
class Drive:
    """A robot, what drives it and how.

    Attributes:
        spec: the robot.
        frequency: of the gait, Hz.
        supply_pa: supply pressure, Pa.
        controller: "gait" (Eq. 13) or "ilc" (Eq. 32).
        target: of learning, rad.
        plant: "twin", "analytical" (model compliant on wheels), or what makes a plant of the right tick.
        steering: of learning, see `ILC`.
    """

    spec: RobotSpec
    frequency: float
    supply_pa: float
    controller: str = "gait"
    target: float = 0.7
    plant: str | Callable[[], Plant] = "twin"
    steering: str = TARGETS

    def __post_init__(self) -> None:
        """Refuse what cannot be driven.

        Raises:
            InputError: a number out of its range, or a pressure above what the robot may be given in pulses.
            UnknownNameError: a controller or plant that there is not.
        """
        if self.controller not in CONTROLLERS:
            raise UnknownNameError("controller", self.controller, CONTROLLERS)
        if isinstance(self.plant, str) and self.plant not in PLANTS:
            raise UnknownNameError("plant", self.plant, PLANTS)
        given = ("pressure", self.supply_pa / 1000, "kPa"), ("frequency", self.frequency, "Hz")
        for name, value, unit in given:
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"{name} {value:g} {unit} is not allowed; it must be finite and above 0")
        if self.spec.segments < 2:
            raise InputError(
                f"{self.spec.name} has one segment; it does not crawl, so that it has no footprint"
            )
        supply = self.spec.supply
        if self.supply_pa > supply.pulsed_limit:
            raise InputError(
                f"pressure {self.supply_pa / 1000:g} kPa is above the {supply.pulsed_limit / 1000:g} kPa "
                f"that {self.spec.name} may be given in pulses ({supply.limit_source})"
            )
        most = RECORD_HZ / _LEAST_SAMPLES
        if self.frequency > most:
            raise InputError(f"frequency {self.frequency:g} Hz is not allowed; {most:.3g} Hz is the most")
        self.make(0.0)

    @property
    def period(self) -> float:
        """Of the gait, s."""
        return 1 / self.frequency

    @property
    def settling(self) -> int:
        """Gait periods after which nothing is left of a start from rest: air, or duties not yet learnt."""
        return 16 if self.controller == "ilc" else 8

    @property
    def lasting(self) -> int:
        """Gait periods that a change of offset is given to be over."""
        return 12 if self.controller == "ilc" else 6

    @property
    def offsets(self) -> tuple[float, ...]:
        """The offsets that are measured where none are asked for: Table 8's, or to ±0.4 as in Fig. 33."""
        most = 3 if self.controller == "ilc" else 4
        return tuple(k / 10 for k in range(-most, most + 1))

    def check(self, offset: float) -> None:
        """Refuse an offset that the controller cannot have.

        Raises:
            InputError: it is out of range.
        """
        self.make(offset)

    def make(self, offset: float, phase: float = 0.0) -> Gait | ILC:
        """Return a controller; ψ = phase, rad.

        Raises:
            InputError: it cannot have these settings.
        """
        if self.controller == "ilc":
            return ILC(self.frequency, offset, target=self.target, phase=phase, steering=self.steering)
        return Gait(self.frequency, offset, phase=phase)

    def steered(self, offset: float, changes: Sequence[tuple[float, float]]) -> Steered:
        """Return a controller whose offset changes."""
        return Steered(self.make(offset), changes)

    def plant_maker(self) -> Callable[[], Plant]:
        """Return what makes the plant; heavy imports wait until it does."""
        if callable(self.plant):
            return self.plant
        return partial(_twin if self.plant == "twin" else _analytical, self)

    def steady_job(self, maker: Callable[[], Plant], offset: float, phase: float, periods: int) -> Job:
        """Return a run under one offset that ends with so many periods to be measured."""
        duration = ticks((self.settling + periods) * self.period)
        return Job(maker, partial(self.make, offset, phase), duration, record_hz=RECORD_HZ)

    def change_time(self, share: float) -> float:
        """Return when the offset changes (s): once the path has settled, after a share of a gait period."""
        return ticks((self.settling + share) * self.period)

    def change_job(
        self, maker: Callable[[], Plant], change: tuple[float, float], time: float, periods: int
    ) -> Job:
        """Return a run in which the offset changes at a time (s) from one to another.

        After what the change may last, so many periods follow.
        """
        before, after = change
        duration = ticks(time + (self.lasting + periods) * self.period)
        return Job(maker, partial(self.steered, before, [(time, after)]), duration, record_hz=RECORD_HZ)


def ticks(time: float) -> float:
    """Return the time (s) of the first sample then or later: samples are taken every other tick."""
    return round(math.ceil(time * RECORD_HZ - 1e-6) / RECORD_HZ, 9)


def _twin(drive: Drive) -> Plant:
    from srs_twin.plants.twin import TwinSnake

    return TwinSnake(drive.spec, supply_pa=drive.supply_pa, tick=TICK)


def _analytical(drive: Drive) -> Plant:
    from srs_twin.plants.analytical import AnalyticalSnake

    # Under the pulses of learning the model with given bends slips (docs/learning.md).
    return AnalyticalSnake(
        drive.spec, model="compliant", friction="wheel", supply_pa=drive.supply_pa, tick=TICK
    )
