"""From a scenario file to a Scenario, with everything that is wrong reported at once."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from srs_twin.documents import Document, load_yaml
from srs_twin.errors import InputFileError, TimeStepError, whole_steps
from srs_twin.files import find, results_name
from srs_twin.robot_file import PA_PER_KPA, RobotFile
from srs_twin.robots import resolve_robot
from srs_twin.scenario.expectation import COMPARISON, Expectation
from srs_twin.scenario.file import PLANTS, ExpectationFile, PneumaticsFile, ScenarioFile, TwinFile, WorldFile
from srs_twin.scenario.scenario import (
    AnalyticalSettings,
    GaitSettings,
    PlantSettings,
    PneumaticsSettings,
    Scenario,
    TwinSettings,
)
from srs_twin.validation import validate
from srs_twin.world import Bounds, Circle, Goal, World

L_PER_MIN = 60_000.0
ML = 1e6
"""Litres a minute in a cubic metre a second, millilitres in a cubic metre."""


def load_scenario(name_or_path: str | os.PathLike[str]) -> Scenario:
    """Load a scenario: a shipped name (gen2_straight) or the path of a scenario file.

    Raises:
        InputError: not found or not readable.
        InputFileError: everything that is wrong with it, one line each.
    """
    path = find("scenario", name_or_path)
    return _scenario(load_yaml(path), results_name(path))


def parse_scenario(data: Mapping[str, Any], *, name: str = "scenario") -> Scenario:
    """Make a scenario of plain data, as `Scenario.document` holds them.

    Raises:
        InputFileError: everything that is wrong with them; lines have no line numbers.
    """
    return _scenario(Document(name, data), name)


def _scenario(document: Document, name: str) -> Scenario:
    file = validate(ScenarioFile, document, document.data)
    robot, foreign = _robot(document)
    warnings = _overpressure(document, robot) if robot else []
    if file:
        _check_times(document, file)
        if robot:
            _check_damping(document, file, robot)
        _check_expectations(document, file)
        _check_gap_factor(document, file)
    document.finish(foreign)
    assert file is not None and robot is not None, "no problem was reported"
    if file.world != WorldFile():
        warnings.append("world: read and checked, but no plant or controller takes notice of it yet")
    return _build(file, robot, file.name or name, tuple(warnings))


def _robot(document: Document) -> tuple[RobotFile | None, tuple[str, ...]]:
    """Return the robot, and what is wrong with a robot file of its own."""
    given = document.get("robot")
    if given is None and document.known(("robot",)) == ():
        return None, ()
    try:
        return resolve_robot(document, given, prefix=("robot",)), ()
    except InputFileError as error:
        return None, error.lines


def _overpressure(document: Document, robot: RobotFile) -> list[str]:
    """Refuse a supply pressure above the robot's limit, or warn of it where it was allowed.

    This looks at the document itself, so that the pressure is judged even where another key is wrong.
    """
    given, limit = document.get("supply", "pressure_kpa"), robot.supply.pulsed_limit_kpa
    number = isinstance(given, (int, float)) and not isinstance(given, bool) and math.isfinite(given)
    if not number or given <= limit.value:
        return []
    text = (
        f"{given:g} kPa is above the {limit.value:g} kPa that {robot.name} may be given in pulses, as a gait "
        f"gives it ({limit.source})"
    )
    if True in (document.get("allow_overpressure"), document.get("supply", "allow_overpressure")):
        return [f"supply.pressure_kpa: {text}"]
    document.report(("supply", "pressure_kpa"), f"{text}; lower it, or set allow_overpressure: true")
    return []


def _check_times(document: Document, file: ScenarioFile) -> None:
    for kind in PLANTS:
        plant = getattr(file.plants, kind)
        if plant is None:
            continue
        key, interval = "duration_s", 1 / file.record_hz
        try:
            whole_steps("duration", file.duration_s, f"the {kind} plant's tick", plant.tick_s)
            key = "record_hz"
            if interval > plant.tick_s:
                whole_steps("recording interval", interval, f"the {kind} plant's tick", plant.tick_s)
            else:
                whole_steps(f"the {kind} plant's tick", plant.tick_s, "recording interval", interval)
                if isinstance(plant, TwinFile):
                    whole_steps("recording interval", interval, "the twin's time step", plant.timestep_s)
        except TimeStepError as error:
            document.report((key,), str(error))


def _check_damping(document: Document, file: ScenarioFile, robot: RobotFile) -> None:
    """The twin's integrator needs steps shorter than its segments' damping times (`mjcf.robot_mjcf`)."""
    bending = robot.bending
    shortest = min(bending.damping_time_s.value, bending.out_of_plane_damping_time_s.value)
    twin = file.plants.twin
    if twin is not None and not twin.timestep_s < shortest:
        document.report(
            ("plants", "twin", "timestep_s"),
            f"{twin.timestep_s:g} s is too long for a robot whose damping times reach down to {shortest:g} s "
            "(bending.damping_time_s, out_of_plane_damping_time_s); it must be shorter",
        )


def _check_expectations(document: Document, file: ScenarioFile) -> None:
    runs = {kind for kind in PLANTS if getattr(file.plants, kind)}
    for i, each in enumerate(file.expect):
        if each.plant and each.plant not in runs:
            document.report(("expect", i, "plant"), f"{each.plant} does not run here; add it to plants")
        if each.of and len(runs) < 2:
            document.report(("expect", i, "of"), "a comparison needs both plants; add the other to plants")


def _check_gap_factor(document: Document, file: ScenarioFile) -> None:
    """The dissertation's factor stands for gaps that the model does not have."""
    analytical, twin = file.plants.analytical, file.plants.twin
    if not file.comparison.gap_factor:
        return
    if analytical is None or twin is None:
        document.report(
            ("comparison", "gap_factor"), "a comparison needs both plants; add the other to plants"
        )
    elif analytical.gaps:
        document.report(
            ("comparison", "gap_factor"),
            "the analytical plant has the gaps in its geometry already; set plants.analytical.gaps: false",
        )


def _build(file: ScenarioFile, robot: RobotFile, name: str, warnings: tuple[str, ...]) -> Scenario:
    pressure_kpa = file.supply.pressure_kpa
    if pressure_kpa is None:
        pressure_kpa = robot.supply.nominal_kpa.value
    gait, start, title = file.controller, file.start, file.title or name
    allow_overpressure = file.allow_overpressure or file.supply.allow_overpressure
    pneumatics, pneumatics_document = _pneumatics(file.pneumatics)
    document = file.model_dump(mode="json", exclude_none=True) | {
        "name": name,
        "title": title,
        "robot": robot.model_dump(mode="json"),
        "supply": {"pressure_kpa": pressure_kpa},
        "pneumatics": pneumatics_document,
        "allow_overpressure": allow_overpressure,
    }
    return Scenario(
        name=name,
        title=title,
        robot=robot.spec(),
        duration=file.duration_s,
        seed=file.seed,
        record_hz=file.record_hz,
        supply_pa=pressure_kpa * PA_PER_KPA,
        pneumatics=pneumatics,
        allow_overpressure=allow_overpressure,
        controller=GaitSettings(gait.frequency_hz, gait.offset, gait.phase_rad, gait.phase_step_rad),
        pose=(start.x_m, start.y_m, start.heading_rad),
        world=_world(file.world),
        plants=_plants(file),
        gap_factor=file.comparison.gap_factor,
        expect=tuple(_expectation(each) for each in file.expect),
        document=document,
        warnings=warnings,
    )


def _pneumatics(file: PneumaticsFile) -> tuple[PneumaticsSettings, dict[str, Any]]:
    """Return the chambers' settings, and what a file with all defaults written out says of them."""
    settings = PneumaticsSettings(file.kind, file.leak_per_s, file.valve_delay_s)
    document = file.model_dump(exclude_none=True)
    if file.critical_ratio is not None:
        settings = replace(settings, critical_ratio=file.critical_ratio)
    elif file.kind == "orifice":
        document["critical_ratio"] = settings.critical_ratio
    if file.flow_limit_l_per_min is not None:
        settings = replace(settings, flow_limit=file.flow_limit_l_per_min / L_PER_MIN)
        if file.line_volume_ml is None:
            document["line_volume_ml"] = round(settings.line_volume * ML, 6)
        else:
            settings = replace(settings, line_volume=file.line_volume_ml / ML)
    return settings, document


def _plants(file: ScenarioFile) -> dict[str, PlantSettings]:
    plants: dict[str, PlantSettings] = {}
    if model := file.plants.analytical:
        plants["analytical"] = AnalyticalSettings(
            gaps=model.gaps,
            timestep=model.timestep_s,
            tick=model.tick_s,
            model=model.model,
            friction=model.friction,
            slip_speed=model.slip_speed_m_s,
            friction_torque=model.friction_torque,
            inertia=model.inertia,
        )
    if twin := file.plants.twin:
        plants["twin"] = TwinSettings(
            gaps=twin.gaps,
            timestep=twin.timestep_s,
            tick=twin.tick_s,
            wheels=twin.wheels,
            hinges_per_segment=twin.hinges_per_segment,
        )
    return plants


def _world(file: WorldFile) -> World:
    bounds, goal = file.bounds, file.goal
    return World(
        obstacles=tuple(Circle(each.x_m, each.y_m, each.radius_m) for each in file.obstacles),
        bounds=Bounds((bounds.x_m[0], bounds.x_m[1]), (bounds.y_m[0], bounds.y_m[1])) if bounds else None,
        goal=Goal(goal.x_m, goal.y_m, goal.heading_rad, goal.radius_m) if goal else None,
    )


def _expectation(file: ExpectationFile) -> Expectation:
    of = file.plant or COMPARISON
    low = -math.inf if file.above is None else file.above
    high = math.inf if file.below is None else file.below
    if file.near is not None:
        tolerance = file.abs if file.abs is not None else (file.rel or 0.0) * abs(file.near)
        low, high = file.near - tolerance, file.near + tolerance
    return Expectation(file.metric, of, low, high, file.near, file.source)
