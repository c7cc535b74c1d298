"""Functions that load scenario files and return the JSON Schema of these files.

A scenario is validated twice. The first validation checks the file as the user wrote it
and reports all problems together. The second validation reads the resolved document,
which contains all defaults and the robot. The second validation ensures that a run can
be repeated from the output folder.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any

from srs_twin.errors import InputError, InputFileError, did_you_mean
from srs_twin.extensions import SECTIONS
from srs_twin.io.arguments import checked
from srs_twin.io.documents import (
    Document,
    Loc,
    Override,
    Overrides,
    child,
    format_path,
    load_yaml,
)
from srs_twin.io.files import StrPath, find_file, is_path, results_name
from srs_twin.io.validation import validate
from srs_twin.robot.file import PA_PER_KPA, SERVO_PRESSURE_KPA, RobotFile, resolve_robot
from srs_twin.robot.sourced import replace_value
from srs_twin.robot.world import World
from srs_twin.scenario.checks import (
    check,
    check_controller,
    check_robot,
    check_start,
    check_supply_pressure,
)
from srs_twin.scenario.fields import Loading, path_fields
from srs_twin.scenario.file import ScenarioFile, with_extensions
from srs_twin.scenario.modified import changed_fields, marked
from srs_twin.scenario.parts import OWN_SCHEMA, read_resolved, scenario_model
from srs_twin.scenario.plants import PRESET, with_preset
from srs_twin.scenario.scenario import Scenario, ignored_obstacles


@checked
def load_scenario(
    scenario: StrPath | Scenario,
    *,
    set: Overrides = (),
) -> Scenario:
    """Load a shipped scenario by name (`gen2_straight`) or a scenario file by path.

    Args:
        scenario: name or path of the scenario, or a loaded scenario to modify.
        set: values that override fields of the file, keyed by dotted path, for example
            ``{"controller.frequency_hz": 1.5}``.

    Raises:
        InputError: the file is not found or cannot be read.
        InputFileError: the scenario is not valid. The error lists all problems.
    """
    if isinstance(scenario, Scenario):
        if not set:
            return scenario
        return parse_scenario(scenario.document, name=scenario.name, set=set)
    path = find_file("scenario", scenario)
    document = load_yaml(path)
    if document.get("geometry") and not document.get("robot"):
        raise InputError(
            f"{document.name}: this is a robot file; give a scenario that contains"
            f" `robot: {document.name}`"
        )
    return _scenario(document, results_name(path), set)


def parse_scenario(
    data: Mapping[str, object],
    *,
    name: str = "scenario",
    set: Overrides = (),
) -> Scenario:
    """Build a scenario from plain data.

    Args:
        data: contents of a scenario file.
        name: file name for messages, which is also the default name of the scenario.
        set: values that override fields, keyed by dotted path.

    Raises:
        InputFileError: the scenario is not valid.
    """
    if set:
        data = copy.deepcopy(dict(data))
    return _scenario(Document(name, data), name, set)


def _scenario(document: Document, name: str, overrides: Overrides) -> Scenario:
    changes = Override.list_of(overrides)
    unmodified = copy.deepcopy(document) if changes else document
    for change in changes:
        _set(document, change)
    file, loading = _checked(document)
    world = loading.world
    uses_goal = any(section.uses_goal for section in file.sections().values())
    if not uses_goal and (world.goal or world.bounds):
        loading.warnings.append(
            "world: `goal` and `bounds` have no effect, because only a controller of"
            " `kind: follow` uses them"
        )
    loading.warnings += ignored_obstacles(file, world, file.plants.running)
    resolved = _resolved(
        file, loading.robot, file.name or name, loading.layout, loading.products
    )
    before = resolved
    if changes:
        before = _resolved_or_raw(unmodified, loading.products)
    earlier = document.get("changes") or ()
    locs = [change.loc for change in changes]
    changed = changed_fields(before, resolved, locs, earlier)
    if changed:
        resolved["changes"] = changed
    file = read_resolved(resolved)
    pose = file.start.build()
    assert file.name and file.title, "set by _resolved"
    return Scenario(
        name=file.name,
        title=marked(file.title, changed),
        robot=loading.robot.spec(file.seed),
        duration=file.duration_s,
        seed=file.seed,
        record_hz=file.record_hz,
        supply_pa=loading.supply_pa,
        pose=(pose.x, pose.y, pose.heading),
        initial_state=loading.initial_state,
        world=world,
        file=file,
        document=resolved,
        warnings=tuple(loading.warnings),
        products=loading.products,
        source=document.name,
    )


def _checked(document: Document) -> tuple[ScenarioFile, Loading]:
    _locate_files(document)
    file = validate(scenario_model(document), document, document.data)
    robot, robot_problems = _robot(document)
    warnings = document.warnings
    length = 1.0
    if robot:
        warnings = warnings + check_supply_pressure(document, robot)
        length = robot.scale.length
    world = World()
    loading = None
    if file:
        if robot:
            file = file.scaled_to(robot.scale)
        drawn = "pegs" if file.world.pegs else "random"
        with document.report_errors("world", drawn):
            world = file.world.build_world(file.start.build(), file.seed, length)
        check(document, file, world, robot)
    if file and robot:
        check_robot(document, file, world, robot)
        loading = Loading(document, file, robot, world, warnings=warnings)
        _build_parts(file, loading)
    document.raise_problems(robot_problems)
    assert file is not None and loading is not None, "no problem was reported"
    return file, loading


def _build_parts(file: ScenarioFile, loading: Loading) -> None:
    document = loading.document
    robot = loading.robot
    products = loading.products
    # The controller is checked last because it needs the products of all sections.
    products |= {key: section.read(loading) for key, section in file.sections().items()}
    if file.controller.is_ready(products):
        loading.supply_pa = supply_kpa(file, robot) * PA_PER_KPA
        check_controller(file, loading)
    if not document.problems:
        with document.report_errors("start"):
            segments = robot.spec(file.seed).segments
            loading.initial_state = file.start.initial_state(
                segments, loading.supply_pa, file.plants.running
            )
            check_start(file, loading, loading.initial_state)
    for key, section in file.sections().items():
        products[key] = products[key] or section.prepare(loading)


def _set(document: Document, change: Override) -> None:
    _check_field(document, change)
    before = document.get(*change.loc)
    is_record = isinstance(before, Mapping) and "unit" in before
    if is_record and not isinstance(change.value, Mapping):
        # A plain number replaces only the value of a record and keeps the unit.
        value = replace_value(before, change.value, None, f"set by {change.label}")
        change = replace(change, value=value)
    twin = document.get(*PRESET[:-1])
    if change.loc == PRESET and isinstance(twin, Mapping):
        document.data["plants"]["twin"] = with_preset(twin, change.value)
    document.apply(change)


def _locate_files(document: Document) -> None:
    if document.folder is not None and isinstance(document.data, dict):
        for loc, kind in path_fields(document.data).items():
            document.locate(loc, kind)


def _resolved_or_raw(
    document: Document, products: Mapping[str, object]
) -> dict[str, Any]:
    if not isinstance(document.data, dict):
        document.data = {}
    _locate_files(document)
    file = validate(scenario_model(document), document, document.data)
    robot, _ = _robot(document)
    if file is None or robot is None:
        return document.data
    file = file.scaled_to(robot.scale)
    available = {name: products.get(name) for name in file.sections()}
    layout: str = file.valves.layout or (*file.controller.layouts(available), "")[0]
    return _resolved(file, robot, "", layout, available)


def _check_field(document: Document, change: Override) -> None:
    first, *more = change.loc
    if first == "changes":
        raise InputError(
            f"{change.label}: the list `changes` is written by srs_twin and cannot be"
            " set; set the changed fields instead"
        )
    known = first in {*ScenarioFile.model_fields, *SECTIONS}
    if first == "robot" and more:
        known = more[0] in {*RobotFile.model_fields, "base"}
    if not known:
        path = format_path(change.loc)
        close = did_you_mean(path, field_paths(document))
        raise InputError(
            f"{change.label}: the field {path} does not"
            f" exist{close or '; `srs-twin show SCENARIO` prints all fields'}"
        )


def _resolved(
    file: ScenarioFile,
    robot: RobotFile,
    name: str,
    layout: str,
    products: Mapping[str, object],
) -> dict[str, Any]:
    """Return a scenario as plain data that contain all defaults and the robot."""
    # `supply.allow_overpressure` is an alias of the top-level key.
    excluded: dict[str, set[str] | bool] = {
        "supply": {"allow_overpressure"},
        "changes": True,
    }
    if file.bench:
        excluded["start"] = True
    plain = file.model_dump(
        mode="json", exclude_none=True, exclude=excluded, by_alias=True
    )
    document = plain | {
        "name": name,
        "title": file.title or name,
        "robot": robot.model_dump(mode="json", exclude_none=True),
        "supply": plain["supply"] | {"pressure_kpa": supply_kpa(file, robot)},
        "controller": file.controller.written(),
        "pneumatics": file.pneumatics.written(),
        "valves": plain["valves"] | {"layout": layout},
        "sensor": file.sensor.written(),
        "allow_overpressure": file.allow_overpressure or file.supply.allow_overpressure,
    }
    if "from" in document.get("start", {}):
        document["start"] = {"from": file.start.run, "time_s": file.start.time_s}
    for key, section in file.sections().items():
        section.resolve(document, file, products.get(key))
    # Absolute paths are valid in any working folder.
    for loc, kind in path_fields(document).items():
        block: Any = reduce(child, loc[:-1], document)
        path = child(block, loc[-1])
        if isinstance(path, str) and (is_path(path) or not kind):
            block[loc[-1]] = str(Path(path).resolve())
    for kind, plant in document["plants"].items():
        plant["tick_s"] = file.tick(kind)
        section = getattr(file.plants, kind)
        absent = [
            *(section.floor_keys if file.bench else ()),
            *(section.wheel_keys if robot.has_skin else ()),
        ]
        for key in absent:
            plant.pop(key, None)
    return document


def supply_kpa(file: ScenarioFile, robot: RobotFile) -> float:
    """Return the supply pressure (kPa), by default the robot's nominal pressure."""
    if file.supply.pressure_kpa is not None:
        return file.supply.pressure_kpa
    if robot.supply is None:
        return SERVO_PRESSURE_KPA
    return float(robot.supply.nominal_kpa.value)


def _robot(document: Document) -> tuple[RobotFile | None, tuple[str, ...]]:
    robot = document.get("robot")
    if robot is None and document.existing_prefix(("robot",)) == ():
        return None, ()
    try:
        return resolve_robot(document, robot, prefix=("robot",)), ()
    except InputFileError as error:
        return None, error.lines


def scenario_json_schema() -> dict[str, Any]:
    """Return a JSON Schema (draft 2020-12) that describes all keys of a scenario."""
    schema = with_extensions().model_json_schema()
    robot_schema = RobotFile.model_json_schema()
    # The definitions get short, numbered names, because the generated names are long.
    names = {
        name: f"Robot{i}_{name.partition('_')[0]}"
        for i, name in enumerate(robot_schema["$defs"], start=1)
    }
    text = json.dumps(robot_schema)
    for name, short in names.items():
        text = text.replace(f'"#/$defs/{name}"', f'"#/$defs/{short}"')
    robot = json.loads(text)
    definitions = {names[name]: part for name, part in robot.pop("$defs").items()}
    either = [{"type": "string"}, _override(robot, definitions), robot]
    schema["properties"]["robot"] |= {"title": "Robot", "anyOf": either}
    schema["$defs"] |= definitions
    sections = schema["properties"]
    sections["controller"]["oneOf"].append(OWN_SCHEMA)
    for key in ("pneumatics", "sensor"):
        sections[key]["anyOf"] = [{"$ref": sections[key].pop("$ref")}, OWN_SCHEMA]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | schema


def field_paths(document: Document) -> list[str]:
    """Return the dotted paths of the fields that a scenario can have.

    List items are omitted. If a block of the document sets the key `kind`, only the
    fields of this kind are returned.
    """
    schema = scenario_json_schema()

    def walk(node: dict[str, Any], path: Loc, depth: int) -> Iterator[str]:
        while "$ref" in node:
            node = schema["$defs"][node["$ref"].rsplit("/", 1)[1]]
        properties = node.get("properties", {})
        kind = properties.get("kind", {}).get("const")
        if kind is not None and document.get(*path, "kind") not in (kind, None):
            return
        if path and not properties:
            yield format_path(path)
        for key, inner in properties.items() if depth else ():
            yield from walk(inner, (*path, key), depth - 1)
        for option in (*node.get("anyOf", ()), *node.get("oneOf", ())):
            yield from walk(option, path, depth)

    return list(dict.fromkeys(walk(schema, (), 3)))


def _override(robot: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    properties: dict[str, object] = {
        "base": {"type": "string", "description": "Name or path of the robot."}
    }
    for name, node in robot["properties"].items():
        properties[name] = node
        if (reference := _reference(node)) is None:
            continue
        section = definitions[reference.rpartition("/")[2]]
        fields = {
            key: _field_or_number(inner, definitions)
            for key, inner in section["properties"].items()
        }
        properties[name] = _closed_object(fields)
    return _closed_object(properties) | {"required": ["base"]}


def _closed_object(properties: Mapping[str, object]) -> dict[str, object]:
    return {
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
    }


def _reference(node: dict[str, Any]) -> str | None:
    return next(
        (n["$ref"] for n in (node, *node.get("anyOf", ())) if "$ref" in n), None
    )


def _field_or_number(
    node: dict[str, Any], definitions: dict[str, Any]
) -> dict[str, Any]:
    reference = _reference(node)
    if reference is None:
        return node
    record = definitions[reference.rpartition("/")[2]]
    number = dict(record["properties"]["value"])
    number.pop("title", None)
    number.pop("description", None)
    return {
        "description": node["description"],
        "anyOf": [number, {"$ref": reference}],
    }
