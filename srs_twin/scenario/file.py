"""Pydantic model of scenario files: keys with units, bounds and descriptions."""

from __future__ import annotations

import math
from collections.abc import Container
from functools import cache, reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, get_args

from pydantic import Field, WithJsonSchema, create_model, model_validator

from srs_twin.extensions import CONTROLLERS, SECTIONS, installed, load, objects
from srs_twin.plants.base import TICK_S
from srs_twin.pneumatics import Pneumatics, make_pneumatics
from srs_twin.pneumatics.orifice import OrificeOptions, OrificePneumatics
from srs_twin.pneumatics.valves import StuckValve
from srs_twin.robot.file import RobotFile
from srs_twin.robot.scale import Scale
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.controllers import CORE_CONTROLLERS, ControllerSection
from srs_twin.scenario.expectation import Expectation
from srs_twin.scenario.fields import (
    ExtensionSection,
    Line,
    Section,
    SectionEntry,
    quantity,
)
from srs_twin.scenario.modified import ChangedField
from srs_twin.scenario.plants import (
    BENCH_TICK_S,
    PLANTS,
    AnalyticalFile,
    PlantsFile,
    TwinFile,
)
from srs_twin.scenario.start import StartFile
from srs_twin.scenario.world import WorldFile
from srs_twin.sensing import DeadSensor, HallSensor, Sensor, Strip, make_sensor

LEAST_RECORD_HZ = 0.1
MOST_RECORD_HZ = 10_000.0


class SensorSection(Section):
    """Base class of sensor sections. The first constructor must build a sensor."""

    def sensor(self, robot: RobotSpec) -> Sensor:
        """Build the sensors of a robot.

        Raises:
            InputError: the sensor cannot be trimmed or calibrated.
        """
        return make_sensor(self.build_with(spec=robot), robot)


class SensorFile(SensorSection):
    """Curvature sensors."""

    constructors = (make_sensor, Strip, HallSensor)
    only = {}  # set below, because all other keys require `kind: hall`

    kind: Literal["ideal", "hall"] = "ideal"
    """Kind of sensor; "ideal" measures the exact bend. The kind "hall" models a magnet
    and a Hall element on a strip, with amplifier, analog-to-digital converter and
    linear calibration (docs/module.md#the-curvature-sensor)."""
    span_rad: float | None = quantity(0.1, 1.6, None)
    """Maximum bend for trimming and calibration (hall only; default {default:.4g})."""
    distance_mm: float | None = quantity(1.0, 50.0, None)
    """Distance between magnet and Hall element along the strip (hall only; default
    {default:g})."""
    orientation: Literal["up", "side"] | None = None
    """Orientation of the magnet's north pole (hall only, default up)."""
    chamber: Literal["semicircular", "rectangular"] | None = None
    """Cross-section of the pressure chambers (hall only, default semicircular); a
    rectangular chamber presses on the strip."""
    noise_uv: float | None = quantity(0.0, 1e5, None)
    """RMS noise of the Hall element within the bandwidth of the amplifier (hall only;
    default {default:g})."""
    bits: int | None = quantity(1, 32, None)
    """Resolution of the analog-to-digital converter in bits (hall only; default
    {default})."""
    bias_v: float | None = quantity(-5.0, 5.0, None)
    """Output voltage drift since the calibration (hall only; default {default:g})."""
    gain_error: float | None = quantity(-0.9, 10.0, None)
    """Relative gain drift since the calibration (hall only; default {default:g})."""

    def written(self) -> dict[str, object]:
        """Return the section as plain data with explicit defaults."""
        keys = self.only["kind", "hall"] if self.kind == "hall" else ()
        return self.with_defaults(*keys).model_dump(exclude_none=True)


SensorFile.only["kind", "hall"] = tuple(
    key for key in SensorFile.model_fields if key != "kind"
)


class _FaultFile(Section):
    segment: int = quantity(1, 63)
    """Segment number (counted from 1 at the head)."""
    from_s: float = quantity(0.0, 3600.0, 0.0)
    """Start time of the fault."""


class DeadSensorFile(_FaultFile):
    """Curvature sensor that no longer responds to the bend."""

    kind: Literal["dead_sensor"]
    """Kind of fault."""
    reading_rad: float | None = quantity(-6.3, 6.3, None)
    """Constant reading of the dead sensor (default: no reading)."""

    def build(self) -> DeadSensor:
        """Return the fault in SI units."""
        reading = math.nan if self.reading_rad is None else self.reading_rad
        return DeadSensor(self.segment, reading, self.from_s)


class StuckValveFile(_FaultFile):
    """Inlet valve that no longer switches."""

    kind: Literal["stuck_valve"]
    """Kind of fault."""
    chamber: Literal["plus", "minus"]
    """Chamber whose valve is stuck."""
    stuck: Literal["open", "closed"]
    """State of the stuck valve; an open valve always fills the chamber, and a closed
    valve always vents it."""

    def build(self) -> StuckValve:
        """Return the fault in SI units."""
        side = ("plus", "minus").index(self.chamber)
        state = {"open": 1, "closed": -1}[self.stuck]
        return StuckValve(self.segment, side, state, self.from_s)


FaultFile = Annotated[DeadSensorFile | StuckValveFile, Field(discriminator="kind")]


class SupplyFile(Section):
    """Compressed air supply."""

    pressure_kpa: float | None = quantity(0.1, 2000.0, None)
    """Supply pressure, gauge (default: nominal pressure of the robot)."""
    allow_overpressure: bool = False
    """Whether a supply pressure above the robot's limit is allowed; this key is an
    alias of the top-level key allow_overpressure."""


class PneumaticsSection(Section):
    """Base class of pneumatics sections. The first constructor must build chambers."""

    def chambers(self, robot: RobotSpec, supply_pa: float, layout: str) -> Pneumatics:
        """Build the chambers of a robot."""
        chambers: Pneumatics = self.build_with(
            spec=robot, supply_pa=supply_pa, layout=layout
        )
        return chambers


class PneumaticsFile(PneumaticsSection):
    """Valves and chambers."""

    constructors = (make_pneumatics, OrificePneumatics, OrificeOptions)
    only = {
        ("kind", "orifice"): (
            "critical_ratio",
            "flow_limit_l_per_min",
            "line_volume_ml",
            "initial_line_pressure_kpa",
        )
    }

    kind: Literal["lag", "orifice"] = "lag"
    """Chamber model; "lag" is an exponential response with the time constant tau_1. The
    model "orifice" computes the compressible flow (ISO 6358) from one supply into
    chambers whose volumes depend on the bends."""
    leak_per_s: float = quantity(0.0, 100.0)
    """Relative rate of pressure loss in a chamber with closed valves."""
    valve_delay_s: float = quantity(0.0, 1.0)
    """Switching delay of the valves (in addition to tau_2)."""
    critical_ratio: float | None = quantity(0.0, 0.8, None)
    """Critical pressure ratio of the valves (orifice only; default {default:g})."""
    flow_limit_l_per_min: float | None = quantity(0.01, 1e4)
    """Maximum flow of the supply at ambient pressure (orifice only; default: no limit).
    """
    line_volume_ml: float | None = quantity(1.0, 1e6, None)
    """Line volume between a flow-limited supply and the inlets (orifice only; default
    {default:g})."""
    initial_line_pressure_kpa: float | None = quantity(0.0, 2000.0)
    """Initial gauge pressure in the line behind a flow-limited supply (orifice only;
    default: supply pressure)."""

    @model_validator(mode="after")
    def _line_is_limited(self) -> PneumaticsFile:
        present = [
            key
            for key in ("line_volume_ml", "initial_line_pressure_kpa")
            if getattr(self, key) is not None
        ]
        if present and self.flow_limit_l_per_min is None:
            raise ValueError(
                f"`{present[0]}` needs a supply with limited flow; set"
                f" `flow_limit_l_per_min`, or remove `{present[0]}`"
            )
        return self

    def written(self) -> dict[str, object]:
        """Return the section as plain data with explicit defaults."""
        keys: tuple[str, ...] = ()
        if self.kind == "orifice":
            keys = ("critical_ratio",)
            if self.flow_limit_l_per_min is not None:
                keys += ("line_volume_ml",)
        return self.with_defaults(*keys).model_dump(exclude_none=True)


class ValvesFile(Section):
    """Valves of each chamber."""

    layout: Literal["3/2", "in_out"] | None = None
    """Valve layout (default: the layout that the controller needs); "3/2" is a single
    valve that fills or vents the chamber. The layout "in_out" is a pair of inlet and
    outlet valves, which can also hold the pressure."""


class ComparisonFile(Section):
    """Options for comparing the plants."""

    gap_factor: bool = False
    """Whether the analytical speed is multiplied by (l + L_o)/l; the dissertation
    applies this factor to a model without rigid gaps (Section 3.4.2). The factor
    requires `gaps: false` for the analytical plant."""


_CORE_KINDS = {
    get_args(section.model_fields["kind"].annotation)[0]: section
    for section in CORE_CONTROLLERS
}

CONTROLLER_NAMES = (*_CORE_KINDS, *installed(CONTROLLERS))
"""Controller kinds, including those added by installed extensions."""

if TYPE_CHECKING:
    ControllerFile = ControllerSection
else:
    ControllerFile = Annotated[
        reduce(or_, CORE_CONTROLLERS), Field(discriminator="kind")
    ]


_FOLDER_NAME = Field(
    pattern=r"^[^./\x00-\x1f][^/\x00-\x1f]*$",
    json_schema_extra={
        "$comment": " that contains no slash or control character and does not begin"
        " with a dot"
    },
)


class ScenarioFile(Section):
    """Scenario file without the sections that `with_extensions` adds."""

    name: Annotated[Line, _FOLDER_NAME] | None = None
    """Name of the output folder (default: file name)."""
    title: Line | None = None
    """One-line title (default: the name)."""
    robot: Annotated[
        Any, WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "object"}]})
    ]
    """Robot; the name of a shipped robot (gen1 to gen4, gen4_module) or the path of a
    robot file. A mapping with the key base (name or path) changes fields of this robot.
    A mapping without base defines a complete robot."""
    duration_s: float = quantity(0.001, 3600.0)
    """Simulated duration."""
    seed: int = quantity(0, 2**32 - 1, 0)
    """Random seed."""
    record_hz: float = quantity(LEAST_RECORD_HZ, MOST_RECORD_HZ, 100.0)
    """Recording rate."""
    supply: SupplyFile = SupplyFile()
    """Compressed air supply."""
    pneumatics: PneumaticsFile = PneumaticsFile()
    """Valves and chambers."""
    allow_overpressure: bool = False
    """Whether a supply pressure above the robot's limit causes a warning instead of an
    error."""
    valves: ValvesFile = ValvesFile()
    """Valves of each chamber."""
    sensor: SensorFile = SensorFile()
    """Curvature sensors."""
    faults: Annotated[list[FaultFile], Field(max_length=200)] = []
    """Faults of sensors and valves."""
    bench: bool = False
    """Whether the head is clamped in the air without a floor, as on a test bench; the
    key applies to both plants."""
    controller: ControllerFile
    """Controller of the valves."""
    start: StartFile = StartFile()
    """Initial state of the snake."""
    world: WorldFile = WorldFile()
    """Obstacles, bounds and goal."""
    plants: PlantsFile = PlantsFile(analytical=AnalyticalFile(), twin=TwinFile())
    """Plants to simulate (default: both)."""
    comparison: ComparisonFile = ComparisonFile()
    """Options for comparing the plants."""
    expect: Annotated[list[Expectation], Field(max_length=200)] = []
    """Expected values of metrics."""
    changes: Annotated[list[ChangedField], Field(max_length=1000)] | None = None
    """Fields changed by --set and similar options; a run writes this list into
    scenario.resolved.yaml."""

    elsewhere: ClassVar[dict[str, str]] = {
        key: f"robot.{key}"
        for key in RobotFile.model_fields
        if key not in ("name", "title", "supply")
    } | {
        f"plants.{plant}.{key}": f"{key} (outside of `plants`)"
        for plant in PLANTS
        for key in ("controller", "pneumatics", "sensor")
    }

    def tick(self, plant: str) -> float:
        """Return the control tick (s) of a plant, even if the plant does not run."""
        section = getattr(self.plants, plant)
        if self.bench:
            default = BENCH_TICK_S
        else:
            default = self.controller.gait_section.tick or TICK_S
        if section is None or section.tick_s is None:
            return default
        return float(section.tick_s)

    def scaled_to(self, scale: Scale) -> Self:
        """Return the scenario with defaults scaled to the units of a robot."""
        plants = {}
        for kind, section in self.plants.running.items():
            tick = self.tick(kind)
            if section.tick_s is None:
                tick *= scale.time
            plants[kind] = section.scaled_to(scale, tick)
        scaled = self.model_copy()
        scaled.__dict__["world"] = self.world.scaled_to(scale)
        scaled.__dict__["plants"] = self.plants.model_copy()
        scaled.plants.__dict__.update(plants)
        return scaled

    def section(self, name: str) -> Any:
        """Return an extension section, or None if the file does not contain it."""
        return getattr(self, name, None)

    def sections(self) -> dict[str, ExtensionSection]:
        """Return the extension sections that the file contains, keyed by name."""
        return {
            name: section
            for name in SECTIONS
            if (section := self.section(name)) is not None
        }


def controller_kinds() -> dict[str, type[ControllerSection]]:
    """Return the section class of each controller kind."""
    return _CORE_KINDS | dict(objects(CONTROLLERS))


def with_extensions(
    sections: Container[str] = SECTIONS, controllers: Container[str] = CONTROLLERS
) -> type[ScenarioFile]:
    """Return the scenario model with the sections and controllers of extensions.

    By default, all installed extensions are included. The extensions are imported.
    """
    return _with_extensions(
        tuple(name for name in installed(SECTIONS) if name in sections),
        tuple(name for name in installed(CONTROLLERS) if name in controllers),
    )


@cache
def _with_extensions(
    sections: tuple[str, ...], controllers: tuple[str, ...]
) -> type[ScenarioFile]:
    fields: dict[str, Any] = {}
    if controllers:
        known = (*CORE_CONTROLLERS, *(load(CONTROLLERS[name]) for name in controllers))
        fields["controller"] = (reduce(or_, known), Field(discriminator="kind"))
    for name in sections:
        entry: SectionEntry = load(SECTIONS[name])
        text = entry.description
        fields[name] = (entry.annotation, Field(None, title=text, description=text))
    if not fields:
        return ScenarioFile
    return create_model(
        "ScenarioFile",
        __base__=ScenarioFile,
        __module__=__name__,
        __doc__="Experiment with a soft snake.",
        **fields,
    )
