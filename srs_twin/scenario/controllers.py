"""Controllers of a scenario: what commands the valves, the bend that it follows, the plan that it follows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Protocol

from pydantic import Field, model_validator

from srs_twin.control.base import Controller
from srs_twin.control.duties import LARGEST_OFFSET, Cycles
from srs_twin.control.gait import Gait
from srs_twin.control.learning import ILC, LEAST_PULSES
from srs_twin.control.pwm import PulseWidth
from srs_twin.control.reference import Constant, Reference, Sine, Square, Staircase, Step
from srs_twin.control.replay import STATES, HoldValves, layouts_for
from srs_twin.control.smc import DirectSMC, IterativeSMC
from srs_twin.pneumatics.chambers import largest_bend
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.fields import Section, constructor_default, quantity

_KIND = "Which controller."
_SHAPE = "How the bend changes over time."
_RIGHT = math.pi / 2

_FREQUENCY = quantity(0.01, 50.0)
_PHASE = quantity(-6.3, 6.3)
_PHASE_STEP = quantity(-6.3, 6.3)
_Phases = Annotated[list[Annotated[float, Field(ge=-6.3, le=6.3)]], Field(max_length=200)]
_CARRIER = quantity(1.0, 1000.0)
_SLOPE = quantity(0.001, 1000.0)

Bend = Annotated[float, Field(ge=-_RIGHT, le=_RIGHT)]


Contradiction = tuple[tuple[str, ...], str, bool]
"""Path in the file, message, and whether it belongs to the key rather than to its value."""


class FileSections(Protocol):
    """Sections of a scenario file, as far as others look at them; `scenario.file.ScenarioFile`."""

    bench: bool
    seed: int
    duration_s: float
    controller: Any
    start: Any
    world: Any
    pneumatics: Any
    plants: Any

    @property
    def model_fields_set(self) -> set[str]:
        """Names of the fields that the file gives."""

    def section(self, name: str) -> Any:
        """Return a section of an extension by its name, None where the file has none."""


@dataclass(frozen=True)
class ControllerContext:
    """What a controller of a scenario is built from.

    Attributes:
        name: of the scenario, for messages.
        robot: the snake.
        supply_pa: supply pressure, gauge, Pa.
        products: of the sections of extensions, by section.
    """

    name: str
    robot: RobotSpec
    supply_pa: float
    products: Mapping[str, Any]


class ControllerSection(Section):
    """What all controllers have in common; `constructors` begin with the controller's class.

    Attributes:
        tick: control tick that suits it, s; None: the plants' own.
    """

    if TYPE_CHECKING:
        kind: str
    tick: ClassVar[float | None] = None

    def controller(self, context: ControllerContext) -> Controller:
        """Return a fresh controller."""
        controller: Controller = self.constructors[0](**self.arguments())
        return controller

    @property
    def gait_section(self) -> ControllerSection:
        """The controller that sets the valves: itself, unless it steers another one."""
        return self

    def contradictions_with(self, file: FileSections) -> Iterator[Contradiction]:
        """Yield what contradicts other sections of the file."""
        return iter(())

    def is_ready(self, products: Mapping[str, Any]) -> bool:
        """Return whether the products of other sections that it needs were read."""
        return True

    def layouts(self, products: Mapping[str, Any]) -> tuple[str, ...]:
        """Return the valve layouts that it can drive.

        Args:
            products: of the sections of extensions, by section.
        """
        found: tuple[str, ...] = self.constructors[0].layouts  # type: ignore[attr-defined]
        return found

    def check(self, spec: RobotSpec, tick: float) -> None:
        """Refuse a robot or tick that it cannot drive.

        Raises:
            InputError: it cannot.
        """

    def warnings(self, limit: float) -> Iterator[str]:
        """Return what to warn of where the segments bend by `limit` (rad) at most.

        Raises:
            InputError: a reference beyond that, which is to be refused.
        """
        return iter(())


class GaitFile(ControllerSection):
    """Lateral undulation, open loop (Eq. 13)."""

    constructors = (Gait,)

    kind: Literal["gait"]
    """Which controller."""
    frequency_hz: float = _FREQUENCY
    """Gait frequency."""
    offset: float = quantity(-0.95, 0.95)
    """Steering offset, positive to the left."""
    phase_rad: float = _PHASE
    """Phase at the start."""
    phase_step_rad: float | None = _PHASE_STEP
    """Lag of each segment behind the one before it (default: the robot's)."""
    phases_rad: _Phases | None = constructor_default()
    """By how much each segment lags more than that, one a segment (default: none)."""
    rest_share: float | None = quantity(0.0, 0.95)
    """Share of the time for which both chambers of a segment vent, about the changes of the wave's sign
    (default: none)."""


class LearningFile(ControllerSection):
    """Iterative learning control of a gait: the duty of each chamber, learnt once a period (Eq. 32)."""

    constructors = (ILC,)
    tick = 0.005  # the peaks of bends that ripple with a carrier of 17 ms must be seen

    kind: Literal["ilc"]
    """Which controller."""
    frequency_hz: float = _FREQUENCY
    """Gait frequency."""
    offset: float = quantity(-LARGEST_OFFSET, LARGEST_OFFSET)
    """Steering offset, positive to the left, by unequal targets."""
    target: Literal["smallest"] | None = None
    """Target of the larger side: the smallest amplitude recorded (default), unless target_rad is given."""
    target_rad: float | None = quantity(0.01, _RIGHT, None)
    """Target of the larger side."""
    k_per_rad: float = quantity(1e-4, 100.0)
    """k, change of duty for an error."""
    free_periods: int = quantity(1, 1000)
    """Periods at full duty before the recorded one."""
    carrier_hz: float = _CARRIER
    """Carrier of the pulse-width modulation."""
    on_fault: Literal["go_on", "stop"] = constructor_default()
    """What a dead sensor or a stuck valve leads to: going on without that module, or the end of the run."""
    steering: Literal["targets", "targets_and_wave"] = constructor_default()
    """What the offset acts on: unequal targets, or also the valves' wave (Eq. 13), which then fills the
    chambers of the side to turn to for longer."""
    phase_rad: float = _PHASE
    """Phase at the start."""
    phase_step_rad: float | None = _PHASE_STEP
    """Lag of each segment behind the one before it (default: the robot's)."""

    @model_validator(mode="after")
    def _fits(self) -> LearningFile:
        if self.target is not None and self.target_rad is not None:
            raise ValueError("give either target or target_rad")
        least = 2 * LEAST_PULSES * self.frequency_hz
        if self.carrier_hz < least:
            raise ValueError(f"a gait of this frequency needs a carrier_hz of {least:g} or more")
        return self

    def check(self, spec: RobotSpec, tick: float) -> None:
        """See `ControllerSection.check`: a period needs enough ticks to learn from."""
        Cycles(spec.modules.array("bias"), self.frequency_hz, tick)

    def warnings(self, limit: float) -> Iterator[str]:
        """See `ControllerSection.warnings`."""
        if self.target_rad and self.target_rad > limit:
            yield (
                f"controller.target_rad: {self.target_rad:.4g} rad is more than the {limit:.4g} rad that the "
                "segments bend by at this supply pressure; duties will stay at 1"
            )


class ConstantFile(Section):
    """One bend for ever."""

    kind: Literal["constant"]
    """How the bend changes over time."""
    bend_rad: float = quantity(-_RIGHT, _RIGHT)
    """Bend."""

    def build(self) -> Reference:
        """Return the reference."""
        return Constant(self.bend_rad)


class StepFile(Section):
    """A jump from one bend to another."""

    constructors = (Step,)

    kind: Literal["step"]
    """How the bend changes over time."""
    bend_rad: float = quantity(-_RIGHT, _RIGHT)
    """Bend after the step."""
    before_rad: float = quantity(-_RIGHT, _RIGHT)
    """Bend before it."""
    time_s: float = quantity(0.0, 3600.0)
    """When it comes."""

    def build(self) -> Reference:
        """Return the reference."""
        return Step(self.bend_rad, self.before_rad, self.time_s)


class _PeriodicFile(Section):
    constructors: ClassVar[tuple[type[Sine | Square], ...]] = (Sine,)

    amplitude_rad: float = quantity(0.001, _RIGHT)
    """Amplitude."""
    frequency_hz: float = quantity(0.01, 50.0)
    """Frequency."""
    phase_rad: float = _PHASE
    """Phase at the start."""
    offset_rad: float = quantity(-_RIGHT, _RIGHT)
    """Mean bend."""


class SineFile(_PeriodicFile):
    """A sine."""

    kind: Literal["sine"]
    """How the bend changes over time."""


class SquareFile(_PeriodicFile):
    """A square wave."""

    constructors = (Square,)

    kind: Literal["square"]
    """How the bend changes over time."""


class StaircaseFile(Section):
    """One bend after another, each held for the same time; the last one stays."""

    kind: Literal["staircase"]
    """How the bend changes over time."""
    bends_rad: Annotated[tuple[Bend, ...], Field(min_length=1, max_length=1000)]
    """The bends, rad."""
    hold_s: float = quantity(0.001, 3600.0)
    """How long each is held."""

    def build(self) -> Reference:
        """Return the reference."""
        return Staircase(self.bends_rad, self.hold_s)


ReferenceFile = Annotated[
    ConstantFile | StepFile | SineFile | SquareFile | StaircaseFile, Field(discriminator="kind")
]


class _TrackingFile(ControllerSection):
    reference: ReferenceFile
    """The bend that every segment is to follow."""
    beyond_range: Literal["refuse", "saturate"] = "refuse"
    """What becomes of a reference beyond what the segments bend by at the supply pressure."""

    def controller(self, context: ControllerContext) -> Controller:
        """See `ControllerSection.controller`."""
        wanted = self.within(largest_bend(context.robot, context.supply_pa))
        controller: Controller = self.constructors[0](**self.arguments() | {"reference": wanted})
        return controller

    def within(self, limit: float) -> Reference:
        """Return the reference, refused or cut beyond what the segments bend by (`limit`, rad).

        Raises:
            InputError: it goes beyond, and is to be refused.
        """
        reference: Reference = self.reference.build()
        return reference.within(limit, self.beyond_range)

    def warnings(self, limit: float) -> Iterator[str]:
        """See `ControllerSection.warnings`."""
        if wanted := getattr(self.within(limit), "wanted", None):
            yield (
                f"controller.reference: asks for {wanted.peak:.4g} rad and is cut at {limit:.4g} rad, the "
                "most that the segments bend by at this supply pressure"
            )


class DirectFile(_TrackingFile):
    """Sliding mode control by valve states, with separate inlet and outlet valves (Eq. 31)."""

    constructors = (DirectSMC,)

    kind: Literal["direct_smc"]
    """Which controller."""
    d_per_s: float = _SLOPE
    """D, slope of the sliding manifold."""
    epsilon_rad_per_s: float = quantity(0.0001, 1000.0)
    """ε, half the width of the dead zone."""
    cutoff_hz: float = quantity(0.1, 1000.0)
    """Cutoff of the velocity filter."""


class IterativeFile(_TrackingFile):
    """Sliding mode control through the duty of pulse-width modulated 3/2 valves (Eq. 29)."""

    constructors = (IterativeSMC,)

    kind: Literal["iterative_smc"]
    """Which controller."""
    k_s_per_rad: float = quantity(1e-5, 1000.0)
    """K, gain."""
    d_per_s: float = _SLOPE
    """D, slope of the sliding manifold."""
    carrier_hz: float = _CARRIER
    """Carrier of the pulse-width modulation."""

    def check(self, spec: RobotSpec, tick: float) -> None:
        """See `ControllerSection.check`: the carrier's periods must not be shorter than ticks."""
        PulseWidth(self.carrier_hz, tick, spec.segments)


class HoldFile(ControllerSection):
    """Valves that stay as they are."""

    constructors = (HoldValves,)

    kind: Literal["hold_valves"]
    """Which controller."""
    plus: Literal["fill", "hold", "vent"] = constructor_default()
    """Valves of the + chambers."""
    minus: Literal["fill", "hold", "vent"] = constructor_default()
    """Valves of the - chambers."""

    def layouts(self, products: Mapping[str, Any]) -> tuple[str, ...]:
        """See `ControllerSection.layouts`."""
        return layouts_for([STATES[self.plus], STATES[self.minus]])


CORE_CONTROLLERS = (GaitFile, LearningFile, DirectFile, IterativeFile, HoldFile)
"""Sections of the controllers of the core."""
