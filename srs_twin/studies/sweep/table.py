"""The table of a sweep as pictures and reports need it, and published values beside it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from srs_twin.comparison.metrics import relative_difference
from srs_twin.errors import UnknownNameError
from srs_twin.scenario.fields import Section
from srs_twin.viewing.html.page import Table
from srs_twin.viewing.plots.labels import field_label, metric_label

if TYPE_CHECKING:
    import pyarrow as pa

MAX_FIELDS = 16

Plain = bool | int | float | Annotated[str, Field(max_length=200)]
FieldName = Annotated[str, Field(min_length=1, max_length=200)]
FieldValues = Annotated[list[Plain], Field(min_length=1, max_length=10_000)]
PublishedValues = Annotated[
    list[Annotated[float, Field(ge=-1e12, le=1e12)] | None], Field(min_length=1, max_length=10_000)
]


class Plot(Section):
    """A picture of the results."""

    kind: Literal["contour", "line", "scatter"]
    """Which kind."""
    x: FieldName
    """Varied field, or metric (scatter), along x."""
    y: FieldName | None = None
    """Varied field along y (contour)."""
    metric: FieldName
    """Metric that is drawn, of each plant or of the comparison."""
    by: FieldName | None = None
    """Varied field that tells lines or colours apart (line, scatter)."""

    @model_validator(mode="after")
    def _what_belongs_together(self) -> Plot:
        if self.kind == "contour" and self.y is None:
            raise ValueError("a contour needs y")
        if self.kind != "contour" and self.y is not None:
            raise ValueError(f"y belongs to contour, not to {self.kind}; metric is what stands upright there")
        if self.kind == "contour" and self.by is not None:
            raise ValueError("by belongs to line and scatter, not to contour")
        return self


class Published(Section):
    """What was published of the metrics, at some values of the varied fields."""

    source: Annotated[str, Field(min_length=1, max_length=60)]
    """Where it is published (Table 8)."""
    note: Annotated[str, Field(min_length=1, max_length=1000)] | None = None
    """What a reader must know to compare (signs, how it was measured)."""
    at: Annotated[dict[FieldName, FieldValues], Field(min_length=1, max_length=MAX_FIELDS)]
    """Varied fields, each with its values where something is published; equally many of each."""
    metrics: Annotated[dict[FieldName, PublishedValues], Field(min_length=1, max_length=64)]
    """Metrics of the plants, each with its published values there; null where there is none."""

    @property
    def places(self) -> list[dict[str, Value]]:
        """Where something is published: each time a value of every field."""
        return [dict(zip(self.at, values, strict=True)) for values in zip(*self.at.values(), strict=True)]


COMPARISON, PLAN = "comparison", "plan"
OWNERS = ("analytical", "twin", COMPARISON, PLAN)
Value = bool | int | float | str
_EXACT = 1e15  # up to where whole numbers, such as seeds, are written out
_SAME = 1e-9  # of the greatest value: what two ways of writing a number may differ by
_ABOUT_ROWS = {"key", "status", "reason", "exit_code", "wall_s"}


@dataclass(frozen=True)
class Values:
    """One column for an axis or a colour.

    Attributes:
        label: what stands at the axis.
        numbers: shape (rows,), NaN where there is none; of text, its place among `names`.
        names: the different texts, sorted; empty for numbers.
    """

    label: str
    numbers: np.ndarray
    names: tuple[str, ...] = ()

    def text(self, number: float) -> str:
        """Return how one of the values is written."""
        if self.names:
            return self.names[int(number)]
        return f"{number:.0f}" if float(number).is_integer() and abs(number) < _EXACT else f"{number:.4g}"

    def number(self, value: Value) -> float:
        """Return which of the `numbers` stands for a value of the field; NaN for a text that no row has."""
        if not self.names:
            return math.nan if isinstance(value, str) else float(value)
        # A column of texts and other things has these as JSON.
        found = [text for text in (str(value), json.dumps(value)) if text in self.names]
        return float(self.names.index(found[0])) if found else math.nan

    def at(self, value: Value) -> np.ndarray:
        """Return which rows have a value of the field, shape (rows,)."""
        number = self.number(value)
        most = float(np.max(np.abs(self.numbers), initial=abs(number), where=np.isfinite(self.numbers)))
        return np.asarray(np.abs(self.numbers - number) <= _SAME * most)


@dataclass(frozen=True)
class SweepTable:
    """The rows of a sweep.

    Attributes:
        columns: name → values, one a row.
    """

    columns: Mapping[str, Sequence[Any]]

    @staticmethod
    def of(table: pa.Table | Mapping[str, Iterable[Any]]) -> SweepTable:
        """Take a table of pyarrow or a mapping of columns."""
        if isinstance(table, Mapping):
            return SweepTable({name: np.asarray(each, dtype=object).tolist() for name, each in table.items()})
        return SweepTable(table.to_pydict())

    @property
    def failed(self) -> np.ndarray:
        """Which rows failed, shape (rows,)."""
        return np.array([status == "failed" for status in self.columns["status"]], dtype=bool)

    @property
    def fields(self) -> list[str]:
        """The varied fields."""
        prefixes = tuple(f"{owner}." for owner in OWNERS)
        return [name for name in self.columns if name not in _ABOUT_ROWS and not name.startswith(prefixes)]

    def owners(self, metric: str) -> list[str]:
        """Return whose metric it is: plants, the comparison, or a plan that nobody followed.

        Raises:
            UnknownNameError: nobody's.
        """
        found = self.holders(metric)
        if not found:
            named = (name.partition(".") for name in self.columns)
            raise UnknownNameError("metric", metric, {rest for owner, _, rest in named if owner in OWNERS})
        return found

    def holders(self, metric: str) -> list[str]:
        """Return whose metric it is, as `owners` does; empty where it is nobody's."""
        return [owner for owner in OWNERS if self._names(owner, metric)]

    def metric(self, metric: str, owner: str) -> Values:
        """Return an owner's metric; of one that is a list, the mean over it."""
        names = self._names(owner, metric)
        if names == [f"{owner}.{metric}"]:
            return Values(metric_label(metric), _numbers(self.columns[names[0]]))
        parts = np.array([_numbers(self.columns[name]) for name in names])
        return Values(f"{metric_label(metric)}, mean over {len(names)}", parts.mean(axis=0))

    def values(self, name: str, owner: str) -> Values:
        """Return a field, or a metric: the owner's own, else the comparison's.

        Raises:
            UnknownNameError: there is no such column.
        """
        if name in self.fields:
            return _field(name, self.columns[name])
        for each in (owner, COMPARISON):
            if self._names(each, name):
                return self.metric(name, each)
        raise UnknownNameError("column", name, self.fields)

    @property
    def repeats(self) -> list[str]:
        """The varied fields that only repeat a run: seeds. Means are over these alone."""
        return [name for name in self.fields if name.rpartition(".")[2] == "seed"]

    @property
    def settings(self) -> list[str]:
        """The fields that are varied on purpose."""
        return [name for name in self.fields if name not in self.repeats]

    def mixed(self, drawn: Iterable[str]) -> list[str]:
        """Return the settings that differ between runs with the same values of the fields drawn."""
        known = [name for name in drawn if name in self.fields]
        places = len(self.groups(known))
        others = (name for name in self.settings if name not in known)
        return [name for name in others if len(self.groups([*known, name])) > places]

    def groups(self, names: Sequence[str]) -> list[tuple[tuple[str, ...], np.ndarray]]:
        """Return the combinations of values of some fields in order: as text, and the rows that have them."""
        columns = [self.values(name, "") for name in names]
        if not columns:
            return [((), np.arange(len(self.failed)))]
        if not len(self.failed):
            return []
        numbers = np.nan_to_num([each.numbers for each in columns], nan=-np.inf)
        places, which = np.unique(numbers, axis=1, return_inverse=True)
        order = np.argsort(which.reshape(-1), kind="stable")
        rows = np.split(order, np.cumsum(np.bincount(which.reshape(-1)))[:-1])
        texts = ([c.text(n) for c, n in zip(columns, place, strict=True)] for place in places.T)
        return [(tuple(text), each) for text, each in zip(texts, rows, strict=True)]

    def _names(self, owner: str, metric: str) -> list[str]:
        """Return the column of a metric, or those of its parts where it is a list."""
        name = f"{owner}.{metric}"
        if name in self.columns:
            return [name]
        stem = f"{name}_"
        return [each for each in self.columns if each.startswith(stem) and each[len(stem) :].isdigit()]


def _field(name: str, column: Sequence[Any]) -> Values:
    given = [value for value in column if value is not None]
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in given):
        return Values(field_label(name), _numbers(column))
    texts = ["" if value is None else str(value) for value in column]
    names = tuple(sorted(set(texts)))
    return Values(field_label(name), np.array([names.index(text) for text in texts], dtype=float), names)


def _numbers(column: Sequence[Any]) -> np.ndarray:
    """Return numbers, NaN for what is missing or not finite."""
    numbers = np.array([np.nan if value is None else float(value) for value in column], dtype=float)
    return np.where(np.isfinite(numbers), numbers, np.nan)


def group_means(group: np.ndarray, count: int, values: np.ndarray) -> np.ndarray:
    """Return the mean of the values of each group, NaN where it has none; the order of the rows is no matter.

    Args:
        group: number of each value's group, shape (rows,).
        count: how many groups.
        values: shape (rows,); NaN ones are left out.
    """
    # Sums in an order of their own: that of the rows would show in the last bit.
    order = np.lexsort((values, group))
    order = order[np.isfinite(values[order])]
    sums = np.bincount(group[order], weights=values[order], minlength=count)
    counts = np.bincount(group[order], minlength=count)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


NONE = "–"


def published_table(published: Published, rows: SweepTable) -> Table:
    """Return what was published beside what the plants did there: the mean over seeds, a row a setting.

    Args:
        published: what was published.
        rows: results of a sweep that varies these fields.
    """
    plants = [o for o in OWNERS if o != COMPARISON and any(o in rows.holders(m) for m in published.metrics)]
    apart = rows.mixed(published.at)
    runs = [_runs(rows, apart, place) for place in published.places]
    averaged = any(len(chosen) > 1 for there in runs for _, chosen in there)
    made = []
    for metric, values in published.metrics.items():
        for place, there, value in zip(published.places, runs, values, strict=True):
            for texts, chosen in there:
                line = [metric_label(metric), *map(_written, place.values()), *texts, _written(value)]
                for plant in plants:
                    mean = _mean(rows, metric, plant, chosen)
                    line += [_written(mean), _difference(value, mean)]
                made.append((*line, *([str(len(chosen))] if averaged else [])))
    headings = ["metric", *map(field_label, (*published.at, *apart)), "published"]
    headings += [heading for plant in plants for heading in (plant, "difference")]
    headings += ["runs"] * averaged
    numbers = range(1, len(headings))
    return Table(tuple(headings), tuple(made), numbers, published.note or "", published.source)


def _runs(
    rows: SweepTable, apart: Sequence[str], place: Mapping[str, Value]
) -> list[tuple[tuple[str, ...], np.ndarray]]:
    """Return the runs at a place that did not fail, by the values of other settings; one entry at least."""
    chosen = ~rows.failed
    for field, value in place.items():
        chosen = chosen & rows.values(field, "").at(value)
    found = [(texts, group[chosen[group]]) for texts, group in rows.groups(apart)]
    return [each for each in found if len(each[1])] or [((NONE,) * len(apart), np.zeros(0, dtype=int))]


def _mean(rows: SweepTable, metric: str, plant: str, chosen: np.ndarray) -> float | None:
    if plant not in rows.holders(metric):
        return None
    numbers = rows.metric(metric, plant).numbers[chosen]
    known = numbers[np.isfinite(numbers)]
    return float(known.mean()) if len(known) else None


def _difference(published: float | None, value: float | None) -> str:
    return NONE if published is None or value is None else relative_difference(published, value)


def _written(value: Value | None) -> str:
    if value is None:
        return NONE
    return f"{value:.4g}" if isinstance(value, float) else str(value)
