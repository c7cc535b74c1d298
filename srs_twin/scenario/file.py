"""The scenario file as a strict model: keys with units, bounds, defaults, texts for editors."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, WithJsonSchema

from srs_twin.identification.takes import RecordingReader
from srs_twin.recordings.recording_map import RecordingMap
from srs_twin.robot.file import RobotFile
from srs_twin.scenario.air import PneumaticsFile, SupplyFile, ValvesFile
from srs_twin.scenario.controllers import ControllerFile, FollowFile
from srs_twin.scenario.expectation import Expectation
from srs_twin.scenario.fields import Line, Section, constructor_default, quantity
from srs_twin.scenario.planner import PlannerFile
from srs_twin.scenario.plants import BENCH_TICK_S, TICK_S, AnalyticalFile, PlantsFile, TwinFile
from srs_twin.scenario.sensors import FaultFile, SensorFile
from srs_twin.scenario.world import StartFile, WorldFile


class ComparisonFile(Section):
    """How the plants are compared."""

    gap_factor: bool = False
    """Multiply the analytical speed by (l + L_o)/l, as the dissertation does for its model without rigid
    gaps (Section 3.4.2); the analytical plant must have gaps: false."""


FilePath = Annotated[str, Field(min_length=1, max_length=1000)]


class RecordingFile(Section):
    """What was measured of a robot and the log of its air (docs/logs.md); paths from the current folder."""

    constructors = (RecordingReader,)

    motion: FilePath
    """What cameras saw (docs/logs.md#file-formats); on a bench also a CSV file of time,bend_1,…."""
    valves: FilePath | None = None
    """Log of valves or pressures; a plain CSV or MCAP file (default: NAME.valves.csv beside the motion)."""
    offset_s: float | None = quantity(-1e9, 1e9)
    """What to add to the log's times (default: estimated)."""
    gait_frequency_hz: float | None = quantity(0.01, 50.0)
    """Gait frequency (default: as the valves repeat themselves)."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = constructor_default()
    """Axis of the file that points up."""
    layout: Literal["auto", "single", "head", "pair", "middles", "head_middles"] = constructor_default()
    """Where the markers are."""
    map: RecordingMap = constructor_default()
    """Which marker, rigid body or column is what (docs/logs.md#a-map)."""
    head: Line | None = constructor_default()
    """Column of the marker at the head; the end towards which it crawls where there is none."""
    longest_gap_s: float = quantity(0.0, 10.0)
    """Longest gap that is filled."""


class ScenarioFile(Section):
    """One experiment with a soft snake."""

    name: Annotated[Line, Field(pattern=r"^[^./\x00-\x1f][^/\x00-\x1f]*$")] | None = None
    """Name of the results' folder (default: the file's name)."""
    title: Line | None = None
    """One line for people (default: the name)."""
    robot: Annotated[Any, WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "object"}]})]
    """Robot: a shipped name (gen1 to gen4, gen4_module), the path of a robot file, {base: a name or
    path} with fields to change, or a whole robot."""
    duration_s: float = quantity(0.001, 3600.0)
    """Simulated time."""
    seed: int = quantity(0, 2**32 - 1, 0)
    """Seed of whatever is random."""
    record_hz: float = quantity(0.1, 10_000.0, 100.0)
    """Recorded samples a second."""
    supply: SupplyFile = SupplyFile()
    """Compressed air."""
    pneumatics: PneumaticsFile = PneumaticsFile()
    """Valves and chambers."""
    allow_overpressure: bool = False
    """Let a supply pressure above the robot's limit run, with a warning."""
    valves: ValvesFile = ValvesFile()
    """The valves of each chamber."""
    sensor: SensorFile = SensorFile()
    """What controllers are told of the bends."""
    faults: Annotated[list[FaultFile], Field(max_length=200)] = []
    """What breaks, and when."""
    bench: bool = False
    """Hold the head fast, in the air, as a module is held on a bench; on both plants, without a floor."""
    controller: ControllerFile
    """What commands the valves."""
    start: StartFile = StartFile()
    """Where the snake lies at first."""
    recording: RecordingFile | None = None
    """What was measured of the robot, to replay and to hold the plants against (controller.kind: replay)."""
    planner: PlannerFile | None = None
    """How the way to the goal is found (controller.kind: follow)."""
    world: WorldFile = WorldFile()
    """Obstacles, bounds and goal."""
    plants: PlantsFile = PlantsFile(analytical=AnalyticalFile(), twin=TwinFile())
    """Which plants run (default: both)."""
    comparison: ComparisonFile = ComparisonFile()
    """How the plants are compared."""
    expect: Annotated[list[Expectation], Field(max_length=200)] = []
    """What must come out."""

    elsewhere: ClassVar[dict[str, str]] = {
        key: f"robot.{key}" for key in RobotFile.model_fields if key not in ("name", "title", "supply")
    }

    def tick(self, plant: str) -> float:
        """Return the control tick of a plant, whether the file names it or not, s."""
        section = getattr(self.plants, plant)
        driven = self.controller.gait if isinstance(self.controller, FollowFile) else self.controller
        suits = BENCH_TICK_S if self.bench else driven.tick or TICK_S
        return suits if section is None or section.tick_s is None else float(section.tick_s)
