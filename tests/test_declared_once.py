"""Sections of files have the defaults of the constructors, and bounds and units of every number."""

from __future__ import annotations

import inspect
from collections.abc import Iterator

from pydantic import BaseModel

from srs_twin.scenario.fields import Section
from srs_twin.scenario.file import with_extensions

# Keys whose default intentionally differs from the constructor, with the reason.
OTHER = {
    "AnalyticalFile.timestep_s": "the constructor multiplies it by a time unit",
    "AnalyticalFile.slip_speed_m_s": "the constructor multiplies it by a time unit",
    "TwinFile.contact": "a file names what is an object",
    "RandomFile.clear_m": "one distance, where `random_circles` takes discs",
}


def sections(source: type[Section] = Section) -> Iterator[type[Section]]:
    for item in source.__subclasses__():
        is_ours = item.__module__.startswith("srs_twin.scenario")
        if is_ours and not item.__name__.startswith("_"):
            yield item
        yield from sections(item)


SECTIONS = sorted(set(sections()), key=lambda item: item.__name__)


def test_defaults_equal_those_of_the_constructors():
    different = set()
    for section in SECTIONS:
        for key, field in section.model_fields.items():
            parameter = section.parameter(key)
            if parameter is None or parameter.default is parameter.empty:
                continue
            if field.is_required() or field.default is None:
                continue
            if field.default != parameter.default:
                different.add(f"{section.__name__}.{key}")
    assert different <= OTHER.keys()


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
        kind = field.annotation
        if inspect.isclass(kind) and issubclass(kind, BaseModel):
            assert issubclass(kind, Section), name
