"""`srs-twin reproduce`: the dissertation's claims compared with both plants."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from srs_twin.cli.console import RunCounter, interruptible, say
from srs_twin.cli.junit import TestCase, write_report
from srs_twin.cli.options import JobsOption, JsonOption, QuietOption

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srs_twin.reproduction.claims import Claim
    from srs_twin.reproduction.figures import FigureEntry
    from srs_twin.reproduction.runs import ProgressFactory, RunStore
    from srs_twin.reproduction.verdicts import JudgedClaim, Outcome
    from srs_twin.studies.sweep.task import Row


CHANGED = 1
"""Exit code if a verdict differs from the baseline."""

OUT = Path("runs/reproduce")
_FORMAT = "{:<30} {:>9} {:>11} {:>11} {:>6}  {}"


def reproduce(
    only: list[str] | None = None,
    quick: bool = False,
    out: Path = OUT,
    jobs: JobsOption = None,
    no_figures: bool = False,
    write_baseline: bool = False,
    scorecard: bool = False,
    others: bool = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Judge the dissertation's claims on both plants.

    The command runs what the claims need, judges every row, and compares the verdicts with the baseline.

    Options:
        --only ID: Name of a row, or a prefix of several names, e.g. gen3 (repeatable).
        --quick: Judge only the rows with short runs, laws first.
        --out DIR: Output folder, which also stores finished runs.
        --no-figures: Omit the figures and their runs.
        --write-baseline: Write the verdicts as the new baseline.
        --scorecard: Print only the credibility grades according to NASA-STD-7009, without any run.
        --others: Print only predicted and published motion of robots that others built, without any run.
    """
    if others:
        _print_others(as_json=as_json)
        return
    if scorecard:
        _print_scorecard(as_json=as_json)
        return
    from srs_twin.compute.workers import start_server

    # Start it first: it imports the modules of the workers while this process imports its own.
    start_server("srs_twin.studies.sweep.warm")
    from srs_twin.errors import InputError
    from srs_twin.io.files import display_path
    from srs_twin.reproduction.claims import load_claims, select_claims
    from srs_twin.reproduction.runs import HTML, JSON, JUNIT, open_store
    from srs_twin.reproduction.verdicts import judge

    if write_baseline and (only or quick):
        raise InputError("--write-baseline needs all rows; remove --only and --quick")
    claims = select_claims(load_claims(), tuple(only or ()), quick=quick)
    figures: Sequence[tuple[FigureEntry, Figure]] = ()
    with interruptible("finished runs are kept; start again to resume"), open_store(out) as store:
        with _counting("runs", quiet=quiet) as progress:
            rows = judge(claims, store, workers=jobs, progress=progress)
        if not no_figures:
            with _counting("runs for figures", quiet=quiet) as progress:
                figures = _draw_figures(store, jobs, progress, run_missing=not (only or quick))
        changes = _write_files(out, rows, figures, new_baseline=write_baseline)
    if as_json:
        print((out / JSON).read_text("utf-8"), end="")
    elif not quiet:
        _print_rows(rows)
    say(f"files in {display_path(out)}: {HTML}, {JSON}, {JUNIT}", quiet=quiet)
    for line in changes:
        say(f"changed from the baseline: {line}")
    if changes:
        say("if the changes are intended, explain them and give --write-baseline")
        raise typer.Exit(CHANGED)


def _print_scorecard(*, as_json: bool) -> None:
    """Print the grades of all capabilities and their reasons."""
    from dataclasses import asdict

    from srs_twin.cli.options import print_json
    from srs_twin.identification.fitting import print_table
    from srs_twin.reproduction.claims import load_claims
    from srs_twin.reproduction.report import FACTORS, UNVALIDATED, scorecard as grade_capabilities
    from srs_twin.reproduction.verdicts import load_baseline

    grades = grade_capabilities(load_claims(), load_baseline())
    if as_json:
        print_json(
            {name: {factor: asdict(grade) for factor, grade in row.items()} for name, row in grades.items()}
        )
        return
    for name, row in grades.items():
        lines = (
            (factor, str(row[factor].grade), row[factor].why.removesuffix(f"; {UNVALIDATED}"))
            for factor in FACTORS
        )
        print_table((name, "grade", "because"), lines, left=(0, 2))
    print(f"Grades 0 to 4 after NASA-STD-7009. Everything here is {UNVALIDATED}.")


def _print_others(*, as_json: bool) -> None:
    """Print the predicted and published motion of robots that others built."""
    from srs_twin.cli.options import print_json
    from srs_twin.identification.fitting import print_table
    from srs_twin.reproduction.others import load_predicted_quantities

    rows = load_predicted_quantities()
    if as_json:
        print_json({"robots": [row.document() for row in rows]})
        return

    compared = [row for row in rows if row.published is not None]
    headings = ("robot", "quantity", "95 % interval", "published", "result")
    print_table(headings, (row.cells() for row in compared), left=(0, 1, 4))
    for robot in dict.fromkeys(row.robot for row in compared):
        first = next(row for row in compared if row.robot == robot)
        commits = [commit or "(none)" for commit in (first.prediction_commit, first.comparison_commit)]
        print(f"{robot}: predicted in commit {commits[0]}, compared in commit {commits[1]}")
    print("known: before the prediction; simulated: by the builders of the robot")
    print(f"{len(rows) - len(compared)} predicted quantities without a published value: --json")


@contextmanager
def _counting(title: str, *, quiet: bool) -> Iterator[ProgressFactory]:
    """Show a progress line; yield a function that adds a number of runs and returns the counter of rows."""
    with RunCounter(title, 0, quiet=quiet) as counting:

        def on_row(row: Row) -> None:
            counting(failed=row.exit_code != 0)
            if row.exit_code:
                say(f"a run failed: {row.reason}", quiet=quiet)

        def add_runs(count: int) -> Callable[[Row], None]:
            counting.total += count
            return on_row

        yield add_runs


def _draw_figures(
    store: RunStore, workers: int | None, progress: ProgressFactory, *, run_missing: bool
) -> list[tuple[FigureEntry, Figure]]:
    """Return the figures whose runs are finished, optionally after running the missing ones."""
    from srs_twin.reproduction.figures import draw_figures, figure_jobs, load_figures

    figures = load_figures()
    if run_missing:
        store.run(figure_jobs(figures, store), workers=workers, progress=progress)
    return list(draw_figures(figures, store))


def _write_files(
    out: Path,
    rows: Sequence[JudgedClaim],
    figures: Sequence[tuple[FigureEntry, Figure]],
    *,
    new_baseline: bool,
) -> list[str]:
    """Write the output files; return the changes from the baseline."""
    from srs_twin.io.file_sets import replace_files
    from srs_twin.reproduction.report import write_html, write_json
    from srs_twin.reproduction.runs import HTML, JSON, JUNIT
    from srs_twin.reproduction.verdicts import load_baseline, write_baseline

    if new_baseline:
        write_baseline(rows)
    changes = load_baseline().changes(rows)
    with replace_files(out, (JSON, HTML, JUNIT)) as fresh:
        write_report(fresh / JUNIT, "srs-twin reproduce", _test_suites(rows))
        write_html(fresh / HTML, rows, figures, changes)
        write_json(fresh / JSON, rows, changes)
    return changes


def _test_suites(rows: Sequence[JudgedClaim]) -> Iterator[tuple[str, list[TestCase]]]:
    """Yield a test suite per use, with a test case per row and column; missed or explained is a failure."""
    from srs_twin.reproduction.report import outcome_text
    from srs_twin.reproduction.verdicts import MET

    def test_case(claim: Claim, column: str, outcome: Outcome) -> TestCase:
        if outcome.verdict == MET:
            return TestCase(claim.id, column)
        message = f"{claim.id}, {column}: {outcome_text(outcome)}, allowed {claim.allowed}"
        text = "\n".join([claim.says, claim.source, outcome.why])
        return TestCase(claim.id, column, 0.0, "failure", message, outcome.verdict, text)

    for use in dict.fromkeys(row.claim.use for row in rows):
        suite = [row for row in rows if row.claim.use == use]
        yield use, [test_case(row.claim, *outcome) for row in suite for outcome in row.outcomes.items()]


def _print_rows(rows: Sequence[JudgedClaim]) -> None:
    """Print a line per row, by category with the headline first, and the numbers of rows that are met."""
    from srs_twin.reproduction.report import (
        TITLES,
        by_category,
        error_text,
        published_text,
        summary_line,
        verdict_text,
    )

    print(_FORMAT.format("row", "published", "analytical", "twin", "error", "verdict"))
    for name, category_rows in by_category(rows).items():
        if category_rows:
            print(f"\n{TITLES[name]}")
        for row in category_rows:
            twin = row.outcomes.get("twin")
            first = row.outcomes.get("analytical") or row.outcomes.get("alone")
            published, error = published_text(row.claim), error_text(row.claim, twin or first)
            verdict = verdict_text(row) + (" (fitted)" if name == "fit" else "")
            print(
                _FORMAT.format(row.claim.id, published, _short_text(first), _short_text(twin), error, verdict)
            )
    print(f"\n{summary_line(rows)}")


def _short_text(outcome: Outcome | None) -> str:
    """Return an outcome in at most 11 characters; for an ordering its first and last value."""
    from srs_twin.reproduction.report import number_text, outcome_text

    if outcome is None:
        return ""
    text = outcome_text(outcome)
    if len(text) <= 11:
        return text
    first, last = (f"{float(number_text(outcome.values[k])):.2g}" for k in (0, -1))
    return f"{first}…{last}"
