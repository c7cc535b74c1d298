"""`srs-twin sweep`: one scenario over many values of its fields."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from srs_twin.cli.console import RunCounter, console, interruptible, new_table, say
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
from srs_twin.errors import InputError
from srs_twin.io.files import display_path

if TYPE_CHECKING:
    from rich.table import Table

    from srs_twin.studies.sweep.execution import Engine
    from srs_twin.studies.sweep.points import Sweep
    from srs_twin.studies.sweep.report import Summary
    from srs_twin.viewing.html import Table as TextTable

SWEEPS = Path("runs/sweeps")

_MAX_REASONS = 5
"""Largest number of failure reasons that are printed."""

_MAX_PUBLISHED = 30
"""Largest number of published values that are printed; the report has all."""


def sweep(
    name: Annotated[str, argument("SWEEP", shipped=["sweep"])],
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

    An interrupted sweep resumes in the same folder.

    Options:
        name: Shipped sweep or sweep file.
        out: Output folder. [default: runs/sweeps/SWEEP]
        engine: Engine for the runs: local, ray, or warp (twins on an accelerator).
        address: Address of a Ray cluster, or Warp device, e.g. cuda:0. [default: local]
        retry_failed: Run failed points again.
        changed: Resume in a folder of another version; keep the rows that still apply.
        without: Leave out the points with this value (repeatable).
        plants: Plants: analytical, twin or both. [default: the sweep's]
    """
    runner = make_engine(engine, workers, address)
    from srs_twin.scenario.modified import marked
    from srs_twin.studies.sweep.execution import open_sweep
    from srs_twin.studies.sweep.loading import load_sweep

    loaded = load_sweep(name, set=changed_fields.changes(), plants=parse_plants(plants))
    for warning in () if quiet else loaded.warnings:
        say(f"warning: {warning}")
    folder = Path(out) if out else SWEEPS / loaded.name
    selected = select_points(loaded, without or ())
    with open_sweep(loaded, folder, changed=changed) as opened:
        missing = tuple(p for p in opened.missing(retry_failed=retry_failed) if p.key in selected)
        existing = len(selected) - len(missing)
        if existing and not quiet:
            say(f"{existing} of {len(selected)} rows exist already, {len(missing)} to do")

        def interrupted_message() -> str:
            summary = opened.finish()
            rows = summary.done + summary.failed
            return f"{rows} of {summary.points} rows are kept; start again to resume"

        with interruptible(interrupted_message):
            with RunCounter(loaded.name, len(missing), quiet=quiet) as counting:
                opened.run(runner, missing, lambda row: counting(failed=row.exit_code != 0))
            summary = opened.finish()
    if as_json:
        document = {"rows": summary.done, "failed": summary.failed, "sha256": summary.sha256}
        print_json(document | {"results": str(summary.folder / "results.parquet")})
    elif not quiet:
        _print_summary(summary, marked(loaded.name, loaded.changes) if loaded.changes else None)
    say(f"files in {summary.folder}: {', '.join(summary.files)}", quiet=quiet)
    if summary.exit_code:
        _print_failures(summary)
        raise typer.Exit(summary.exit_code)


def select_points(swept: Sweep, without: Sequence[str]) -> set[str]:
    """Return the keys of the points of a sweep that are not left out.

    Args:
        swept: sweep.
        without: values to leave out, each as `field=value`.

    Raises:
        UnknownNameError: a field is not varied, or never has this value.
    """
    from srs_twin.errors import UnknownNameError

    selected = {point.key: point.changes for point in swept.points}
    for excluded in without:
        field, _, value = excluded.partition("=")
        if field not in swept.fields:
            raise UnknownNameError("varied field", field, swept.fields)
        values = {str(point.changes[field]) for point in swept.points}
        if value not in values:
            raise UnknownNameError(f"value of {field}", value, values)
        selected = {key: changes for key, changes in selected.items() if str(changes[field]) != value}
    return set(selected)


def make_engine(name: str, workers: int | None, address: str | None) -> Engine:
    """Return an engine by name.

    Raises:
        InputError: the options do not suit the engine, or it is not available.
        UnknownNameError: the engine does not exist.
    """
    if name == "local":
        from srs_twin.compute.workers import start_server

        # Start it first: it imports the modules of the workers while this process imports its own.
        start_server("srs_twin.studies.sweep.warm")
    from srs_twin.errors import UnknownNameError
    from srs_twin.studies.sweep import execution

    if name not in execution.ENGINES:
        raise UnknownNameError("engine", name, execution.ENGINES)
    if name == "ray":
        return execution.on_ray(address, workers)
    if name == "warp":
        return execution.on_device(address, workers)
    if address is not None:
        raise InputError("--address is only for the engines ray and warp; remove it")
    return execution.local(workers)


def _print_summary(summary: Summary, title: str | None) -> None:
    """Print the ranges of the results, published values, and the paths of the files."""
    table = new_table("metric", "least", "median", "most", title=title)
    for name, values in summary.ranges.items():
        table.add_row(name, *(f"{value:.4g}" for value in values))
    terminal = console()
    if summary.ranges:
        terminal.print(table)
    if summary.published is not None and len(summary.published.rows) <= _MAX_PUBLISHED:
        terminal.print(_published_table(summary.published))
    print(f"{summary.done} of {summary.points} runs done, {summary.failed} failed")
    print(f"results sha256 {summary.sha256}")
    print(f"report {display_path(summary.folder / 'report.html')}")


def _published_table(published: TextTable) -> Table:
    """Return the table of published values, grouped by metric."""
    table = new_table(*published.headings[1:], title=f"compared with {published.title}")
    # Field names may wrap; numbers must not.
    for column in table.columns[: published.headings.index("published") - 1]:
        column.no_wrap = False
    metric = None
    for name, *cells in published.rows:
        if name != metric:
            table.add_row(name)
        metric = name
        table.add_row(*(f"{'' if i else '  '}{cell}" for i, cell in enumerate(cells)))
    return table


def _print_failures(summary: Summary) -> None:
    """Print the reasons of failed runs, the most frequent first."""
    for reason, count in list(summary.reasons.items())[:_MAX_REASONS]:
        say(f"{count} failed: {reason}")
    if len(summary.reasons) > _MAX_REASONS:
        say(f"and for {len(summary.reasons) - _MAX_REASONS} other reasons: see results.parquet")
