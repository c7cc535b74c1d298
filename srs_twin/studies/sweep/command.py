"""`srs-twin sweep`: one scenario over many values of its fields."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from srs_twin.cli.console import console, interruptible, new_table, say
from srs_twin.cli.options import (
    NO_CHANGES,
    ChangeOptions,
    JsonOption,
    QuietOption,
    argument,
    jobs_option,
    option,
    parse_plants,
    print_json,
)
from srs_twin.cli.progress import RunCounter
from srs_twin.errors import InputError
from srs_twin.io.files import display_path

if TYPE_CHECKING:
    from rich.table import Table

    from srs_twin.studies.sweep.execution import Engine
    from srs_twin.studies.sweep.points import Sweep
    from srs_twin.studies.sweep.report import Summary
    from srs_twin.viewing.html.page import Table as TextTable

SWEEPS = Path("runs/sweeps")
_SHOWN_REASONS = 5
_MOST_PUBLISHED = 30  # rows of published values; more are for the report


def sweep(
    given: Annotated[str, argument("SWEEP", shipped=["sweep"])],
    out: Annotated[str | None, option("--out DIR")] = None,
    engine: Annotated[str, option("--engine NAME")] = "local",
    workers: Annotated[int | None, jobs_option("--workers N")] = None,
    address: Annotated[str | None, option("--address HOST:PORT")] = None,
    retry_failed: Annotated[bool, option("--retry-failed")] = False,
    changed: Annotated[bool, option("--changed")] = False,
    without: Annotated[list[str] | None, option("--without FIELD=VALUE")] = None,
    plants: Annotated[str | None, option("--plants LIST")] = None,
    changed_fields: ChangeOptions = NO_CHANGES,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run a scenario over grids, lists or samples of its fields.

    What an earlier start left in the folder is kept, and it goes on from there.

    Options:
        given: A shipped sweep or a file.
        out: Folder of results. [default: runs/sweeps/SWEEP]
        engine: Who runs the points: local, ray, or warp (twins on an accelerator).
        address: Of a Ray cluster, or the device of warp, as cuda:0. [default: this machine's]
        retry_failed: Run again what failed.
        changed: Go on in a folder of an earlier version; keep what still belongs.
        without: Leave out the points with this value; may be repeated.
        plants: analytical, twin or both. [default: the sweep's]
    """
    chosen = chosen_engine(engine, workers, address)
    from srs_twin.scenario.modified import marked
    from srs_twin.studies.sweep.execution import open_sweep
    from srs_twin.studies.sweep.loading import load_sweep

    found = load_sweep(given, set=changed_fields.changes(), plants=parse_plants(plants))
    for warning in () if quiet else found.warnings:
        say(f"warning: {warning}")
    folder = Path(out) if out else SWEEPS / found.name
    wanted = wanted_points(found, without or ())
    with open_sweep(found, folder, changed=changed) as opened:
        missing = tuple(p for p in opened.missing(retry_failed=retry_failed) if p.key in wanted)
        there = len(wanted) - len(missing)
        if there and not quiet:
            say(f"{there} of {len(wanted)} rows are there already, {len(missing)} to do")

        def kept() -> str:
            summary = opened.finish()
            rows = summary.done + summary.failed
            return f"{rows} of {summary.points} rows are kept, start again to go on"

        with interruptible(kept):
            with RunCounter(found.name, len(missing), quiet=quiet) as counting:
                opened.run(chosen, missing, lambda row: counting(failed=row.exit_code != 0))
            summary = opened.finish()
    if as_json:
        done = {"rows": summary.done, "failed": summary.failed, "sha256": summary.sha256}
        print_json(done | {"results": str(summary.folder / "results.parquet")})
    elif not quiet:
        _show(summary, marked(found.name, found.changes) if found.changes else None)
    say(f"files in {summary.folder}: {', '.join(summary.files)}", quiet=quiet)
    if summary.exit_code:
        _complain(summary)
        raise typer.Exit(summary.exit_code)


def wanted_points(found: Sweep, without: Sequence[str]) -> set[str]:
    """Return the keys of the points of a sweep that are not left out.

    Args:
        found: the sweep.
        without: `field=value` each.

    Raises:
        InputError: a field is not varied, or never has this value.
    """
    from srs_twin.errors import UnknownNameError

    wanted = {point.key: point.changes for point in found.points}
    for each in without:
        field, _, value = each.partition("=")
        if field not in found.fields:
            raise UnknownNameError("varied field", field, found.fields)
        values = {str(point.changes[field]) for point in found.points}
        if value not in values:
            raise UnknownNameError(f"value of {field}", value, values)
        wanted = {key: changes for key, changes in wanted.items() if str(changes[field]) != value}
    return set(wanted)


def chosen_engine(name: str, workers: int | None, address: str | None) -> Engine:
    """Return the engine of a name.

    Raises:
        InputError: it cannot be had so.
        UnknownNameError: there is no such engine.
    """
    if name == "local":
        from srs_twin.compute.workers import start_server

        # First of all: it loads what workers need while this process loads what it needs itself.
        start_server("srs_twin.studies.sweep.warm")
    from srs_twin.errors import UnknownNameError
    from srs_twin.studies.sweep import execution

    if name not in execution.ENGINES:
        raise UnknownNameError("engine", name, execution.ENGINES)
    if name == "ray":
        return execution.on_ray(address, workers)
    if name == "warp":
        from srs_twin.studies.sweep.on_device import on_device

        return on_device(address, workers)
    if address is not None:
        raise InputError("--address belongs to the engines ray and warp")
    return execution.local(workers)


def _show(summary: Summary, title: str | None) -> None:
    """Print what the results span, and where they are."""
    lines = new_table("metric", "least", "median", "most", title=title)
    for name, (least, median, most) in summary.spans.items():
        lines.add_row(name, *(f"{value:.4g}" for value in (least, median, most)))
    terminal = console()
    if summary.spans:
        terminal.print(lines)
    if summary.published is not None and len(summary.published.rows) <= _MOST_PUBLISHED:
        terminal.print(_published(summary.published))
    print(f"{summary.done} of {summary.points} runs done, {summary.failed} failed")
    print(f"results sha256 {summary.sha256}")
    print(f"report {display_path(summary.folder / 'report.html')}")


def _published(found: TextTable) -> Table:
    """Return the table of published values: under the name of each metric a line a place."""
    lines = new_table(*found.headings[1:], title=f"beside {found.title}")
    # Names of fields may be broken, numbers not.
    for column in lines.columns[: found.headings.index("published") - 1]:
        column.no_wrap = False
    metric = None
    for name, *cells in found.rows:
        if name != metric:
            lines.add_row(name)
        metric = name
        lines.add_row(*(f"{'' if i else '  '}{cell}" for i, cell in enumerate(cells)))
    return lines


def _complain(summary: Summary) -> None:
    """Say why runs failed, the most frequent reasons first."""
    for reason, count in list(summary.reasons.items())[:_SHOWN_REASONS]:
        say(f"{count} failed: {reason}")
    if len(summary.reasons) > _SHOWN_REASONS:
        say(f"and for {len(summary.reasons) - _SHOWN_REASONS} other reasons: see results.parquet")
