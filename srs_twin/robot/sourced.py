"""Numbers with unit, status and source, and the units of file keys.

The name of a key ends with a unit, as in ``segment_length_m`` or
``stiffness_nm_per_rad``. A `Record` repeats the unit next to the number. The two units
must agree, so a number copied from a table in another unit is rejected.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar, Generic, Literal, NamedTuple, TypeVar

import numpy as np
from pydantic import (
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)
from pydantic.fields import FieldInfo

from srs_twin.io.validation import StrictModel, attribute_docstrings

UNITS = {
    "_nm_per_rad": "N*m/rad",
    "_rad_per_m": "rad/m",
    "_m_per_kpa": "m/kPa",
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
"""Unit of each key suffix, with longer suffixes first, because the first match counts.
"""

# SI unit of each unit, with the numerator and denominator of the conversion factor.
# Division avoids rounding errors, because 3.1 / 1000 is the double 0.0031, but
# 3.1 * 0.001 is not.
_SI_CONVERSIONS = {
    "kPa": ("Pa", 1000, 1),
    "m/kPa": ("m/Pa", 1, 1000),
    "mm": ("m", 1, 1000),
    "ml": ("m³", 1, 1e6),
    "µV": ("V", 1, 1e6),
    "L/min": ("m³/s", 1, 60_000),
    "deg": ("rad", math.pi, 180),
}


def split_unit(key: str) -> tuple[str, str]:
    """Split a key into name and unit.

    A key without a unit suffix has the unit "1".
    """
    # The letter n in mu_n denotes the normal direction, not the unit newton.
    suffix = next(
        (suffix for suffix in UNITS if key.endswith(suffix) and key != "mu_n"), ""
    )
    return key.removesuffix(suffix), UNITS.get(suffix, "1")


def si_unit(key: str) -> str:
    """Return the SI unit to which `to_si` converts the value of a key."""
    unit = split_unit(key)[1]
    return _SI_CONVERSIONS.get(unit, (unit, 1, 1))[0]


def to_si(key: str, value: Any) -> Any:
    """Convert the value of a key to SI units."""
    _, up, down = _SI_CONVERSIONS.get(split_unit(key)[1], ("", 1, 1))
    return value if value is None or up == down else value * up / down


def from_si(key: str, value: Any) -> Any:
    """Convert a value in SI units to the unit of a key."""
    _, up, down = _SI_CONVERSIONS.get(split_unit(key)[1], ("", 1, 1))
    return value if value is None or up == down else round(value * down / up, 6)


Status = Literal["measured", "calibrated", "estimated"]
Value = TypeVar("Value")
Unit = TypeVar("Unit")


_DISTRIBUTION_KEYS = {
    "normal": ("sd",),
    "lognormal": ("factor",),
    "uniform": ("low", "high"),
}


MIN_PROBABILITY = 1e-9
"""Minimum distance of probabilities from 0 and 1, because normal quantiles are infinite
there."""


class Uncertain(StrictModel):
    """Prior distribution of an uncertain number."""

    kind: Literal["normal", "lognormal", "uniform"]
    """Kind of distribution. The number is the mean of a "normal" distribution and,
    unless `median` is given, the median of a "lognormal" distribution. A "uniform"
    distribution ranges from low to high."""
    sd: float | None = Field(None, gt=0.0, le=1e9)
    """Standard deviation of a normal distribution, in the unit of the number."""
    factor: float | None = Field(None, gt=1.0, le=100.0)
    """Geometric standard deviation of a lognormal distribution. Two thirds of the
    values lie between median / factor and median * factor."""
    median: float | None = Field(None, gt=0.0, le=1e9)
    """Median of a lognormal distribution, in the unit of the number (default: the
    number)."""
    low: float | None = Field(None, ge=-1e9, le=1e9)
    """Lower bound of a uniform distribution, in the unit of the number."""
    high: float | None = Field(None, ge=-1e9, le=1e9)
    """Upper bound of a uniform distribution, in the unit of the number."""
    source: str | None = Field(None, min_length=1, max_length=1000)
    """Source of the distribution, or reason for assuming it."""

    @model_validator(mode="after")
    def _check_keys(self) -> Uncertain:
        required = _DISTRIBUTION_KEYS[self.kind]
        present = tuple(
            name
            for name in ("sd", "factor", "low", "high")
            if getattr(self, name) is not None
        )
        if present != required:
            needs = " and ".join(required)
            has = ", ".join(present) or "nothing"
            raise ValueError(
                f"the distribution `{self.kind}` needs {needs}, but {has} was given"
            )
        if self.median is not None and self.kind != "lognormal":
            raise ValueError(
                f"the distribution `{self.kind}` has no `median`; it needs"
                f" {' and '.join(required)}"
            )
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise ValueError(f"`low` {self.low:g} must be below `high` {self.high:g}")
        return self

    @model_serializer(mode="wrap")
    def _without_missing(
        self, inner: SerializerFunctionWrapHandler
    ) -> dict[str, object]:
        return {key: value for key, value in inner(self).items() if value is not None}

    def quantile(
        self, value: float, bounds: tuple[float, float], probabilities: np.ndarray
    ) -> np.ndarray:
        """Return quantiles of the distribution.

        Args:
            value: uncertain number in the file.
            bounds: minimum and maximum of the number, at which normal and lognormal
                distributions are truncated.
            probabilities: cumulative probabilities, any shape.
        """
        if self.low is not None and self.high is not None:
            return self.low + (self.high - self.low) * np.asarray(probabilities)
        if self.factor is not None:
            # A bound of 0, which has an infinite logarithm, is replaced by 1e-300.
            median = value if self.median is None else self.median
            ends = np.log(np.maximum(bounds, 1e-300) / median) / np.log(self.factor)
            return np.asarray(
                median * self.factor ** _truncated_normal(ends, probabilities)
            )
        assert self.sd is not None, "the model of the file requires it"
        ends = (np.array(bounds) - value) / self.sd
        return np.asarray(value + self.sd * _truncated_normal(ends, probabilities))


def _truncated_normal(ends: np.ndarray, probabilities: np.ndarray) -> np.ndarray:
    from scipy.special import ndtr, ndtri

    low, high = ndtr(ends)
    inside = np.clip(probabilities, MIN_PROBABILITY, 1 - MIN_PROBABILITY)
    return np.asarray(ndtri(low + (high - low) * inside))


class Record(StrictModel, Generic[Value, Unit]):
    """Number with unit, status and source."""

    value: Value
    """Number in the unit of the key."""
    unit: Unit
    """Unit, which must match the suffix of the key, or '1' for a dimensionless number.
    """
    status: Status
    """Origin of the number, "measured" if the source states a measured or set value,
    "calibrated" if fitted to measurements, or "estimated" if assumed by this project.
    """
    source: str = Field(min_length=1, max_length=1000)
    """Section or table that states the number, or method of estimation."""
    uncertain: Uncertain | None = None
    """Prior distribution of the number (default: none, for an exact number)."""

    @model_serializer(mode="wrap")
    def _without_missing(
        self, inner: SerializerFunctionWrapHandler
    ) -> dict[str, object]:
        return {
            key: value
            for key, value in inner(self).items()
            if key != "uncertain" or value is not None
        }

    @classmethod
    def model_parametrized_name(cls, params: tuple[object, ...]) -> str:
        """Return a readable type name for JSON Schemas."""
        return "Record"


def bounded(low: float, high: float) -> FieldInfo:
    """Return a pydantic field that restricts a number to an interval."""
    field: FieldInfo = Field(ge=low, le=high)
    return field


class _NumberField(NamedTuple):
    low: float
    high: float
    kind: type = float
    shape: Callable[[Any], Any] = lambda value: value
    optional: bool = False
    needed_by: str | None = None
    only_for: str | None = None


def number_field(low: float, high: float, kind: type = float, **options: Any) -> Any:
    """Define a numeric key of a `Records` section.

    Args:
        low: minimum allowed number.
        high: maximum allowed number.
        kind: type of the number, float or int.
        **options: `shape` is a function that converts the type of one number to the
            type of the record's value (default: one number). `optional` states whether
            the key may be missing. `needed_by` is the robot kind that requires the key.
            `only_for` is the only robot kind that may have the key.
    """
    return _NumberField(low, high, kind, **options)


def _describe(schema: dict[str, Any], cls: type[Records]) -> None:
    """Insert the unit and range before the first semicolon of each description."""
    for key, text in attribute_docstrings(cls).items():
        entry = schema["properties"][key]
        head, semicolon, rest = text.rstrip(".").partition(";")
        entry["description"] = f"{head}{entry.get('description', '')}{semicolon}{rest}."


class Records(StrictModel):
    """Base class of file sections whose numbers are records.

    Attributes:
        bounds: mapping from each key to the minimum and maximum of its number.
        needed_by: mapping from keys to the robot kind that requires them. Other robots
            cannot have these keys.
        only_for: mapping from keys to the only robot kind that may have them.
    """

    model_config = ConfigDict(json_schema_extra=_describe)
    bounds: ClassVar[dict[str, tuple[float, float]]]
    needed_by: ClassVar[dict[str, str]]
    only_for: ClassVar[dict[str, str]] = {}

    def __init_subclass__(cls, needed_by: str | None = None, **options: Any) -> None:
        super().__init_subclass__(**options)
        fields = {
            key: field
            for key, field in vars(cls).items()
            if isinstance(field, _NumberField)
        }
        cls.bounds = {key: (field.low, field.high) for key, field in fields.items()}
        cls.needed_by = {
            key: kind
            for key, field in fields.items()
            if (kind := field.needed_by or needed_by)
        }
        cls.only_for = cls.only_for | {
            key: field.only_for for key, field in fields.items() if field.only_for
        }
        for key, field in fields.items():
            unit = split_unit(key)[1]
            value: Any = Annotated[field.kind, bounded(field.low, field.high)]
            record: Any = Record[field.shape(value), Literal[unit]]  # type: ignore[misc]
            optional = field.optional or field.needed_by or field.only_for
            cls.__annotations__[key] = record | None if optional else record
            text = (
                f"{'' if unit == '1' else f', {unit}'}, {field.low:.10g} to"
                f" {field.high:.10g}"
            )
            setattr(cls, key, Field(None if optional else ..., description=text))

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle plain data, because pickle cannot import the generated classes."""
        return type(self).model_validate, (self.model_dump(exclude_unset=True),)

    def to_si(self) -> dict[str, Any]:
        """Return the numbers in SI units, keyed by name without unit suffix."""
        return {
            split_unit(key)[0]: to_si(key, record.value)
            for key, record in self
            if isinstance(record, Record)
        }


def replace_value(
    before: Mapping[str, object] | None, value: object, unit: str | None, source: str
) -> dict[str, object]:
    """Return a record with a new number and status "estimated", as plain data.

    Args:
        before: data of the old record, whose unit is kept, or None for a new record.
        value: new number.
        unit: unit of a new record.
        source: origin of the number.
    """
    record = {
        key: entry
        for key, entry in (before or {"unit": unit}).items()
        if key != "uncertain"
    }
    return {**record, "value": value, "status": "estimated", "source": source}
