"""Limits and defaults of the keys of files: files that were accepted stay accepted, and mean the same.

`limits.csv` holds those of every numeric key, the bounds within which fits search, and
the spreads with which a live ensemble begins, on which the figures of
docs/live-method.md rest. After an intended change: `python tests/test_limits.py`.
"""

from __future__ import annotations

import csv
from dataclasses import fields
from pathlib import Path

import pytest

from srs_twin import load_robot
from srs_twin.identification.parameters import free_parameters, parameter_names
from srs_twin.live.ensemble import ModelError
from srs_twin.scenario.loading import scenario_json_schema
from srs_twin.studies.optimization.loading import study_json_schema
from srs_twin.studies.sweep.points import sweep_json_schema

pytestmark = pytest.mark.fast

FILE = Path(__file__).with_name("limits.csv")
KEYWORDS = ("exclusiveMinimum", "minimum", "exclusiveMaximum", "maximum", "default")


def limits():
    """Return key → its limits and its default, of scenarios, sweeps and studies; bounds of fits."""
    spec = load_robot("gen2")
    bounds = {
        name: free_parameters(spec, [name.replace("_N", "_1")])[0]
        for name in parameter_names()
    }
    found = {
        f"fit {name}": ["", f"{each.low:g}", "", f"{each.high:g}", ""]
        for name, each in bounds.items()
    }
    found |= {
        f"ensemble {each.name}": ["", "", "", "", str(each.default)]
        for each in fields(ModelError)
    }
    for kind in (scenario_json_schema, sweep_json_schema, study_json_schema):
        schema = kind()
        parts = {"": schema} | schema["$defs"]
        for part, each in parts.items():
            for name, given in properties(each):
                numbers = [
                    one for one in (given, *given.get("anyOf", [])) if limited(one)
                ]
                if numbers:
                    about = numbers[0] | (
                        {"default": given["default"]} if "default" in given else {}
                    )
                    key = f"{kind.__name__.split('_')[0]} {part}.{name}"
                    found[key] = [str(about.get(keyword, "")) for keyword in KEYWORDS]
    return found


def properties(schema):
    """Yield name and schema of each key, also of those of nested objects."""
    for name, each in schema.get("properties", {}).items():
        yield name, each
        for one in (each, *each.get("anyOf", [])):
            for inner, given in properties(one):
                yield f"{name}.{inner}", given


def limited(schema):
    """Whether a schema is one of a number with a limit."""
    return schema.get("type") in ("number", "integer") and bool(
        schema.keys() & set(KEYWORDS[:-1])
    )


def test_limits_and_defaults_of_keys_are_those_that_files_rely_on():
    with FILE.open(encoding="utf-8", newline="") as file:
        kept = {key: values for key, *values in csv.reader(file)}
    now = limits()
    assert {key: now.get(key) for key in kept} == kept


if __name__ == "__main__":
    with FILE.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(
            [key, *values] for key, values in limits().items()
        )
