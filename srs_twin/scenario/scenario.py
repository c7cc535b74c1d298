"""Scenario: one experiment in SI, ready to build its plants and its controller."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.plants.analytical import AnalyticalSnake
from srs_twin.pneumatics.valves import StuckValve
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import World
from srs_twin.scenario.controllers import ControllerContext, ControllerSection
from srs_twin.scenario.expectation import Expectation
from srs_twin.scenario.modified import Changes, invalidated_by, marked, with_plants
from srs_twin.scenario.plants import PLANTS, AnalyticalFile, PlantFile, TwinFile
from srs_twin.sensing import DeadSensor, FaultySensor, Sensor
from srs_twin.trajectory import Trajectory

if TYPE_CHECKING:
    from srs_twin.control.base import Controller
    from srs_twin.plants.base import Plant
    from srs_twin.pneumatics import Pneumatics
    from srs_twin.scenario.file import ScenarioFile
    from srs_twin.scenario.start import FirstState


@dataclass(frozen=True)
class Scenario:
    """One experiment.

    Attributes:
        name: of the file, and of the folder of results.
        title: one line for people, with the changed fields.
        robot: the snake, overrides included.
        duration: s.
        seed: for whatever is random.
        record_hz: recorded samples a second.
        supply_pa: supply pressure, Pa.
        pose: start: centre of mass x, y (m) and mean heading (rad).
        begin: brings its plants into their first states; None: they lie straight and at rest at `pose`.
        world: obstacles, bounds, goal.
        file: the sections of the file, all defaults written out.
        document: plain data of a file that loads as an equal scenario, defaults and robot written out.
        warnings: what a person should know before trusting the results.
        products: section of an extension → what it made of its keys and files.
        source: the file, as messages show it.
    """

    name: str
    title: str
    robot: RobotSpec
    duration: float
    seed: int
    record_hz: float
    supply_pa: float
    pose: tuple[float, float, float]
    begin: FirstState | None = field(compare=False, repr=False)
    world: World
    file: ScenarioFile
    document: Mapping[str, Any] = field(repr=False)
    warnings: tuple[str, ...] = ()
    products: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)
    source: str = field(default="", compare=False)

    @property
    def plants(self) -> Mapping[str, PlantFile]:
        """The plants that the file names, and how they run."""
        return self.file.plants.running

    @property
    def controller(self) -> ControllerSection:
        """What commands the valves."""
        return self.file.controller

    @property
    def planner(self) -> Any:
        """The product of the section `planner`; None where nothing follows a plan."""
        return self.products.get("planner")

    @property
    def recording(self) -> Any:
        """The product of the section `recording`; None where nothing is replayed."""
        return self.products.get("recording")

    @property
    def changes(self) -> Changes:
        """The fields that differ from the scenario's file."""
        return tuple(self.document.get("changes", ()))

    @property
    def label(self) -> str:
        """The name, with the changed fields."""
        return marked(self.name, self.changes)

    @property
    def expect(self) -> tuple[Expectation, ...]:
        """The expectations that changed fields leave valid."""
        return tuple(each for each in self.file.expect if not invalidated_by(each, self.changes))

    @property
    def left_out(self) -> list[dict[str, Any]]:
        """The invalidated expectations: `metric`, `of`, `source`, and the changed fields (`because`)."""
        found = ((each, invalidated_by(each, self.changes)) for each in self.file.expect)
        return [
            {"metric": each.metric, "of": each.subject, "source": each.source, "because": fields}
            for each, fields in found
            if fields
        ]

    def run_on(self, plants: Sequence[str] | None) -> Scenario:
        """Return the scenario with a note of the plants that run where these are not its own (None)."""
        changes = with_plants(self.changes, tuple(self.plants), plants or tuple(self.plants))
        if changes == list(self.changes):
            return self
        document = {key: value for key, value in self.document.items() if key != "changes"}
        document |= {"changes": changes} if changes else {}
        return replace(self, document=document, title=marked(document["title"], changes))

    @property
    def layout(self) -> str:
        """The layout of the valves, "3/2" or "in_out"."""
        assert self.file.valves.layout is not None, "defaults are written out"
        return self.file.valves.layout

    @property
    def timing(self) -> dict[str, Any]:
        """The arguments of `rollout` and `Job` that are the scenario's."""
        names = ("duration", "pose", "begin", "seed", "record_hz")
        return {name: getattr(self, name) for name in names}

    @property
    def measured(self) -> Trajectory | None:
        """What was recorded of the robot, on the clock of the run; None where nothing is replayed."""
        measured = (each.measured(self.products[key]) for key, each in self.file.sections().items())
        trajectory = next(filter(None, measured), None)
        if trajectory is None:
            return None
        time = trajectory.time - trajectory.time[0]
        kept = time <= self.duration + 1e-9
        columns = {name: column[kept] for name, column in trajectory.columns.items()}
        return replace(trajectory, columns=columns | {"time": time[kept]})

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
            changes: arguments of the plant other than the scenario's, and `gaps`.

        Raises:
            UnknownNameError: another kind.
        """
        if kind not in PLANTS:
            raise UnknownNameError("plant", kind, PLANTS)
        robot = robot or self.robot
        settings = self.plants.get(kind) or (AnalyticalFile() if kind == "analytical" else TwinFile())
        arguments: dict[str, Any] = {
            "supply_pa": self.supply_pa,
            "tick": self.file.tick(kind),
            "base": "clamped" if self.file.bench else "free",
            "sensor": self._sensors(robot),
        }
        arguments |= settings.arguments() | {"gaps": settings.gaps} | changes
        if not arguments.pop("gaps"):
            robot = replace(robot, geometry=replace(robot.geometry, rigid_gap=0.0))
        arguments["pneumatics"] = self._chambers(robot)
        arguments["world"] = None if self.file.bench else self.world
        if kind == "analytical":
            return AnalyticalSnake(robot, **arguments)
        from srs_twin.plants.twin.snake import TwinSnake

        return TwinSnake(robot, **arguments)

    def check_run(self) -> None:
        """Refuse a run that cannot start, before anything is simulated.

        Raises:
            InputError: it cannot start; a plan cannot be made, for example.
        """
        with self.named_in_errors():
            for key, section in self.file.sections().items():
                section.check_run(self.products[key])

    def build_controller(self) -> Controller:
        """Return a fresh controller.

        Raises:
            InputError: one that follows a plan, and nothing can be planned.
        """
        return self.controller.controller(
            ControllerContext(self.name, self.robot, self.supply_pa, self.products)
        )

    def _chambers(self, robot: RobotSpec) -> Pneumatics:
        replaced = (
            section.chambers(self.products[key], robot, self.supply_pa, self.layout)
            for key, section in self.file.sections().items()
        )
        chambers = next(filter(None, replaced), None)
        if chambers is None:
            chambers = self.file.pneumatics.chambers(robot, self.supply_pa, self.layout)
        faults = (each.build() for each in self.file.faults)
        chambers.stuck = tuple(fault for fault in faults if isinstance(fault, StuckValve))
        return chambers

    def _sensors(self, robot: RobotSpec) -> Sensor:
        sensor = self.file.sensor.sensor(robot)
        faults = (each.build() for each in self.file.faults)
        dead = tuple(fault for fault in faults if isinstance(fault, DeadSensor))
        return FaultySensor(sensor, dead) if dead else sensor
