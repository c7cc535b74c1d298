"""`srs-twin sweep`: one scenario over many values of its fields."""

from __future__ import annotations

from dataclasses import dataclass
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
    parse_plants,
    print_json,
)
from srs_twin.io.files import display_path

if TYPE_CHECKING:
    from rich.table import Table

    from srs_twin.studies.sweep.execution import Engine
    from srs_twin.studies.sweep.report import Summary
    from srs_twin.studies.sweep.task import Row
    from srs_twin.viewing.html import Table as TextTable

SWEEPS = Path("runs/sweeps")

_MAX_REASONS = 5
"""Largest number of failure reasons that are printed."""

_MAX_PUBLISHED = 30
"""Largest number of published values that are printed; the report has all."""


@dataclass(frozen=True)
class StudyOptions:
    """Options of commands that run many points.

    Options:
        --engine NAME: Engine for the runs: local, ray, or warp (twins on an
            accelerator).
        --address HOST:PORT: Address of a Ray cluster, or Warp device, e.g. cuda:0.
        [default: local]
        --changed: Resume in a folder of another version; keep the rows that still
            apply.
    """

    engine: str = "local"
    workers: Annotated[int | None, jobs_option("--workers N")] = None
    address: str | None = None
    changed: bool = False

    def make_engine(self) -> Engine:
        """Return the engine; raises as `studies.sweep.execution.make_engine`."""
        if self.engine == "local":
            from srs_twin.compute.workers import start_server

            # Start it first: it imports the modules of the workers while this process
            # imports its own.
            start_server("srs_twin.studies.sweep.warm")
        from srs_twin.studies.sweep.execution import make_engine

        return make_engine(self.engine, self.workers, self.address)


DEFAULT_STUDY = StudyOptions()


def sweep(
    name: Annotated[str, argument("SWEEP", shipped=["sweep"])],
    out: str | None = None,
    study: StudyOptions = DEFAULT_STUDY,
    retry_failed: bool = False,
    without: list[str] | None = None,
    plants: str | None = None,
    changed_fields: ChangeOptions = NO_CHANGES,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run a scenario over grids, lists or samples of its fields.

    An interrupted sweep resumes in the same folder.

    Options:
        name: Shipped sweep or sweep file.
        --out DIR: Output folder. [default: runs/sweeps/SWEEP]
        --retry-failed: Run failed points again.
        --without FIELD=VALUE: Leave out the points with this value (repeatable).
        --plants LIST: Plants: analytical, twin or analytical,twin. [default: the
            sweep's]
    """
    runner = study.make_engine()
    from srs_twin.scenario.modified import marked
    from srs_twin.studies.sweep.execution import select_points, sweep as run_sweep
    from srs_twin.studies.sweep.loading import load_sweep

    loaded = load_sweep(name, set=changed_fields.changes(), plants=parse_plants(plants))
    for warning in () if quiet else loaded.warnings:
        say(f"warning: {warning}")
    wanted = len(select_points(loaded, without or ()))
    with interruptible(), RunCounter(loaded.name, 0, quiet=quiet) as counting:

        def follow(part: str, total: int, row: Row | None) -> None:
            if row is None and total < wanted:
                say(
                    f"{wanted - total} of {wanted} rows exist already, {total} to do",
                    quiet=quiet,
                )
            counting.follow(part, total, row)

        summary = run_sweep(
            loaded,
            out=out or SWEEPS / loaded.name,
            without=without or (),
            engine=runner,
            retry_failed=retry_failed,
            changed=study.changed,
            progress=follow,
        )
    if as_json:
        document = {
            "rows": summary.done,
            "failed": summary.failed,
            "sha256": summary.sha256,
        }
        print_json(document | {"results": str(summary.folder / "results.parquet")})
    elif not quiet:
        _print_summary(
            summary, marked(loaded.name, loaded.changes) if loaded.changes else None
        )
    say(f"files in {summary.folder}: {', '.join(summary.files)}", quiet=quiet)
    if summary.exit_code:
        _print_failures(summary)
        raise typer.Exit(summary.exit_code)


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
        say(
            f"and for {len(summary.reasons) - _MAX_REASONS} other reasons: see"
            " results.parquet"
        )
