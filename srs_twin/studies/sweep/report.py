"""HTML report of a sweep: varied fields, results by run, and means over seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from srs_twin.io.files import write_text
from srs_twin.studies.sweep.points import Sweep, is_number
from srs_twin.studies.sweep.table import COMPARISON, SweepTable
from srs_twin.studies.sweep.task import PLAN
from srs_twin.viewing.html import Table, cell, image, render
from srs_twin.viewing.plots.labels import field_label

MAX_RUNS = 200
"""Largest number of rows of a table of runs."""

_MAX_COLUMNS = 24
"""Largest number of metric columns in a report."""

_COLUMNS_PER_TABLE = 6
"""Number of metric columns that fit on a printed page."""


@dataclass(frozen=True)
class Summary:
    """Summary of a sweep.

    Attributes:
        folder: output folder.
        points: number of points.
        done: number of successful runs.
        reasons: reason of failure → number of runs.
        exit_code: highest exit code of the failed runs; 0 without failures.
        sha256: digest of the results, see `store.rows_digest`.
        ranges: metric → (minimum, median, maximum), for the summary metrics.
        files: names of the written files.
        results: all rows as columns.
    """

    folder: Path
    points: int
    done: int
    reasons: Mapping[str, int]
    exit_code: int
    sha256: str
    ranges: Mapping[str, tuple[float, float, float]]
    files: tuple[str, ...]
    results: SweepTable = field(repr=False)

    @property
    def failed(self) -> int:
        """Number of failed runs."""
        return sum(self.reasons.values())


@dataclass(frozen=True)
class _Column:
    """Metric of a plant or of the comparison: heading, and a number per run, NaN if missing."""

    heading: str
    numbers: np.ndarray

    def text(self, run: int) -> str:
        """Return the number of a run as text, to the fourth digit of the column's largest number."""
        largest = np.abs(self.numbers[np.isfinite(self.numbers)]).max(initial=0)
        places = 3 - int(np.floor(np.log10(largest))) if largest else 0
        number = self.numbers[run]
        if np.isfinite(number):
            return f"{number:z.{max(places, 0)}f}"
        return cell(None)

    def mean_text(self, runs: np.ndarray) -> str:
        """Return mean ± standard deviation of runs, and their number if some have no value."""
        numbers = self.numbers[runs]
        known = numbers[np.isfinite(numbers)]
        if not len(known):
            return cell(None)
        std = f" ± {known.std(ddof=1):.2g}" if len(known) > 1 else ""
        return f"{known.mean():.4g}{std}" + (
            f" ({len(known)})" if len(known) < len(numbers) else ""
        )


def run_tables(results: SweepTable, metrics: Sequence[str]) -> list[Table]:
    """Return tables with one row per run, ordered by the fields' values, with a few metrics each.

    Args:
        results: results of a sweep; a table of more than `MAX_RUNS` runs is replaced by
            a note.
        metrics: metrics to show for each plant and the comparison; a list metric is
            shown by its mean.
    """
    if len(results.failed) > MAX_RUNS:
        return [
            Table(
                (),
                (),
                note=f"{len(results.failed)} runs; their rows are in results.parquet.",
            )
        ]
    fields = [results.values(name, "") for name in results.fields]
    failed = results.failed
    order = np.lexsort([field.numbers for field in reversed(fields)])
    columns, note = _metric_columns(results, metrics)
    headings = (
        *(field.label for field in fields),
        *(["status"] if failed.any() else []),
    )
    starts = [tuple(field.text(field.numbers[i]) for field in fields) for i in order]
    if failed.any():
        starts = [
            (*start, "failed" if failed[i] else "done")
            for start, i in zip(starts, order, strict=True)
        ]
    return _split_tables(
        headings, zip(starts, order, strict=True), columns, _Column.text, note
    )


def mean_tables(results: SweepTable, metrics: Sequence[str]) -> list[Table]:
    """Return mean ± standard deviation over seeds, with one row per combination of all other fields.

    The result is empty if each combination has only one run.

    Args:
        results: results of a sweep; failed runs are left out.
        metrics: see `run_tables`.
    """
    groups = results.groups(results.settings)
    if len(groups) == len(results.failed):
        return []
    if len(groups) > MAX_RUNS:
        return [
            Table(
                (),
                (),
                note=f"{len(groups)} combinations; their runs are in results.parquet.",
            )
        ]
    successful = [(texts, rows[~results.failed[rows]]) for texts, rows in groups]
    lines = [((*texts, str(len(rows))), rows) for texts, rows in successful]
    columns, note = _metric_columns(results, metrics)
    headings = (*map(field_label, results.settings), "runs")
    return _split_tables(headings, lines, columns, _Column.mean_text, note)


def _metric_columns(
    results: SweepTable, metrics: Sequence[str]
) -> tuple[list[_Column], str]:
    """Return the columns of metrics, owners side by side, and a note if some are left out."""
    columns = []
    for metric in dict.fromkeys(metrics):
        for owner in results.owners_if_any(metric):
            values = results.metric(metric, owner)
            if owner in (COMPARISON, PLAN):
                heading = values.label
            else:
                heading = f"{values.label}, {owner}"
            columns.append(_Column(heading, values.numbers))
    if len(columns) <= _MAX_COLUMNS:
        return columns, ""
    note = (
        f"{_MAX_COLUMNS} of {len(columns)} columns are shown; results.parquet has all."
    )
    return columns[:_MAX_COLUMNS], note


def _split_tables(
    headings: tuple[str, ...],
    lines: Iterable[tuple[tuple[str, ...], Any]],
    columns: Sequence[_Column],
    text: Callable[[_Column, Any], str],
    note: str,
) -> list[Table]:
    """Return tables with as many metric columns as fit on a page; at least one table.

    Args:
        headings: headings of the first columns of each table.
        lines: first cells of each line, and its run or runs.
        columns: metric columns.
        text: function that returns a metric's text for these runs.
        note: note below each table.
    """
    tables = []
    lines = list(lines)
    for first in range(0, max(len(columns), 1), _COLUMNS_PER_TABLE):
        chunk = columns[first : first + _COLUMNS_PER_TABLE]
        rows = tuple(
            (*start, *(text(column, runs) for column in chunk)) for start, runs in lines
        )
        all_headings = (*headings, *(column.heading for column in chunk))
        tables.append(Table(all_headings, rows, range(len(all_headings)), note))
    return tables


REPORT = "report.html"

_MAX_VALUES = 12
"""Largest number of values of a field that are listed."""

_MAX_REASONS = 20
"""Largest number of failure reasons that are listed."""


def write_report(
    path: Path,
    sweep: Sweep,
    summary: Summary,
    results: SweepTable,
    metrics: Sequence[str],
    pictures: Mapping[str, bytes],
) -> None:
    """Write the self-contained HTML page atomically.

    Args:
        path: file to write or replace.
        sweep: sweep.
        summary: its summary.
        results: its results.
        metrics: metrics of the tables.
        pictures: title → PNG.

    Raises:
        InputError: the path cannot be written.
    """
    versions = [("results sha256", summary.sha256), *sweep.versions.items()]
    content = render(
        "studies/sweep/report.html",
        title=sweep.title,
        subtitle=_counts(summary),
        warnings=sweep.warnings,
        failures=_failures(summary),
        scenario=(
            f"{sweep.document['scenario']} ({sweep.experiment.base.get('title', '')})"
        ),
        varied=_varied(sweep),
        plots=[image(content, "png", title) for title, content in pictures.items()],
        runs=run_tables(results, metrics),
        repeats=", ".join(map(field_label, results.repeats)),
        means=mean_tables(results, metrics),
        made_with=Table(["", ""], versions),
    )
    write_text(path, content)


def _counts(summary: Summary) -> str:
    missing = summary.points - summary.done - summary.failed
    text = f"{summary.done} of {summary.points} runs done, {summary.failed} failed"
    if missing:
        return f"{text}, {missing} not run yet"
    return text


def _failures(summary: Summary) -> Table:
    rows = [
        (reason, str(count))
        for reason, count in list(summary.reasons.items())[:_MAX_REASONS]
    ]
    more = len(summary.reasons) - len(rows)
    if more:
        note = f"And {more} other reasons: see results.parquet."
    else:
        note = ""
    return Table(["reason", "runs"], rows, numbers=[1], note=note)


def _varied(sweep: Sweep) -> Table:
    """Return the table of varied and fixed fields."""
    rows = []
    for name, column in zip(sweep.fields, zip(*sweep.values, strict=True), strict=True):
        rows.append(
            (field_label(name), name, _values_text(list(dict.fromkeys(column))))
        )
    for name, value in sweep.document.get("fixed", {}).items():
        rows.append((field_label(name), name, f"{_value_text(value)} (fixed)"))
    if sweep.experiment.periods is not None:
        rows.append(
            ("simulated time", "periods", f"{sweep.experiment.periods:g} periods")
        )
    rows.append(("plants", "plants", " and ".join(sweep.experiment.plants)))
    return Table(["quantity", "field", "values"], rows)


def _values_text(values: list[Any]) -> str:
    if len(values) <= _MAX_VALUES:
        return ", ".join(map(_value_text, values))
    if all(map(is_number, values)):
        return (
            f"{_value_text(min(values))} to {_value_text(max(values))}, {len(values)}"
            " values"
        )
    return (
        f"{', '.join(map(_value_text, values[:_MAX_VALUES]))} and"
        f" {len(values) - _MAX_VALUES} more"
    )


def _value_text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)
