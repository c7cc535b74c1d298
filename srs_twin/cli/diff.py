"""Command `srs-twin diff`, which compares two sets of results."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from srs_twin.cli.console import console, new_table, say
from srs_twin.cli.junit import TestCase, report_path, write_report
from srs_twin.cli.options import JsonOption, argument, print_json

if TYPE_CHECKING:
    from rich.table import Table

    from srs_twin.comparison.diff import ChangedValue, Difference, Leaf, Tolerances

EXIT_DIFFERENT = 1
"""Exit code if a difference exceeds the tolerance."""

_MAX_ROWS = 40
"""Maximum number of rows in all printed tables together."""


def diff(
    a: Annotated[str, argument("A")],
    b: Annotated[str, argument("B")],
    rel: float | None = None,
    abs_: float | None = None,
    tolerances: str | None = None,
    junit: str | None = None,
    as_json: JsonOption = False,
) -> None:
    """Compare two sets of results value by value.

    A and B are files (metrics.json, results.parquet or reproduce.json), or folders of
    such files, written by `run`, `compare`, `replay`, `sweep` or `reproduce`. The exit
    code is 1 if a difference exceeds the tolerance.

    Options:
        a: Folder or file with the reference results.
        b: Folder or file with the results to compare with the reference.
        --rel NUMBER: Relative tolerance for all metrics. [default: 1e-6]
        --abs NUMBER: Absolute tolerance for all metrics. [default: 1e-9]
        --tolerances FILE: YAML file that sets tolerances for individual metrics (see
            docs/ci.md).
        --junit FILE: Write the differences to this file as a JUnit XML report.
    """
    from srs_twin.comparison.diff import (
        Tolerances,
        diff as compare_results,
        load_tolerances,
    )
    from srs_twin.errors import InputError
    from srs_twin.io.files import check_output_folder

    report = None if junit is None else report_path(junit)
    if report is not None:
        check_output_folder(report.parent, (report.name,), option="--junit")
    try:
        allowed = load_tolerances(tolerances) if tolerances else Tolerances()
        difference = compare_results(a, b, _with_options(allowed, rel=rel, abs=abs_))
    except InputError as error:
        # A report of the error replaces the report of an earlier comparison.
        if report is not None:
            text = str(error)
            kind = type(error).__name__
            case = TestCase("diff", "compare", 0.0, "error", text, kind, text)
            write_report(report, "srs-twin diff", [("diff", [case])])
        raise
    for package, (old, new) in difference.versions.items():
        say(f"different versions of {package}: {old} → {new}")
    if as_json:
        print_json(difference.document())
    else:
        _show(difference)
    if report is not None:
        write_report(report, "srs-twin diff", [("diff", _test_cases(difference))])
    if difference.moved:
        raise typer.Exit(EXIT_DIFFERENT)


def _with_options(allowed: Tolerances, **options: float | None) -> Tolerances:
    from srs_twin.errors import InputError

    given = {name: value for name, value in options.items() if value is not None}
    for name, value in given.items():
        if not 0 <= value < float("inf"):
            raise InputError(
                f"--{name} {value:g} is not allowed; give a finite number of at least 0"
            )
    return allowed.model_copy(update=given)


def _show(difference: Difference) -> None:
    tables: dict[str, Table] = {}
    for change in difference.moved[:_MAX_ROWS]:
        plant, dot, metric = change.metric.rpartition(".")
        title = f"{change.where}{dot and ', '}{plant}"
        if title not in tables:
            tables[title] = new_table("metric", "a", "b", "b − a", "%", title=title)
            tables[title].columns[0].no_wrap = False
            tables[title].columns[0].overflow = "fold"
        tables[title].add_row(metric, *_cells(change))
    for table in tables.values():
        console().print(table)
    if len(difference.moved) > _MAX_ROWS:
        print(f"and {len(difference.moved) - _MAX_ROWS} more; list all with --json")
    print(f"{len(difference.moved)} different, {difference.same} equal")


def _cells(change: ChangedValue) -> list[str]:
    """Return the cells for a, b, b − a, and (b − a)/|a| in per cent.

    The values a and b have enough digits to show their difference.
    """
    from srs_twin.comparison.diff import tolerance_names
    from srs_twin.comparison.sampling import is_near_zero, split_unit

    a = change.a
    b = change.b
    digits = next((n for n in range(4, 18) if _text(a, n) != _text(b, n)), 17)
    shift = ""
    per_cent = ""
    if isinstance(a, float | int) and isinstance(b, float | int):
        shift = f"{b - a:+.3g}"
        _, unit = split_unit(tolerance_names(change.metric)[-1])
        if change.rel is not None and not is_near_zero(a, b, unit):
            per_cent = f"{100 * change.rel:+.3g}"
    return [_text(a, digits), _text(b, digits), shift, per_cent]


def _text(value: Leaf, digits: int = 9) -> str:
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.{digits}g}"
    return str(value)


def _test_cases(difference: Difference) -> Iterator[TestCase]:
    for where in difference.wheres:
        lines = [
            f"{m.metric}: {_text(m.a)} → {_text(m.b)}"
            for m in difference.moved
            if m.where == where
        ]
        case = TestCase("diff", where)
        if lines:
            case = case._replace(
                outcome="failure",
                message=f"{len(lines)} different",
                kind="different",
                text="\n".join(lines),
            )
        yield case
