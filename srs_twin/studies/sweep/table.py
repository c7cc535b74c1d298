"""Columns of a sweep's results for plots and reports, and the comparison with published values."""

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
from srs_twin.viewing.html import Table
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
    """Plot of the results."""

    kind: Literal["contour", "line", "scatter"]
    """Kind of plot."""
    x: FieldName
    """Varied field along x; with scatter also a metric."""
    y: FieldName | None = None
    """Varied field along y (contour)."""
    metric: FieldName
    """Plotted metric, of each plant or of the comparison."""
    by: FieldName | None = None
    """Varied field that distinguishes lines or colours (line, scatter)."""

    @model_validator(mode="after")
    def _check_combinations(self) -> Plot:
        if self.kind == "contour" and self.y is None:
            raise ValueError("a contour needs y")
        if self.kind != "contour" and self.y is not None:
            raise ValueError(f"y is only for contour, not for {self.kind}, whose vertical axis is metric")
        if self.kind == "contour" and self.by is not None:
            raise ValueError("by is only for line and scatter, not for contour")
        return self


class Published(Section):
    """Published values of metrics at some values of the varied fields."""

    source: Annotated[str, Field(min_length=1, max_length=60)]
    """Source of the values (Table 8)."""
    note: Annotated[str, Field(min_length=1, max_length=1000)] | None = None
    """Note on the comparison (signs, method of measurement)."""
    at: Annotated[dict[FieldName, FieldValues], Field(min_length=1, max_length=MAX_FIELDS)]
    """Varied fields → their values at each published point; lists of equal length."""
    metrics: Annotated[dict[FieldName, PublishedValues], Field(min_length=1, max_length=64)]
    """Metrics of the plants → their published values at each point; null if missing."""

    @property
    def settings(self) -> list[dict[str, Value]]:
        """Values of the fields at each published point."""
        return [dict(zip(self.at, values, strict=True)) for values in zip(*self.at.values(), strict=True)]


COMPARISON, PLAN = "comparison", "plan"
OWNERS = ("analytical", "twin", COMPARISON, PLAN)
Value = bool | int | float | str
_EXACT = 1e15
"""Magnitude below which whole numbers, such as seeds, are printed with all digits."""

_RELATIVE_TOLERANCE = 1e-9
"""Relative difference up to which two numbers are the same value of a field."""

_ROW_COLUMNS = {"key", "status", "reason", "exit_code", "wall_s"}
"""Columns that are neither varied fields nor metrics."""


@dataclass(frozen=True)
class ColumnValues:
    """Values of one column for an axis or a colour.

    Attributes:
        label: axis label.
        numbers: values, shape (rows,), NaN if missing; for texts their index in `names`.
        names: distinct texts, sorted; empty for numbers.
    """

    label: str
    numbers: np.ndarray
    names: tuple[str, ...] = ()

    def text(self, number: float) -> str:
        """Return a value as text."""
        if self.names:
            return self.names[int(number)]
        return f"{number:.0f}" if float(number).is_integer() and abs(number) < _EXACT else f"{number:.4g}"

    def number(self, value: Value) -> float:
        """Return the number that represents a value of the field; NaN for an unknown text."""
        if not self.names:
            return math.nan if isinstance(value, str) else float(value)
        # In a column with texts, other values are stored as JSON.
        texts = [text for text in (str(value), json.dumps(value)) if text in self.names]
        return float(self.names.index(texts[0])) if texts else math.nan

    def rows_with(self, value: Value) -> np.ndarray:
        """Return a mask of the rows with a value of the field, shape (rows,)."""
        number = self.number(value)
        largest = float(np.max(np.abs(self.numbers), initial=abs(number), where=np.isfinite(self.numbers)))
        return np.asarray(np.abs(self.numbers - number) <= _RELATIVE_TOLERANCE * largest)


@dataclass(frozen=True)
class SweepTable:
    """Results of a sweep by column.

    Attributes:
        columns: name → values, one per row.
    """

    columns: Mapping[str, Sequence[Any]]

    @staticmethod
    def from_columns(table: pa.Table | Mapping[str, Iterable[object]]) -> SweepTable:
        """Return the table of a pyarrow table or a mapping of columns."""
        if isinstance(table, Mapping):
            return SweepTable(
                {name: np.asarray(column, dtype=object).tolist() for name, column in table.items()}
            )
        return SweepTable(table.to_pydict())

    @property
    def failed(self) -> np.ndarray:
        """Whether the run of each row failed, shape (rows,)."""
        return np.array([status == "failed" for status in self.columns["status"]], dtype=bool)

    @property
    def fields(self) -> list[str]:
        """Varied fields."""
        prefixes = tuple(f"{owner}." for owner in OWNERS)
        return [name for name in self.columns if name not in _ROW_COLUMNS and not name.startswith(prefixes)]

    def owners(self, metric: str) -> list[str]:
        """Return the results that contain a metric: plants, comparison or plan.

        Raises:
            UnknownNameError: no owner has it.
        """
        owners = self.owners_if_any(metric)
        if not owners:
            names = (name.partition(".") for name in self.columns)
            raise UnknownNameError("metric", metric, {rest for owner, _, rest in names if owner in OWNERS})
        return owners

    def owners_if_any(self, metric: str) -> list[str]:
        """Return the owners that have a metric; empty if there is none."""
        return [owner for owner in OWNERS if self._names(owner, metric)]

    def metric(self, metric: str, owner: str) -> ColumnValues:
        """Return a metric of an owner; for a list metric its mean."""
        names = self._names(owner, metric)
        if names == [f"{owner}.{metric}"]:
            return ColumnValues(metric_label(metric), _numbers(self.columns[names[0]]))
        elements = np.array([_numbers(self.columns[name]) for name in names])
        return ColumnValues(f"{metric_label(metric)}, mean over {len(names)}", elements.mean(axis=0))

    def values(self, name: str, owner: str) -> ColumnValues:
        """Return a varied field, or a metric of an owner or of the comparison.

        Raises:
            UnknownNameError: the column does not exist.
        """
        if name in self.fields:
            return _field(name, self.columns[name])
        for candidate in (owner, COMPARISON):
            if self._names(candidate, name):
                return self.metric(name, candidate)
        raise UnknownNameError("column", name, self.fields)

    @property
    def repeats(self) -> list[str]:
        """Varied fields that are seeds and thus only repeat a run; means are taken over these fields only."""
        return [name for name in self.fields if name.rpartition(".")[2] == "seed"]

    @property
    def settings(self) -> list[str]:
        """Varied fields except `repeats`."""
        return [name for name in self.fields if name not in self.repeats]

    def unplotted_settings(self, plotted: Iterable[str]) -> list[str]:
        """Return the settings that differ between runs with the same values of the plotted fields."""
        known = [name for name in plotted if name in self.fields]
        count = len(self.groups(known))
        others = (name for name in self.settings if name not in known)
        return [name for name in others if len(self.groups([*known, name])) > count]

    def groups(self, names: Sequence[str]) -> list[tuple[tuple[str, ...], np.ndarray]]:
        """Return the combinations of values of fields, in order, as texts with the rows that have them."""
        columns = [self.values(name, "") for name in names]
        if not columns:
            return [((), np.arange(len(self.failed)))]
        if not len(self.failed):
            return []
        numbers = np.nan_to_num([column.numbers for column in columns], nan=-np.inf)
        combinations, which = np.unique(numbers, axis=1, return_inverse=True)
        order = np.argsort(which.reshape(-1), kind="stable")
        rows = np.split(order, np.cumsum(np.bincount(which.reshape(-1)))[:-1])
        texts = ([c.text(n) for c, n in zip(columns, row, strict=True)] for row in combinations.T)
        return [(tuple(text), row) for text, row in zip(texts, rows, strict=True)]

    def _names(self, owner: str, metric: str) -> list[str]:
        """Return the column of a metric, or those of its elements if it is a list."""
        name = f"{owner}.{metric}"
        if name in self.columns:
            return [name]
        stem = f"{name}_"
        return [
            column for column in self.columns if column.startswith(stem) and column[len(stem) :].isdigit()
        ]


def _field(name: str, column: Sequence[object]) -> ColumnValues:
    known = [value for value in column if value is not None]
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in known):
        return ColumnValues(field_label(name), _numbers(column))
    texts = ["" if value is None else str(value) for value in column]
    names = tuple(sorted(set(texts)))
    return ColumnValues(
        field_label(name), np.array([names.index(text) for text in texts], dtype=float), names
    )


def _numbers(column: Sequence[Any]) -> np.ndarray:
    """Return numbers, NaN for missing and infinite ones."""
    numbers = np.array([np.nan if value is None else float(value) for value in column], dtype=float)
    return np.where(np.isfinite(numbers), numbers, np.nan)


def group_means(group: np.ndarray, count: int, values: np.ndarray) -> np.ndarray:
    """Return the mean of the values of each group, NaN for empty groups; independent of the order of rows.

    Args:
        group: group number of each value, shape (rows,).
        count: number of groups.
        values: values, shape (rows,); NaN is ignored.
    """
    # Sorting makes the last bit of the sums independent of the order of rows.
    order = np.lexsort((values, group))
    order = order[np.isfinite(values[order])]
    sums = np.bincount(group[order], weights=values[order], minlength=count)
    counts = np.bincount(group[order], minlength=count)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


NONE = "–"
"""Text of a missing value."""


def published_table(published: Published, results: SweepTable) -> Table:
    """Return published values with those of the plants, as means over seeds, one row per setting.

    Args:
        published: published values.
        results: results of a sweep that varies their fields.
    """
    plants = [
        owner
        for owner in OWNERS
        if owner != COMPARISON and any(owner in results.owners_if_any(metric) for metric in published.metrics)
    ]
    further = results.unplotted_settings(published.at)
    runs = [_runs_at(results, further, setting) for setting in published.settings]
    is_mean = any(len(chosen) > 1 for groups in runs for _, chosen in groups)
    rows = []
    for metric, values in published.metrics.items():
        for setting, groups, value in zip(published.settings, runs, values, strict=True):
            for texts, chosen in groups:
                row = [metric_label(metric), *map(_value_text, setting.values()), *texts, _value_text(value)]
                for plant in plants:
                    mean = _mean(results, metric, plant, chosen)
                    row += [_value_text(mean), _difference_text(value, mean)]
                rows.append((*row, *([str(len(chosen))] if is_mean else [])))
    headings = ["metric", *map(field_label, (*published.at, *further)), "published"]
    headings += [heading for plant in plants for heading in (plant, "difference")]
    headings += ["runs"] * is_mean
    numbers = range(1, len(headings))
    return Table(tuple(headings), tuple(rows), numbers, published.note or "", published.source)


def _runs_at(
    results: SweepTable, further: Sequence[str], setting: Mapping[str, Value]
) -> list[tuple[tuple[str, ...], np.ndarray]]:
    """Return the successful runs at a setting, grouped by further fields; at least one group."""
    chosen = ~results.failed
    for field, value in setting.items():
        chosen = chosen & results.values(field, "").rows_with(value)
    groups = [(texts, rows[chosen[rows]]) for texts, rows in results.groups(further)]
    return [group for group in groups if len(group[1])] or [((NONE,) * len(further), np.zeros(0, dtype=int))]


def _mean(results: SweepTable, metric: str, plant: str, chosen: np.ndarray) -> float | None:
    if plant not in results.owners_if_any(metric):
        return None
    numbers = results.metric(metric, plant).numbers[chosen]
    known = numbers[np.isfinite(numbers)]
    return float(known.mean()) if len(known) else None


def _difference_text(published: float | None, value: float | None) -> str:
    return NONE if published is None or value is None else relative_difference(published, value)


def _value_text(value: Value | None) -> str:
    if value is None:
        return NONE
    return f"{value:.4g}" if isinstance(value, float) else str(value)
