"""A setting's default, bounds and unit stand in one place: its constructor, its section, its key."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel

import srs_twin.scenario
from srs_twin.robot.sourced import UNITS, split_unit
from srs_twin.scenario.fields import Section
from srs_twin.scenario.file import ScenarioFile

ROOM = Path(srs_twin.scenario.__file__).parent

# Keys whose default is another than the constructor's on purpose, and why.
OTHER = {
    "DeadSensorFile.reading_rad": "nothing is read unless a reading is given",
    "FollowFile.delay_s": "a real snake answers late",
    "OmplFile.seconds": "it has no other end",
    "TwinFile.contact": "a file names what is an object",
    "RandomFile.clear_m": "one distance, where `random_circles` takes discs",
    "RandomFile.seed": "the scenario's",
}


def sections(of: type[Section] = Section) -> Iterator[type[Section]]:
    for each in of.__subclasses__():
        if each.__module__.startswith("srs_twin.scenario") and not each.__name__.startswith("_"):
            yield each
        yield from sections(each)


SECTIONS = sorted(set(sections()), key=lambda each: each.__name__)


def keys_in_sources() -> Iterator[tuple[str, str, ast.expr]]:
    """Yield section, key and what is assigned to it in the sources."""
    for path in ROOM.glob("*.py"):
        tree = ast.parse(path.read_text("utf-8"))
        shared = {
            ast.unparse(each.targets[0]): each.value for each in tree.body if isinstance(each, ast.Assign)
        }
        for node in ast.walk(tree):
            for line in node.body if isinstance(node, ast.ClassDef) else ():
                if isinstance(line, ast.AnnAssign) and line.value is not None:
                    assert isinstance(line.target, ast.Name)
                    yield node.name, line.target.id, shared.get(ast.unparse(line.value), line.value)


@pytest.mark.parametrize("section", SECTIONS, ids=lambda each: each.__name__)
def test_defaults_are_the_constructors(section):
    for key, field in section.model_fields.items():
        parameter = section.parameter(key)
        if parameter is None or parameter.default is parameter.empty or field.default is None:
            continue
        if f"{section.__name__}.{key}" not in OTHER and not field.is_required():
            assert field.default == parameter.default, key


def test_no_default_of_a_constructor_is_typed_again():
    by_name = {each.__name__: each for each in SECTIONS}
    typed = []
    for name, key, given in keys_in_sources():
        parameter = by_name[name].parameter(key) if name in by_name else None
        if parameter is None or parameter.default is parameter.empty:
            continue
        default = [given]
        if isinstance(given, ast.Call) and ast.unparse(given.func) in ("quantity", "constructor_default"):
            default = given.args[2:]
        if default and ast.unparse(default[0]) != "None":
            typed.append(f"{name}.{key}")
    assert set(typed) <= OTHER.keys(), "take the default out: the section has the constructor's"


def test_no_unit_is_typed_that_the_key_names():
    twice = [
        f"{name}.{key}"
        for name, key, given in keys_in_sources()
        if any(word.arg == "unit" for word in getattr(given, "keywords", ())) and split_unit(key)[1] != "1"
    ]
    assert twice == []
    assert all(key.endswith(tuple(UNITS)) for key in ("slip_speed_m_s", "k_s_per_rad", "duration_s"))


@pytest.mark.parametrize("section", SECTIONS, ids=lambda each: each.__name__)
def test_each_section_names_its_bounds_and_units_to_editors(section):
    for key, shown in section.model_json_schema().get("properties", {}).items():
        numbers = [
            each for each in (shown, *shown.get("anyOf", ())) if each.get("type") in ("number", "integer")
        ]
        for number in numbers:
            assert {"minimum", "maximum"} <= number.keys(), key
            assert shown.get("unit"), key


def test_every_section_of_a_file_is_a_section():
    for name, field in ScenarioFile.model_fields.items():
        if inspect.isclass(field.annotation) and issubclass(field.annotation, BaseModel):
            assert issubclass(field.annotation, Section), name
