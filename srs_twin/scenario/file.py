"""The scenario file as a strict model: keys with units, bounds, defaults, texts for editors."""

from __future__ import annotations

import math
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field, WithJsonSchema, create_model, model_validator

from srs_twin import extensions
from srs_twin.extensions import objects
from srs_twin.pneumatics import OrificePneumatics, Pneumatics, make_pneumatics
from srs_twin.pneumatics.valves import StuckValve
from srs_twin.robot.file import RobotFile
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.controllers import CORE_CONTROLLERS, ControllerSection
from srs_twin.scenario.expectation import Expectation
from srs_twin.scenario.fields import Line, Section, quantity
from srs_twin.scenario.modified import ChangedField
from srs_twin.scenario.plants import BENCH_TICK_S, TICK_S, AnalyticalFile, PlantsFile, TwinFile
from srs_twin.scenario.sections import ExtensionSection, section_entries
from srs_twin.scenario.start import StartFile
from srs_twin.scenario.world import WorldFile
from srs_twin.sensing import DeadSensor, HallSensor, Sensor, Strip, make_sensor

LEAST_RECORD_HZ = 0.1
"""Least recording rate, Hz."""
MOST_RECORD_HZ = 10_000.0
"""Greatest recording rate, Hz."""


class SensorFile(Section):
    """What controllers are told of the bends."""

    constructors = (make_sensor, Strip, HallSensor)
    only = {}  # of kind hall, all other keys: below

    kind: Literal["ideal", "hall"] = "ideal"
    """ideal: the bend as it is; hall: magnet and Hall element on a strip, amplifier, converter, straight
    line (docs/sensor.md)."""
    span_rad: float | None = quantity(0.1, 1.6, None)
    """Bends to both sides over which it is trimmed and calibrated (hall; default {default:.4g})."""
    distance_mm: float | None = quantity(1.0, 50.0, None)
    """From the magnet to the element, along the strip (hall; default {default:g})."""
    orientation: Literal["up", "side"] | None = None
    """Of the magnet's north (hall; default up)."""
    chamber: Literal["semicircular", "rectangular"] | None = None
    """Cross-section of the pressure chambers (hall; default semicircular); a rectangular one presses on
    the strip."""
    noise_uv: float | None = quantity(0.0, 1e5, None)
    """RMS noise of the element that the amplifier passes (hall; default {default:g})."""
    bits: int | None = quantity(1, 32, None)
    """Of the converter (hall; default {default})."""
    bias_v: float | None = quantity(-5.0, 5.0, None)
    """Drift of the output since the calibration (hall; default {default:g})."""
    gain_error: float | None = quantity(-0.9, 10.0, None)
    """Drift of the gain since the calibration, as a share of it (hall; default {default:g})."""

    def resolved(self) -> SensorFile:
        """Return the section with all defaults written out."""
        return self.with_defaults(*self.only["kind", "hall"]) if self.kind == "hall" else self

    def sensor(self, robot: RobotSpec) -> Sensor:
        """Return the sensors of a robot.

        Raises:
            InputError: a sensor that cannot be trimmed or calibrated.
        """
        return make_sensor(spec=robot, **self.arguments())


SensorFile.only["kind", "hall"] = tuple(key for key in SensorFile.model_fields if key != "kind")


class _FaultFile(Section):
    segment: int = quantity(1, 63)
    """Which segment, counted from the head."""
    from_s: float = quantity(0.0, 3600.0, 0.0)
    """Since when."""


class DeadSensorFile(_FaultFile):
    """A curvature sensor that tells nothing more."""

    kind: Literal["dead_sensor"]
    """What breaks."""
    reading_rad: float | None = quantity(-6.3, 6.3, None)
    """What it says instead (default: no reading at all)."""

    def build(self) -> DeadSensor:
        """Return it in SI."""
        reading = math.nan if self.reading_rad is None else self.reading_rad
        return DeadSensor(self.segment, reading, self.from_s)


class StuckValveFile(_FaultFile):
    """A chamber's inlet that no longer obeys."""

    kind: Literal["stuck_valve"]
    """What breaks."""
    chamber: Literal["plus", "minus"]
    """Of which chamber."""
    stuck: Literal["open", "closed"]
    """open: fills its chamber for ever; closed: vents it."""

    def build(self) -> StuckValve:
        """Return it in SI."""
        side = 0 if self.chamber == "plus" else 1
        return StuckValve(self.segment, side, 1 if self.stuck == "open" else -1, self.from_s)


FaultFile = Annotated[DeadSensorFile | StuckValveFile, Field(discriminator="kind")]


class SupplyFile(Section):
    """Compressed air."""

    pressure_kpa: float | None = quantity(0.1, 2000.0, None)
    """Supply pressure, gauge (default: the robot's nominal one)."""
    allow_overpressure: bool = False
    """The same as allow_overpressure of the scenario."""


class PneumaticsFile(Section):
    """Valves and chambers."""

    constructors = (make_pneumatics, OrificePneumatics)
    only = {
        ("kind", "orifice"): ("critical_ratio", "flow_limit_l_per_min", "line_volume_ml", "line_begins_kpa")
    }

    kind: Literal["lag", "orifice"] = "lag"
    """How chambers fill; lag: exponentially, with tau_1; orifice: compressible flow (ISO 6358) into
    chambers that grow as they bend, from one supply."""
    leak_per_s: float = quantity(0.0, 100.0)
    """Share of its pressure that a held chamber loses a second."""
    valve_delay_s: float = quantity(0.0, 1.0)
    """How much later than commanded a valve switches, besides tau_2."""
    critical_ratio: float | None = quantity(0.0, 0.8, None)
    """Critical pressure ratio of the valves (orifice; default {default:g})."""
    flow_limit_l_per_min: float | None = quantity(0.01, 1e4)
    """Most that the supply delivers, measured at ambient pressure (orifice; default: no limit)."""
    line_volume_ml: float | None = quantity(1.0, 1e6, None)
    """Volume between a limited supply and the inlets (orifice; default {default:g})."""
    line_begins_kpa: float | None = quantity(0.0, 2000.0)
    """Pressure in that line at first, gauge (orifice; default: the supply's)."""

    @model_validator(mode="after")
    def _line_is_limited(self) -> PneumaticsFile:
        given = [key for key in ("line_volume_ml", "line_begins_kpa") if getattr(self, key) is not None]
        if given and self.flow_limit_l_per_min is None:
            raise ValueError(f"{given[0]} is felt only with flow_limit_l_per_min; give that too")
        return self

    def resolved(self) -> PneumaticsFile:
        """Return the section with the defaults written out that matter."""
        if self.kind == "lag":
            return self
        limited = self.flow_limit_l_per_min is not None
        return self.with_defaults("critical_ratio", *(["line_volume_ml"] if limited else []))

    def chambers(self, robot: RobotSpec, supply_pa: float, layout: str) -> Pneumatics:
        """Return fresh chambers of a robot."""
        return make_pneumatics(spec=robot, supply_pa=supply_pa, layout=layout, **self.arguments())


class ValvesFile(Section):
    """The valves of each chamber."""

    layout: Literal["3/2", "in_out"] | None = None
    """3/2: one valve, which fills or vents; in_out: an inlet and an outlet valve, which can hold as well
    (default: what the controller drives)."""


class ComparisonFile(Section):
    """How the plants are compared."""

    gap_factor: bool = False
    """Multiply the analytical speed by (l + L_o)/l, as the dissertation does for its model without rigid
    gaps (Section 3.4.2); the analytical plant must have gaps: false."""


CONTROLLERS = (*CORE_CONTROLLERS, *(section for _, section in objects(extensions.CONTROLLERS)))
"""Sections of all controllers, those of the installed extensions included."""

if TYPE_CHECKING:
    ControllerFile = ControllerSection
else:
    ControllerFile = Annotated[reduce(or_, CONTROLLERS), Field(discriminator="kind")]


class CoreScenarioFile(Section):
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
    record_hz: float = quantity(LEAST_RECORD_HZ, MOST_RECORD_HZ, 100.0)
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
    world: WorldFile = WorldFile()
    """Obstacles, bounds and goal."""
    plants: PlantsFile = PlantsFile(analytical=AnalyticalFile(), twin=TwinFile())
    """Which plants run (default: both)."""
    comparison: ComparisonFile = ComparisonFile()
    """How the plants are compared."""
    expect: Annotated[list[Expectation], Field(max_length=200)] = []
    """What must come out."""
    changes: Annotated[list[ChangedField], Field(max_length=1000)] | None = None
    """Fields that were changed by --set and the like; a run writes them into scenario.resolved.yaml."""

    elsewhere: ClassVar[dict[str, str]] = {
        key: f"robot.{key}" for key in RobotFile.model_fields if key not in ("name", "title", "supply")
    }

    def tick(self, plant: str) -> float:
        """Return the control tick of a plant, whether the file names it or not, s."""
        section = getattr(self.plants, plant)
        suits = BENCH_TICK_S if self.bench else self.controller.gait_section.tick or TICK_S
        return suits if section is None or section.tick_s is None else float(section.tick_s)

    def section(self, name: str) -> Any:
        """Return a section of an extension by its name, None where the file has none."""
        return getattr(self, name, None)

    def sections(self) -> dict[str, ExtensionSection]:
        """Return name → section of the sections of extensions that the file has."""
        given = {name: self.section(name) for name in section_entries()}
        return {name: section for name, section in given.items() if section is not None}


if TYPE_CHECKING:
    ScenarioFile = CoreScenarioFile
else:
    ScenarioFile = create_model(
        "ScenarioFile",
        __base__=CoreScenarioFile,
        __module__=__name__,
        __doc__=CoreScenarioFile.__doc__,
        **{
            name: (entry.annotation, Field(None, title=entry.description, description=entry.description))
            for name, entry in section_entries().items()
        },
    )
