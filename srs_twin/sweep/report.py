"""report.html of a sweep: what was varied, what came out, beside what was published, in one page to print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srs_twin.files import atomic_write
from srs_twin.viewing.html import Markup, element, folded, image, page, table
from srs_twin.viewing.labels import field_label
from srs_twin.viewing.sweep_beside import BesideTable
from srs_twin.viewing.sweep_summary import TextTable, means_by, run_tables
from srs_twin.viewing.sweep_table import SweepTable

if TYPE_CHECKING:
    from srs_twin.sweep.execution import Summary
    from srs_twin.sweep.points import Sweep

REPORT = "report.html"

_MOST_LISTED = 12  # values of a field that are written out
_MOST_REASONS = 20
_READING = (
    "Runs that failed have no values and are in no mean; a dash means that there is no such number. Where a "
    "metric is a list, its mean is shown. Metrics are described in the documents; speeds are positive "
    "forward, yaw rates, curvatures and radii to the left.",
    "After ± stands the standard deviation (over n − 1) of the runs that share the value, whatever else "
    "varied; in brackets how many of them have the metric, where some have not.",
)
_BESIDE_READING = (
    "Differences are those from the published value, in per cent of it; in the metric's unit where the one "
    "is zero or the signs differ."
)


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
    parts = [
        element("h1", sweep.title),
        element("p", _counts(summary), cls="sub"),
        *(element("p", f"Note: {warning}") for warning in sweep.warnings),
        *_failures(summary),
        element("h2", "What was varied"),
        element("p", _scenario(sweep)),
        _varied(sweep),
        *_beside(summary.beside),
        *([element("h2", "Pictures")] if pictures else []),
        *(image(content, "png", title) for title, content in pictures.items()),
        element("h2", "Results"),
        *_results(rows, metrics),
        *_means(rows, metrics),
        element("h2", "How to read this"),
        *(element("p", sentence) for sentence in _READING),
        element("h2", "Made with"),
        _made_with(sweep, summary),
    ]
    with atomic_write(path) as part:
        part.write_text(page(sweep.title, *parts), encoding="utf-8")


def _counts(summary: Summary) -> str:
    missing = summary.points - summary.done - summary.failed
    said = f"{summary.done} of {summary.points} runs done, {summary.failed} failed"
    return f"{said}, {missing} not run yet" if missing else said


def _scenario(sweep: Sweep) -> str:
    name, title = sweep.document["scenario"], sweep.experiment.base.get("title", "")
    return f"The scenario is {name} ({title}), other than what stands here."


def _failures(summary: Summary) -> list[Markup]:
    if not summary.reasons:
        return []
    rows = [(reason, str(count)) for reason, count in list(summary.reasons.items())[:_MOST_REASONS]]
    more = len(summary.reasons) - len(rows)
    said = [element("p", f"And {more} other reasons: see results.parquet.")] if more else []
    return [element("h2", "Why runs failed"), table(["reason", "runs"], rows, numbers=[1]), *said]


def _varied(sweep: Sweep) -> Markup:
    """Return the table of fields: what was varied, and what was otherwise than in the scenario."""
    rows = []
    for name, column in zip(sweep.fields, zip(*sweep.values, strict=True), strict=True):
        rows.append((field_label(name), name, _values(list(dict.fromkeys(column)))))
    for name, value in sweep.document.get("fixed", {}).items():
        rows.append((field_label(name), name, f"{_plain(value)} (fixed)"))
    if sweep.experiment.periods is not None:
        rows.append(("simulated time", "periods", f"{sweep.experiment.periods:g} periods"))
    rows.append(("plants", "plants", " and ".join(sweep.experiment.plants)))
    return table(["what", "field", "values"], rows)


def _values(values: list[Any]) -> str:
    if len(values) <= _MOST_LISTED:
        return ", ".join(map(_plain, values))
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return f"{_plain(min(values))} to {_plain(max(values))}, {len(values)} values"
    return f"{', '.join(map(_plain, values[:_MOST_LISTED]))} and {len(values) - _MOST_LISTED} more"


def _plain(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _beside(found: BesideTable | None) -> list[Markup]:
    if found is None:
        return []
    return [
        element("h2", f"Beside what was published: {found.source}"),
        table(found.headings, found.rows, numbers=range(1, len(found.headings))),
        *([element("p", found.note)] if found.note else []),
        element("p", _BESIDE_READING),
    ]


def _results(rows: SweepTable, metrics: Sequence[str]) -> list[Markup]:
    return [part for found in run_tables(rows, metrics) for part in _shown(found)]


def _means(rows: SweepTable, metrics: Sequence[str]) -> list[Markup]:
    """Return the means by the values of each field, where a value has several runs."""
    made = []
    for name in rows.fields:
        tables = means_by(name, rows, metrics)
        if tables:
            made += [element("h2", f"Means by {field_label(name)}"), *(p for t in tables for p in _shown(t))]
    return made


def _shown(found: TextTable) -> list[Markup]:
    """Return a table, where it has anything, and what it leaves out."""
    made = [table(found.headings, found.rows, numbers=range(len(found.headings)))] if found.headings else []
    return [*made, *([element("p", found.left_out, cls="sub")] if found.left_out else [])]


def _made_with(sweep: Sweep, summary: Summary) -> Markup:
    rows = [("results sha256", summary.sha256), *sweep.versions.items()]
    return folded("Versions, and the digest of the results", table(["", ""], rows))
