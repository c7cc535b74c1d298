"""The scenario file as a strict model: keys with units, bounds, defaults, texts for editors."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, ValidationInfo, WithJsonSchema, field_validator, model_validator

from srs_twin.control.gait import SLOT_S
from srs_twin.errors import TimeStepError, UnknownNameError, whole_steps
from srs_twin.scenario.expectation import COMPARISON, known_metrics
from srs_twin.validation import Strict

PLANTS = ("analytical", "twin")


def quantity(title: str, unit: str, low: float, high: float, default: Any = ...) -> Any:
    """Return the field of a bounded number, its description made of title, unit and range."""
    text = f"{title}{f' in {unit}' if unit else ''}, {low:.10g} to {high:.10g}."
    return Field(default, title=title, description=text, ge=low, le=high)


def section(text: str, default: Any = ...) -> Any:
    """Return a field with a description."""
    return Field(default, title=text.partition(";")[0].rstrip("."), description=text)


ORIFICE_ONLY = ("critical_ratio", "flow_limit_l_per_min", "line_volume_ml")

Metres = Annotated[float, Field(ge=-1000.0, le=1000.0)]


class GaitFile(Strict):
    """Lateral undulation, open loop (Eq. 13)."""

    kind: Literal["gait"] = section("Which controller.")
    frequency_hz: float = quantity("Gait frequency", "Hz", 0.01, 50.0)
    offset: float = quantity("Steering offset, positive to the left", "", -0.95, 0.95, 0.0)
    phase_rad: float = quantity("Phase at the start", "rad", -6.3, 6.3, 0.0)
    phase_step_rad: float | None = quantity(
        "Lag of each segment behind the one before it (default: the robot's)", "rad", -6.3, 6.3, None
    )


class SupplyFile(Strict):
    """Compressed air."""

    pressure_kpa: float | None = quantity(
        "Supply pressure, gauge (default: the robot's nominal one)", "kPa", 0.1, 2000.0, None
    )
    allow_overpressure: bool = section("The same as allow_overpressure of the scenario.", False)


class PneumaticsFile(Strict):
    """Valves and chambers."""

    kind: Literal["lag", "orifice"] = section(
        "How chambers fill; lag: exponentially, with tau_1; orifice: compressible flow (ISO 6358) into "
        "chambers that grow as they bend, from one supply.",
        "lag",
    )
    leak_per_s: float = quantity(
        "Share of its pressure that a held chamber loses a second", "1/s", 0.0, 100.0, 0.0
    )
    valve_delay_s: float = quantity(
        "How much later than commanded a valve switches, besides tau_2", "s", 0.0, 1.0, 0.0
    )
    critical_ratio: float | None = quantity(
        "Critical pressure ratio of the valves (orifice; default 0.3)", "", 0.0, 0.8, None
    )
    flow_limit_l_per_min: float | None = quantity(
        "Most that the supply delivers, measured at ambient pressure (orifice; default: no limit)",
        "L/min", 0.01, 10_000.0, None,
    )  # fmt: skip
    line_volume_ml: float | None = quantity(
        "Volume between a limited supply and the inlets (orifice; default 50)", "ml", 1.0, 1e6, None
    )

    @model_validator(mode="after")
    def _what_belongs_together(self) -> PneumaticsFile:
        given = [name for name in ORIFICE_ONLY if getattr(self, name) is not None]
        if given and self.kind != "orifice":
            raise ValueError(f"{given[0]} belongs to kind: orifice; set that, or take {given[0]} out")
        if self.line_volume_ml is not None and self.flow_limit_l_per_min is None:
            raise ValueError("line_volume_ml is felt only with flow_limit_l_per_min; give that too")
        return self


class StartFile(Strict):
    """Where the snake lies at first, straight and at rest."""

    x_m: float = quantity("x of the centre of mass", "m", -1000.0, 1000.0, 0.0)
    y_m: float = quantity("y of the centre of mass", "m", -1000.0, 1000.0, 0.0)
    heading_rad: float = quantity("Mean heading, counter-clockwise from x", "rad", -6.3, 6.3, 0.0)


class ObstacleFile(Strict):
    """A round obstacle."""

    x_m: float = quantity("x of the centre", "m", -1000.0, 1000.0)
    y_m: float = quantity("y of the centre", "m", -1000.0, 1000.0)
    radius_m: float = quantity("Radius", "m", 0.001, 100.0)


class BoundsFile(Strict):
    """The rectangle that the snake is to stay in."""

    x_m: Annotated[list[Metres], Field(min_length=2, max_length=2)] = section("Lowest and highest x, m.")
    y_m: Annotated[list[Metres], Field(min_length=2, max_length=2)] = section("Lowest and highest y, m.")

    @field_validator("x_m", "y_m")
    @classmethod
    def _ordered(cls, ends: list[float]) -> list[float]:
        if not ends[0] < ends[1]:
            raise ValueError(f"the lowest comes first, but {ends[0]:g} is not below {ends[1]:g}")
        return ends


class GoalFile(Strict):
    """Where the centre of mass is to arrive."""

    x_m: float = quantity("x", "m", -1000.0, 1000.0)
    y_m: float = quantity("y", "m", -1000.0, 1000.0)
    heading_rad: float | None = quantity("Heading on arrival (default: any)", "rad", -6.3, 6.3, None)
    radius_m: float = quantity("How near is near enough", "m", 0.001, 100.0, 0.05)


class WorldFile(Strict):
    """What surrounds the snake."""

    obstacles: Annotated[list[ObstacleFile], Field(max_length=1000)] = section("Round obstacles.", [])
    bounds: BoundsFile | None = section("The rectangle to stay in.", None)
    goal: GoalFile | None = section("Where to arrive.", None)


class _PlantFile(Strict):
    """What both plants have in common."""

    gaps: bool = section("Whether the rigid gaps of the segments are part of the body.", True)
    timestep_s: float = quantity("Time step of the integrator", "s", 1e-5, 0.02, 0.001)
    tick_s: float = Field(
        default=0.02, ge=1e-5, le=1.0, title="Control tick", validate_default=True,
        description="Control tick in s, 1e-5 to 1; above 0.1 ms a multiple of it, the twin's of timestep_s.",
    )  # fmt: skip

    @field_validator("tick_s")
    @classmethod
    def _whole_slots(cls, tick: float) -> float:
        return _whole(tick, "valve slot", min(SLOT_S, tick))


def _whole(tick: float, step_name: str, step: float) -> float:
    try:
        whole_steps("tick", tick, step_name, step)
    except TimeStepError as error:
        raise ValueError(str(error)) from error
    return tick


class AnalyticalFile(_PlantFile):
    """The dissertation's planar model."""

    timestep_s: float = quantity("Longest step of the integrator", "s", 1e-5, 0.02, 0.002)
    model: Literal["complete", "simplified", "compliant"] = section(
        "complete: bends as the actuators give them; simplified: chords frozen at their straight length "
        "besides; compliant: bends that load and inertia deflect.",
        "complete",
    )
    friction_torque: bool = section(
        "Whether friction's moment about the centre of mass acts; only simplified goes without.", True
    )
    inertia: Literal["point", "connector", "lumped"] = section(
        "Of each connector about itself; point: none, connector: a compact body with two wheels, lumped: "
        "the dissertation's, which counts the segments twice.",
        "point",
    )
    friction: Literal["axis", "wheel", "viscous", "ellipse"] = section(
        "Law of the floor; axis: one point a connector (the text's), wheel: two wheels at the track, "
        "ellipse: two skids at the track, viscous: a law for tests.",
        "axis",
    )
    slip_speed_m_s: float = quantity("Slip speed below which friction is smoothed", "m/s", 1e-6, 0.1, 0.00025)

    @model_validator(mode="after")
    def _torque_is_there(self) -> AnalyticalFile:
        if not self.friction_torque and self.model != "simplified":
            raise ValueError(f"model {self.model} has a friction torque; only simplified goes without")
        return self


class TwinFile(_PlantFile):
    """The MuJoCo twin."""

    @field_validator("tick_s")
    @classmethod
    def _whole_steps(cls, tick: float, info: ValidationInfo) -> float:
        # Without a valid time step there is nothing to compare with: its own message is enough.
        return _whole(tick, "time step", info.data.get("timestep_s", tick))

    wheels: Literal["rolling", "skid"] = section(
        "What it stands on; rolling: hinge wheels (friction law wheel), skid: runners (law ellipse).",
        "rolling",
    )
    hinges_per_segment: int = quantity("Bending hinges a segment", "", 1, 32, 2)


class PlantsFile(Strict):
    """Which plants run, and how; one that is not named does not run."""

    analytical: AnalyticalFile | None = section("The analytical model; {} for its defaults.", None)
    twin: TwinFile | None = section("The MuJoCo twin; {} for its defaults.", None)

    @model_validator(mode="after")
    def _some(self) -> PlantsFile:
        empty = [name for name in PLANTS if name in self.model_fields_set and getattr(self, name) is None]
        if empty:
            raise ValueError(f"{empty[0]} has nothing after it; write '{empty[0]}: {{}}' for its defaults")
        if not self.model_fields_set:
            raise ValueError("names no plant; write 'analytical: {}', 'twin: {}' or both")
        return self


_BOUND = 1e9


class ExpectationFile(Strict):
    """What a metric must come out as: near a value (rel or abs), below or above one."""

    metric: str = Field(
        title="Metric", description="Name of the metric.", json_schema_extra={"enum": list(known_metrics())}
    )
    plant: Literal["analytical", "twin"] | None = section("Which plant's metric.", None)
    of: Literal["comparison"] | None = section("A metric of the comparison instead of a plant's.", None)
    near: float | None = quantity("The expected value", "the metric's unit", -_BOUND, _BOUND, None)
    rel: float | None = quantity("Relative tolerance of near", "", 1e-9, 100.0, None)
    abs: float | None = quantity("Absolute tolerance of near", "the metric's unit", 0.0, _BOUND, None)
    below: float | None = quantity("Highest allowed value", "the metric's unit", -_BOUND, _BOUND, None)
    above: float | None = quantity("Lowest allowed value", "the metric's unit", -_BOUND, _BOUND, None)
    source: str | None = Field(
        None,
        title="Source",
        min_length=1,
        max_length=1000,
        description="Where the value is published; none for our own.",
    )

    @field_validator("metric")
    @classmethod
    def _known(cls, metric: str) -> str:
        if metric not in known_metrics():
            raise ValueError(str(UnknownNameError("metric", metric, known_metrics())))
        return metric

    @model_validator(mode="after")
    def _one_of_each(self) -> ExpectationFile:
        if (self.plant is None) == (self.of is None):
            raise ValueError("give either plant (analytical or twin) or of: comparison")
        if self.metric not in known_metrics(self.of or self.plant):
            right = "plant: analytical or plant: twin" if self.of else f"of: {COMPARISON}"
            raise ValueError(f"{self.metric} needs {right}")
        if sum(value is not None for value in (self.near, self.below, self.above)) != 1:
            raise ValueError("give exactly one of near, below and above")
        tolerances = sum(value is not None for value in (self.rel, self.abs))
        if tolerances != (self.near is not None):
            raise ValueError("near needs either rel or abs; below and above take neither")
        if self.near == 0 and self.rel is not None:
            raise ValueError("a relative tolerance of 0 allows nothing else; use abs")
        return self


class ComparisonFile(Strict):
    """How the plants are compared."""

    gap_factor: bool = section(
        "Multiply the analytical speed by (l + L_o)/l, as the dissertation does for its model without rigid "
        "gaps (Section 3.4.2); the analytical plant must have gaps: false.",
        False,
    )


ROBOT_TEXT = (
    "The snake: a shipped name (gen1 to gen4), the path of a robot file, {base: a name or path} with fields "
    "to change, or a whole robot."
)


class ScenarioFile(Strict):
    """One experiment with a soft snake."""

    name: str | None = Field(
        None, title="Name", min_length=1, max_length=200, pattern=r"^[^./\x00-\x1f][^/\x00-\x1f]*$",
        description="Name of the results' folder (default: the file's name).",
    )  # fmt: skip
    title: str | None = Field(
        None,
        title="Title",
        min_length=1,
        max_length=200,
        description="One line for people (default: the name).",
    )
    robot: Annotated[Any, WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "object"}]})] = Field(
        title="Robot", description=ROBOT_TEXT
    )
    duration_s: float = quantity("Simulated time", "s", 0.001, 3600.0)
    seed: int = quantity("Seed of whatever is random", "", 0, 2**32 - 1, 0)
    record_hz: float = quantity("Recorded samples a second", "Hz", 0.1, 10_000.0, 100.0)
    supply: SupplyFile = section("Compressed air.", SupplyFile())
    pneumatics: PneumaticsFile = section("Valves and chambers.", PneumaticsFile())
    allow_overpressure: bool = section(
        "Let a supply pressure above the robot's limit run, with a warning.", False
    )
    controller: GaitFile = section("What commands the valves.")
    start: StartFile = section("Where the snake lies at first.", StartFile())
    world: WorldFile = section("Obstacles, bounds and goal.", WorldFile())
    plants: PlantsFile = section(
        "Which plants run (default: both).", PlantsFile(analytical=AnalyticalFile(), twin=TwinFile())
    )
    comparison: ComparisonFile = section("How the plants are compared.", ComparisonFile())
    expect: Annotated[list[ExpectationFile], Field(max_length=200)] = section("What must come out.", [])
