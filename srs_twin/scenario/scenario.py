"""Scenario: one experiment in SI, ready to build its plants and its controller."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.pneumatics.valves import StuckValve
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.control import ControllerSettings, LearningSettings, ReplaySettings
from srs_twin.scenario.expectation import Expectation
from srs_twin.scenario.following import FollowSettings
from srs_twin.scenario.settings import (
    AnalyticalSettings,
    PlantSettings,
    PneumaticsSettings,
    SensorSettings,
    TwinSettings,
    default_tick,
)
from srs_twin.sensing import DeadSensor, FaultySensor, Sensor
from srs_twin.trajectory import Trajectory
from srs_twin.world import World

if TYPE_CHECKING:
    from srs_twin.control.base import Controller
    from srs_twin.plants.base import Plant
    from srs_twin.pneumatics import Pneumatics

_KINDS = {"analytical": AnalyticalSettings, "twin": TwinSettings}


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
        layout: of the valves, "3/2" or "in_out".
        sensor: what controllers are told of the bends.
        faults: what breaks.
        bench: whether the head is clamped, in the air.
        controller: what commands the valves.
        pose: start: centre of mass x, y (m) and mean heading (rad).
        world: obstacles, bounds, goal.
        plants: plants that the file names → how they run.
        gap_factor: whether speeds are compared with the dissertation's factor (l + L_o)/l.
        expect: what must come out.
        document: plain data of a file that loads as an equal scenario, defaults and robot written out.
        warnings: what a person should know before believing the results.
        measured: what was recorded of the robot, on the clock of the run; None where nothing is replayed.
        source: the file, as messages show it.
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
    layout: str
    sensor: SensorSettings
    faults: tuple[DeadSensor | StuckValve, ...]
    bench: bool
    controller: ControllerSettings | FollowSettings
    pose: tuple[float, float, float]
    world: World
    plants: Mapping[str, PlantSettings]
    gap_factor: bool
    expect: tuple[Expectation, ...]
    document: Mapping[str, Any] = field(repr=False)
    warnings: tuple[str, ...] = ()
    measured: Trajectory | None = field(default=None, compare=False, repr=False)
    source: str = field(default="", compare=False)

    @contextmanager
    def named_in_errors(self) -> Iterator[None]:
        """Say in a block's errors which file it was: what only building finds knows of no file.

        Raises:
            InputError: the block raised one.
        """
        try:
            yield
        except InputError as error:
            error.args = (f"{self.source}: {error}",)
            raise

    def build_plant(self, kind: str, *, robot: RobotSpec | None = None, **changes: Any) -> Plant:
        """Return a plant, fresh and at rest; one that the file does not name gets its defaults.

        Args:
            kind: "analytical" or "twin".
            robot: another robot than the scenario's.
            changes: settings or arguments of the plant other than the scenario's.

        Raises:
            UnknownNameError: another kind.
        """
        if kind not in _KINDS:
            raise UnknownNameError("plant", kind, _KINDS)
        driven = self.controller.gait if isinstance(self.controller, FollowSettings) else self.controller
        learning = isinstance(driven, LearningSettings)
        tick = default_tick(bench=self.bench, learning=learning)
        settings = self.plants.get(kind) or _KINDS[kind](tick=tick)
        robot = robot or self.robot
        hung = {"sensor": self._sensors(robot), "base": "clamped" if self.bench else "free"}
        arguments = hung | asdict(settings) | changes
        robot = robot if arguments.pop("gaps") else _without_gaps(robot)
        arguments["pneumatics"] = self._chambers(robot)
        if kind == "analytical":
            from srs_twin.plants.analytical import AnalyticalSnake

            return AnalyticalSnake(robot, supply_pa=self.supply_pa, **arguments)
        from srs_twin.plants.twin import TwinSnake

        if not self.bench:
            arguments["world"] = self.world
        return TwinSnake(robot, supply_pa=self.supply_pa, **arguments)

    def _chambers(self, robot: RobotSpec) -> Pneumatics:
        chambers = None
        if isinstance(self.controller, ReplaySettings):
            chambers = self.controller.chambers(robot, self.supply_pa, self.layout)
        if chambers is None:
            chambers = self.pneumatics.make(robot, self.supply_pa, self.layout)
        chambers.stuck = tuple(fault for fault in self.faults if isinstance(fault, StuckValve))
        return chambers

    def _sensors(self, robot: RobotSpec) -> Sensor:
        sensor = self.sensor.make(robot)
        dead = tuple(fault for fault in self.faults if isinstance(fault, DeadSensor))
        return FaultySensor(sensor, dead) if dead else sensor

    def build_controller(self) -> Controller:
        """Return a fresh controller."""
        return self.controller.make()


def _without_gaps(robot: RobotSpec) -> RobotSpec:
    return replace(robot, geometry=replace(robot.geometry, rigid_gap=0.0))
