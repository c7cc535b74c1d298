"""Sections for plug-in classes in scenario files.

A scenario names a plug-in class as ``kind: module:Name``, or by a short name that an
installed distribution registers. If the class is a controller, a chamber model or a
sensor, the keys of the section are the constructor arguments, whose units are not
converted. The class may also be a subclass of `Section` that defines its own keys. The
module `srs_twin.extensions` describes which modules may be imported.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from inspect import Parameter, signature
from types import EllipsisType, SimpleNamespace
from typing import Any, ClassVar, NamedTuple, get_type_hints

from pydantic import ConfigDict, Field, TypeAdapter, create_model
from pydantic.errors import PydanticUserError

from srs_twin.control.base import Controller
from srs_twin.control.gait import Gait
from srs_twin.errors import AbsentPartError, InputError, UnknownNameError
from srs_twin.extensions import PART_PATTERN, READING, SECTIONS, part
from srs_twin.io.documents import Document
from srs_twin.pneumatics import KINDS as PNEUMATICS, Pneumatics
from srs_twin.scenario.controllers import ControllerSection
from srs_twin.scenario.fields import Section
from srs_twin.scenario.file import (
    CONTROLLER_NAMES,
    PneumaticsSection,
    ScenarioFile,
    SensorSection,
    with_extensions,
)
from srs_twin.sensing import KINDS as SENSORS, Sensor


class _Kind(NamedTuple):
    section: type[Section]
    base: type
    known: Collection[str]


PARTS = {
    "controller": _Kind(ControllerSection, Controller, CONTROLLER_NAMES),
    "pneumatics": _Kind(PneumaticsSection, Pneumatics, PNEUMATICS),
    "sensor": _Kind(SensorSection, Sensor, SENSORS),
}
"""Sections of a scenario that may name plug-in classes."""

_CONTEXT = ("spec", "supply_pa", "layout")
"""Constructor arguments that the scenario determines and that a file cannot set."""

OWN_SCHEMA = {
    "type": "object",
    "properties": {"kind": {"type": "string", "pattern": f"^{PART_PATTERN}$"}},
    "required": ["kind"],
}
"""JSON Schema of the section of a plug-in class."""


class _ArgumentsSection(Section):
    """Section whose keys are the constructor arguments of a class.

    Field names end with an underscore to avoid name clashes with methods.

    Attributes:
        not_written: fields whose defaults a file cannot express, so they are written
            only if they were set.
    """

    not_written: ClassVar[set[str]]

    def arguments(self, *constructors: object) -> dict[str, object]:
        """Return the constructor arguments of the class."""
        return {name[:-1]: value for name, value in self if name != "kind"}

    def written(self) -> dict[str, object]:
        """Return the section as plain data, including arguments that are None."""
        unset = self.not_written - self.model_fields_set
        return self.model_dump(mode="json", by_alias=True, exclude=unset)


class _AbsentSection(ControllerSection, PneumaticsSection, SensorSection):
    """Placeholder for a plug-in class that is not imported.

    The keys are not checked, and `build` raises an error.
    """

    model_config = ConfigDict(extra="allow")
    constructors = (Gait,)  # supports all valve layouts and robots

    kind: str

    def arguments(self, *constructors: object) -> dict[str, object]:
        """Raise an `AbsentPartError`."""
        raise AbsentPartError(self.kind)


def scenario_model(document: Document) -> type[ScenarioFile]:
    """Return a model for a scenario file with the sections that the file contains.

    Plug-in classes that cannot be used are reported to the document. If the file
    contains unknown names, the model has all sections, so that error messages can
    suggest valid names.
    """
    outside = _parts_from_outside(document)
    kind = document.get("controller", "kind")
    keys = set(document.data) if isinstance(document.data, Mapping) else set()
    known = keys <= {*ScenarioFile.model_fields, *SECTIONS}
    if known and ("controller" in outside or kind in CONTROLLER_NAMES):
        model = with_extensions(keys, (kind,))
    else:
        model = with_extensions()
    if outside:
        model = _model("ScenarioFile", model, **outside)
    return model


def _parts_from_outside(
    document: Document,
) -> dict[str, tuple[type[Section], EllipsisType]]:
    sections: dict[str, tuple[type[Section], EllipsisType]] = {}
    for key, (section, base, known) in PARTS.items():
        kind = document.get(key, "kind")
        if not isinstance(kind, str) or kind in known:
            continue
        own: type[Section] = _AbsentSection
        try:
            if not READING.get():
                own = _section(key, kind, part(key, kind, (base, section), known))
        except UnknownNameError:
            continue  # the validation lists the known names
        except InputError as error:
            document.report((key, "kind"), str(error))
        sections[key] = (own, ...)
    return sections


def read_resolved(data: Mapping[str, object]) -> ScenarioFile:
    """Parse the plain data of a resolved scenario.

    Raises:
        InputFileError: a plug-in class cannot be used.
    """
    document = Document("scenario", data)
    model = scenario_model(document)
    document.raise_problems()
    return model.model_validate_json(json.dumps(data), strict=True)


@cache
def _model(name: str, base: Any, **fields: Any) -> Any:
    return create_model(name, __base__=base, **fields)


@cache
def _section(key: str, name: str, found: type) -> type[Section]:
    if issubclass(found, Section):
        section: type[Section] = _model(name, found, kind=(str, ...))
        return section
    fields: dict[str, Any] = {"kind": (str, ...)}
    not_written = set()
    for parameter, hint in _parameters(name, found):
        default = ... if parameter.default is parameter.empty else parameter.default
        adapter = _adapter(hint)
        if adapter is not None:
            field = f"{parameter.name}_"
            fields[field] = (hint, Field(default, alias=parameter.name))
            if not _is_read_back(adapter, default):
                not_written.add(field)
        elif default is ...:
            raise InputError(
                f"{name}: the argument `{parameter.name}` has a type that a scenario"
                " file cannot contain; give this argument a default value, or define"
                " a section for the class"
            )
    fields["constructors"] = (ClassVar[Any], (found,))
    fields["not_written"] = (ClassVar[Any], not_written)
    return create_model(
        name, __base__=(_ArgumentsSection, PARTS[key].section), **fields
    )


def _parameters(name: str, found: type) -> Iterator[tuple[Parameter, object]]:
    keys = [
        parameter
        for parameter in signature(found).parameters.values()
        if parameter.name not in _CONTEXT
        and parameter.kind in (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)
    ]
    annotations = {
        key.name: key.annotation for key in keys if key.annotation is not key.empty
    }
    namespace = getattr(found.__init__, "__globals__", {})  # type: ignore[misc]
    try:
        hints = get_type_hints(
            SimpleNamespace(__annotations__=annotations), namespace, include_extras=True
        )
    except (NameError, SyntaxError, TypeError) as error:
        text = (
            f"{name}: the types of the constructor's arguments cannot be read ({error})"
        )
        raise InputError(
            f"{text}; import these types outside of `if TYPE_CHECKING`"
        ) from error
    for key in keys:
        yield key, hints.get(key.name, Any)


def _adapter(hint: Any) -> TypeAdapter[object] | None:
    """Return the validator of a type, or None if a file cannot contain the type."""
    try:
        adapter: TypeAdapter[object] = TypeAdapter(hint)
        adapter.json_schema()
    except PydanticUserError:
        return None
    return adapter


def _is_read_back(adapter: TypeAdapter[object], default: object) -> bool:
    try:
        written = adapter.dump_json(default, warnings=False)
        return default is ... or bool(adapter.validate_json(written) == default)
    except ValueError:
        return False
