"""Tables of the keys of input files and output documents, from their JSON Schemas."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from srs_twin.io.validation import describe_schema
from srs_twin.recordings.facts import RecordingFacts
from srs_twin.robot.file import RobotFile
from srs_twin.scenario.file import with_extensions
from srs_twin.studies.sweep.points import SweepFile

Schema = Mapping[str, Any]

_HEAD = "| key | unit | allowed | default | meaning |\n|---|---|---|---|---|"
# Text before an allowed block → suffix of the key in the title of its section.
_SUFFIX = {"": "", "a list of ": "[]", "names, each with ": ".NAME"}
_RECORD_KEYS = ("value", "unit", "status", "source", "uncertain")


def scenario() -> str:
    """Return the keys of scenario files."""
    return KeyTables(
        with_extensions().model_json_schema(), {"robot": "[a robot](robot.md)"}
    ).markdown("scenario")


def sweep() -> str:
    """Return the keys of sweep files, below a heading of the page of scenarios."""
    return KeyTables(
        SweepFile.model_json_schema(by_alias=True), heading="###"
    ).markdown("sweep")


def robot() -> str:
    """Return the keys of robot files."""
    tables = KeyTables(RobotFile.model_json_schema())
    prior = tables.root["$defs"]["Uncertain"]
    # The key `uncertain` belongs to records, which have no separate section.
    return "\n\n".join(
        [tables.markdown("robot"), *tables.section("robot", "uncertain", prior)]
    )


def inspection() -> str:
    """Return the keys of the output of `inspect --json`."""
    return _OutputTables(RecordingFacts.model_json_schema(), heading="###").markdown(
        "inspect"
    )


@dataclass
class KeyTables:
    """Tables of the keys of one kind of file, one section per block.

    Attributes:
        root: JSON Schema of the file.
        elsewhere: key → link to another page that describes it.
        sections: name of a definition → title of the section that describes it.
        heading: number signs of the headings of sections.
    """

    root: Schema
    elsewhere: Mapping[str, str] = field(default_factory=dict)
    sections: dict[str, str] = field(default_factory=dict)
    heading: str = "##"

    def markdown(self, name: str) -> str:
        """Return one section per block in the order of the file; `name` is the prefix of the anchors."""
        return "\n\n".join(self.section(name, "", self.root))

    def section(self, name: str, path: str, block: Schema) -> Iterator[str]:
        """Yield the table of a block of the schema, then the tables of its subblocks."""
        title = f"{self.heading} {path or 'At the top level'}"
        rows: list[str] = []
        inner: list[tuple[str, Schema]] = []
        for key, schema in block["properties"].items():
            key_path = f"{path.partition(' (')[0]}.{key}".removeprefix(".")
            values = self.elsewhere.get(key_path) or self._allowed(
                name, key_path, schema, inner
            )
            default = (
                "required" if key in block.get("required", ()) else _default(schema)
            )
            rows.append(
                row(
                    f"`{key}`",
                    self._unit(schema),
                    values,
                    default,
                    self._meaning(schema),
                )
            )
        yield (
            f"({_anchor(name, path)})=\n{title}\n\n{block['description']}\n\n{_HEAD}\n"
            + "\n".join(rows)
        )
        for title, subblock in inner:
            yield from self.section(name, title, subblock)

    def _allowed(
        self, name: str, key_path: str, schema: Schema, inner: list[tuple[str, Schema]]
    ) -> str:
        """Return the allowed values of a key; append blocks without a section to `inner`."""
        links = []
        plain = []
        for option, form in self._options(schema):
            definition = option.get("$ref", "").rpartition("/")[2]
            block = self.root["$defs"][definition] if definition else option
            if "properties" not in block or set(block["properties"]) == set(
                _RECORD_KEYS
            ):
                value = block.get("properties", {}).get("value", block)
                plain.append(form + describe_schema(value, self.root))
                continue
            if definition not in self.sections:
                kind = block["properties"].get("kind", {}).get("const")
                title = key_path + _SUFFIX[form] + (f" (kind: {kind})" if kind else "")
                self.sections[definition] = title
                inner.append((title, block))
            title = self.sections[definition]
            links.append(f"{form}[{title}](#{_anchor(name, title)})")
        return (
            "; ".join([*dict.fromkeys(filter(None, plain)), *dict.fromkeys(links)])
            or "see the meaning"
        )

    def _options(self, schema: Schema, form: str = "") -> Iterator[tuple[Schema, str]]:
        """Yield the schema of each allowed value, and the text for its form: value, list or mapping."""
        values = schema.get("additionalProperties")
        if choices := schema.get("anyOf") or schema.get("oneOf"):
            for choice in choices:
                yield from self._options(choice, form)
        elif schema.get("type") == "array" and _has_blocks(schema["items"]):
            yield from self._options(schema["items"], "a list of ")
        elif isinstance(values, dict):
            yield from self._options(values, "names, each with ")
        elif schema.get("type") != "null":
            yield schema, form

    def _meaning(self, schema: Schema) -> str:
        # The description of a quantity repeats unit and range, which have separate
        # columns.
        if "unit" in schema:
            return str(schema["title"])
        block = self.root["$defs"].get(schema.get("$ref", "").rpartition("/")[2], {})
        summary, _, _ = block.get("description", "").partition("\n\n")
        return str(schema.get("description") or " ".join(summary.split()))

    def _unit(self, schema: Schema) -> str:
        for option, _ in self._options(schema):
            definition = option.get("$ref", "").rpartition("/")[2]
            record = self.root["$defs"][definition]["properties"] if definition else {}
            if set(record) == set(_RECORD_KEYS):
                return _unit_text(record["unit"]["const"])
        return _unit_text(schema.get("unit", ""))


class _OutputTables(KeyTables):
    """Tables of the keys of an output document, whose numbers have plain units."""

    def _meaning(self, schema: Schema) -> str:
        return str(schema.get("description", ""))

    def _unit(self, schema: Schema) -> str:
        options = (option.get("items", option) for option, _ in self._options(schema))
        return _unit_text(
            next((str(option["unit"]) for option in options if "unit" in option), "")
        )


def _unit_text(unit: str) -> str:
    return "" if unit == "1" else unit


def _has_blocks(schema: Schema) -> bool:
    return "$ref" in schema or any(
        "$ref" in option for option in schema.get("oneOf", schema.get("anyOf", ()))
    )


def row(*cells: str) -> str:
    """Return a row of a Markdown table; escape bars, and angle brackets outside code."""
    escaped = [
        cell if cell.startswith("`") else cell.replace("<", "&lt;") for cell in cells
    ]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in escaped) + " |"


def _default(schema: Schema) -> str:
    default = schema.get("default")
    if default is None:
        return "none"
    if isinstance(default, dict):
        return "its defaults"
    return f"`{json.dumps(default)}`" if default != [] else "empty"


def _anchor(name: str, path: str) -> str:
    characters = [c if c.isalnum() or c == "_" else "-" for c in f"{name}-{path}"]
    return "-".join(filter(None, "".join(characters).split("-")))
