"""From a scenario file to a Scenario, with everything that is wrong reported at once."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from srs_twin.errors import InputError, InputFileError, did_you_mean
from srs_twin.io.documents import Change, Document, dotted, load_yaml, path_of
from srs_twin.io.files import find, results_name
from srs_twin.io.validation import validate
from srs_twin.robot.file import PA_PER_KPA, RobotFile, far_off, resolve_robot
from srs_twin.robot.sourced import restated
from srs_twin.robot.world import World
from srs_twin.scenario.checks import (
    check,
    check_controller,
    check_robot,
    overpressure,
)
from srs_twin.scenario.file import ScenarioFile
from srs_twin.scenario.modified import changed_fields, marked
from srs_twin.scenario.plants import PRESET, with_preset
from srs_twin.scenario.scenario import Scenario
from srs_twin.scenario.sections import Loading


def load_scenario(
    name_or_path: str | os.PathLike[str], *, set: Mapping[str, Any] | Sequence[Change] = ()
) -> Scenario:
    """Load a scenario: a shipped name (gen2_straight) or the path of a scenario file.

    Args:
        name_or_path: of the scenario.
        set: dotted fields and their values instead of the file's: ``{"controller.frequency_hz": 1.5}``.

    Raises:
        InputError: not found or not readable.
        InputFileError: everything that is wrong with it, one line each.
    """
    path = find("scenario", name_or_path)
    return _scenario(load_yaml(path), results_name(path), set)


def parse_scenario(
    data: Mapping[str, Any], *, name: str = "scenario", set: Mapping[str, Any] | Sequence[Change] = ()
) -> Scenario:
    """Make a scenario of plain data, as `Scenario.document` holds them.

    Raises:
        InputFileError: everything that is wrong with them; lines have no line numbers.
    """
    return _scenario(Document(name, copy.deepcopy(dict(data)) if set else data), name, set)


def _scenario(document: Document, name: str, changes: Mapping[str, Any] | Sequence[Change]) -> Scenario:
    if isinstance(changes, Mapping):
        changes = [Change(f"set {key}={value!r}", path_of(key), value) for key, value in changes.items()]
    unmodified = copy.deepcopy(document.data) if changes else None
    for change in changes:
        _set(document, change)
    file = validate(ScenarioFile, document, document.data)
    robot, foreign = _robot(document)
    warnings = overpressure(document, robot) if robot else []
    if robot:
        warnings += [f"robot.{dotted(loc)}: {text}" for loc, text in far_off(document.get("robot"))]
    supply_pa, layout, world, begin = 0.0, "", World(), None
    products: dict[str, Any] = {}
    if file:
        with document.reporting("world", "random"):
            world = file.world.surroundings(file.start.build(), file.seed)
        check(document, file)
    if file and robot:
        check_robot(document, file, robot)
        loading = Loading(document, file, robot, world, products, warnings)
        products |= {key: section.read(loading) for key, section in file.sections().items()}
        if file.controller.is_ready(products):
            supply_pa = supply_kpa(file, robot) * PA_PER_KPA
            layout, more = check_controller(document, file, robot, supply_pa, products)
            warnings += more
        if not document.problems:
            with document.reporting("start"):
                begin = file.start.begin(robot.spec(file.seed).segments, supply_pa, file.plants.running)
        for key, section in file.sections().items():
            products[key] = products[key] or section.prepare(loading)
    document.finish(foreign)
    assert file is not None and robot is not None, "no problem was reported"
    uses_goal = any(section.uses_goal for section in file.sections().values())
    if not uses_goal and (world.goal or world.bounds):
        warnings.append(
            "world: no plant or controller takes notice of its goal and bounds; controller.kind: follow does"
        )
    resolved = _resolved(file, robot, file.name or name, layout, products)
    before = _resolved_or_raw(unmodified, products) if changes else resolved
    if changed := changed_fields(
        before, resolved, [each.loc for each in changes], document.get("changes") or ()
    ):
        resolved["changes"] = changed
    file = ScenarioFile.model_validate_json(json.dumps(resolved), strict=True)
    pose = file.start.build()
    assert file.name and file.title, "defaults are written out"
    return Scenario(
        name=file.name,
        title=marked(file.title, changed),
        robot=robot.spec(file.seed),
        duration=file.duration_s,
        seed=file.seed,
        record_hz=file.record_hz,
        supply_pa=supply_pa,
        pose=(pose.x, pose.y, pose.heading),
        begin=begin,
        world=world,
        file=file,
        document=resolved,
        warnings=tuple(warnings),
        products=products,
        source=document.name,
    )


def _set(document: Document, change: Change) -> None:
    """Put a changed value into the document."""
    _check_field(change)
    before = document.get(*change.loc)
    if isinstance(before, Mapping) and "unit" in before and not isinstance(change.value, Mapping):
        change = replace(change, value=restated(before, change.value, None, f"set by {change.words}"))
    if change.loc == PRESET and isinstance(twin := document.get(*PRESET[:-1]), Mapping):
        document.data["plants"]["twin"] = with_preset(twin, change.value)
    document.change(change)


def _resolved_or_raw(data: Any, products: Mapping[str, Any]) -> dict[str, Any]:
    """Return the plain data of a scenario with its defaults; as they are if it is incomplete."""
    document = Document("", data if isinstance(data, dict) else {})
    file, (robot, _) = validate(ScenarioFile, document, document.data), _robot(document)
    if file is None or robot is None:
        return document.data
    known = {name: products.get(name) for name in file.sections()}
    layout: str = file.valves.layout or (*file.controller.layouts(known), "")[0]
    return _resolved(file, robot, "", layout, known)


def _check_field(change: Change) -> None:
    """Refuse a field whose beginning no scenario has, with those like it."""
    first, *more = change.loc
    if first == "changes":
        raise InputError(f"{change.words}: srs_twin itself lists the changed fields; set the fields instead")
    sections = {*RobotFile.model_fields, "base"}
    if first not in ScenarioFile.model_fields or (first == "robot" and more and more[0] not in sections):
        from srs_twin.scenario.schema import field_paths

        field = dotted(change.loc)
        close = did_you_mean(field, field_paths()) or "; `srs-twin show SCENARIO` prints all"
        raise InputError(f"{change.words}: there is no field {field}{close}")


def _resolved(
    file: ScenarioFile, robot: RobotFile, name: str, layout: str, products: Mapping[str, Any]
) -> dict[str, Any]:
    """Return plain data of the same scenario with all defaults and the robot written out."""
    # The supply's own allow_overpressure is another name of the scenario's.
    left_out: Any = {"supply": {"allow_overpressure"}, "changes": True}
    left_out |= {"start": True} if file.bench else {}
    plain = file.model_dump(mode="json", exclude_none=True, exclude=left_out, by_alias=True)
    document = plain | {
        "name": name,
        "title": file.title or name,
        "robot": robot.model_dump(mode="json", exclude_none=True),
        "supply": plain["supply"] | {"pressure_kpa": supply_kpa(file, robot)},
        "pneumatics": plain["pneumatics"] | file.pneumatics.resolved().model_dump(exclude_none=True),
        "valves": plain["valves"] | {"layout": layout},
        "sensor": file.sensor.resolved().model_dump(exclude_none=True),
        "allow_overpressure": file.allow_overpressure or file.supply.allow_overpressure,
    }
    # A run's folder can be read from any other folder.
    for key in document["world"].keys() & {"map", "circles"}:
        document["world"][key] = str(Path(document["world"][key]).resolve())
    if "from" in document.get("start", {}):
        document["start"] = {"from": str(Path(file.start.run or "").resolve()), "time_s": file.start.time_s}
    for key, section in file.sections().items():
        section.resolve(document, file, products.get(key))
    for kind, plant in document["plants"].items():
        plant["tick_s"] = file.tick(kind)
        for key in getattr(file.plants, kind).on_a_floor if file.bench else ():
            plant.pop(key, None)
    return document


def supply_kpa(file: ScenarioFile, robot: RobotFile) -> float:
    """Return the supply pressure, the robot's nominal one where none is given, kPa."""
    given = file.supply.pressure_kpa
    return float(robot.supply.nominal_kpa.value) if given is None else given


def _robot(document: Document) -> tuple[RobotFile | None, tuple[str, ...]]:
    """Return the robot, and what is wrong with a robot file of its own."""
    given = document.get("robot")
    if given is None and document.known(("robot",)) == ():
        return None, ()
    try:
        return resolve_robot(document, given, prefix=("robot",)), ()
    except InputFileError as error:
        return None, error.lines
