"""`srs-twin reproduce`: every statement of the dissertation beside what both plants say."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from srs_twin.cli.console import interruptible, say
from srs_twin.cli.junit import TestCase, write_report
from srs_twin.cli.options import JobsOption, JsonOption, QuietOption, option
from srs_twin.cli.progress import RunCounter

if TYPE_CHECKING:
    from srs_twin.reproduction.claims import Claim
    from srs_twin.reproduction.runs import Store
    from srs_twin.reproduction.verdicts import Judged
    from srs_twin.studies.sweep.task import Row


CHANGED = 1
OUT = Path("runs/reproduce")
_FORMAT = "{:<30} {:>9} {:>11} {:>11} {:>6}  {}"


def reproduce(
    only: Annotated[list[str] | None, option("--only ID")] = None,
    quick: Annotated[bool, option("--quick")] = False,
    out: Annotated[Path, option("--out DIR")] = OUT,
    jobs: JobsOption = None,
    no_figures: Annotated[bool, option("--no-figures")] = False,
    write_baseline: Annotated[bool, option("--write-baseline")] = False,
    scorecard: Annotated[bool, option("--scorecard")] = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Judge the claims of the dissertation on both plants.

    Runs what the claims need, judges every row, and compares what comes out with the baseline.

    Options:
        only: Row, or the rows that begin with it; may be repeated.
        quick: The quick rows only: laws first, short runs.
        out: Folder of the results and of the runs that are kept.
        no_figures: Draw no figures, and run nothing for them.
        write_baseline: Let what comes out be the baseline of later runs.
        scorecard: Only grade what is kept, after NASA-STD-7009, and run nothing.
    """
    if scorecard:
        _show_scorecard(as_json=as_json)
        return
    from srs_twin.compute.workers import start_server

    # First of all: it loads what workers need while this process loads what it needs itself.
    start_server("srs_twin.studies.sweep.warm")
    from srs_twin.errors import InputError
    from srs_twin.io.files import display_path
    from srs_twin.reproduction.claims import chosen, load_claims
    from srs_twin.reproduction.runs import HTML, JSON, JUNIT, open_store
    from srs_twin.reproduction.verdicts import judge

    if write_baseline and (only or quick):
        raise InputError("--write-baseline needs all rows; leave --only and --quick out")
    claims = chosen(load_claims(), tuple(only or ()), quick=quick)
    figures = []
    with interruptible("what was finished is kept, start again to go on"), open_store(out) as store:
        with _counting("runs", quiet=quiet) as started:
            rows = judge(claims, store, workers=jobs, started=started)
        if not no_figures:
            with _counting("runs for figures", quiet=quiet) as started:
                figures = _figures(store, jobs, started, every=not (only or quick))
        changes = _written(out, rows, figures, write_baseline=write_baseline)
    if as_json:
        print((out / JSON).read_text("utf-8"), end="")
    elif not quiet:
        _show(rows)
    say(f"files in {display_path(out)}: {HTML}, {JSON}, {JUNIT}", quiet=quiet)
    for line in changes:
        say(f"changed from the baseline: {line}")
    if changes:
        say("explain the change, then let --write-baseline write it")
        raise typer.Exit(CHANGED)


def _show_scorecard(*, as_json: bool) -> None:
    """Print the grade of every capability, with the figure behind it."""
    from dataclasses import asdict

    from srs_twin.cli.options import print_json
    from srs_twin.identification.fitting import print_table
    from srs_twin.reproduction.claims import load_claims
    from srs_twin.reproduction.scorecard import FACTORS, UNVALIDATED
    from srs_twin.reproduction.scorecard import scorecard as graded
    from srs_twin.reproduction.verdicts import load_baseline

    found = graded(load_claims(), load_baseline())
    if as_json:
        print_json(
            {name: {factor: asdict(grade) for factor, grade in row.items()} for name, row in found.items()}
        )
        return
    for name, row in found.items():
        lines = (
            (each, str(row[each].grade), row[each].why.removesuffix(f"; {UNVALIDATED}")) for each in FACTORS
        )
        print_table((name, "grade", "because"), lines, left=(0, 2))
    print(f"Grades 0 to 4 after NASA-STD-7009. Everything here is {UNVALIDATED}.")


@contextmanager
def _counting(title: str, *, quiet: bool) -> Iterator[Callable[[int], Callable[[Row], None]]]:
    """Yield what takes the number of further runs and returns what counts each that is finished."""
    with RunCounter(title, 0, quiet=quiet) as counting:

        def progress(row: Row) -> None:
            counting(failed=row.exit_code != 0)
            if row.exit_code:
                say(f"a run failed: {row.reason}", quiet=quiet)

        def started(count: int) -> Callable[[Row], None]:
            counting.total += count
            return progress

        yield started


def _figures(
    store: Store, workers: int | None, started: Callable[[int], Callable[[Row], None]], *, every: bool
) -> list[Any]:
    """Return the figures whose runs are there; of a whole reproduction run what is theirs alone."""
    from srs_twin.reproduction.figures import drawn, jobs, load_pictures

    pictures = load_pictures()
    if every:
        store.run(jobs(pictures, store), workers=workers, started=started)
    return list(drawn(pictures, store))


def _written(out: Path, rows: Sequence[Judged], figures: list[Any], *, write_baseline: bool) -> list[str]:
    """Write the files; return what has changed from the baseline."""
    from srs_twin.io.file_sets import replace_files
    from srs_twin.reproduction.report import write_html, write_json
    from srs_twin.reproduction.runs import HTML, JSON, JUNIT
    from srs_twin.reproduction.verdicts import load_baseline
    from srs_twin.reproduction.verdicts import write_baseline as write

    if write_baseline:
        write(rows)
    changes = load_baseline().changes(rows)
    with replace_files(out, (JSON, HTML, JUNIT)) as fresh:
        write_report(fresh / JUNIT, "srs-twin reproduce", _suites(rows))
        write_html(fresh / HTML, rows, figures, changes)
        write_json(fresh / JSON, rows, changes)
    return changes


def _suites(rows: Sequence[Judged]) -> Iterator[tuple[str, list[TestCase]]]:
    """Yield a suite a use with a test case for each row and column; missed is a failure, explained or not."""
    from srs_twin.reproduction.report import cell
    from srs_twin.reproduction.verdicts import MET

    def test(claim: Claim, column: str, outcome: Any) -> TestCase:
        if outcome.verdict == MET:
            return TestCase(claim.id, column)
        said = f"{claim.id}, {column}: {cell(outcome)}, allowed {claim.allowed}"
        text = "\n".join([claim.says, claim.source, outcome.why])
        return TestCase(claim.id, column, 0.0, "failure", said, outcome.verdict, text)

    for use in dict.fromkeys(row.claim.use for row in rows):
        of = [row for row in rows if row.claim.use == use]
        yield use, [test(row.claim, *each) for row in of for each in row.outcomes.items()]


def _show(rows: Sequence[Judged]) -> None:
    """Print a line for each row, by category with the headline first, and how many are met."""
    from srs_twin.reproduction.report import TITLES, by_category, percent, published, summary_line, verdict

    print(_FORMAT.format("row", "published", "analytical", "twin", "error", "verdict"))
    for name, chosen in by_category(rows).items():
        if chosen:
            print(f"\n{TITLES[name]}")
        for row in chosen:
            twin = row.outcomes.get("twin")
            first = row.outcomes.get("analytical") or row.outcomes.get("alone")
            stated, apart = published(row.claim), percent(row.claim, twin or first)
            said = verdict(row) + (" (fitted)" if name == "fit" else "")
            print(_FORMAT.format(row.claim.id, stated, _narrow(first), _narrow(twin), apart, said))
    print(f"\n{summary_line(rows)}")


def _narrow(outcome: Any) -> str:
    """Return what came out in a few characters: of an ordering its first and last value."""
    from srs_twin.reproduction.report import cell, short

    if outcome is None:
        return ""
    text = cell(outcome)
    if len(text) <= 11:
        return text
    first, last = (f"{float(short(outcome.values[k])):.2g}" for k in (0, -1))
    return f"{first}…{last}"
