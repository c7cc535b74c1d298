"""A sweep and its points: how values of fields are put together, and the key of each point."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.documents import Loc, path_of
from srs_twin.planning.scenario import PLANNER_FILES
from srs_twin.robot.file import units_of
from srs_twin.robot.sourced import restated
from srs_twin.scenario.plants import PRESET, with_preset
from srs_twin.scenario.provenance import run_key
from srs_twin.studies.sweep.file import MAX_POINTS, RangeFile, SamplingFile

if TYPE_CHECKING:
    from srs_twin.scenario.modified import Changes as Changed
    from srs_twin.studies.sweep.table import Plot, Published


RUNNER = "srs_twin.studies.sweep.task"
"""Module that runs a point: its sources, with those it imports, decide a row."""

Value = bool | int | float | str
Changes = Mapping[str, Value]

BY_A_SWEEP = "varied by a sweep"
"""Source of a robot's number that a sweep sets."""


@dataclass(frozen=True)
class Point:
    """One run of a sweep.

    Attributes:
        key: SHA-256 of everything that decides the results, hex.
        changes: dotted field → value.
    """

    key: str
    changes: Changes


@dataclass(frozen=True)
class Experiment:
    """What all points of a sweep have in common; small enough to go to every worker.

    Attributes:
        base: plain data of the scenario, defaults and robot written out, `fixed` fields set.
        plants: which plants run; none: the scenario is only planned.
        periods: simulated time in periods of the gait or the reference; None: the scenario's duration_s.
        robots: name → plain data of each robot that the field `robot` takes.
        trajectories: whether they are kept.
    """

    base: Mapping[str, Any] = field(repr=False)
    plants: tuple[str, ...]
    periods: float | None = None
    robots: Mapping[str, Any] = field(default_factory=dict, repr=False)
    trajectories: bool = False

    def document(self, changes: Changes) -> dict[str, Any]:
        """Return plain data of the scenario with these changes, as `parse_scenario` takes them."""
        document: dict[str, Any] = {k: v for k, v in self.base.items() if k not in ("expect", "changes")}
        for name, value in changes.items():
            document = self.with_change(document, name, value)
        if self.periods is not None:
            document["duration_s"] = _duration(document, self.plants, self.periods)
        return document

    def with_fixed(self, fixed: Mapping[str, Value | list[Value]]) -> dict[str, Any]:
        """Return the base with other values of some fields."""
        found = dict(self.base)
        for name, value in fixed.items():
            found = self.with_change(found, name, value)
        return found

    def with_change(self, document: Any, name: str, value: Value | list[Value]) -> Any:
        """Return plain data of a scenario with one field changed; a robot's name stands for its file."""
        whole: Any = self.robots.get(str(value), value) if name == "robot" else value
        where = path_of(name)
        if name == "planner.kind":
            document = _planned_by(document, value)
        if where == PRESET:
            twin = with_preset(document["plants"].get("twin", {}), value)
            return {**document, "plants": {**document["plants"], "twin": twin}}
        if len(where) == 3 and where[0] == "robot" and not isinstance(whole, Mapping):
            # A number that the robot does not have yet has no record either.
            unit = units_of(str(where[1])).get(str(where[2]))
            if unit is not None:
                whole = restated(None, value, unit, BY_A_SWEEP)
        return changed(document, where, whole)


@dataclass(frozen=True)
class Sweep:
    """One scenario over many values of its fields.

    Attributes:
        name: of the folder of results.
        title: one line for people.
        experiment: what all points have in common.
        fields: the varied fields, dotted, in the order of the file.
        values: a value for each field, a row a point.
        metrics: which become columns; None: all.
        plots: pictures of the results.
        versions: package → version: those that decide the numbers.
        document: plain data of the sweep file.
        warnings: what a person should know before believing the results.
        beside: what was published of the metrics; the keys of points do not depend on it.
        changes: fields that differ from the sweep's file; `title` names them.
    """

    name: str
    title: str
    experiment: Experiment
    fields: tuple[str, ...]
    values: tuple[tuple[Value, ...], ...] = field(repr=False)
    metrics: tuple[str, ...] | None
    plots: tuple[Plot, ...]
    versions: Mapping[str, str]
    document: Mapping[str, Any] = field(repr=False)
    warnings: tuple[str, ...] = ()
    beside: Published | None = None
    changes: Changed = ()

    @cached_property
    def points(self) -> tuple[Point, ...]:
        """The runs, each once, in the order of the file."""
        found: dict[str, Point] = {}
        for row in self.values:
            changes = dict(zip(self.fields, row, strict=True))
            key = run_key(self.experiment.document(changes), self.experiment.plants, RUNNER)
            found.setdefault(key, Point(key, changes))
        return tuple(found.values())


def _planned_by(document: Any, kind: Any) -> Any:
    """Return plain data of a scenario without what another kind of planner knows nothing of."""
    planner = document.get("planner")
    if not isinstance(planner, Mapping) or kind not in PLANNER_FILES:
        return document
    known = PLANNER_FILES[str(kind)].model_fields
    return {**document, "planner": {key: each for key, each in planner.items() if key in known}}


def changed(data: Any, loc: Loc, value: Value | list[Value]) -> Any:
    """Return plain data with one value replaced; what is on the way is copied, the rest shared.

    A plain value in place of a robot's record changes its number: unit stays, status and source say so.
    """
    if not loc:
        if isinstance(data, Mapping) and {"value", "unit"} <= data.keys() and not isinstance(value, Mapping):
            return restated(data, value, None, BY_A_SWEEP)
        return value
    first, rest = loc[0], loc[1:]
    if isinstance(data, list) and isinstance(first, int) and first < len(data):
        return [*data[:first], changed(data[first], rest, value), *data[first + 1 :]]
    inner = data if isinstance(data, Mapping) else {}
    return {**inner, first: changed(inner.get(first), rest, value)}


def leaves(data: Any, prefix: str = "") -> Iterator[str]:
    """Yield the dotted names of all plain values in plain data; records of a robot count as one."""
    if isinstance(data, Mapping) and not {"value", "unit"} <= data.keys():
        for key, value in data.items():
            yield from leaves(value, f"{prefix}.{key}" if prefix else str(key))
    else:
        yield prefix


def _duration(document: Mapping[str, Any], plants: tuple[str, ...], periods: float) -> Any:
    """Return so many periods of gait or reference in whole ticks, s; the given duration without them."""
    controller = document.get("controller", {})
    frequency = (controller.get("reference") or controller).get("frequency_hz")
    ticks = [document.get("plants", {}).get(plant, {}).get("tick_s", 0.02) for plant in plants]
    numbers = [frequency, *ticks]
    if not all(isinstance(n, int | float) and not isinstance(n, bool) and 0 < n < math.inf for n in numbers):
        return document.get("duration_s")
    tick = max(ticks)
    return round(math.ceil(periods / frequency / tick * (1 - 1e-12)) * tick, 9)


Given = Mapping[str, Sequence[Value] | RangeFile]


def sample(vary: Given, sampling: SamplingFile) -> list[tuple[Value, ...]]:
    """Return the points, a row each with a value for each field.

    Raises:
        InputError: lists of unequal length, a range without a count, or too many points.
    """
    if sampling.kind in ("latin_hypercube", "sobol"):
        return _drawn(list(vary.values()), sampling)
    lists = [_listed(name, values) for name, values in vary.items()]
    if sampling.kind == "list":
        lengths = {name: len(values) for name, values in zip(vary, lists, strict=True)}
        if len(set(lengths.values())) > 1:
            counts = ", ".join(f"{name} {length}" for name, length in lengths.items())
            raise InputError(f"sampling: list takes as many values of each field, but there are {counts}")
        return list(zip(*lists, strict=True))
    count = 1
    for values in lists:
        count *= len(values)
    if count > MAX_POINTS:
        raise InputError(f"the grid has {count} points; at most {MAX_POINTS} are allowed")
    return list(product(*lists))


def _listed(name: str, values: Sequence[Value] | RangeFile) -> list[Value]:
    if not isinstance(values, RangeFile):
        return list(values)
    if values.count is None:
        raise InputError(f"{name}: a range needs a count here, or sampling: latin_hypercube or sobol")
    spaced = np.geomspace if values.scale == "log" else np.linspace
    return [float(value) for value in spaced(values.start, values.stop, values.count)]


def _drawn(fields: Sequence[Sequence[Value] | RangeFile], sampling: SamplingFile) -> list[tuple[Value, ...]]:
    """Spread points over the ranges; of a list, every value gets an equal share."""
    from scipy.stats import qmc

    assert sampling.count is not None, "checked by the file's model"
    engine = qmc.Sobol if sampling.kind == "sobol" else qmc.LatinHypercube
    unit = engine(d=len(fields), rng=sampling.seed or 0).random(sampling.count)
    columns = [_placed(values, shares) for values, shares in zip(fields, unit.T, strict=True)]
    return list(zip(*columns, strict=True))


def _placed(values: Sequence[Value] | RangeFile, shares: np.ndarray) -> list[Value]:
    if not isinstance(values, RangeFile):
        return [values[int(share * len(values))] for share in shares]
    if values.scale == "log":
        return [float(value) for value in values.start * (values.stop / values.start) ** shares]
    return [float(value) for value in values.start + (values.stop - values.start) * shares]
