"""JSON Schema of scenario files, including overrides of robot fields."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from srs_twin.robot.file import RobotFile
from srs_twin.scenario.file import ScenarioFile


def scenario_json_schema() -> dict[str, Any]:
    """Return a schema (draft 2020-12) with title, description, unit and range of every key."""
    schema = ScenarioFile.model_json_schema()
    robot_schema = RobotFile.model_json_schema()
    # Use numbered names, because the generated names of records contain their bounds and are long.
    names = {
        name: f"Robot{i}_{name.partition('_')[0]}" for i, name in enumerate(robot_schema["$defs"], start=1)
    }
    text = json.dumps(robot_schema)
    for name, short in names.items():
        text = text.replace(f'"#/$defs/{name}"', f'"#/$defs/{short}"')
    robot = json.loads(text)
    definitions = {names[name]: part for name, part in robot.pop("$defs").items()}
    either = [{"type": "string"}, _override(robot, definitions), robot]
    schema["properties"]["robot"] |= {"title": "Robot", "anyOf": either}
    schema["$defs"] |= definitions
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | schema


def field_paths() -> list[str]:
    """Return the dotted paths of all fields of a scenario; the items of a list have none."""
    schema = scenario_json_schema()

    def walk(node: dict[str, Any], path: str, depth: int) -> Iterator[str]:
        while "$ref" in node:
            node = schema["$defs"][node["$ref"].rsplit("/", 1)[1]]
        properties = node.get("properties", {})
        if path and not properties:
            yield path
        for key, child in properties.items() if depth else ():
            yield from walk(child, f"{path}.{key}".lstrip("."), depth - 1)
        for option in (*node.get("anyOf", ()), *node.get("oneOf", ())):
            yield from walk(option, path, depth)

    return list(dict.fromkeys(walk(schema, "", 3)))


def _override(robot: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of {base: …}, where a field is a plain number or a whole record."""

    def reference(node: dict[str, Any]) -> str | None:
        return next((n["$ref"] for n in (node, *node.get("anyOf", ())) if "$ref" in n), None)

    def definition(node: dict[str, Any]) -> dict[str, Any] | None:
        name = reference(node)
        return None if name is None else definitions[name.rsplit("/", 1)[1]]

    def field(node: dict[str, Any]) -> dict[str, Any]:
        record = definition(node)
        if record is None:
            return node
        plain = {k: v for k, v in record["properties"]["value"].items() if k not in ("title", "description")}
        return {"description": node["description"], "anyOf": [plain, {"$ref": reference(node)}]}

    properties: dict[str, Any] = {"base": {"type": "string", "description": "Name or path of the robot."}}
    for name, node in robot["properties"].items():
        section = definition(node)
        if section is None:
            properties[name] = node
            continue
        fields = {key: field(child) for key, child in section["properties"].items()}
        properties[name] = {"type": "object", "properties": fields, "additionalProperties": False}
    return {"type": "object", "properties": properties, "required": ["base"], "additionalProperties": False}
