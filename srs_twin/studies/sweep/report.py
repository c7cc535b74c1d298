"""HTML report of a sweep, with its fields, runs, plots and means over seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from srs_twin.io.files import write_text
from srs_twin.scenario.provenance import versions
from srs_twin.studies.sweep.points import Sweep, is_number
from srs_twin.studies.sweep.table import COMPARISON, SweepTable, shown_metrics
from srs_twin.studies.sweep.task import PLAN
from srs_twin.viewing.html import Table, cell, image, render
from srs_twin.viewing.plots.labels import field_label

MAX_RUNS = 200
"""Maximum number of runs in a table."""

_MAX_COLUMNS = 24
"""Maximum number of metric columns in a report."""

_COLUMNS_PER_TABLE = 6
"""Number of metric columns that fit on a printed page."""


@dataclass(frozen=True)
class Summary:
    """Summary of a sweep.

    Attributes:
        folder: output folder.
        points: number of points in the sweep.
        done: number of successful runs.
        reasons: number of failed runs, keyed by error message.
        exit_code: highest exit code of the failed runs, or 0 if no run failed.
        sha256: SHA-256 of all rows without wall times.
        ranges: minimum, median and maximum of each summary metric, keyed by column.
        files: names of the written files.
        results: table of all rows.
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
    """Table column with one number per run, or NaN if the value is missing."""

    heading: str
    numbers: np.ndarray

    def text(self, run: int) -> str:
        """Format a number, rounded to a decimal place that the whole column shares."""
        largest = np.abs(self.numbers[np.isfinite(self.numbers)]).max(initial=0)
        places = 3 - int(np.floor(np.log10(largest))) if largest else 0
        if np.isfinite(self.numbers[run]):
            return f"{self.numbers[run]:z.{max(places, 0)}f}"
        return cell(None)

    def mean_text(self, runs: np.ndarray) -> str:
        numbers = self.numbers[runs]
        known = numbers[np.isfinite(numbers)]
        if not len(known):
            return cell(None)
        text = f"{known.mean():.4g}"
        if len(known) > 1:
            text += f" ± {known.std(ddof=1):.2g}"
        if len(known) < len(numbers):
            text += f" ({len(known)})"
        return text


def run_tables(results: SweepTable, metrics: Sequence[str]) -> list[Table]:
    """Return tables with one row per run, ordered by field values.

    If there are more than `MAX_RUNS` runs, the tables are replaced by a note. List
    metrics are averaged over their elements.
    """
    failed = results.failed
    if len(failed) > MAX_RUNS:
        note = f"{len(failed)} runs; their rows are in results.parquet."
        return [Table((), (), note=note)]
    fields = [results.values(name, "") for name in results.fields]
    headings = [field.label for field in fields]
    if failed.any():
        headings.append("status")
    lines = []
    for i in np.lexsort([column.numbers for column in reversed(fields)]):
        start = [column.text(column.numbers[i]) for column in fields]
        if failed.any():
            start.append("failed" if failed[i] else "done")
        lines.append((start, i))
    return _split_tables(results, metrics, headings, lines, _Column.text)


def mean_tables(results: SweepTable, metrics: Sequence[str]) -> list[Table]:
    """Return tables of means over seeds, or an empty list if no seed varies."""
    groups = results.groups(results.settings)
    if len(groups) == len(results.failed):
        return []
    if len(groups) > MAX_RUNS:
        note = f"{len(groups)} combinations; their runs are in results.parquet."
        return [Table((), (), note=note)]
    lines = []
    for texts, rows in groups:
        done = rows[~results.failed[rows]]
        lines.append(([*texts, str(len(done))], done))
    headings = [*map(field_label, results.settings), "runs"]
    return _split_tables(results, metrics, headings, lines, _Column.mean_text)


def _metric_columns(
    results: SweepTable, metrics: Sequence[str]
) -> tuple[list[_Column], str]:
    columns = []
    for metric in dict.fromkeys(metrics):
        for owner in results.owners_if_any(metric):
            values = results.metric(metric, owner)
            heading = values.label
            if owner not in (COMPARISON, PLAN):
                heading += f", {owner}"
            columns.append(_Column(heading, values.numbers))
    if len(columns) <= _MAX_COLUMNS:
        return columns, ""
    note = (
        f"{_MAX_COLUMNS} of {len(columns)} columns are shown; results.parquet has all."
    )
    return columns[:_MAX_COLUMNS], note


Rows = TypeVar("Rows")
"""One run of a table, or several runs whose mean is shown."""


def _split_tables(
    results: SweepTable,
    metrics: Sequence[str],
    headings: list[str],
    lines: list[tuple[list[str], Rows]],
    text: Callable[[_Column, Rows], str],
) -> list[Table]:
    columns, note = _metric_columns(results, metrics)
    tables = []
    for first in range(0, max(len(columns), 1), _COLUMNS_PER_TABLE):
        chunk = columns[first : first + _COLUMNS_PER_TABLE]
        rows = [
            (*start, *(text(column, runs) for column in chunk)) for start, runs in lines
        ]
        shown = (*headings, *(column.heading for column in chunk))
        tables.append(Table(shown, rows, range(len(shown)), note))
    return tables


REPORT = "report.html"

_MAX_VALUES = 12
"""Maximum number of listed values per field."""

_MAX_REASONS = 20


def write_report(
    path: Path, sweep: Sweep, summary: Summary, pictures: Mapping[str, bytes]
) -> None:
    """Write a self-contained HTML report atomically."""
    results = summary.results
    metrics = shown_metrics(sweep)
    made_with = [("results sha256", summary.sha256), *versions().items()]
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
        made_with=Table(["", ""], made_with),
    )
    write_text(path, content)


def _counts(summary: Summary) -> str:
    missing = summary.points - summary.done - summary.failed
    text = f"{summary.done} of {summary.points} runs done, {summary.failed} failed"
    if missing:
        return f"{text}, {missing} not run yet"
    return text


def _failures(summary: Summary) -> Table:
    rows = [(reason, str(count)) for reason, count in summary.reasons.items()]
    note = ""
    if len(rows) > _MAX_REASONS:
        note = f"And {len(rows) - _MAX_REASONS} other reasons: see results.parquet."
    return Table(["reason", "runs"], rows[:_MAX_REASONS], numbers=[1], note=note)


def _varied(sweep: Sweep) -> Table:
    rows = []
    for name, column in zip(sweep.fields, zip(*sweep.values, strict=True), strict=True):
        values = list(dict.fromkeys(column))
        rows.append((field_label(name), name, _values_text(values)))
    for name, value in sweep.document.get("fixed", {}).items():
        rows.append((field_label(name), name, f"{_value_text(value)} (fixed)"))
    periods = sweep.experiment.periods
    if periods is not None:
        rows.append(("simulated time", "periods", f"{periods:g} periods"))
    rows.append(("plants", "plants", " and ".join(sweep.experiment.plants)))
    return Table(["quantity", "field", "values"], rows)


def _values_text(values: list[Any]) -> str:
    if len(values) > _MAX_VALUES and all(map(is_number, values)):
        low, high = map(_value_text, (min(values), max(values)))
        return f"{low} to {high}, {len(values)} values"
    text = ", ".join(map(_value_text, values[:_MAX_VALUES]))
    if len(values) > _MAX_VALUES:
        text += f" and {len(values) - _MAX_VALUES} more"
    return text


def _value_text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)
