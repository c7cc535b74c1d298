"""report.html of a sweep: what was varied, a row a run, and means over seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.io.files import write_text
from srs_twin.studies.sweep.table import COMPARISON, PLAN, SweepTable
from srs_twin.viewing.html.page import Table, image, render
from srs_twin.viewing.plots.labels import field_label

if TYPE_CHECKING:
    from srs_twin.studies.sweep.points import Sweep


MOST_RUNS = 200
"""Beyond so many runs there is no row a run."""

_MOST_COLUMNS = 24
_COLUMNS = 6  # of metrics side by side: what a printed page holds
_NONE = "–"


@dataclass(frozen=True)
class Summary:
    """Outcome of a sweep.

    Attributes:
        folder: of its files.
        points: number of runs of the sweep.
        done: number of those that succeeded.
        reasons: why runs failed → their number.
        exit_code: the highest of the failed runs; 0 where none failed.
        sha256: of the results, see `results.digest`.
        spans: speed, yaw rate and amplitude of each plant → least, median and most.
        files: names of the files written.
        published: published values beside those of the plants, where the sweep has any.
    """

    folder: Path
    points: int
    done: int
    reasons: Mapping[str, int]
    exit_code: int
    sha256: str
    spans: Mapping[str, tuple[float, float, float]]
    files: tuple[str, ...]
    published: Table | None = None

    @property
    def failed(self) -> int:
        """Number of failed runs."""
        return sum(self.reasons.values())


@dataclass(frozen=True)
class _Column:
    """A metric of a plant or of the comparison: its heading, and a number a run, NaN where there is none."""

    heading: str
    numbers: np.ndarray

    def text(self, run: int) -> str:
        """Write a run's number to the fourth digit of the column's largest."""
        largest = np.abs(self.numbers[np.isfinite(self.numbers)]).max(initial=0)
        places = 3 - int(np.floor(np.log10(largest))) if largest else 0
        number = self.numbers[run]
        return f"{number:z.{max(places, 0)}f}" if np.isfinite(number) else _NONE

    def mean(self, runs: np.ndarray) -> str:
        """Write mean ± standard deviation of runs, and of how many where some have no value."""
        numbers = self.numbers[runs]
        known = numbers[np.isfinite(numbers)]
        if not len(known):
            return _NONE
        spread = f" ± {known.std(ddof=1):.2g}" if len(known) > 1 else ""
        return f"{known.mean():.4g}{spread}" + (f" ({len(known)})" if len(known) < len(numbers) else "")


def run_tables(rows: SweepTable, metrics: Sequence[str]) -> list[Table]:
    """Return a row a run in the order of the fields' values, few metrics a table.

    Args:
        rows: results of a sweep; of more than `MOST_RUNS` runs, what is returned says so and has no rows.
        metrics: what is shown, of each plant that has it; of a list, its mean.
    """
    if len(rows.failed) > MOST_RUNS:
        return [Table((), (), note=f"{len(rows.failed)} runs, a row each in results.parquet.")]
    fields, failed = [rows.values(name, "") for name in rows.fields], rows.failed
    order = np.lexsort([field.numbers for field in reversed(fields)])
    columns, left_out = _columns(rows, metrics)
    headings = (*(field.label for field in fields), *(["status"] if failed.any() else []))
    named = [tuple(field.text(field.numbers[i]) for field in fields) for i in order]
    if failed.any():
        named = [(*names, "failed" if failed[i] else "done") for names, i in zip(named, order, strict=True)]
    return _tables(headings, zip(named, order, strict=True), columns, _Column.text, left_out)


def means(rows: SweepTable, metrics: Sequence[str]) -> list[Table]:
    """Return mean ± standard deviation over seeds, a row a combination of all other fields.

    None where every combination has one run. What was varied on purpose is never averaged over.

    Args:
        rows: results of a sweep; runs that failed are left out.
        metrics: as `run_tables` takes them.
    """
    groups = rows.groups(rows.settings)
    if len(groups) == len(rows.failed):
        return []
    if len(groups) > MOST_RUNS:
        return [Table((), (), note=f"{len(groups)} combinations; their runs are in results.parquet.")]
    done = [(texts, each[~rows.failed[each]]) for texts, each in groups]
    lines = [((*texts, str(len(each))), each) for texts, each in done]
    columns, not_shown = _columns(rows, metrics)
    return _tables((*map(field_label, rows.settings), "runs"), lines, columns, _Column.mean, not_shown)


def _columns(rows: SweepTable, metrics: Sequence[str]) -> tuple[list[_Column], str]:
    """Return the columns of metrics, those of one metric side by side, and what is said of those left out."""
    found = []
    for metric in dict.fromkeys(metrics):
        for owner in rows.holders(metric):
            values = rows.metric(metric, owner)
            heading = values.label if owner in (COMPARISON, PLAN) else f"{values.label}, {owner}"
            found.append(_Column(heading, values.numbers))
    if len(found) <= _MOST_COLUMNS:
        return found, ""
    said = f"{_MOST_COLUMNS} of {len(found)} columns are shown; results.parquet has all."
    return found[:_MOST_COLUMNS], said


def _tables(
    headings: tuple[str, ...],
    lines: Iterable[tuple[tuple[str, ...], Any]],
    columns: Sequence[_Column],
    cell: Callable[[_Column, Any], str],
    note: str,
) -> list[Table]:
    """Return tables of as many columns as a page holds; one without columns where there are none.

    Args:
        headings: of what every table begins with.
        lines: what a line begins with, and which of the numbers of each column are its own.
        columns: of all tables.
        cell: writes what a column has for these runs.
        note: below each table.
    """
    made, lines = [], list(lines)
    for first in range(0, max(len(columns), 1), _COLUMNS):
        few = columns[first : first + _COLUMNS]
        rows = tuple((*begin, *(cell(column, own) for column in few)) for begin, own in lines)
        shown = (*headings, *(column.heading for column in few))
        made.append(Table(shown, rows, range(len(shown)), note))
    return made


REPORT = "report.html"

_MOST_LISTED = 12  # values of a field that are written out
_MOST_REASONS = 20


def write_report(
    path: Path,
    sweep: Sweep,
    summary: Summary,
    rows: SweepTable,
    metrics: Sequence[str],
    pictures: Mapping[str, bytes],
) -> None:
    """Write the page, whole or not at all; it needs nothing from outside itself.

    Args:
        path: file to write; an existing one is replaced.
        sweep: what was run.
        summary: how it ended.
        rows: the results.
        metrics: what the tables show.
        pictures: title → PNG.

    Raises:
        InputError: the place cannot be written.
    """
    versions = [("results sha256", summary.sha256), *sweep.versions.items()]
    content = render(
        "studies/sweep/report.html",
        title=sweep.title,
        subtitle=_counts(summary),
        warnings=sweep.warnings,
        failures=_failures(summary),
        scenario=f"{sweep.document['scenario']} ({sweep.experiment.base.get('title', '')})",
        varied=_varied(sweep),
        published=summary.published,
        plots=[image(content, "png", title) for title, content in pictures.items()],
        runs=run_tables(rows, metrics),
        repeats=", ".join(map(field_label, rows.repeats)),
        means=means(rows, metrics),
        made_with=Table(["", ""], versions),
    )
    write_text(path, content)


def _counts(summary: Summary) -> str:
    missing = summary.points - summary.done - summary.failed
    said = f"{summary.done} of {summary.points} runs done, {summary.failed} failed"
    return f"{said}, {missing} not run yet" if missing else said


def _failures(summary: Summary) -> Table:
    rows = [(reason, str(count)) for reason, count in list(summary.reasons.items())[:_MOST_REASONS]]
    more = len(summary.reasons) - len(rows)
    note = f"And {more} other reasons: see results.parquet." if more else ""
    return Table(["reason", "runs"], rows, numbers=[1], note=note)


def _varied(sweep: Sweep) -> Table:
    """Return the table of fields: what was varied, and what was otherwise than in the scenario."""
    rows = []
    for name, column in zip(sweep.fields, zip(*sweep.values, strict=True), strict=True):
        rows.append((field_label(name), name, _values(list(dict.fromkeys(column)))))
    for name, value in sweep.document.get("fixed", {}).items():
        rows.append((field_label(name), name, f"{_plain(value)} (fixed)"))
    if sweep.experiment.periods is not None:
        rows.append(("simulated time", "periods", f"{sweep.experiment.periods:g} periods"))
    rows.append(("plants", "plants", " and ".join(sweep.experiment.plants)))
    return Table(["what", "field", "values"], rows)


def _values(values: list[Any]) -> str:
    if len(values) <= _MOST_LISTED:
        return ", ".join(map(_plain, values))
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return f"{_plain(min(values))} to {_plain(max(values))}, {len(values)} values"
    return f"{', '.join(map(_plain, values[:_MOST_LISTED]))} and {len(values) - _MOST_LISTED} more"


def _plain(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
