"""Sections of files: what a key may hold, the unit that it names, and what is built of it in SI.

The unit of a number stands in its key and nowhere else: ``frequency_hz``, ``k_per_rad``, ``distance_mm``. A
section builds an object by a constructor whose parameters have the keys' names without their units
(``frequency``, ``k`` or ``K``, ``distance``). Where the constructor has a default, the file has the same.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Self

from pydantic import Field

from srs_twin.io.validation import Strict
from srs_twin.robot.sourced import in_si, in_unit, split_unit


@dataclass(frozen=True)
class _Key:
    """What a section says of a key, before the key's name and the constructor are known."""

    text: str
    default: Any
    bounds: tuple[float, float] | None = None
    unit: str | None = None

    def field(self, key: str, parameter: inspect.Parameter | None) -> Any:
        own = parameter.default if parameter and parameter.default is not parameter.empty else ...
        default = own if self.default is ... else self.default
        if self.bounds is None:
            return Field(default, title=self.text.partition(";")[0].rstrip("."), description=self.text)
        (low, high), unit = self.bounds, self.unit or split_unit(key)[1]
        title = self.text.format(default=None if own is ... else in_unit(key, own))
        text = f"{title}{'' if unit == '1' else f' in {unit}'}, {low:.10g} to {high:.10g}."
        return Field(
            default, title=title, description=text, ge=low, le=high, json_schema_extra={"unit": unit}
        )


def quantity(title: str, low: float, high: float, default: Any = ..., *, unit: str | None = None) -> Any:
    """Return the field of a bounded number of a `Section`.

    Args:
        title: what it is; ``{default}`` in it is the constructor's default.
        low: the lowest allowed.
        high: the highest allowed.
        default: what a file gets that leaves it out. Not given: the constructor's, and the key is required
            where that has none.
        unit: of a key that does not name it.
    """
    return _Key(title, default, (low, high), unit)


def section(text: str, default: Any = ...) -> Any:
    """Return the field of anything else, with a description; `default` as in `quantity`."""
    return _Key(text, default)


class Section(Strict):
    """A block of keys of a file.

    Attributes:
        constructors: whose parameters the keys set, the first's before the others'; `build` calls the first.
        parameters: of the constructors, by name in small letters.
    """

    constructors: ClassVar[tuple[Callable[..., Any], ...]] = ()
    parameters: ClassVar[dict[str, inspect.Parameter]] = {}

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        signatures = [inspect.signature(each).parameters for each in reversed(cls.constructors)]
        cls.parameters = {name.lower(): each for known in signatures for name, each in known.items()}
        for key, given in list(vars(cls).items()):
            if isinstance(given, _Key):
                setattr(cls, key, given.field(key, cls.parameter(key)))

    @classmethod
    def parameter(cls, key: str) -> inspect.Parameter | None:
        """Return the parameter that a key sets, by its whole name or by that without its unit."""
        return cls.parameters.get(key) or cls.parameters.get(split_unit(key)[0])

    def arguments(self) -> dict[str, Any]:
        """Return what the keys set, by parameter, in SI; None leaves a default alone."""
        found = {}
        for key in type(self).model_fields:
            parameter, value = self.parameter(key), getattr(self, key)
            if parameter and not (value is None and parameter.default is not parameter.empty):
                found[parameter.name] = in_si(key, value)
        return found

    def build(self) -> Any:
        """Return what the section describes."""
        return self.constructors[0](**self.arguments())

    def with_defaults(self, *keys: str) -> Self:
        """Return the section with the constructor's defaults for these keys where it says nothing."""
        missing = {key: self.parameter(key) for key in keys if getattr(self, key) is None}
        return self.model_copy(update={k: in_unit(k, each.default) for k, each in missing.items() if each})
