"""Rows of the reproduction as JUnit XML: a suite a use, a test case for each row and column.

`srs-twin reproduce`: every statement of the dissertation beside what both plants say.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from xml.etree.ElementTree import Element, SubElement

import typer

from srs_twin.cli import INTERRUPTED, say
from srs_twin.cli.junit import sum_up, writable, write_tree
from srs_twin.cli.progress import Counting

if TYPE_CHECKING:
    from srs_twin.reproduction import Claim, Judged, Store
    from srs_twin.reproduction.runs import Orders
    from srs_twin.sweep.task import Row


def write_rows(path: Path, rows: Sequence[Judged]) -> None:
    """Write a report: what is missed is a failure, explained or not.

    Args:
        path: the file; an earlier one is replaced.
        rows: judged.

    Raises:
        InputError: it cannot be written.
    """
    root = Element("testsuites", name="srs-twin reproduce")
    for use in dict.fromkeys(row.claim.use for row in rows):
        suite = SubElement(root, "testsuite", name=use)
        for row in (row for row in rows if row.claim.use == use):
            _cases(suite, row)
        sum_up(suite, 0.0)
    sum_up(root, 0.0)
    write_tree(path, root)


def _cases(suite: Element, row: Judged) -> None:
    from srs_twin.reproduction.report import cell
    from srs_twin.reproduction.verdicts import MET

    claim = row.claim
    for column, outcome in row.outcomes.items():
        case = SubElement(suite, "testcase", classname=claim.id, name=column, time="0.000")
        if outcome.verdict != MET:
            said = f"{claim.id}, {column}: {cell(outcome)}, allowed {claim.allowed}"
            failure = SubElement(case, "failure", message=writable(said), type=outcome.verdict)
            failure.text = writable("\n".join([claim.says, claim.source, outcome.why]))


CHANGED = 1
OUT = Path("runs/reproduce")
_FORMAT = "{:<30} {:>9} {:>11} {:>11} {:>6}  {}"


def reproduce(
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="ID", help="Row, or the rows that begin with it; may be repeated."),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="The quick rows only: laws first, short runs.")
    ] = False,
    out: Annotated[
        Path,
        typer.Option("--out", metavar="DIR", help="Folder of the results and of the runs that are kept."),
    ] = OUT,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs", "-j", metavar="N", min=1, max=4096, help="Runs at once. [default: one a processor]"
        ),
    ] = None,
    no_figures: Annotated[
        bool, typer.Option("--no-figures", help="Draw no figures, and run nothing for them.")
    ] = False,
    write_baseline: Annotated[
        bool, typer.Option("--write-baseline", help="Let what comes out be the baseline of later runs.")
    ] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="No table and no progress; errors only.")
    ] = False,
) -> None:
    """Reproduce the dissertation: run what its claims need, judge every row, compare with the baseline."""
    from srs_twin.parallel import start_server

    # First of all: it loads what workers need while this process loads what it needs itself.
    start_server("srs_twin.sweep.warm")
    from srs_twin.errors import InputError
    from srs_twin.io.files import shown
    from srs_twin.reproduction import load_claims, open_store
    from srs_twin.reproduction.claims import chosen
    from srs_twin.reproduction.runs import HTML, JSON, JUNIT, Orders

    if write_baseline and (only or quick):
        raise InputError("--write-baseline needs all rows; leave --only and --quick out")
    claims = chosen(load_claims(), tuple(only or ()), quick=quick)
    orders = Orders()
    try:
        with open_store(out) as store:
            rows = _judged(claims, store, orders, jobs, quiet=quiet)
            figures = (
                None if no_figures else _figures(store, orders, jobs, every=not (only or quick), quiet=quiet)
            )
            changes = _written(out, rows, figures, write_baseline=write_baseline)
    except KeyboardInterrupt:
        say("interrupted; what was finished is kept, start again to go on")
        raise typer.Exit(INTERRUPTED) from None
    if not quiet:
        _show(rows)
        say(f"files in {shown(out)}: {HTML}, {JSON}, {JUNIT}")
    for line in changes:
        say(f"changed from the baseline: {line}")
    if changes:
        say("explain the change, then let --write-baseline write it")
        raise typer.Exit(CHANGED)


def _judged(
    claims: Sequence[Claim], store: Store, orders: Orders, jobs: int | None, *, quiet: bool
) -> tuple[Judged, ...]:
    from srs_twin.reproduction import judge

    counts: list[Counting] = []

    def planned(count: int) -> None:
        counts.append(Counting("runs", count, quiet=quiet))

    def progress(row: Row) -> None:
        counts[-1](failed=row.exit_code != 0)
        if row.exit_code and not quiet:
            say(f"a run failed: {row.reason}")

    return judge(claims, store, orders, workers=jobs, progress=progress, planned=planned)


def _figures(store: Store, orders: Orders, jobs: int | None, *, every: bool, quiet: bool) -> list[Any]:
    """Return the figures whose runs are there; of a whole reproduction run what is theirs alone."""
    from srs_twin.reproduction.figures import PICTURES, StoredRuns, drawn, wanted

    if every:
        keys = dict.fromkeys(order.key for order in wanted(PICTURES, orders))
        due = store.missing(orders.made[key] for key in keys)
        counting = Counting("runs for figures", len(due), quiet=quiet)
        store.run(due, workers=jobs, progress=lambda row: counting(failed=row.exit_code != 0))
    return drawn(PICTURES, StoredRuns(store, orders))


def _written(
    out: Path, rows: Sequence[Judged], figures: list[Any] | None, *, write_baseline: bool
) -> list[str]:
    """Write the files; return what has changed from the baseline."""
    pass
    from srs_twin.reproduction import load_baseline
    from srs_twin.reproduction.report import write_html, write_json
    from srs_twin.reproduction.runs import HTML, JSON, JUNIT
    from srs_twin.reproduction.verdicts import write_baseline as write

    if write_baseline:
        write(rows)
    changes = load_baseline().changes(rows)
    write_rows(out / JUNIT, rows)
    write_html(out / HTML, rows, figures or [], changes)
    write_json(out / JSON, rows, changes)
    return changes


def _show(rows: Sequence[Judged]) -> None:
    """Print a line for each row, those of each use together, and how many are met."""
    from srs_twin.reproduction.report import TITLES, USES, percent, published, summary_line, verdict

    print(_FORMAT.format("row", "published", "analytical", "twin", "error", "verdict"))
    for use in USES:
        chosen = [row for row in rows if row.claim.use == use]
        if chosen:
            print(f"\n{TITLES[use]}")
        for row in chosen:
            first, twin = (
                row.outcomes.get("analytical") or row.outcomes.get("alone"),
                row.outcomes.get("twin"),
            )
            cells = [_narrow(each) for each in (first, twin)]
            said = verdict(row) + (" (fitted)" if use == "fit" else "")
            print(
                _FORMAT.format(
                    row.claim.id, published(row.claim), *cells, percent(row.claim, twin or first), said
                )
            )
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
