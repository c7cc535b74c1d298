"""`srs-twin diff`: what moved from one set of results to another."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from srs_twin.cli.console import console, new_table, say
from srs_twin.cli.junit import TestCase, report_path, write_report
from srs_twin.cli.options import JsonOption, argument, option, print_json

if TYPE_CHECKING:
    from srs_twin.comparison.diff import Difference, Leaf

MOVED = 1
_SHOWN = 40


def diff(
    a: Annotated[str, argument("A")],
    b: Annotated[str, argument("B")],
    rel: Annotated[float | None, option("--rel NUMBER")] = None,
    abs_: Annotated[float | None, option("--abs NUMBER")] = None,
    tolerances: Annotated[str | None, option("--tolerances FILE")] = None,
    junit: Annotated[str | None, option("--junit FILE")] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare results number by number; exit with 1 when one moved.

    A and B are what `run`, `compare`, `replay`, `sweep` or `reproduce` left: metrics.json, results.parquet,
    reproduce.json, or folders that hold such files.

    Options:
        a: Reference: a folder of results, or one file.
        b: Results that are held against it.
        rel: Relative tolerance. [default: 1e-6]
        abs_: Absolute tolerance. [default: 1e-9]
        tolerances: Tolerances by metric, a YAML file (docs/ci.md).
        junit: Also write what moved as JUnit XML.
    """
    from srs_twin.comparison.diff import Tolerances, load_tolerances, read_results
    from srs_twin.comparison.diff import diff as difference
    from srs_twin.errors import InputError
    from srs_twin.io.files import check_output_folder

    report = None if junit is None else report_path(junit)
    if report is not None:
        check_output_folder(report.parent, (report.name,), option="--junit")
    allowed = load_tolerances(tolerances) if tolerances else Tolerances()
    given = {name: value for name, value in (("rel", rel), ("abs", abs_)) if value is not None}
    for name, value in given.items():
        if not 0 <= value < float("inf"):
            raise InputError(f"--{name} {value:g} is not allowed; it must be finite and 0 or more")
    found = difference(read_results(a), read_results(b), allowed.model_copy(update=given))
    for package, (old, new) in found.versions.items():
        say(f"made with another {package}: {old} → {new}")
    if as_json:
        print_json(found.document())
    else:
        _show(found)
    if report is not None:
        write_report(report, "srs-twin diff", [("diff", _test_cases(found))])
    if found.moved:
        raise typer.Exit(MOVED)


def _show(found: Difference) -> None:
    """Print what moved as a table, at most `_SHOWN` rows."""
    lines = new_table("where", "metric", "a", "b", "(b − a)/|a|", left=(0, 1))
    for column in lines.columns[:2]:
        column.no_wrap, column.overflow = False, "fold"
    for each in found.moved[:_SHOWN]:
        rel = "" if each.rel is None else f"{each.rel:+.2g}"
        lines.add_row(each.where, each.metric, _text(each.a), _text(each.b), rel)
    if found.moved:
        console().print(lines)
    if len(found.moved) > _SHOWN:
        print(f"and {len(found.moved) - _SHOWN} more; --json lists them all")
    print(f"{len(found.moved)} moved, {found.same} the same")


def _text(value: Leaf) -> str:
    if value is None:
        return "–"
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _test_cases(found: Difference) -> Iterator[TestCase]:
    """Yield a test case a place, a failure where a value moved."""
    for where in found.wheres:
        lines = [f"{m.metric}: {_text(m.a)} → {_text(m.b)}" for m in found.moved if m.where == where]
        failure = ("failure", f"{len(lines)} moved", "moved", "\n".join(lines)) if lines else ()
        yield TestCase("diff", where, 0.0, *failure)
