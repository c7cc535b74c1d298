"""Tables of sweep results for plots and reports."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.comparison.metrics import COMPARISON_UNITS
from srs_twin.errors import UnknownNameError
from srs_twin.io.files import atomic_write
from srs_twin.scenario.provenance import versions
from srs_twin.studies.sweep.points import Sweep, Value, is_number
from srs_twin.studies.sweep.task import PLAN, Row
from srs_twin.viewing.plots.labels import field_label, metric_label

if TYPE_CHECKING:
    import pyarrow as pa

COMPARISON = "comparison"
"""Prefix of metrics that compare the two plants."""

OWNERS = ("analytical", "twin", COMPARISON, PLAN)
"""Owners of metrics, which are also the prefixes of metric columns."""

_EXACT = 1e15
"""Magnitude below which integers, such as seeds, are printed with all digits."""

_ROW_COLUMNS = {"key", "status", "reason", "exit_code", "wall_s"}

_ELEMENT = re.compile(r"(_\d+)?(_period_\d+)?$")
"""Suffix that marks a column as one element of a list metric."""

_SUMMARY_METRICS = (
    "com_speed_m_s",
    "yaw_rate_rad_s",
    "mean_bend_amplitude_rad",
    "com_speed_rel",
    "shape_rms_body",
)
"""Metrics in the summary of a sweep that simulates plants."""

_PLAN_SUMMARY_METRICS = ("plan_found", "plan_length_m", "plan_s")
"""Metrics in the summary of a sweep without simulations."""


@dataclass(frozen=True)
class ColumnValues:
    """Values of one column, converted to numbers for an axis or a colour scale.

    Attributes:
        numbers: values, or indices into `names`, or NaN if missing, shape (rows,).
        names: distinct strings in sorted order, if the column contains strings.
    """

    label: str
    numbers: np.ndarray
    names: tuple[str, ...] = ()

    def text(self, number: float) -> str:
        """Return a number of the column as text."""
        if self.names:
            return self.names[int(number)]
        if float(number).is_integer() and abs(number) < _EXACT:
            return f"{number:.0f}"
        return f"{number:.4g}"


@dataclass(frozen=True)
class SweepTable:
    """Sweep results with one column per field and metric.

    Attributes:
        columns: values of all rows, keyed by column name.
    """

    columns: Mapping[str, Sequence[Any]]

    @staticmethod
    def from_rows(sweep: Sweep, rows: Iterable[Row]) -> SweepTable:
        """Build a table of rows, sorted by key.

        The columns are ``key``, the varied fields, ``status``, ``reason``,
        ``exit_code``, the metrics (such as ``twin.com_speed_m_s``) and ``wall_s``.
        Missing metrics are None.

        Args:
            sweep: sweep that produced the rows.
            rows: rows in any order.
        """
        rows = sorted(rows, key=lambda row: row.key)
        changes = {point.key: point.changes for point in sweep.points}
        columns: dict[str, Sequence[object]] = {"key": [row.key for row in rows]}
        for name in sweep.fields:
            columns[name] = _of_one_type([changes[row.key][name] for row in rows])
        for name in ("status", "reason", "exit_code"):
            columns[name] = [getattr(row, name) for row in rows]
        for name in _metrics(sweep, rows):
            columns[name] = [row.values.get(name) for row in rows]
        columns["wall_s"] = [row.wall_s for row in rows]
        return SweepTable(columns)

    def write(self, path: Path, sweep: Sweep) -> None:
        """Write the table, the title and the package versions to a Parquet file.

        Args:
            path: output file.
            sweep: sweep that provides the title.

        Raises:
            InputError: the file cannot be written.
        """
        import pyarrow as pa

        types = dict.fromkeys(self.columns, pa.float64())
        types |= dict.fromkeys(self.fields, None if len(self.failed) else pa.bool_())
        types |= dict.fromkeys(("key", "status", "reason"), pa.string())
        types["exit_code"] = pa.int8()
        columns = {
            name: pa.array(values, types[name]) for name, values in self.columns.items()
        }
        about = json.dumps({"title": sweep.title, "versions": versions()})
        write_table(path, pa.table(columns, metadata={"srs_twin.sweep": about}))

    def ranges(self) -> dict[str, tuple[float, float, float]]:
        """Return the minimum, median and maximum of each summary metric."""
        ranges = {}
        for name, column in self.columns.items():
            owner, _, metric = name.partition(".")
            shown = _PLAN_SUMMARY_METRICS if owner == PLAN else _SUMMARY_METRICS
            values = [value for value in column if value is not None]
            if metric in shown and values:
                ranges[name] = min(values), float(np.median(values)), max(values)
        return ranges

    @cached_property
    def failed(self) -> np.ndarray:
        """Mask of failed runs, shape (rows,)."""
        return np.array(
            [status == "failed" for status in self.columns["status"]], dtype=bool
        )

    @cached_property
    def fields(self) -> list[str]:
        """Names of the varied fields."""
        prefixes = tuple(f"{owner}." for owner in OWNERS)
        return [
            name
            for name in self.columns
            if name not in _ROW_COLUMNS and not name.startswith(prefixes)
        ]

    def owners(self, metric: str) -> list[str]:
        """Return the owners of a metric, such as the plants.

        Raises:
            UnknownNameError: the results contain no metric with this name.
        """
        owners = self.owners_if_any(metric)
        if not owners:
            names = (name.partition(".") for name in self.columns)
            raise UnknownNameError(
                "metric", metric, {rest for owner, _, rest in names if owner in OWNERS}
            )
        return owners

    def owners_if_any(self, metric: str) -> list[str]:
        """Return the owners of a metric, or an empty list if there are none."""
        return [owner for owner in OWNERS if self._names(owner, metric)]

    def metric(self, metric: str, owner: str) -> ColumnValues:
        """Return a metric of one owner, averaged over the elements of a list metric."""
        names = self._names(owner, metric)
        elements = np.array([_numbers(self.columns[name]) for name in names])
        label = metric_label(metric)
        if names != [f"{owner}.{metric}"]:
            label += f", mean over {len(names)}"
        return ColumnValues(label, elements.mean(axis=0))

    def values(self, name: str, owner: str) -> ColumnValues:
        """Return a varied field, or a metric that belongs to `owner` or the comparison.

        Args:
            name: name of a varied field or of a metric.
            owner: owner of the metric.

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
        """Names of the varied seeds, over which results are averaged."""
        return [name for name in self.fields if name.rpartition(".")[2] == "seed"]

    @property
    def settings(self) -> list[str]:
        """Names of the varied fields that are not seeds."""
        return [name for name in self.fields if name not in self.repeats]

    def unplotted_settings(self, plotted: Iterable[str]) -> list[str]:
        """Return the settings that vary at fixed values of the plotted fields."""
        known = [name for name in plotted if name in self.fields]
        count = len(self.groups(known))
        others = (name for name in self.settings if name not in known)
        return [name for name in others if len(self.groups([*known, name])) > count]

    def groups(self, names: Sequence[str]) -> list[tuple[tuple[str, ...], np.ndarray]]:
        """Return the distinct combinations of field values, with their row indices."""
        if not names:
            return [((), np.arange(len(self.failed)))]
        columns = [self.values(name, "") for name in names]
        if not len(self.failed):
            return []
        numbers = np.nan_to_num([column.numbers for column in columns], nan=-np.inf)
        combinations, which = np.unique(numbers, axis=1, return_inverse=True)
        order = np.argsort(which.reshape(-1), kind="stable")
        rows = np.split(order, np.cumsum(np.bincount(which.reshape(-1)))[:-1])
        texts = [
            tuple(c.text(n) for c, n in zip(columns, values, strict=True))
            for values in combinations.T
        ]
        return list(zip(texts, rows, strict=True))

    def _names(self, owner: str, metric: str) -> list[str]:
        name = f"{owner}.{metric}"
        if name in self.columns:
            return [name]
        element = re.compile(rf"{re.escape(name)}_\d+")
        return list(filter(element.fullmatch, self.columns))


def write_table(path: Path, table: pa.Table) -> None:
    """Write a table as a Parquet file atomically."""
    import pyarrow.parquet as pq

    with atomic_write(path) as part:
        pq.write_table(table, part, compression="zstd")


def write_columns(path: Path, columns: Mapping[str, Any]) -> None:
    """Write columns as a Parquet file atomically, with NaN as a missing value."""
    import pyarrow as pa

    arrays = {name: pa.array(v, from_pandas=True) for name, v in columns.items()}
    write_table(path, pa.table(arrays))


def shown_metrics(sweep: Sweep) -> tuple[str, ...]:
    """Return the metrics for a report, by default the plotted and summary metrics."""
    if sweep.metrics is not None:
        return sweep.metrics
    summary = _SUMMARY_METRICS if sweep.experiment.plants else _PLAN_SUMMARY_METRICS
    plotted = (plot.metric for plot in sweep.plots)
    return tuple(dict.fromkeys((*plotted, *summary)))


def _metrics(sweep: Sweep, rows: Iterable[Row]) -> list[str]:
    names = dict.fromkeys(
        name for row in rows for name in row.values
    ) or _plotted_columns(sweep)
    if sweep.metrics is None:
        return list(names)
    stems = {
        f"{metric}{side}"
        for metric in sweep.metrics
        for side in ("", "_plus", "_minus")
    }
    return [name for name in names if _ELEMENT.sub("", name.partition(".")[2]) in stems]


def _plotted_columns(sweep: Sweep) -> dict[str, None]:
    plants = sweep.experiment.plants or (PLAN,)
    names = (name for plot in sweep.plots for name in (plot.metric, plot.x, plot.by))
    return {
        f"{owner}.{name}": None
        for name in names
        if name is not None and name not in sweep.fields
        for owner in ((COMPARISON,) if name in COMPARISON_UNITS else plants)
    }


def _of_one_type(values: list[Value]) -> Sequence[Value]:
    types = {type(value) for value in values}
    if len(types) <= 1:
        return values
    if types <= {int, float}:
        return [float(value) for value in values]
    return [value if isinstance(value, str) else json.dumps(value) for value in values]


def _field(name: str, column: Sequence[object]) -> ColumnValues:
    known = [value for value in column if value is not None]
    if all(map(is_number, known)):
        return ColumnValues(field_label(name), _numbers(column))
    texts = ["" if value is None else str(value) for value in column]
    names, indices = np.unique(texts, return_inverse=True)
    return ColumnValues(field_label(name), indices.astype(float), tuple(names.tolist()))


def _numbers(column: Sequence[object]) -> np.ndarray:
    numbers = np.array(column, dtype=float)
    return np.where(np.isfinite(numbers), numbers, np.nan)


def group_means(group: np.ndarray, count: int, values: np.ndarray) -> np.ndarray:
    """Return the mean of each group, which does not depend on the row order.

    Args:
        group: group number of each value, shape (rows,).
        count: number of groups, including empty groups, which have a mean of NaN.
        values: values to average, except NaN, shape (rows,).
    """
    # Floating-point sums depend on the order of their terms, so the values are sorted.
    order = np.lexsort((values, group))
    order = order[np.isfinite(values[order])]
    sums = np.bincount(group[order], weights=values[order], minlength=count)
    counts = np.bincount(group[order], minlength=count)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
