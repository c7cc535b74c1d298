"""Numbers of files: the unit that a key names, and records with status and source.

The unit of a number stands in its key and nowhere else: ``segment_length_m``, ``stiffness_nm_per_rad``. A
`Record` repeats it beside the number, and the two are checked against each other, so that a number copied
from a table with another unit is refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar, Generic, Literal, NamedTuple, TypeVar

from pydantic import (
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from srs_twin.io.validation import Strict, docstrings

UNITS = {
    "_nm_per_rad": "N*m/rad",
    "_rad_per_m": "rad/m",
    "_rad_per_s": "rad/s",
    "_deg_per_s": "deg/s",
    "_s_per_rad": "s/rad",
    "_l_per_min": "L/min",
    "_per_rad": "1/rad",
    "_per_s": "1/s",
    "_rad_s": "rad/s",
    "_m_s": "m/s",
    "_kpa": "kPa",
    "_rad": "rad",
    "_deg": "deg",
    "_hz": "Hz",
    "_kg": "kg",
    "_mm": "mm",
    "_ml": "ml",
    "_uv": "µV",
    "_m": "m",
    "_n": "N",
    "_s": "s",
    "_v": "V",
}
"""How a key ends → the unit of its number; longer ends first."""

# The SI unit, and one of the unit in it as a numerator and a denominator: 3.1 mm divided by 1000 are the
# double 0.0031.
_IN_SI = {
    "kPa": ("Pa", 1000, 1),
    "mm": ("m", 1, 1000),
    "ml": ("m³", 1, 1e6),
    "µV": ("V", 1, 1e6),
    "L/min": ("m³/s", 1, 60_000),
    "deg": ("rad", math.pi, 180),
}


def split_unit(key: str) -> tuple[str, str]:
    """Return a key without its unit, and the unit; "1" where it names none."""
    # The n of μ_n is the normal to the heading.
    ending = next((each for each in UNITS if key.endswith(each) and key != "mu_n"), "")
    return key.removesuffix(ending), UNITS.get(ending, "1")


def si_unit(key: str) -> str:
    """Return the SI unit of a key's value after `in_si`."""
    unit = split_unit(key)[1]
    return _IN_SI.get(unit, (unit, 1, 1))[0]


def in_si(key: str, value: Any) -> Any:
    """Return a value of a key in SI."""
    _, up, down = _IN_SI.get(split_unit(key)[1], ("", 1, 1))
    return value if value is None or up == down else value * up / down


def in_unit(key: str, value: Any) -> Any:
    """Return a value in SI in the unit that a key names."""
    _, up, down = _IN_SI.get(split_unit(key)[1], ("", 1, 1))
    return value if value is None or up == down else round(value * down / up, 6)


Status = Literal["measured", "calibrated", "estimated"]
Value = TypeVar("Value")
Unit = TypeVar("Unit")


_SHAPES = {"normal": ("sd",), "lognormal": ("factor",), "uniform": ("low", "high")}


class Uncertain(Strict):
    """How well a number is known: a distribution."""

    kind: Literal["normal", "lognormal", "uniform"]
    """normal: around the number; lognormal: its logarithm is, within a factor; uniform: a range."""
    sd: float | None = Field(None, gt=0.0, le=1e9)
    """Standard deviation of a normal distribution, in the number's unit."""
    factor: float | None = Field(None, gt=1.0, le=100.0)
    """Geometric standard deviation: two thirds lie between the number over and times this."""
    low: float | None = Field(None, ge=-1e9, le=1e9)
    """Lower end of the range, in the number's unit."""
    high: float | None = Field(None, ge=-1e9, le=1e9)
    """Upper end of the range."""
    source: str | None = Field(None, min_length=1, max_length=1000)
    """Where the spread comes from, or why it was assumed."""

    @model_validator(mode="after")
    def _has_its_numbers(self) -> Uncertain:
        wanted = _SHAPES[self.kind]
        given = tuple(name for name in ("sd", "factor", "low", "high") if getattr(self, name) is not None)
        if given != wanted:
            raise ValueError(f"{self.kind} takes {' and '.join(wanted)}, not {', '.join(given) or 'nothing'}")
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise ValueError(f"low {self.low:g} is not below high {self.high:g}")
        return self

    @model_serializer(mode="wrap")
    def _what_is_given(self, inner: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in inner(self).items() if value is not None}


class Record(Strict, Generic[Value, Unit]):
    """One number and where it comes from."""

    value: Value
    """The number, in the unit that the key names."""
    unit: Unit
    """The unit, the same as in the key; '1' for a pure number."""
    status: Status
    """measured: stated in the source as measured or set; calibrated: found by a fit to measurements;
    estimated: our assumption."""
    source: str = Field(min_length=1, max_length=1000)
    """Section, table, or how it was estimated."""
    uncertain: Uncertain | None = None
    """How well it is known (default: taken as it is)."""

    @model_serializer(mode="wrap")
    def _what_is_known(self, inner: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in inner(self).items() if key != "uncertain" or value is not None}

    @classmethod
    def model_parametrized_name(cls, params: tuple[Any, ...]) -> str:
        """Give the models of all records one readable name in JSON schemas."""
        return "Record"


def between(low: float, high: float) -> Any:
    """Return the bounds of a number."""
    return Field(ge=low, le=high)


class _Number(NamedTuple):
    """What a section says of a record, before its key is known."""

    low: float
    high: float
    kind: type
    shape: Callable[[Any], Any]
    optional: bool


def number(
    low: float,
    high: float,
    kind: type = float,
    shape: Callable[[Any], Any] = lambda value: value,
    optional: bool = False,
) -> Any:
    """Return the field of a `Record` in a `Records` section.

    Args:
        low: the lowest allowed.
        high: the highest allowed.
        kind: of number, float or int.
        shape: returns what a record may hold, given what a number may be; default one number.
        optional: whether the file may leave it out.
    """
    return _Number(low, high, kind, shape, optional)


def _describe(schema: dict[str, Any], cls: type[Records]) -> None:
    """Say of each key what its docstring says; unit and range stand before a semicolon."""
    for key, text in docstrings(cls).items():
        shown = schema["properties"][key]
        head, semicolon, more = text.rstrip(".").partition(";")
        shown["description"] = f"{head}{shown.get('description', '')}{semicolon}{more}."


class Records(Strict):
    """A section of a file whose numbers are records."""

    model_config = ConfigDict(json_schema_extra=_describe)
    bounds: ClassVar[dict[str, tuple[float, float]]]  # of each number

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.bounds = {}
        for key, given in list(vars(cls).items()):
            if isinstance(given, _Number):
                cls.bounds[key] = given.low, given.high
                unit, value = split_unit(key)[1], Annotated[given.kind, between(given.low, given.high)]
                record: Any = Record[given.shape(value), Literal[unit]]  # type: ignore[misc]
                cls.__annotations__[key] = record | None if given.optional else record
                words = f"{'' if unit == '1' else f', {unit}'}, {given.low:.10g} to {given.high:.10g}"
                setattr(cls, key, Field(None if given.optional else ..., description=words))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as plain data: pickle does not find the classes of the records by name."""
        return type(self).model_validate, (self.model_dump(exclude_unset=True),)

    def in_si(self) -> dict[str, Any]:
        """Return the numbers by key without its unit, in SI."""
        return {split_unit(key)[0]: in_si(key, each.value) for key, each in self if each is not None}


def restated(before: Mapping[str, Any] | None, value: Any, unit: str | None, source: str) -> dict[str, Any]:
    """Return plain data of a record whose number somebody sets: an estimate, and what it is.

    Args:
        before: plain data of the record so far, whose unit stays; None or empty: there is none yet.
        value: the number.
        unit: of the key, for a record that is new.
        source: who set it.
    """
    kept = {key: each for key, each in (before or {"unit": unit}).items() if key != "uncertain"}
    return {**kept, "value": value, "status": "estimated", "source": source}
