"""Controllers of a scenario in SI, able to make the controller itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from srs_twin.control.reference import Constant, Reference, Sine, Square, Staircase, Step
from srs_twin.scenario.control_file import (
    ConstantFile,
    DirectFile,
    DrivingFile,
    GaitFile,
    HoldFile,
    LearningFile,
    ReferenceFile,
    SineFile,
    SquareFile,
    StaircaseFile,
    StepFile,
)

if TYPE_CHECKING:
    from srs_twin.control.base import Controller


@dataclass(frozen=True)
class GaitSettings:
    """Open-loop gait (Eq. 13).

    Attributes:
        frequency: Hz.
        offset: φ, positive to the left.
        phase: ψ, rad.
        phase_step: β, rad; None takes the robot's.
    """

    frequency: float
    offset: float = 0.0
    phase: float = 0.0
    phase_step: float | None = None

    def make(self) -> Controller:
        """Return a fresh controller."""
        from srs_twin.control.gait import Gait

        return Gait(self.frequency, self.offset, phase=self.phase, phase_step=self.phase_step)


@dataclass(frozen=True)
class DirectSettings:
    """Direct sliding mode control (Eq. 31).

    Attributes:
        reference: the bend to follow.
        slope: D, 1/s.
        epsilon: ε, rad/s.
        cutoff_hz: of the velocity filter, Hz.
    """

    reference: Reference
    slope: float
    epsilon: float
    cutoff_hz: float

    def make(self) -> Controller:
        """Return a fresh controller."""
        from srs_twin.control.direct_smc import DirectSMC

        return DirectSMC(self.reference, D=self.slope, epsilon=self.epsilon, cutoff_hz=self.cutoff_hz)


@dataclass(frozen=True)
class IterativeSettings:
    """Iterative sliding mode control (Eq. 29).

    Attributes:
        reference: the bend to follow.
        gain: K, s/rad.
        slope: D, 1/s.
        carrier_hz: of the pulse-width modulation, Hz.
    """

    reference: Reference
    gain: float
    slope: float
    carrier_hz: float

    def make(self) -> Controller:
        """Return a fresh controller."""
        from srs_twin.control.iterative_smc import IterativeSMC

        return IterativeSMC(self.reference, K=self.gain, D=self.slope, carrier_hz=self.carrier_hz)


@dataclass(frozen=True)
class HoldSettings:
    """Valves that stay as they are.

    Attributes:
        plus: valves of the + chambers, "fill", "hold" or "vent".
        minus: of the − chambers.
    """

    plus: str
    minus: str

    def make(self) -> Controller:
        """Return a fresh controller."""
        from srs_twin.control.steady import HoldValves

        return HoldValves(self.plus, self.minus)


@dataclass(frozen=True)
class LearningSettings:
    """Iterative learning control of a gait (Eq. 32).

    Attributes:
        frequency: Hz.
        offset: φ, positive to the left.
        target: A, rad; None: the smallest amplitude recorded.
        gain: k, 1/rad.
        free_periods: at full duty before the recorded one.
        carrier_hz: of the pulse-width modulation, Hz.
        on_fault: "go_on" or "stop".
        phase: ψ, rad.
        phase_step: β, rad; None takes the robot's.
    """

    frequency: float
    offset: float
    target: float | None
    gain: float
    free_periods: int
    carrier_hz: float
    on_fault: str
    phase: float
    phase_step: float | None

    def make(self) -> Controller:
        """Return a fresh controller.

        Raises:
            InputError: a carrier that is too slow for the gait.
        """
        from srs_twin.control.learning import ILC, SMALLEST

        return ILC(
            self.frequency, self.offset, target=SMALLEST if self.target is None else self.target, k=self.gain,
            free_periods=self.free_periods, carrier_hz=self.carrier_hz, on_fault=self.on_fault,
            phase=self.phase, phase_step=self.phase_step,
        )  # fmt: skip


ControllerSettings = GaitSettings | LearningSettings | DirectSettings | IterativeSettings | HoldSettings


def controller_settings(given: DrivingFile, limit: float) -> ControllerSettings:
    """Return what a file says of its controller.

    Args:
        given: the file's section.
        limit: the largest bend of the segments, rad.

    Raises:
        InputError: a reference beyond the limit that is to be refused.
    """
    if isinstance(given, GaitFile):
        return GaitSettings(given.frequency_hz, given.offset, given.phase_rad, given.phase_step_rad)
    if isinstance(given, LearningFile):
        return LearningSettings(
            given.frequency_hz, given.offset, given.target_rad, given.k_per_rad, given.free_periods,
            given.carrier_hz, given.on_fault, given.phase_rad, given.phase_step_rad,
        )  # fmt: skip
    if isinstance(given, HoldFile):
        return HoldSettings(given.plus, given.minus)
    reference = _reference(given.reference).within(limit, given.beyond_range)
    if isinstance(given, DirectFile):
        return DirectSettings(reference, given.d_per_s, given.epsilon_rad_per_s, given.cutoff_hz)
    return IterativeSettings(reference, given.k_s_per_rad, given.d_per_s, given.carrier_hz)


_PERIODIC: Mapping[type, type[Sine] | type[Square]] = {SineFile: Sine, SquareFile: Square}


def _reference(given: ReferenceFile) -> Reference:
    if isinstance(given, ConstantFile):
        return Constant(given.bend_rad)
    if isinstance(given, StepFile):
        return Step(given.bend_rad, given.before_rad, given.time_s)
    if isinstance(given, StaircaseFile):
        return Staircase(tuple(given.bends_rad), given.hold_s)
    make = _PERIODIC[type(given)]
    return make(given.amplitude_rad, given.frequency_hz, given.phase_rad, given.offset_rad)
