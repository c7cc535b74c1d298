"""Default, bounds and unit of a setting are declared once: in its constructor, its section or its key."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

from pydantic import BaseModel

import srs_twin.scenario
from srs_twin.robot.sourced import UNITS, split_unit
from srs_twin.scenario.fields import Section
from srs_twin.scenario.file import with_extensions

ROOM = Path(srs_twin.scenario.__file__).parent

# Keys whose default intentionally differs from the constructor, with the reason.
OTHER = {
    "AnalyticalFile.timestep_s": (
        "the constructor multiplies it by the time unit of the robot"
    ),
    "AnalyticalFile.slip_speed_m_s": (
        "the constructor multiplies it by the time unit of the robot"
    ),
    "DeadSensorFile.reading_rad": "nothing is read unless a reading is given",
    "FollowFile.delay_s": "a real snake answers late",
    "TwinFile.contact": "a file names what is an object",
    "RandomFile.clear_m": "one distance, where `random_circles` takes discs",
    "RandomFile.seed": "the scenario's",
}


def sections(source: type[Section] = Section) -> Iterator[type[Section]]:
    for item in source.__subclasses__():
        if item.__module__.startswith(
            "srs_twin.scenario"
        ) and not item.__name__.startswith("_"):
            yield item
        yield from sections(item)


SECTIONS = sorted(set(sections()), key=lambda item: item.__name__)


def keys_in_sources() -> Iterator[tuple[str, str, ast.expr]]:
    """Yield section, key and the assigned expression in the sources."""
    for path in ROOM.glob("*.py"):
        tree = ast.parse(path.read_text("utf-8"))
        shared = {
            ast.unparse(item.targets[0]): item.value
            for item in tree.body
            if isinstance(item, ast.Assign)
        }
        for node in ast.walk(tree):
            for line in node.body if isinstance(node, ast.ClassDef) else ():
                if isinstance(line, ast.AnnAssign) and line.value is not None:
                    assert isinstance(line.target, ast.Name)
                    yield (
                        node.name,
                        line.target.id,
                        shared.get(ast.unparse(line.value), line.value),
                    )


def test_defaults_equal_those_of_the_constructors():
    for section in SECTIONS:
        for key, field in section.model_fields.items():
            parameter = section.parameter(key)
            if (
                parameter is None
                or parameter.default is parameter.empty
                or field.default is None
            ):
                continue
            if f"{section.__name__}.{key}" not in OTHER and not field.is_required():
                assert field.default == parameter.default, (section, key)


def test_no_default_is_declared_twice():
    by_name = {item.__name__: item for item in SECTIONS}
    typed = []
    for name, key, given in keys_in_sources():
        parameter = by_name[name].parameter(key) if name in by_name else None
        if parameter is None or parameter.default is parameter.empty:
            continue
        default = [given]
        if isinstance(given, ast.Call) and ast.unparse(given.func) in (
            "quantity",
            "constructor_default",
        ):
            default = given.args[2:]
        if default and ast.unparse(default[0]) != "None":
            typed.append(f"{name}.{key}")
    assert set(typed) <= OTHER.keys(), (
        "take the default out: the section has the constructor's"
    )


def test_no_unit_is_declared_twice():
    twice = [
        f"{name}.{key}"
        for name, key, given in keys_in_sources()
        if any(word.arg == "unit" for word in getattr(given, "keywords", ()))
        and split_unit(key)[1] != "1"
    ]
    assert twice == []
    assert all(
        key.endswith(tuple(UNITS))
        for key in ("slip_speed_m_s", "k_s_per_rad", "duration_s")
    )


def test_schema_contains_bounds_and_units():
    for section in SECTIONS:
        for key, shown in section.model_json_schema().get("properties", {}).items():
            numbers = [
                item
                for item in (shown, *shown.get("anyOf", ()))
                if item.get("type") in ("number", "integer")
            ]
            for number in numbers:
                assert {"minimum", "maximum"} <= number.keys(), (section, key)
                assert shown.get("unit"), (section, key)


def test_every_section_of_a_file_is_a_section():
    for name, field in with_extensions().model_fields.items():
        if inspect.isclass(field.annotation) and issubclass(
            field.annotation, BaseModel
        ):
            assert issubclass(field.annotation, Section), name
