"""Loaded scenario in SI units, which builds plants and a controller."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeVar

from srs_twin.errors import InputError, UnknownNameError, named_in_errors
from srs_twin.plants.analytical import AnalyticalSnake
from srs_twin.pneumatics.valves import StuckValve
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import World
from srs_twin.scenario.controllers import ControllerContext, ControllerSection
from srs_twin.scenario.expectation import Expectation
from srs_twin.scenario.modified import Changes, invalidated_by, marked, with_plants
from srs_twin.scenario.parts import read_resolved
from srs_twin.scenario.plants import PLANTS, AnalyticalFile, PlantFile, TwinFile
from srs_twin.sensing import DeadSensor, FaultySensor, Sensor
from srs_twin.trajectory import Trajectory

if TYPE_CHECKING:
    from srs_twin.control.base import Controller
    from srs_twin.plants.base import Plant
    from srs_twin.pneumatics import Pneumatics
    from srs_twin.scenario.file import ScenarioFile
    from srs_twin.scenario.start import InitialState

Fault = TypeVar("Fault", StuckValve, DeadSensor)

IGNORED_OBSTACLES = (
    "plants.analytical: the model ignores the obstacles of this world and passes"
    " through them; only `model: compliant` with `contact: true` touches them"
)


def ignored_obstacles(
    file: ScenarioFile, world: World, plants: Iterable[str]
) -> tuple[str, ...]:
    """Return a warning if the analytical plant runs and ignores obstacles."""
    touches = file.plants.analytical is not None and file.plants.analytical.contact
    ignores = (
        "analytical" in plants and world.has_obstacles and not (touches or file.bench)
    )
    if ignores:
        return (IGNORED_OBSTACLES,)
    return ()


@dataclass(frozen=True)
class Scenario:
    """Experiment with a robot, a controller and one or two plants.

    Attributes:
        name: name of the scenario and of the output folder.
        title: one-line title, which includes the changed fields.
        robot: robot file with overrides applied.
        duration: simulated duration, s.
        seed: random seed.
        record_hz: recording rate, Hz.
        supply_pa: gauge supply pressure, Pa.
        pose: initial centre of mass x, y (m) and mean heading (rad).
        initial_state: function that sets the initial state of a plant, or None for a
            straight snake at rest at `pose`.
        world: obstacles, bounds and goal.
        file: sections of the file with explicit defaults.
        document: scenario as plain data, including all defaults and the robot. An equal
            scenario can be loaded from this document.
        warnings: warnings for the user.
        products: objects built by extension sections, keyed by section name.
        source: file name for messages.
    """

    name: str
    title: str
    robot: RobotSpec
    duration: float
    seed: int
    record_hz: float
    supply_pa: float
    pose: tuple[float, float, float]
    initial_state: InitialState | None = field(compare=False, repr=False)
    world: World
    file: ScenarioFile
    document: Mapping[str, Any] = field(repr=False)
    warnings: tuple[str, ...] = field(default=(), compare=False)
    products: Mapping[str, object] = field(
        default_factory=dict, compare=False, repr=False
    )
    source: str = field(default="", compare=False)

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in vars(self).items() if name != "file"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Pickle cannot import the generated classes of plug-ins, so the sections are
        # parsed again.
        vars(self).update(state, file=read_resolved(state["document"]))

    @property
    def plants(self) -> Mapping[str, PlantFile]:
        """Plant sections of the file, keyed by name."""
        return self.file.plants.running

    @property
    def controller(self) -> ControllerSection:
        """Section of the controller."""
        return self.file.controller

    @property
    def planner(self) -> Any:
        """Planner that the section `planner` built, or None without this section."""
        return self.products.get("planner")

    @property
    def recording(self) -> Any:
        """Recording that the section `recording` read, or None without this section."""
        return self.products.get("recording")

    @property
    def changes(self) -> Changes:
        """Fields that differ from the scenario file."""
        return tuple(self.document.get("changes", ()))

    @property
    def label(self) -> str:
        """Name of the scenario, followed by the changed fields."""
        return marked(self.name, self.changes)

    @property
    def expect(self) -> tuple[Expectation, ...]:
        """Expectations that the changed fields do not invalidate."""
        return tuple(
            item for item in self.file.expect if not invalidated_by(item, self.changes)
        )

    @property
    def left_out(self) -> list[dict[str, Any]]:
        """Expectations that changed fields invalidate, and these fields (`because`)."""
        pairs = (
            (item, invalidated_by(item, self.changes)) for item in self.file.expect
        )
        return [
            {
                "metric": item.metric,
                "of": item.subject,
                "source": item.source,
                "because": fields,
            }
            for item, fields in pairs
            if fields
        ]

    def plants_to_run(self, plants: Sequence[str] | None) -> tuple[str, ...]:
        """Return the given plants, or the plants of the scenario if `plants` is None.

        Raises:
            InputError: the list of plants is empty.
        """
        if plants is None:
            return tuple(self.plants)
        if not plants:
            raise InputError(
                "the list of plants is empty; name at least one plant, or omit the list"
            )
        return tuple(plants)

    def run_on(self, plants: Sequence[str] | None) -> Scenario:
        """Return the scenario for a run on given plants.

        If `plants` is None, the plants of the scenario are kept. Different plants are
        recorded as a changed field.
        """
        kinds = self.plants_to_run(plants)
        changes = with_plants(self.changes, tuple(self.plants), kinds)
        if changes == list(self.changes):
            return self
        document = {
            key: value for key, value in self.document.items() if key != "changes"
        }
        document |= {"changes": changes} if changes else {}
        warnings = tuple(text for text in self.warnings if text != IGNORED_OBSTACLES)
        warnings += ignored_obstacles(self.file, self.world, kinds)
        title = marked(document["title"], changes)
        return replace(self, document=document, title=title, warnings=warnings)

    @property
    def layout(self) -> str:
        """Valve layout, "3/2" or "in_out"."""
        assert self.file.valves.layout is not None, "set when the scenario was loaded"
        return self.file.valves.layout

    @property
    def timing(self) -> dict[str, Any]:
        """Arguments of `rollout` and `Job` that the scenario defines."""
        names = (
            "duration",
            "pose" if self.initial_state is None else "initial_state",
            "seed",
            "record_hz",
        )
        return {name: getattr(self, name) for name in names}

    @property
    def measured(self) -> Trajectory | None:
        """Measured trajectory from time 0 to the end of the run, or None."""
        measured = (
            section.measured(self.products[key])
            for key, section in self.file.sections().items()
        )
        trajectory = next(filter(None, measured), None)
        if trajectory is None:
            return None
        start = trajectory.time[0]
        part = trajectory.between(start, start + self.duration)
        return replace(part, columns={**part.columns, "time": part.time - start})

    def build_plant(
        self, kind: str, *, robot: RobotSpec | None = None, **changes: object
    ) -> Plant:
        """Build a plant at rest.

        A plant that the scenario file does not name gets the default options.

        Args:
            kind: "analytical" or "twin".
            robot: robot to use instead of the scenario's robot.
            changes: plant arguments that override the values in the scenario.

        Raises:
            UnknownNameError: the kind is unknown.
        """
        if kind not in PLANTS:
            raise UnknownNameError("plant", kind, PLANTS)
        robot = robot or self.robot
        settings = self.plants.get(kind) or (
            AnalyticalFile() if kind == "analytical" else TwinFile()
        )
        arguments: dict[str, Any] = {
            "supply_pa": self.supply_pa,
            "tick": self.file.tick(kind),
            "base": "clamped" if self.file.bench else "free",
        }
        arguments |= settings.arguments() | {"gaps": settings.gaps} | changes
        if "sensor" not in changes:
            arguments["sensor"] = self._sensors(robot)
        if not arguments.pop("gaps"):
            robot = replace(robot, geometry=replace(robot.geometry, rigid_gap=0.0))
        if "pneumatics" not in changes:
            arguments["pneumatics"] = self._chambers(robot)
        if self.file.bench:
            arguments["world"] = None
        else:
            arguments["world"] = arguments.get("world", self.world)
        if kind == "analytical":
            return AnalyticalSnake(robot, **arguments)
        from srs_twin.plants.twin.snake import TwinSnake

        return TwinSnake(robot, **arguments)

    def check_run(self) -> None:
        """Check that a run can start, for example that the plan can be computed.

        Raises:
            InputError: the run cannot start.
        """
        with named_in_errors(self.source):
            for key, section in self.file.sections().items():
                section.check_run(self.products[key])

    def build_controller(self) -> Controller:
        """Build the controller.

        Raises:
            InputError: the controller needs a plan, and no plan can be computed.
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
        chambers.stuck = self._faults(StuckValve)
        return chambers

    def _sensors(self, robot: RobotSpec) -> Sensor:
        sensor = self.file.sensor.sensor(robot)
        dead = self._faults(DeadSensor)
        if dead:
            return FaultySensor(sensor, dead)
        return sensor

    def _faults(self, kind: type[Fault]) -> tuple[Fault, ...]:
        faults = (fault.build() for fault in self.file.faults)
        return tuple(fault for fault in faults if isinstance(fault, kind))
