"""What the sections of a scenario must agree on: checked once each of them is sound."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import chain
from typing import Any

from srs_twin.comparison.metrics import MEASURED_UNITS
from srs_twin.control.replay import HoldValves
from srs_twin.errors import Clock, InputError, TimeStepError, nearest_rate, whole_steps
from srs_twin.io.documents import Document
from srs_twin.pneumatics.base import Pneumatics
from srs_twin.pneumatics.chambers import largest_bend
from srs_twin.robot.file import RobotFile
from srs_twin.scenario.file import LEAST_RECORD_HZ, MOST_RECORD_HZ, ScenarioFile
from srs_twin.scenario.plants import TwinFile

_ROUNDED = 1.001
"""A pressure stated with three digits may be that much above the limit that it means: 48.3 kPa, 7 psi."""


def check(document: Document, file: ScenarioFile) -> None:
    """Report what in a file contradicts something else in it, whatever the robot."""
    _check_times(document, file)
    for loc, text in file.start.contradictions():
        document.report(("start", *loc), text, at_key=True)
    if file.bench:
        _check_bench(document, file)
    _check_floor(document, file)
    _check_expectations(document, file)
    _check_gap_factor(document, file)
    _check_world(document, file)
    sections = [section.contradictions_with(file) for section in file.sections().values()]
    for loc, text, at_key in chain(file.controller.contradictions_with(file), *sections):
        document.report(loc, text, at_key=at_key)


def _check_floor(document: Document, file: ScenarioFile) -> None:
    """Not every plant can stand on every floor."""
    world, plants = file.world, file.plants
    if world.steps and plants.analytical is not None:
        document.report(("world", "steps"), "the analytical model's floor is a plane; only the twin climbs")
    uneven = "steps" if world.steps else "floor"
    preloaded = plants.twin is not None and plants.twin.contact == "preloaded"
    if preloaded and (world.steps or world.floor.tilt_deg):
        document.report(("world", uneven), "a twin on a floor like this needs contact: loaded (plants.twin)")


def overpressure(document: Document, robot: RobotFile) -> list[str]:
    """Refuse a supply pressure above the robot's limit, or warn of it where it was allowed.

    This looks at the document itself, so that the pressure is judged even where another key is wrong.
    """
    given = document.get("supply", "pressure_kpa")
    held = document.get("controller", "kind") == HoldValves.kind
    limit = robot.supply.continuous_limit_kpa if held else robot.supply.pulsed_limit_kpa
    number = isinstance(given, (int, float)) and not isinstance(given, bool) and math.isfinite(given)
    if not number or given <= limit.value * (_ROUNDED if held else 1.0):
        return []
    how = "for as long as valves are held open" if held else "in pulses, as a gait gives it"
    most = f"the {limit.value:g} kPa that {robot.name} may be given {how} ({limit.source})"
    text = f"{given:g} kPa is above {most}"
    if True in (document.get("allow_overpressure"), document.get("supply", "allow_overpressure")):
        return [f"supply.pressure_kpa: {text}"]
    document.report(("supply", "pressure_kpa"), f"{text}; lower it, or set allow_overpressure: true")
    return []


def check_robot(document: Document, file: ScenarioFile, robot: RobotFile) -> None:
    """Report what the robot does not allow: faults, a sensor, a time step."""
    segments = robot.geometry.connectors.value - 1
    for k, fault in enumerate(file.faults):
        if fault.segment > segments:
            text = f"{fault.segment} is not allowed; {robot.name} has {segments} segments"
            document.report(("faults", k, "segment"), text)
    with document.reporting("sensor"):
        file.sensor.sensor(robot.spec())
    # The twin's integrator needs steps shorter than its segments' damping times (`mjcf.robot_mjcf`).
    bending, twin = robot.bending, file.plants.twin
    shortest = min(bending.damping_time_s.value, bending.out_of_plane_damping_time_s.value)
    if twin is not None and not twin.timestep_s < shortest:
        document.report(
            ("plants", "twin", "timestep_s"),
            f"{twin.timestep_s:g} s is too long for a robot whose damping times reach down to {shortest:g} s "
            "(bending.damping_time_s, out_of_plane_damping_time_s); it must be shorter",
        )


def check_controller(
    document: Document, file: ScenarioFile, robot: RobotFile, supply_pa: float, products: Mapping[str, Any]
) -> tuple[str, list[str]]:
    """Return the layout of the controller's valves and warnings; report why it cannot be had."""
    spec, controller = robot.spec(), file.controller
    limit = largest_bend(spec, supply_pa)
    warnings: list[str] = []
    try:
        warnings = list(controller.warnings(limit))
    except InputError as error:
        document.report(("controller", "reference"), f"{error} (beyond_range: saturate)")
    possible = controller.layouts(products)
    layout = file.valves.layout or possible[0]
    if layout not in possible:
        why = "; 3/2 valves cannot hold" if layout == "3/2" else "; it has no use for valves that hold"
        text = f"{controller.kind} drives valves of layout {', '.join(possible)}, not {layout}{why}"
        document.report(("valves", "layout"), text)
    with document.reporting("pneumatics"):
        _check_felt(document, file, file.pneumatics.chambers(spec, supply_pa, layout))
    for kind in file.plants.running:
        try:
            controller.check(spec, file.tick(kind))
        except InputError as error:
            document.report(("controller",), f"on the {kind} plant: {error}")
    return layout, warnings


def _check_felt(document: Document, file: ScenarioFile, chambers: Pneumatics) -> None:
    """Chambers that feel how segments bend take turns with the bodies."""
    twin = file.plants.twin
    if twin is not None and chambers.feels_bend and twin.timestep_s > chambers.felt_s * (1 + 1e-9):
        document.report(
            ("plants", "twin", "timestep_s"),
            f"{twin.timestep_s:g} s is too long for these chambers, which feel how the segments bend; it "
            f"must be {chambers.felt_s:g} s or less",
        )


def _check_times(document: Document, file: ScenarioFile) -> None:
    for kind, plant in file.plants.running.items():
        tick, interval = file.tick(kind), 1 / file.record_hz
        named = f"the {kind} plant's tick"
        key: tuple[str, ...] = ("plants", kind, "tick_s")
        try:
            if isinstance(plant, TwinFile):
                whole_steps("tick", tick, "time step", plant.timestep_s)
            key = ("duration_s",)
            whole_steps("duration", file.duration_s, named, tick)
            key = ("record_hz",)
            if interval > tick:
                whole_steps("recording interval", interval, named, tick)
            else:
                whole_steps(named, tick, "recording interval", interval)
                if isinstance(plant, TwinFile):
                    whole_steps("recording interval", interval, "the twin's time step", plant.timestep_s)
        except TimeStepError as error:
            words = str(error) if key != ("record_hz",) else f"{error.fault}; {_rate_remedy(file)}"
            document.report(key, words)


def _rate_remedy(file: ScenarioFile) -> str:
    """Return the nearest recording rate that fits all plants, in words."""
    clocks = [
        Clock(file.tick(kind), plant.timestep_s if isinstance(plant, TwinFile) else None)
        for kind, plant in file.plants.running.items()
    ]
    rate = nearest_rate(file.record_hz, clocks, LEAST_RECORD_HZ, MOST_RECORD_HZ)
    return "no rate fits the plants' ticks; change tick_s" if rate is None else f"record_hz: {rate} would fit"


def _check_bench(document: Document, file: ScenarioFile) -> None:
    """On a bench there is no floor to lie on."""
    if "start" in file.model_fields_set:
        text = "what hangs on a bench starts where it is held; take one out"
        document.report(("start",), text, at_key=True)
    for kind, plant in file.plants.running.items():
        for key in plant.on_a_floor:
            if key in plant.model_fields_set:
                text = "on a bench there is no floor; take it out, or bench: true"
                document.report(("plants", kind, key), text, at_key=True)
    if file.plants.analytical and file.plants.analytical.model == "compliant":
        text = "compliant is for a free snake; on a bench the bends of complete are the free module's"
        document.report(("plants", "analytical", "model"), text)


def _check_world(document: Document, file: ScenarioFile) -> None:
    random, bounds = file.world.random, file.world.bounds
    if random and random.kind == "strewn" and not (random.area or bounds):
        document.report(("world", "random"), "where? Give area, or bounds of the world")


def _check_expectations(document: Document, file: ScenarioFile) -> None:
    measured = any(section.measures for section in file.sections().values())
    for i, each in enumerate(file.expect):
        if each.metric in MEASURED_UNITS and not measured:
            document.report(("expect", i, "metric"), f"{each.metric} needs recording")
        if each.plant and each.plant not in file.plants.running:
            document.report(("expect", i, "plant"), f"{each.plant} does not run here; add it to plants")
        if each.of and len(file.plants.running) < 2:
            document.report(("expect", i, "of"), "a comparison needs both plants; add the other to plants")


def _check_gap_factor(document: Document, file: ScenarioFile) -> None:
    """The dissertation's factor stands for gaps that the model does not have."""
    analytical, twin, key = file.plants.analytical, file.plants.twin, ("comparison", "gap_factor")
    if not file.comparison.gap_factor:
        return
    if analytical is None or twin is None:
        document.report(key, "a comparison needs both plants; add the other to plants")
    elif analytical.gaps:
        text = "the analytical plant has the gaps in its geometry already; set plants.analytical.gaps: false"
        document.report(key, text)
