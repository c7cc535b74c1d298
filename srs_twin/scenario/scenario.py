"""Scenario: one experiment in SI, ready to build its plants and its controller."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

from srs_twin.errors import UnknownNameError
from srs_twin.scenario.expectation import Expectation
from srs_twin.spec import RobotSpec
from srs_twin.world import World

if TYPE_CHECKING:
    from srs_twin.control.base import Controller
    from srs_twin.plants.base import Plant
    from srs_twin.pneumatics import Pneumatics


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


@dataclass(frozen=True)
class PneumaticsSettings:
    """Valves and chambers of both plants; all but `kind` are arguments of that kind in `pneumatics.KINDS`.

    Attributes:
        kind: "lag" or "orifice".
        leak_per_s: 1/s.
        valve_delay_s: s.
        critical_ratio: b, "orifice" only.
        flow_limit: m³/s at ambient pressure, "orifice" only; None: no limit.
        line_volume: m³, "orifice" only.
    """

    kind: str = "lag"
    leak_per_s: float = 0.0
    valve_delay_s: float = 0.0
    critical_ratio: float = 0.3
    flow_limit: float | None = None
    line_volume: float = 50e-6

    def make(self, robot: RobotSpec, supply_pa: float) -> Pneumatics:
        """Return fresh chambers of a robot."""
        from srs_twin.pneumatics import make_pneumatics

        options = asdict(self)
        kind = options.pop("kind")
        if kind == "lag":
            options = {name: options[name] for name in ("leak_per_s", "valve_delay_s")}
        return make_pneumatics(kind, robot, supply_pa=supply_pa, layout="3/2", **options)


@dataclass(frozen=True)
class AnalyticalSettings:
    """How the analytical model runs; all but `gaps` are arguments of `AnalyticalSnake`.

    Attributes:
        gaps: whether the robot's rigid gaps are part of the body.
        timestep: s.
        tick: s.
        model: "complete", "simplified" or "compliant".
        friction: "axis", "wheel", "viscous" or "ellipse".
        slip_speed: m/s.
        friction_torque: whether friction's moment about the centre of mass acts.
        inertia: "point", "connector" or "lumped".
    """

    gaps: bool = True
    timestep: float = 0.002
    tick: float = 0.02
    model: str = "complete"
    friction: str = "axis"
    slip_speed: float = 0.00025
    friction_torque: bool = True
    inertia: str = "point"


@dataclass(frozen=True)
class TwinSettings:
    """How the twin runs; all but `gaps` are arguments of `TwinSnake`.

    Attributes:
        gaps: whether the robot's rigid gaps are part of the body.
        timestep: s.
        tick: s.
        wheels: "rolling" or "skid".
        hinges_per_segment: bending hinges a segment.
    """

    gaps: bool = True
    timestep: float = 0.001
    tick: float = 0.02
    wheels: str = "rolling"
    hinges_per_segment: int = 2


PlantSettings = AnalyticalSettings | TwinSettings

_DEFAULTS: Mapping[str, PlantSettings] = {"analytical": AnalyticalSettings(), "twin": TwinSettings()}


@dataclass(frozen=True)
class Scenario:
    """One experiment.

    Attributes:
        name: of the file, and of the folder of results.
        title: one line for people.
        robot: the snake, overrides included.
        duration: s.
        seed: for whatever is random.
        record_hz: recorded samples a second.
        supply_pa: supply pressure, Pa.
        pneumatics: valves and chambers.
        allow_overpressure: whether a pressure above the robot's limit was asked for knowingly.
        controller: what commands the valves.
        pose: start: centre of mass x, y (m) and mean heading (rad).
        world: obstacles, bounds, goal.
        plants: plants that the file names → how they run.
        gap_factor: whether speeds are compared with the dissertation's factor (l + L_o)/l.
        expect: what must come out.
        document: plain data of a file that loads as an equal scenario, defaults and robot written out.
        warnings: what a person should know before believing the results.
    """

    name: str
    title: str
    robot: RobotSpec
    duration: float
    seed: int
    record_hz: float
    supply_pa: float
    pneumatics: PneumaticsSettings
    allow_overpressure: bool
    controller: GaitSettings
    pose: tuple[float, float, float]
    world: World
    plants: Mapping[str, PlantSettings]
    gap_factor: bool
    expect: tuple[Expectation, ...]
    document: Mapping[str, Any] = field(repr=False)
    warnings: tuple[str, ...] = ()

    def build_plant(self, kind: str, *, robot: RobotSpec | None = None, **changes: Any) -> Plant:
        """Return a plant, fresh and at rest; one that the file does not name gets its defaults.

        Args:
            kind: "analytical" or "twin".
            robot: another robot than the scenario's.
            changes: settings or arguments of the plant other than the scenario's.

        Raises:
            UnknownNameError: another kind.
        """
        settings = self.plants.get(kind) or _DEFAULTS.get(kind)
        if settings is None:
            raise UnknownNameError("plant", kind, _DEFAULTS)
        arguments = asdict(settings) | changes
        robot = robot or self.robot
        robot = robot if arguments.pop("gaps") else _without_gaps(robot)
        arguments["pneumatics"] = self.pneumatics.make(robot, self.supply_pa)
        if kind == "analytical":
            from srs_twin.plants.analytical import AnalyticalSnake

            return AnalyticalSnake(robot, supply_pa=self.supply_pa, **arguments)
        from srs_twin.plants.twin import TwinSnake

        return TwinSnake(robot, supply_pa=self.supply_pa, **arguments)

    def build_controller(self) -> Controller:
        """Return a fresh controller."""
        from srs_twin.control.gait import Gait

        gait = self.controller
        return Gait(gait.frequency, gait.offset, phase=gait.phase, phase_step=gait.phase_step)


def _without_gaps(robot: RobotSpec) -> RobotSpec:
    return replace(robot, geometry=replace(robot.geometry, rigid_gap=0.0))
