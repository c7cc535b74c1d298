"""Section `controller` of a scenario: valve controllers and reference bends."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from srs_twin.control.base import Controller
from srs_twin.control.duties import MAX_OFFSET, ChamberPeriods
from srs_twin.control.gait import Gait, PitchWave
from srs_twin.control.grasp import Grasp, check_hold, check_release
from srs_twin.control.learning import ILC, MIN_PULSES
from srs_twin.control.pwm import PulseWidthModulator
from srs_twin.control.reference import (
    Constant,
    Reference,
    Sine,
    Square,
    Staircase,
    StepReference,
)
from srs_twin.control.replay import STATES, HoldValves, layouts_for
from srs_twin.control.smc import DirectSMC, IterativeSMC
from srs_twin.pneumatics.chambers import largest_bend
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.fields import (
    Contradiction,
    FileSections,
    Section,
    constructor_default,
    quantity,
)

_RIGHT_ANGLE = math.pi / 2
"""Maximum reference bend, rad."""

_FREQUENCY = quantity(0.01, 50.0)
_PHASE = quantity(-6.3, 6.3)
_Phases = Annotated[
    list[Annotated[float, Field(ge=-6.3, le=6.3)]], Field(max_length=200)
]
_CARRIER = quantity(1.0, 1000.0)
_SLOPE = quantity(0.001, 1000.0)

Bend = Annotated[float, Field(ge=-_RIGHT_ANGLE, le=_RIGHT_ANGLE)]


@dataclass(frozen=True)
class ControllerContext:
    """Scenario data used to build a controller.

    Attributes:
        name: scenario name, used in messages.
        robot: robot used in the scenario.
        supply_pa: gauge supply pressure, Pa.
        products: objects built by extension sections, keyed by section name.
    """

    name: str
    robot: RobotSpec
    supply_pa: float
    products: Mapping[str, Any]


class ControllerSection(Section):
    """Base class of the controller sections.

    The first entry of `constructors` is the controller class.

    Attributes:
        tick: preferred control tick, s, or None for the default tick.
    """

    if TYPE_CHECKING:
        kind: str
    tick: ClassVar[float | None] = None

    def controller(self, context: ControllerContext) -> Controller:
        """Build a controller."""
        controller: Controller = self.build()
        return controller

    @property
    def gait_section(self) -> ControllerSection:
        """Section of the gait that drives the valves, by default this section."""
        return self

    def contradictions_with(self, file: FileSections) -> Iterator[Contradiction]:
        """Yield contradictions with other sections of the file."""
        return iter(())

    def is_ready(self, products: Mapping[str, object]) -> bool:
        """Return whether all objects that the controller needs are available."""
        return True

    def layouts(self, products: Mapping[str, object]) -> tuple[str, ...]:
        """Return the valve layouts that the controller can drive."""
        layouts: tuple[str, ...] = self.constructors[0].layouts  # type: ignore[attr-defined]
        return layouts

    def check(self, spec: RobotSpec, tick: float) -> None:
        """Raise an `InputError` if the robot or the tick (s) is not supported."""

    def warnings(self, limit: float) -> Iterator[str]:
        """Yield warnings about a reference that exceeds the maximum bend `limit` (rad).

        Raises:
            InputError: the reference exceeds the limit, and `beyond_range` is "refuse".
        """
        return iter(())


class PitchFile(Section):
    """Pitch wave in the gait of a spatial robot."""

    constructors = (PitchWave,)

    fraction: float = quantity(0.0, 1.0)
    """Pitch amplitude as a fraction of the sum of pitch and lateral amplitude (0:
    planar, 0.5: equal amplitudes, 1: pitch only)."""
    lag_rad: float = quantity(-6.3, 6.3)
    """Phase lag of the pitch wave behind the lateral wave (pi/2 or -pi/2 for
    sidewinding)."""
    frequency_ratio: float = quantity(0.1, 10.0)
    """Ratio of pitch frequency to lateral frequency."""
    lifted_segments: int = quantity(0, 63)
    """Number of segments, counted from the head, that are always bent upwards."""


class GaitFile(ControllerSection):
    """Open-loop lateral undulation (Eq. 13)."""

    constructors = (Gait,)

    kind: Literal["gait"]
    """Kind of controller."""
    frequency_hz: float = _FREQUENCY
    """Gait frequency."""
    offset: float = quantity(-0.95, 0.95)
    """Steering offset, positive to the left."""
    phase_rad: float = _PHASE
    """Phase of the gait at the start."""
    phase_step_rad: float | None = _PHASE
    """Phase lag of each segment behind the segment in front of it (default: value in
    the robot file)."""
    phases_rad: _Phases | None = constructor_default()
    """Additional phase lag of each segment, rad (default: none)."""
    rest_fraction: float | None = quantity(0.0, 0.95)
    """Fraction of the gait period, around the sign changes of the valve wave, in which
    both chambers of a segment are vented (default: none)."""
    pitch: PitchFile | None = None
    """Pitch wave of a spatial robot (default: none)."""

    def controller(self, context: ControllerContext) -> Controller:
        """Build a gait controller."""
        return Gait(**self.arguments() | {"pitch": self.pitch and self.pitch.build()})

    def check(self, spec: RobotSpec, tick: float) -> None:
        """Raise an `InputError` if the robot or the tick (s) is not supported."""
        if self.pitch is not None:
            self.pitch.build().check(spec)


class LearningFile(ControllerSection):
    """Iterative learning control of a gait.

    The duty cycle of each chamber is updated once per gait period (Eq. 32).
    """

    constructors = (ILC,)
    tick = 0.005  # s; the tick must resolve a carrier period of 17 ms

    kind: Literal["ilc"]
    """Kind of controller."""
    frequency_hz: float = _FREQUENCY
    """Gait frequency."""
    offset: float = quantity(-MAX_OFFSET, MAX_OFFSET)
    """Steering offset, positive to the left, which makes the target amplitudes
    unequal."""
    target: Literal["smallest"] | None = None
    """Target amplitude of the side that bends further; "smallest" (the default without
    target_rad) selects the smallest recorded amplitude."""
    target_rad: float | None = quantity(0.01, _RIGHT_ANGLE, None)
    """Target amplitude (on the side that bends further)."""
    k_per_rad: float = quantity(1e-4, 100.0)
    """Learning gain k (change of the duty cycle per amplitude error)."""
    free_periods: int = quantity(1, 1000)
    """Number of periods at full duty cycle before the amplitudes are recorded."""
    carrier_hz: float = _CARRIER
    """Carrier frequency of the pulse-width modulation."""
    on_fault: Literal["go_on", "stop"] = constructor_default()
    """Response to a dead sensor or a stuck valve; "go_on" continues the gait without
    the faulty module, and "stop" ends the run."""
    steering: Literal["targets", "targets_and_wave"] = constructor_default()
    """Quantities that the offset changes; with "targets", only the target
    amplitudes change. With "targets_and_wave", the valve wave (Eq. 13) also changes and
    fills the chambers on the inner side of the turn for longer."""
    phase_rad: float = _PHASE
    """Phase of the gait at the start."""
    phase_step_rad: float | None = _PHASE
    """Phase lag of each segment behind the segment in front of it (default: value in
    the robot file)."""

    @model_validator(mode="after")
    def _fits(self) -> LearningFile:
        if self.target is not None and self.target_rad is not None:
            raise ValueError(
                "`target` and `target_rad` are both set; set only one of them"
            )
        least = 2 * MIN_PULSES * self.frequency_hz
        if self.carrier_hz < least:
            raise ValueError(
                "`carrier_hz` is too low for this gait frequency; it must be at least"
                f" {least:g}"
            )
        return self

    def check(self, spec: RobotSpec, tick: float) -> None:
        """Raise an `InputError` if the robot or the tick (s) is not supported."""
        ChamberPeriods(spec.modules.array("bias"), self.frequency_hz, tick)

    def warnings(self, limit: float) -> Iterator[str]:
        """Yield a warning if the target exceeds the maximum bend `limit` (rad)."""
        if self.target_rad and self.target_rad > limit:
            yield (
                f"controller.target_rad: {self.target_rad:.4g} rad is above"
                f" {limit:.4g} rad, the maximum bend at this supply pressure, so the"
                " duties will stay at 1"
            )


class ConstantFile(Section):
    """Constant bend."""

    constructors = (Constant,)

    kind: Literal["constant"]
    """Shape of the reference."""
    bend_rad: float = quantity(-_RIGHT_ANGLE, _RIGHT_ANGLE)
    """Bend."""


class StepFile(Section):
    """Step from one bend to another."""

    constructors = (StepReference,)

    kind: Literal["step"]
    """Shape of the reference."""
    bend_rad: float = quantity(-_RIGHT_ANGLE, _RIGHT_ANGLE)
    """Bend after the step."""
    before_rad: float = quantity(-_RIGHT_ANGLE, _RIGHT_ANGLE)
    """Bend before the step."""
    time_s: float = quantity(0.0, 3600.0)
    """Time of the step."""


class _PeriodicFile(Section):
    """Base class of periodic references."""

    constructors: ClassVar[tuple[type[Sine | Square], ...]] = (Sine,)

    amplitude_rad: float = quantity(0.001, _RIGHT_ANGLE)
    """Amplitude."""
    frequency_hz: float = quantity(0.01, 50.0)
    """Frequency."""
    phase_rad: float = _PHASE
    """Phase of the reference at the start."""
    offset_rad: float = quantity(-_RIGHT_ANGLE, _RIGHT_ANGLE)
    """Mean bend."""


class SineFile(_PeriodicFile):
    """Sine wave."""

    kind: Literal["sine"]
    """Shape of the reference."""


class SquareFile(_PeriodicFile):
    """Square wave."""

    constructors = (Square,)

    kind: Literal["square"]
    """Shape of the reference."""


class StaircaseFile(Section):
    """Sequence of bends with equal durations. The last bend is held until the end."""

    constructors = (Staircase,)

    kind: Literal["staircase"]
    """Shape of the reference."""
    bends_rad: Annotated[tuple[Bend, ...], Field(min_length=1, max_length=1000)]
    """Bend angles, rad."""
    hold_s: float = quantity(0.001, 3600.0)
    """Duration of each bend."""


ReferenceFile = Annotated[
    ConstantFile | StepFile | SineFile | SquareFile | StaircaseFile,
    Field(discriminator="kind"),
]


class _TrackingFile(ControllerSection):
    """Base class of controllers that track a reference bend."""

    reference: ReferenceFile
    """Reference bend of all segments."""
    beyond_range: Literal["refuse", "saturate"] = "refuse"
    """Response to a reference beyond the maximum bend at the supply pressure; "refuse"
    rejects the scenario, and "saturate" limits the reference to the maximum bend."""

    def controller(self, context: ControllerContext) -> Controller:
        reference = self.within(largest_bend(context.robot, context.supply_pa))
        controller: Controller = self.constructors[0](
            **self.arguments() | {"reference": reference}
        )
        return controller

    def within(self, limit: float) -> Reference:
        """Return the reference, limited to the maximum bend `limit` (rad) if allowed.

        Raises:
            InputError: the reference exceeds the limit, and `beyond_range` is "refuse".
        """
        reference: Reference = self.reference.build()
        return reference.limited(limit, self.beyond_range)

    def warnings(self, limit: float) -> Iterator[str]:
        """Yield a warning if the reference exceeds the maximum bend `limit` (rad)."""
        if unlimited := getattr(self.within(limit), "unclipped", None):
            yield (
                f"controller.reference: {unlimited.peak:.4g} rad is limited to"
                f" {limit:.4g} rad, the maximum bend at this supply pressure"
            )


class DirectFile(_TrackingFile):
    """Sliding mode control of separate inlet and outlet valves (Eq. 31)."""

    constructors = (DirectSMC,)

    kind: Literal["direct_smc"]
    """Kind of controller."""
    d_per_s: float = _SLOPE
    """Slope D of the sliding manifold."""
    epsilon_rad_per_s: float = quantity(0.0001, 1000.0)
    """Half width ε of the dead zone."""
    cutoff_hz: float = quantity(0.1, 1000.0)
    """Cut-off frequency of the velocity filter."""


class IterativeFile(_TrackingFile):
    """Sliding mode control by pulse-width modulation of 3/2 valves (Eq. 29)."""

    constructors = (IterativeSMC,)

    kind: Literal["iterative_smc"]
    """Kind of controller."""
    k_s_per_rad: float = quantity(1e-5, 1000.0)
    """Controller gain K."""
    d_per_s: float = _SLOPE
    """Slope D of the sliding manifold."""
    carrier_hz: float = _CARRIER
    """Carrier frequency of the pulse-width modulation."""

    def check(self, spec: RobotSpec, tick: float) -> None:
        """Raise an `InputError` if the robot or the tick (s) is not supported."""
        PulseWidthModulator(self.carrier_hz, tick, spec.segments, scale=spec.scale)


class HoldFile(ControllerSection):
    """Constant valve states."""

    constructors = (HoldValves,)

    kind: Literal["hold_valves"]
    """Kind of controller."""
    plus: Literal["fill", "hold", "vent"] = constructor_default()
    """Valve state of the + chambers."""
    minus: Literal["fill", "hold", "vent"] = constructor_default()
    """Valve state of the - chambers."""

    def layouts(self, products: Mapping[str, object]) -> tuple[str, ...]:
        """Return the valve layouts that can produce the valve states."""
        return layouts_for([STATES[self.plus], STATES[self.minus]])


class GraspFile(ControllerSection):
    """Whole-body grasp in which the tail holds an object and the front drags it."""

    constructors = (Grasp,)

    kind: Literal["grasp"]
    """Kind of controller."""
    frequency_hz: float = _FREQUENCY
    """Gait frequency of the dragging segments."""
    mode: Literal["open_loop", "sensed"] = constructor_default()
    """Trigger of the next grasp phase; in the mode "open_loop", phases begin at given
    times. In the mode "sensed", the drag begins when the measured bends settle."""
    side: Literal["left", "right"] = constructor_default()
    """Side of the body on which the object lies."""
    hold: int = quantity(1, 62)
    """Number of tail segments that hold the object."""
    curl_s: float = quantity(0.01, 100.0)
    """Time in which the duty cycle of the curling segments rises from 0 to 1."""
    drag_after_s: float = quantity(0.0, 1000.0)
    """Start time of the drag (latest start time in sensed mode)."""
    release_after_s: float | None = quantity(0.0, 1e6)
    """Time between the start of the drag and the release (default: never)."""
    drag_m: float | None = quantity(0.001, 1000.0)
    """Drag distance after which the object is released (sensed mode only; default: no
    limit)."""
    phase_step_rad: float | None = _PHASE
    """Phase lag of each segment behind the segment in front of it (default: value in
    the robot file)."""

    def check(self, spec: RobotSpec, tick: float) -> None:
        """Raise an `InputError` if the robot or the tick (s) is not supported."""
        check_hold(self.arguments()["hold"], spec)
        check_release(self.mode, self.drag_m)


CORE_CONTROLLERS = (
    GaitFile,
    LearningFile,
    DirectFile,
    IterativeFile,
    HoldFile,
    GraspFile,
)
