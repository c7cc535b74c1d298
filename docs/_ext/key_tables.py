"""Tables of every key that a file may have, from the JSON schemas that editors use."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from srs_twin.io.validation import describe_schema
from srs_twin.recordings.facts import RecordingFacts
from srs_twin.robot.file import RobotFile
from srs_twin.scenario.file import ScenarioFile
from srs_twin.studies.sweep.file import SweepFile

Schema = Mapping[str, Any]

_HEAD = "| key | unit | allowed | default | meaning |\n|---|---|---|---|---|"
_SUFFIX = {"": "", "a list of ": "[]", "names, each with ": ".NAME"}
_RECORD = ("value", "unit", "status", "source", "uncertain")


def scenario() -> str:
    """Return the keys of scenario files."""
    return Blocks(ScenarioFile.model_json_schema(), {"robot": "[a robot](robot.md)"}).markdown("scenario")


def sweep() -> str:
    """Return the keys of sweep files."""
    return Blocks(SweepFile.model_json_schema(by_alias=True)).markdown("sweep")


def robot() -> str:
    """Return the keys of robot files."""
    blocks = Blocks(RobotFile.model_json_schema())
    spread = blocks.root["$defs"]["Uncertain"]
    # A key of records, which have no section of their own.
    return "\n\n".join([blocks.markdown("robot"), *blocks._section("robot", "uncertain", spread)])


def inspection() -> str:
    """Return the keys of what `inspect --json` prints."""
    return _Output(RecordingFacts.model_json_schema()).markdown("inspect")


@dataclass
class Blocks:
    """The blocks of keys of one kind of file, each described once.

    Attributes:
        root: the whole schema.
        elsewhere: what to say of keys that are described on another page.
        places: name of a definition → the path under which it is described.
    """

    root: Schema
    elsewhere: Mapping[str, str] = field(default_factory=dict)
    places: dict[str, str] = field(default_factory=dict)

    def markdown(self, name: str) -> str:
        """Return a section for each block, in the order of the file; anchors begin with that name."""
        return "\n\n".join(self._section(name, "", self.root))

    def _section(self, name: str, path: str, block: Schema) -> Iterator[str]:
        title = f"## {path}" if path else "## At the top level"
        rows: list[str] = []
        inner: list[tuple[str, Schema]] = []
        for key, schema in block["properties"].items():
            where = f"{path.partition(' (')[0]}.{key}".removeprefix(".")
            words = self.elsewhere.get(where) or self._words(name, where, schema, inner)
            default = "required" if key in block.get("required", ()) else _default(schema)
            rows.append(row(f"`{key}`", self._unit(schema), words, default, self._meaning(schema)))
        yield f"({_anchor(name, path)})=\n{title}\n\n{block['description']}\n\n{_HEAD}\n" + "\n".join(rows)
        for where, each in inner:
            yield from self._section(name, where, each)

    def _words(self, name: str, where: str, schema: Schema, inner: list[tuple[str, Schema]]) -> str:
        """Return what a key may hold; blocks that are new go to `inner`."""
        links, plain = [], []
        for option, form in self._options(schema):
            definition = option.get("$ref", "").rpartition("/")[2]
            block = self.root["$defs"][definition] if definition else option
            if "properties" not in block or set(block["properties"]) == set(_RECORD):
                value = block.get("properties", {}).get("value", block)
                plain.append(form + describe_schema(value, self.root))
                continue
            if definition not in self.places:
                kind = block["properties"].get("kind", {}).get("const")
                place = where + _SUFFIX[form] + (f" (kind: {kind})" if kind else "")
                self.places[definition] = place
                inner.append((place, block))
            place = self.places[definition]
            links.append(f"{form}[{place}](#{_anchor(name, place)})")
        return "; ".join([*dict.fromkeys(filter(None, plain)), *dict.fromkeys(links)]) or "see the meaning"

    def _options(self, schema: Schema, form: str = "") -> Iterator[tuple[Schema, str]]:
        """Yield what a key may hold, and in which form: by itself, in a list, or under names of its own."""
        values = schema.get("additionalProperties")
        if choices := schema.get("anyOf") or schema.get("oneOf"):
            for choice in choices:
                yield from self._options(choice, form)
        elif schema.get("type") == "array" and _blocks_in(schema["items"]):
            yield from self._options(schema["items"], "a list of ")
        elif isinstance(values, dict):
            yield from self._options(values, "names, each with ")
        elif schema.get("type") != "null":
            yield schema, form

    def _meaning(self, schema: Schema) -> str:
        # Of a quantity unit and range have columns of their own.
        if "unit" in schema:
            return str(schema["title"])
        block = self.root["$defs"].get(schema.get("$ref", "").rpartition("/")[2], {})
        return str(schema.get("description") or block.get("description", ""))

    def _unit(self, schema: Schema) -> str:
        for option, _ in self._options(schema):
            definition = option.get("$ref", "").rpartition("/")[2]
            record = self.root["$defs"][definition]["properties"] if definition else {}
            if set(record) == set(_RECORD):
                return _shown(record["unit"]["const"])
        return _shown(schema.get("unit", ""))


class _Output(Blocks):
    """The blocks of a document that is printed: numbers have plain units."""

    def _meaning(self, schema: Schema) -> str:
        return str(schema.get("description", ""))

    def _unit(self, schema: Schema) -> str:
        options = (option.get("items", option) for option, _ in self._options(schema))
        return _shown(next((str(each["unit"]) for each in options if "unit" in each), ""))


def _shown(unit: str) -> str:
    return "" if unit == "1" else unit


def _blocks_in(schema: Schema) -> bool:
    return "$ref" in schema or any("$ref" in each for each in schema.get("oneOf", schema.get("anyOf", ())))


def row(*cells: str) -> str:
    """Return a row of a Markdown table; bars and, outside code, angle brackets are shown as they are."""
    shown = [cell if cell.startswith("`") else cell.replace("<", "&lt;") for cell in cells]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in shown) + " |"


def _default(schema: Schema) -> str:
    default = schema.get("default")
    if default is None:
        return "none"
    if isinstance(default, dict):
        return "its defaults"
    return f"`{json.dumps(default)}`" if default != [] else "empty"


def _anchor(name: str, path: str) -> str:
    letters = [c if c.isalnum() or c == "_" else "-" for c in f"{name}-{path}"]
    return "-".join(filter(None, "".join(letters).split("-")))
