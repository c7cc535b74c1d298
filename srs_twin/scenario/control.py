"""Controllers of a scenario in SI, able to make the controller itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.control.reference import Constant, Reference, Sine, Square, Staircase, Step
from srs_twin.scenario.control_file import (
    ConstantFile,
    DirectFile,
    DrivingFile,
    GaitFile,
    HoldFile,
    LearningFile,
    ReferenceFile,
    ReplayFile,
    SineFile,
    SquareFile,
    StaircaseFile,
    StepFile,
)

if TYPE_CHECKING:
    from srs_twin.control.base import Controller
    from srs_twin.pneumatics import Pneumatics, Schedule
    from srs_twin.recordings.recording import Recording
    from srs_twin.robot.spec import RobotSpec


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
        from srs_twin.control.smc import DirectSMC

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
        from srs_twin.control.smc import IterativeSMC

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
        from srs_twin.control.replay import HoldValves

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
        steering: "targets" or "targets_and_wave".
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
    steering: str
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
            steering=self.steering, phase=self.phase, phase_step=self.phase_step,
        )  # fmt: skip


@dataclass(frozen=True)
class ReplaySettings:
    """Recorded valves, or recorded pressures.

    Attributes:
        kind: "valve" or "pressure".
        frequency: of the gait that was recorded, Hz.
        sha256: of the log.
        schedule: of the valves from the start of the run on; all venting where pressures were recorded.
        time: of the pressures, s from the start of the run, shape (rows,); empty for valves.
        pressure: gauge, shape (rows, segments, 2), Pa.
    """

    kind: str
    frequency: float | None
    sha256: str
    schedule: Schedule = field(compare=False, repr=False)
    time: np.ndarray = field(compare=False, repr=False)
    pressure: np.ndarray = field(compare=False, repr=False)

    @classmethod
    def of(cls, recording: Recording) -> ReplaySettings:
        """Return what a recording that was joined with its log commanded."""
        from srs_twin.identification.takes import commands, pressures

        log = recording.valves
        assert log is not None, "it was joined with its log"
        schedule = commands(recording, log.source)
        frequency = recording.trajectory.metadata.get("gait_frequency_hz")
        time, pressure = pressures(recording) or (np.zeros(0), np.zeros((0, *log.values.shape[1:])))
        return cls(log.kind, frequency, log.sha256, schedule, time, pressure)

    def make(self) -> Controller:
        """Return a fresh controller."""
        from srs_twin.control.replay import Replay

        return Replay(self.schedule, self.frequency)

    def chambers(self, robot: RobotSpec, supply_pa: float, layout: str) -> Pneumatics | None:
        """Return chambers that hold the recorded pressures; None where valves were recorded."""
        if self.kind == "valve":
            return None
        from srs_twin.pneumatics.recorded import RecordedPressures

        return RecordedPressures(robot, self.time, self.pressure, supply_pa=supply_pa, layout=layout)


ControllerSettings = (
    GaitSettings | LearningSettings | DirectSettings | IterativeSettings | HoldSettings | ReplaySettings
)


def controller_settings(
    given: DrivingFile, limit: float, recording: Recording | None = None
) -> ControllerSettings:
    """Return what a file says of its controller.

    Args:
        given: the file's section.
        limit: the largest bend of the segments, rad.
        recording: what is replayed.

    Raises:
        InputError: a reference beyond the limit that is to be refused.
    """
    if isinstance(given, GaitFile):
        return GaitSettings(given.frequency_hz, given.offset, given.phase_rad, given.phase_step_rad)
    if isinstance(given, LearningFile):
        return LearningSettings(
            given.frequency_hz, given.offset, given.target_rad, given.k_per_rad, given.free_periods,
            given.carrier_hz, given.on_fault, given.steering, given.phase_rad, given.phase_step_rad,
        )  # fmt: skip
    if isinstance(given, ReplayFile):
        assert recording is not None, "a replay without a recording was reported"
        return ReplaySettings.of(recording)
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
