"""Consistency checks between validated sections of a scenario."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain

import numpy as np

from srs_twin.comparison.metrics import MEASURED_UNITS
from srs_twin.control.gait import Gait
from srs_twin.control.replay import HoldValves
from srs_twin.errors import (
    InputError,
    SamplingGrid,
    TimeStepError,
    count_steps,
    nearest_rate,
)
from srs_twin.io.documents import Document, Loc
from srs_twin.plants.analytical.options import AnalyticalOptions
from srs_twin.plants.base import refusals
from srs_twin.plants.clearance import (
    PENETRATION_M,
    TOUCHING_M,
    collision_lines,
    start_overlaps,
)
from srs_twin.plants.twin.mjcf.numerics import ModelSettings
from srs_twin.plants.twin.mjcf.rules import coupling_violations, violations
from srs_twin.pneumatics.base import Pneumatics
from srs_twin.pneumatics.chambers import largest_bend
from srs_twin.robot.file import SERVO_PRESSURE_KPA, RobotFile
from srs_twin.robot.geometry import body_shape, relative_headings
from srs_twin.robot.plausibility import likely_unit
from srs_twin.robot.rules import Violation
from srs_twin.robot.sourced import split_unit
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import World
from srs_twin.scenario.fields import Contradiction, Loading
from srs_twin.scenario.file import (
    LEAST_RECORD_HZ,
    MOST_RECORD_HZ,
    ScenarioFile,
    StuckValveFile,
)
from srs_twin.scenario.plants import PlantFile, TwinFile
from srs_twin.scenario.start import InitialState
from srs_twin.scenario.world import WorldFile

_ROUNDING = 1.001
"""Tolerance factor on pressure limits, which allows for rounding in unit conversions.
For example, 7 psi is 48.26 kPa but is often rounded to 48.3 kPa."""


_DOUBTFUL = 20.0
"""Factor between supply pressure and nominal pressure above which a message suggests
another unit. One shipped scenario uses a tenth of the nominal pressure."""

_PSI_KPA = 6.894757

_PSI_TOLERANCE = 0.1
"""Relative tolerance for recognising a pressure that was entered in psi instead of kPa.
"""


def check(
    document: Document, file: ScenarioFile, world: World, robot: RobotFile | None
) -> None:
    """Report contradictions between the sections of a scenario.

    The argument `robot` is None if the robot is invalid.
    """
    spec = None if robot is None else robot.spec()
    sections = [
        section.contradictions_with(file) for section in file.sections().values()
    ]
    own = (
        _times(file),
        file.start.contradictions(),
        _bench(file),
        _refusals(file, world, spec),
        _options(file, spec),
        _expectations(file),
        _gap_factor(file),
        _world(file),
        _faults(file),
    )
    _report(document, chain(*own, file.controller.contradictions_with(file), *sections))


def _report(document: Document, contradictions: Iterable[Contradiction]) -> None:
    for loc, text, at_key in contradictions:
        document.report(loc, text, at_key=at_key)


def _refusals(
    file: ScenarioFile, world: World, spec: RobotSpec | None
) -> Iterator[Contradiction]:
    for kind, plant in file.plants.running.items():
        key = plant.kind_key
        for refusal in refusals(key, getattr(plant, key), spec, world):
            yield _placed(kind, plant, refusal)


def _options(file: ScenarioFile, spec: RobotSpec | None) -> Iterator[Contradiction]:
    plant = file.plants.analytical
    if plant is not None:
        options = AnalyticalOptions(base=_base(file), **plant.arguments())
        for violation in options.violations(spec):
            yield _placed("analytical", plant, violation)


def _twin(file: ScenarioFile, spec: RobotSpec, world: World) -> Iterator[Contradiction]:
    twin = file.plants.twin
    if twin is not None:
        settings = ModelSettings(base=_base(file), **twin.arguments())
        for violation in violations(spec, settings, world):
            yield _placed("twin", twin, violation)


def _base(file: ScenarioFile) -> str:
    return "clamped" if file.bench else "free"


def _placed(kind: str, plant: PlantFile, violation: Violation) -> Contradiction:
    parameter, text = violation
    keys = {split_unit(key)[0]: key for key in type(plant).model_fields}
    if parameter in keys:
        return Contradiction(("plants", kind, keys[parameter]), text)
    if parameter == "spec":
        return Contradiction(("robot",), text)
    if parameter in WorldFile.model_fields:
        return Contradiction(("world", parameter), text)
    return Contradiction((parameter,), text, at_key=True)


def check_supply_pressure(document: Document, robot: RobotFile) -> list[str]:
    """Check the supply pressure against the limit of the robot and return warnings.

    A pressure above the limit is reported as a problem, or returned as a warning if the
    scenario allows overpressure. The check reads the raw document, so it also works if
    other keys are invalid.
    """
    loc = ("supply", "pressure_kpa")
    pressure = document.get(*loc)
    supply = robot.supply
    if supply is None:
        if pressure not in (None, SERVO_PRESSURE_KPA):
            document.report(
                loc,
                f"{robot.name} has servos and therefore no supply pressure;"
                " remove this key",
            )
        return []
    is_number = isinstance(pressure, (int, float)) and not isinstance(pressure, bool)
    if not is_number or not math.isfinite(pressure):
        return []
    limit = supply.pulsed_limit_kpa
    highest = limit.value
    use = "in pulses of a gait"
    if document.get("controller", "kind") == HoldValves.kind:
        limit = supply.continuous_limit_kpa
        highest = limit.value * _ROUNDING
        use = "if valves stay open"
    nominal = supply.nominal_kpa.value
    hint = _unit_hint(pressure, nominal)
    if pressure <= highest:
        text = f"{pressure:g} kPa is far below the nominal pressure {nominal:g} kPa of"
        text += f" {robot.name}{hint}"
        return [document.describe(loc, text)] if hint else []
    text = (
        f"{pressure:g} kPa is above the limit of {robot.name} {use}, which is"
        f" {limit.value:g} kPa ({limit.source})"
    )
    if True in (
        document.get("allow_overpressure"),
        document.get("supply", "allow_overpressure"),
    ):
        return [f"supply.pressure_kpa: {text}"]
    document.report(
        loc, f"{text}; lower the pressure, or set `allow_overpressure: true`{hint}"
    )
    return []


def _unit_hint(pressure: float, nominal: float) -> str:
    """Return a hint on the unit of an implausible pressure (kPa), or an empty text."""
    in_psi = abs(pressure * _PSI_KPA / nominal - 1) < _PSI_TOLERANCE
    plausible = 1 / _DOUBTFUL < pressure / nominal < _DOUBTFUL and not in_psi
    if pressure <= 0 or plausible:
        return ""
    return f"; {likely_unit(pressure, 'kPa', nominal)}"


def check_robot(
    document: Document, file: ScenarioFile, world: World, robot: RobotFile
) -> None:
    """Report faults, sensors and time steps that the robot does not support."""
    segments = robot.geometry.connectors.value - 1
    for k, fault in enumerate(file.faults):
        if fault.segment > segments:
            text = (
                f"segment {fault.segment} does not exist; {robot.name} has {segments}"
                " segments"
            )
            document.report(("faults", k, "segment"), text)
    with document.report_errors("sensor"):
        file.sensor.sensor(robot.spec())
    _report(
        document,
        chain(
            _kinds(file, robot),
            _contact(file, robot),
            _twin(file, robot.spec(), world),
        ),
    )


def check_start(
    file: ScenarioFile, loading: Loading, initial_state: InitialState | None
) -> None:
    """Report overlaps of the body, obstacles and objects in the initial state."""
    world = loading.world
    if file.bench or not world.is_solid:
        return
    spec = loading.robot.spec(file.seed)
    pose = file.start.build()
    allowed = TOUCHING_M
    if file.start.run is not None:
        allowed = PENETRATION_M * spec.scale.length
    texts: dict[Loc, str] = {}
    for kind, plant in file.plants.running.items():
        com = np.array([pose.x, pose.y])
        heading = pose.heading
        bend = spec.modules.array("bias")
        if initial_state is not None:
            state = initial_state.states[kind]
            com = state.com
            heading = state.heading
            bend = state.bend
        robot = spec
        if not plant.gaps:
            robot = replace(spec, geometry=replace(spec.geometry, rigid_gap=0.0))
        hinges = getattr(plant, "hinges_per_segment", 2)
        lines = _outline(robot, com, heading, bend, hinges)
        half_width = spec.geometry.width / 2
        for overlap in start_overlaps(world, lines, half_width, allowed=allowed):
            loc = file.world.place_of(overlap.number, world)
            text = overlap.text
            if len(loc) < 2:
                # Obstacles placed at random or read from a map have no individual key.
                text = f"{overlap.name} {text}"
            texts.setdefault(loc, text)
    for loc, text in texts.items():
        loading.document.report(("world", *loc), text)


def _outline(
    spec: RobotSpec, com: np.ndarray, heading: float, bend: np.ndarray, hinges: int
) -> np.ndarray:
    geometry = spec.geometry
    shape = body_shape(
        bend, spec.mass.array(), geometry.segment_length, geometry.rigid_gap
    )
    cos = math.cos(heading)
    sin = math.sin(heading)
    position = com + shape @ np.array([[cos, sin], [-sin, cos]])
    theta = heading + relative_headings(bend)
    return collision_lines(position[None], theta[None], geometry, hinges)


def _kinds(file: ScenarioFile, robot: RobotFile) -> Iterator[Contradiction]:
    if robot.is_spatial:
        yield from _spatial(file, robot)
    if robot.has_servos and file.pneumatics.kind != "lag":
        text = (
            f"{robot.name} has servos, which only the pneumatic model `lag` represents;"
            " use `lag`"
        )
        yield Contradiction(("pneumatics", "kind"), text)


def _contact(file: ScenarioFile, robot: RobotFile) -> Iterator[Contradiction]:
    if not robot.has_skin:
        return
    for kind, plant in file.plants.running.items():
        for key in plant.wheel_keys:
            if key in plant.model_fields_set:
                reason = (
                    "has a skin, and its own key `contact.law` sets the friction law"
                )
                yield Contradiction(
                    ("plants", kind, key),
                    f"{robot.name} {reason}; remove this key",
                    at_key=True,
                )


def _spatial(file: ScenarioFile, robot: RobotFile) -> Iterator[Contradiction]:
    if file.start.moves:
        text = (
            f"{robot.name} is spatial and must start straight and at rest; set only"
            " the pose in `start`"
        )
        yield Contradiction(("start",), text, at_key=True)
    if file.pneumatics.kind != "lag":
        yield Contradiction(
            ("pneumatics", "kind"),
            f"{robot.name} is spatial, which only the pneumatic model `lag` supports;"
            " use `lag`",
        )


def check_controller(file: ScenarioFile, loading: Loading) -> None:
    """Set the valve layout, and report a controller that does not fit the scenario."""
    document = loading.document
    spec = loading.robot.spec()
    controller = file.controller
    try:
        loading.warnings += list(
            controller.warnings(largest_bend(spec, loading.supply_pa))
        )
    except InputError as error:
        document.report(
            ("controller", "reference"), f"{error} (with `beyond_range: saturate`)"
        )
    if spec.is_spatial and not any(
        getattr(each, "spatial", False) for each in controller.constructors
    ):
        document.report(
            ("controller", "kind"),
            f"the controller is not allowed, because {spec.name} is spatial; use the"
            f" controller `{Gait.kind}`",
        )
    possible = controller.layouts(loading.products)
    loading.layout = layout = file.valves.layout or possible[0]
    if layout not in possible:
        reason = "it never holds the air in a chamber"
        if layout == "3/2":
            reason = (
                "3/2 valves cannot hold the air in a chamber, as this controller"
                " requires"
            )
        text = (
            f"the controller `{controller.kind}` needs valves of layout"
            f" {', '.join(possible)}, not {layout}, because {reason}"
        )
        document.report(("valves", "layout"), text)
    with document.report_errors("pneumatics"):
        chambers = file.pneumatics.chambers(spec, loading.supply_pa, layout)
        _report(document, _coupling_step(file, chambers))
    for kind in file.plants.running:
        try:
            controller.check(spec, file.tick(kind))
        except InputError as error:
            document.report(("controller",), f"on the {kind} plant: {error}")


def _coupling_step(file: ScenarioFile, chambers: Pneumatics) -> Iterator[Contradiction]:
    twin = file.plants.twin
    if twin is not None:
        for violation in coupling_violations(twin.timestep_s, chambers):
            yield _placed("twin", twin, violation)


def _times(file: ScenarioFile) -> Iterator[Contradiction]:
    for kind, plant in file.plants.running.items():
        tick = file.tick(kind)
        interval = 1 / file.record_hz
        tick_name = f"the {kind} plant's tick"
        key: tuple[str, ...] = ("plants", kind, "tick_s")
        try:
            if isinstance(plant, TwinFile):
                count_steps("tick", tick, "time step", plant.timestep_s)
            key = ("duration_s",)
            count_steps("duration", file.duration_s, tick_name, tick)
            key = ("record_hz",)
            if interval > tick:
                count_steps("recording interval", interval, tick_name, tick)
            else:
                count_steps(tick_name, tick, "recording interval", interval)
                if isinstance(plant, TwinFile):
                    count_steps(
                        "recording interval",
                        interval,
                        "the twin's time step",
                        plant.timestep_s,
                    )
        except TimeStepError as error:
            text = str(error)
            if key == ("record_hz",):
                text = f"{error.problem}; {_rate_remedy(file)}"
            yield Contradiction(key, text)


def _step(plant: PlantFile) -> float | None:
    """Return the time step (s) of which the tick must be a multiple, or None."""
    if isinstance(plant, TwinFile):
        return plant.timestep_s
    return None


def _rate_remedy(file: ScenarioFile) -> str:
    clocks = [
        SamplingGrid(file.tick(kind), _step(plant))
        for kind, plant in file.plants.running.items()
    ]
    rate = nearest_rate(file.record_hz, clocks, LEAST_RECORD_HZ, MOST_RECORD_HZ)
    if rate is None:
        return "no rate fits the ticks of the plants; change `tick_s`"
    return f"use `record_hz: {rate}`"


def _bench(file: ScenarioFile) -> Iterator[Contradiction]:
    if not file.bench:
        return
    if "start" in file.model_fields_set:
        yield Contradiction(
            ("start",),
            "a robot on a bench is clamped and has no start pose; remove `start` or"
            " `bench`",
            at_key=True,
        )
    for kind, plant in file.plants.running.items():
        for key in plant.floor_keys:
            if key in plant.model_fields_set:
                text = (
                    "this key describes the floor, but a robot on a bench touches"
                    " no floor; remove this key, or `bench: true`"
                )
                yield Contradiction(("plants", kind, key), text, at_key=True)


def _world(file: ScenarioFile) -> Iterator[Contradiction]:
    world = file.world
    plants = file.plants
    if (
        world.random
        and world.random.kind == "strewn"
        and not (world.random.area or world.bounds)
    ):
        yield Contradiction(
            ("world", "random"),
            "obstacles of kind `strewn` need an area; set `area`, or `bounds` of the"
            " world",
        )
    if world.pegs and plants.analytical and not plants.analytical.contact:
        text = (
            "the analytical plant must be able to touch the pegs; set `model:"
            " compliant` and `contact: true`"
        )
        yield Contradiction(("plants", "analytical"), text)


def _faults(file: ScenarioFile) -> Iterator[Contradiction]:
    for k, fault in enumerate(file.faults):
        for earlier in file.faults[:k]:
            # At its start, a fault replaces the faults before it in the list.
            if (
                isinstance(earlier, StuckValveFile)
                and isinstance(fault, StuckValveFile)
                and fault.segment == earlier.segment
                and fault.chamber == earlier.chamber
                and fault.stuck != earlier.stuck
                and fault.from_s <= earlier.from_s
            ):
                text = (
                    f"this fault hides an earlier entry (stuck {earlier.stuck} from"
                    f" {earlier.from_s:g} s); remove one, or sort them by `from_s`"
                )
                yield Contradiction(("faults", k), text)


def _expectations(file: ScenarioFile) -> Iterator[Contradiction]:
    measured = any(section.measures for section in file.sections().values())
    for i, item in enumerate(file.expect):
        if item.metric in MEASURED_UNITS and not measured:
            yield Contradiction(
                ("expect", i, "metric"),
                f"the metric `{item.metric}` compares with a recording; add"
                " the section `recording`",
            )
        if item.plant and item.plant not in file.plants.running:
            yield Contradiction(
                ("expect", i, "plant"),
                f"the plant `{item.plant}` does not run here; add it to `plants`",
            )
        if item.of and len(file.plants.running) < 2:
            yield Contradiction(
                ("expect", i, "of"),
                "a comparison needs both plants; add the other one to `plants`",
            )


def _gap_factor(file: ScenarioFile) -> Iterator[Contradiction]:
    analytical = file.plants.analytical
    twin = file.plants.twin
    key = ("comparison", "gap_factor")
    if not file.comparison.gap_factor:
        return
    if analytical is None or twin is None:
        yield Contradiction(
            key, "a comparison needs both plants; add the other one to `plants`"
        )
    elif analytical.gaps:
        text = (
            "the analytical plant already has the rigid gaps in its geometry; set"
            " `plants.analytical.gaps: false`"
        )
        yield Contradiction(key, text)
