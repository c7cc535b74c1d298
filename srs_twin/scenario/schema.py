"""The JSON Schema of scenario files, for editors; overrides of a robot's fields included."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from srs_twin.robot.file import RobotFile
from srs_twin.scenario.file import ScenarioFile


def scenario_json_schema() -> dict[str, Any]:
    """Return a schema (draft 2020-12) that knows every key with its title, description, unit and range."""
    schema = ScenarioFile.model_json_schema()
    parts = RobotFile.model_json_schema()
    # The names of records spell out their bounds; numbers do.
    names = {name: f"Robot{i}_{name.partition('_')[0]}" for i, name in enumerate(parts["$defs"], start=1)}
    text = json.dumps(parts)
    for name, short in names.items():
        text = text.replace(f'"#/$defs/{name}"', f'"#/$defs/{short}"')
    robot = json.loads(text)
    definitions = {names[name]: part for name, part in robot.pop("$defs").items()}
    either = [{"type": "string"}, _override(robot, definitions), robot]
    schema["properties"]["robot"] |= {"title": "Robot", "anyOf": either}
    schema["$defs"] |= definitions
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | schema


def field_paths() -> list[str]:
    """Return every field of a scenario, dotted; of lists the field itself."""
    schema = scenario_json_schema()

    def walk(node: dict[str, Any], path: str, depth: int) -> Iterator[str]:
        while "$ref" in node:
            node = schema["$defs"][node["$ref"].rsplit("/", 1)[1]]
        parts = node.get("properties", {})
        if path and not parts:
            yield path
        for key, each in parts.items() if depth else ():
            yield from walk(each, f"{path}.{key}".lstrip("."), depth - 1)
        for option in (*node.get("anyOf", ()), *node.get("oneOf", ())):
            yield from walk(option, path, depth)

    return list(dict.fromkeys(walk(schema, "", 3)))


def _override(robot: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of {base: …} with any field given as a plain number or as a whole record."""

    def reference(node: dict[str, Any]) -> str | None:
        return next((each["$ref"] for each in (node, *node.get("anyOf", ())) if "$ref" in each), None)

    def definition(node: dict[str, Any]) -> dict[str, Any] | None:
        found = reference(node)
        return None if found is None else definitions[found.rsplit("/", 1)[1]]

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
        fields = {key: field(each) for key, each in section["properties"].items()}
        properties[name] = {"type": "object", "properties": fields, "additionalProperties": False}
    return {"type": "object", "properties": properties, "required": ["base"], "additionalProperties": False}
