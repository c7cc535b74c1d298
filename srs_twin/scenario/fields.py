"""Sections of files: what a key may hold, the unit that it names, and what is built of it in SI.

The unit of a number stands in its key and nowhere else: ``frequency_hz``, ``k_per_rad``, ``distance_mm``. A
section builds an object by a constructor whose parameters have the keys' names without their units
(``frequency``, ``k`` or ``K``, ``distance``). Where the constructor has a default, the file has the same. The
docstring of a key is its description in JSON schemas; of a number, unit and range come behind it, and
``{default}`` stands for the constructor's.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, ClassVar, Self

from pydantic import ConfigDict, Field, model_validator

from srs_twin.io.validation import StrictModel, attribute_docstrings
from srs_twin.robot.sourced import from_si, split_unit, to_si

Line = Annotated[str, Field(min_length=1, max_length=200)]
PathOrName = Annotated[str, Field(min_length=1, max_length=4096)]
FilePath = Annotated[str, Field(min_length=1, max_length=1000)]


def quantity(low: float, high: float, default: Any = ..., *, unit: str | None = None) -> Any:
    """Return the field of a bounded number of a `Section`.

    Args:
        low: the lowest allowed.
        high: the highest allowed.
        default: what a file gets that leaves it out. Not given: the constructor's, and the key is required
            where that has none.
        unit: of a key that does not name it.
    """
    given = {} if default is ... else {"default": default}
    return partial(Field, ge=low, le=high, json_schema_extra={"unit": unit} if unit else None, **given)


def constructor_default() -> Any:
    """Return the field of anything else that has the constructor's default."""
    return partial(Field)


def _describe(schema: dict[str, Any], cls: type[Section]) -> None:
    """Say of each key what its docstring says; of a number also unit, range and default."""
    for key, text in attribute_docstrings(cls).items():
        shown = schema["properties"][key]
        title = text.partition(";")[0].rstrip(".")
        for bounds in (shown, *shown.get("anyOf", ())):
            if "minimum" in bounds:
                parameter, unit = cls.parameter(key), shown.setdefault("unit", split_unit(key)[1])
                title = text.rstrip(".").format(default=from_si(key, parameter and parameter.default))
                low, high = bounds["minimum"], bounds["maximum"]
                text = f"{title}{'' if unit == '1' else f' in {unit}'}, {low:.10g} to {high:.10g}."
        shown |= {"title": title, "description": text}


class Section(StrictModel):
    """A block of keys of a file.

    Attributes:
        constructors: whose parameters the keys set, the first's before the others'; `build` calls the first.
        parameters: of the constructors, by name in small letters.
        only: key and what it must be → other keys, which mean nothing without that.
    """

    model_config = ConfigDict(json_schema_extra=_describe)

    constructors: ClassVar[tuple[Callable[..., Any], ...]] = ()
    parameters: ClassVar[dict[str, inspect.Parameter]] = {}
    only: ClassVar[dict[tuple[str, str], tuple[str, ...]]] = {}

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        signatures = [inspect.signature(each).parameters for each in reversed(cls.constructors)]
        cls.parameters = {name.lower(): each for known in signatures for name, each in known.items()}
        for key, given in list(vars(cls).items()):
            if isinstance(given, partial):
                parameter = cls.parameter(key)
                known = parameter is not None and parameter.default is not parameter.empty
                own = {"default": parameter.default} if parameter and known else {}
                setattr(cls, key, Field(**own | given.keywords))

    @classmethod
    def parameter(cls, key: str) -> inspect.Parameter | None:
        """Return the parameter that a key sets, by its whole name or by that without its unit."""
        return cls.parameters.get(key) or cls.parameters.get(split_unit(key)[0])

    @model_validator(mode="after")
    def _belongs_there(self) -> Self:
        for (key, needed), names in self.only.items():
            given = [name for name in names if getattr(self, name) is not None]
            if given and getattr(self, key) != needed:
                text = f"{given[0]} belongs to {key}: {needed}; set that, or take {given[0]} out"
                raise ValueError(text)
        return self

    def arguments(self, *of: Callable[..., Any]) -> dict[str, Any]:
        """Return what the keys set, by parameter, in SI; None leaves a default alone.

        Args:
            of: constructors whose parameters count; none: all.
        """
        known = {name for each in of for name in inspect.signature(each).parameters}
        found = {}
        for key, value in self:
            parameter = self.parameter(key)
            if parameter is None or (of and parameter.name not in known):
                continue
            if not (value is None and parameter.default is not parameter.empty):
                found[parameter.name] = to_si(key, value)
        return found

    def build(self) -> Any:
        """Return what the section describes."""
        return self.constructors[0](**self.arguments())

    def with_defaults(self, *keys: str) -> Self:
        """Return the section with the constructor's defaults for these keys where it says nothing."""
        missing = {key: self.parameter(key) for key in keys if getattr(self, key) is None}
        return self.model_copy(update={k: from_si(k, each.default) for k, each in missing.items() if each})
