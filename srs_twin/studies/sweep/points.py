"""Sweep files and sweep points, which are combinations of field values."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, Discriminator, Field, Tag, model_validator

from srs_twin.errors import InputError
from srs_twin.io.documents import Loc, parse_path
from srs_twin.io.provenance import Provenance
from srs_twin.planning.scenario import PLANNER_FILES
from srs_twin.robot.file import section_units
from srs_twin.robot.sourced import replace_value
from srs_twin.scenario.expectation import MetricName
from srs_twin.scenario.fields import Line, PathOrName, Section, quantity
from srs_twin.scenario.plants import PRESET, with_preset
from srs_twin.scenario.provenance import run_provenance

if TYPE_CHECKING:
    from srs_twin.scenario.modified import Changes as Changed


MAX_POINTS = 1_000_000

MAX_FIELDS = 16

Value = bool | int | float | str

Plain = bool | int | float | Annotated[str, Field(max_length=200)]


def _check_field_name(name: str) -> str:
    try:
        parse_path(name)
    except InputError as error:
        raise ValueError(str(error)) from None
    return name


FieldName = Annotated[
    str, Field(min_length=1, max_length=200), AfterValidator(_check_field_name)
]
FieldValues = Annotated[list[Plain], Field(min_length=1, max_length=10_000)]


class Plot(Section):
    """Plot of sweep results."""

    kind: Literal["line", "scatter"]
    """Kind of plot."""
    x: FieldName
    """Varied field on the x axis, or a metric in the case of a scatter plot."""
    metric: MetricName
    """Metric on the y axis."""
    by: FieldName | None = None
    """Varied field whose values are shown in separate lines or colours."""


class RangeFile(Section):
    """Range of field values, including both ends."""

    start: float = Field(
        alias="from",
        ge=-1e12,
        le=1e12,
        title="From",
        description="First value of the field.",
    )
    stop: float = Field(
        alias="to",
        ge=-1e12,
        le=1e12,
        title="To",
        description="Last value of the field.",
    )
    count: int | None = quantity(2, 10_000, None)
    """Number of values for the sampling kinds `grid` and `list`."""
    scale: Literal["linear", "log"] = "linear"
    """Spacing of the values, which is linear or logarithmic."""

    @model_validator(mode="after")
    def _ascending(self) -> RangeFile:
        if not self.start < self.stop:
            raise ValueError(
                f"`from` must be below `to`, but {self.start:g} is not below"
                f" {self.stop:g}"
            )
        if self.scale == "log" and self.start <= 0:
            raise ValueError(
                "with `scale: log`, all values must be above 0, but `from` is"
                f" {self.start:g}"
            )
        return self


def _values_or_range(value: object) -> str:
    if isinstance(value, dict | RangeFile):
        return "range"
    return "values"


_OneOf = Annotated[FieldValues, Tag("values")] | Annotated[RangeFile, Tag("range")]
VariedField = Annotated[_OneOf, Discriminator(_values_or_range)]


class SamplingFile(Section):
    """Method for combining the values of several fields."""

    kind: Literal["grid", "list", "latin_hypercube", "sobol"] = "grid"
    """Sampling method. The method `grid` uses all combinations of values, and `list`
    combines the k-th values of all fields. The methods `latin_hypercube` and `sobol`
    draw points that fill the ranges evenly.
    """
    count: int | None = quantity(1, MAX_POINTS, None)
    """Number of points for `latin_hypercube` and `sobol`. With `sobol`, the number must
    be a power of 2.
    """
    seed: int | None = quantity(0, 2**32 - 1, None)
    """Random seed of the points for `latin_hypercube` and `sobol` (default 0)."""

    @model_validator(mode="after")
    def _check_combinations(self) -> SamplingFile:
        if self.kind in ("grid", "list"):
            for name in ("count", "seed"):
                if getattr(self, name) is not None:
                    raise ValueError(
                        f"`{name}` is allowed only for latin_hypercube and sobol, not"
                        f" for {self.kind}"
                    )
        elif self.count is None:
            raise ValueError(
                f"the sampling {self.kind} needs the number of points; set `count`"
            )
        elif self.kind == "sobol" and self.count & (self.count - 1):
            below = 1 << (self.count.bit_length() - 1)
            raise ValueError(
                f"`count` {self.count} is not allowed for sobol; use a power of 2,"
                f" such as {below} or {2 * below}"
            )
        return self


class SweepFile(Section):
    """Sweep of one scenario with many values of its fields."""

    title: Line | None = None
    """Title on one line (default: the name of the sweep)."""
    scenario: PathOrName
    """Name of a shipped scenario or path of a scenario file."""
    plants: (
        Annotated[list[Literal["analytical", "twin"]], Field(max_length=2)] | None
    ) = None
    """Plants to simulate (default: the plants of the scenario). With an empty list, the
    scenario is planned but not simulated.
    """
    periods: float | None = quantity(3.0, 1000.0, None)
    """Simulated time in periods of the gait or the reference, which replaces
    `duration_s`. The time is rounded up to whole control ticks.
    """
    fixed: Annotated[dict[FieldName, Plain], Field(max_length=64)] = {}
    """New values of scenario fields, which apply to all runs."""
    vary: Annotated[
        dict[FieldName, VariedField], Field(min_length=1, max_length=MAX_FIELDS)
    ]
    """Scenario fields to vary, keyed by dotted name (such as `supply.pressure_kpa`).
    Each field has a list of values, or a range with the keys `from`, `to` and `count`.
    """
    sampling: SamplingFile = SamplingFile()
    """Method for combining the values."""
    metrics: Annotated[list[MetricName], Field(min_length=1, max_length=64)] | None = (
        None
    )
    """Metrics to include in the table of results (default: all)."""
    trajectories: bool = False
    """Whether to store the trajectories of all runs."""
    plots: Annotated[list[Plot], Field(max_length=32)] = []
    """Plots of the sweep results."""


def is_number(value: object) -> bool:
    """Return whether a value is an integer or a float, but not a boolean."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def sweep_json_schema() -> dict[str, object]:
    """Return the JSON Schema (draft 2020-12) of sweep files."""
    schema = SweepFile.model_json_schema(by_alias=True)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | schema


RUNNER = "srs_twin.studies.sweep.task"
"""Module that runs a point. Its source code and imports affect the row keys."""

Changes = Mapping[str, Value]

BY_A_SWEEP = "varied by a sweep"
"""Source that is recorded for robot parameters set by a sweep."""


@dataclass(frozen=True)
class Point:
    """Point of a sweep, with the value of each varied field.

    Attributes:
        key: SHA-256 of all inputs that affect the results.
    """

    key: str
    changes: Changes


@dataclass(frozen=True)
class Experiment:
    """Inputs shared by all points of a sweep.

    Attributes:
        base: scenario as plain data, including defaults, robot and fixed fields.
        plants: plants to simulate, or an empty tuple if the scenario is only planned.
        periods: simulated time in periods of the gait or the reference, or None to use
            the field duration_s of the scenario.
        robots: contents of robot files, keyed by the values of the field `robot`.
    """

    base: Mapping[str, Any] = field(repr=False)
    plants: tuple[str, ...]
    periods: float | None = None
    robots: Mapping[str, object] = field(default_factory=dict, repr=False)
    trajectories: bool = False

    def document(self, changes: Changes) -> dict[str, Any]:
        """Return the changed scenario as plain data for `parse_scenario`."""
        document = self.with_fixed(changes)
        for key in ("expect", "changes"):
            document.pop(key, None)
        if self.periods is not None:
            document["duration_s"] = _duration(document, self.plants, self.periods)
        return document

    def provenance(self, document: Mapping[str, object]) -> Provenance:
        """Return the provenance of a scenario that runs on the experiment's plants."""
        return run_provenance(document, self.plants, RUNNER)

    def point(self, changes: Changes) -> Point:
        """Return the sweep point with the given field values."""
        return Point(self.provenance(self.document(changes)).key, changes)

    def with_fixed(self, fixed: Mapping[str, Value | list[Value]]) -> dict[str, Any]:
        """Return the base scenario with some fields changed, as plain data."""
        document = dict(self.base)
        for name, value in fixed.items():
            document = self.with_change(document, name, value)
        return document

    def with_change(self, document: Any, name: str, value: Value | list[Value]) -> Any:
        """Return a scenario with one field changed, as plain data.

        A robot name is replaced by the contents of the robot file.
        """
        content: object = (
            self.robots.get(str(value), value) if name == "robot" else value
        )
        path = parse_path(name)
        if name == "planner.kind":
            document = _with_planner_keys(document, value)
        if path == PRESET:
            twin = with_preset(document["plants"].get("twin", {}), value)
            return {**document, "plants": {**document["plants"], "twin": twin}}
        if len(path) == 3 and path[0] == "robot" and not isinstance(content, Mapping):
            # A parameter that is missing from the robot file needs a new record.
            unit = section_units(str(path[1])).get(str(path[2]))
            if unit is not None:
                content = replace_value(None, value, unit, BY_A_SWEEP)
        return with_value(document, path, content)


@dataclass(frozen=True)
class Sweep:
    """Loaded and validated sweep.

    Attributes:
        name: name of the sweep and of its default output folder.
        fields: dotted names of the varied fields.
        values: values of the varied fields, one row per point.
        metrics: metrics that become columns, or None for all metrics.
        document: sweep file as plain data.
        changes: fields that differ from the sweep file.
    """

    name: str
    title: str
    experiment: Experiment
    fields: tuple[str, ...]
    values: tuple[tuple[Value, ...], ...] = field(repr=False)
    metrics: tuple[str, ...] | None
    plots: tuple[Plot, ...]
    document: Mapping[str, Any] = field(repr=False)
    warnings: tuple[str, ...] = ()
    changes: Changed = ()

    @cached_property
    def points(self) -> tuple[Point, ...]:
        """Distinct points, in the order of the sweep file."""
        points: dict[str, Point] = {}
        for row in self.values:
            changes = dict(zip(self.fields, row, strict=True))
            point = self.experiment.point(changes)
            points.setdefault(point.key, point)
        return tuple(points.values())


def _with_planner_keys(document: Any, kind: Any) -> Any:
    planner = document.get("planner")
    if not isinstance(planner, Mapping) or kind not in PLANNER_FILES:
        return document
    known = PLANNER_FILES[kind].model_fields
    kept = {key: value for key, value in planner.items() if key in known}
    return {**document, "planner": kept}


def with_value(data: Any, loc: Loc, value: object) -> Any:
    """Return a copy of plain data in which one value is replaced.

    If a number replaces the record of a robot parameter, the record keeps its unit, and
    its source becomes `BY_A_SWEEP`.
    """
    if not loc:
        if _is_record(data) and not isinstance(value, Mapping):
            return replace_value(data, value, None, BY_A_SWEEP)
        return value
    first = loc[0]
    rest = loc[1:]
    if isinstance(data, list) and isinstance(first, int) and first < len(data):
        return [*data[:first], with_value(data[first], rest, value), *data[first + 1 :]]
    inner = data if isinstance(data, Mapping) else {}
    return {**inner, first: with_value(inner.get(first), rest, value)}


def _is_record(data: object) -> bool:
    return isinstance(data, Mapping) and {"value", "unit"} <= data.keys()


def leaf_names(data: object, prefix: str = "") -> Iterator[str]:
    """Yield the dotted name of each value.

    A record of a robot parameter counts as one value.
    """
    if isinstance(data, Mapping) and not _is_record(data):
        for key, value in data.items():
            yield from leaf_names(value, f"{prefix}.{key}" if prefix else str(key))
    else:
        yield prefix


def _duration(
    document: Mapping[str, Any], plants: tuple[str, ...], periods: float
) -> Any:
    """Return the duration (s) of `periods`, rounded up to whole control ticks.

    If the frequency or a tick is unknown, the duration of the scenario is returned.
    """
    controller = document.get("controller", {})
    frequency = (controller.get("reference") or controller).get("frequency_hz")
    ticks = [
        document.get("plants", {}).get(plant, {}).get("tick_s", 0.02)
        for plant in plants
    ]
    numbers = [frequency, *ticks]
    if not all(is_number(number) and 0 < number < math.inf for number in numbers):
        return document.get("duration_s")
    tick = max(ticks)
    return round(math.ceil(periods / frequency / tick * (1 - 1e-12)) * tick, 9)


Varied = Mapping[str, Sequence[Value] | RangeFile]


def sample(
    vary: Varied, sampling: SamplingFile, integer_fields: Container[str] = ()
) -> list[tuple[Value, ...]]:
    """Return the field values of all points, one row per point.

    Args:
        vary: values or range of each field, keyed by dotted name.
        sampling: method for combining the values.
        integer_fields: names of the fields that accept only integers.
    """
    if sampling.kind in ("latin_hypercube", "sobol"):
        return _space_filling_points(vary, sampling, integer_fields)
    lists = [
        _value_list(name, values, integers=name in integer_fields)
        for name, values in vary.items()
    ]
    if sampling.kind == "list":
        lengths = {name: len(values) for name, values in zip(vary, lists, strict=True)}
        if len(set(lengths.values())) > 1:
            counts = ", ".join(f"{name} {length}" for name, length in lengths.items())
            raise InputError(
                "`sampling: list` needs the same number of values of each field, but"
                f" the fields have {counts}"
            )
        return list(zip(*lists, strict=True))
    count = math.prod(len(values) for values in lists)
    if count > MAX_POINTS:
        raise InputError(
            f"the grid has {count} points, but at most {MAX_POINTS} are allowed; use"
            " fewer values"
        )
    return list(product(*lists))


def _value_list(
    name: str, values: Sequence[Value] | RangeFile, *, integers: bool
) -> list[Value]:
    if not isinstance(values, RangeFile):
        return list(values)
    if values.count is None:
        raise InputError(
            f"{name}: the range has no `count`; give `count`, or set `sampling` to"
            " latin_hypercube or sobol"
        )
    spaced = np.geomspace if values.scale == "log" else np.linspace
    numbers = spaced(values.start, values.stop, values.count)
    if integers:
        return _whole_numbers(name, numbers)
    found: list[Value] = numbers.tolist()
    return found


def _whole_numbers(name: str, numbers: np.ndarray) -> list[Value]:
    whole = np.rint(numbers)
    # Logarithmic spacing has rounding errors.
    is_whole = np.isclose(numbers, whole, rtol=1e-12, atol=1e-12)
    if not is_whole.all():
        raise InputError(
            f"{name}: the range gives {numbers[~is_whole][0]:g}, but the field needs"
            " whole numbers; change `count`"
        )
    return list(map(int, whole))


def sobol_points(
    dimensions: int, count: int, rng: np.random.Generator | int
) -> np.ndarray:
    """Return scrambled Sobol points in the unit cube, shape (count, dimensions)."""
    from scipy.stats import qmc

    points = qmc.Sobol(dimensions, rng=rng).random_base2(max(count - 1, 1).bit_length())
    return np.asarray(points[:count])


def _space_filling_points(
    vary: Varied, sampling: SamplingFile, integer_fields: Container[str]
) -> list[tuple[Value, ...]]:
    from scipy.stats import qmc

    assert sampling.count is not None, "checked by the file's model"
    engine = qmc.Sobol if sampling.kind == "sobol" else qmc.LatinHypercube
    unit = engine(d=len(vary), rng=sampling.seed or 0).random(sampling.count)
    columns = []
    for (name, values), fractions in zip(vary.items(), unit.T, strict=True):
        integers = name in integer_fields
        columns.append(_values_at(name, values, fractions, integers=integers))
    return list(zip(*columns, strict=True))


def _values_at(
    name: str,
    values: Sequence[Value] | RangeFile,
    fractions: np.ndarray,
    *,
    integers: bool,
) -> list[Value]:
    if not isinstance(values, RangeFile):
        return [values[int(fraction * len(values))] for fraction in fractions]
    if not integers:
        numbers = value_at(fractions, values.start, values.stop, values.scale)
        return list(map(float, numbers))
    low = math.ceil(values.start)
    high = math.floor(values.stop)
    if low > high:
        raise InputError(
            f"{name}: there is no whole number between {values.start:g} and"
            f" {values.stop:g}"
        )
    # Whole numbers are rounded down from a range that extends to `high` + 1. With a
    # linear scale, they are equally likely.
    numbers = value_at(fractions, low, high + 1, values.scale)
    return [min(math.floor(number), high) for number in numbers]


Fraction = TypeVar("Fraction", float, np.ndarray)
"""Fraction of a range, or an array of fractions."""


def value_at(fraction: Fraction, low: float, high: float, scale: str) -> Fraction:
    """Return the values at fractions from 0 to 1 of a linear or logarithmic range."""
    if scale == "log":
        growth: Fraction = (high / low) ** fraction
        return low * growth
    return low + (high - low) * fraction
