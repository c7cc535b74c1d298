"""Command `srs-twin sweep`, which runs a scenario with many values of its fields."""

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
    parse_plants,
    print_json,
    workers_option,
)
from srs_twin.io.files import display_path

if TYPE_CHECKING:
    from srs_twin.studies.sweep.execution import Engine
    from srs_twin.studies.sweep.points import Sweep
    from srs_twin.studies.sweep.report import Summary
    from srs_twin.studies.sweep.task import Row

SWEEPS = Path("runs/sweeps")

_MAX_REASONS = 5


@dataclass(frozen=True)
class StudyOptions:
    """Options shared by all commands that perform many runs.

    Options:
        --engine NAME: Engine that executes the runs: local (processes on this machine),
            ray (Ray cluster) or warp (twins on a GPU).
        --address HOST:PORT: Address of the Ray cluster (--engine ray), or name of the
            Warp device (--engine warp), for example cuda:0.
        --changed: Resume in a folder with results of a different version of the file,
            and keep the rows that are still valid.
    """

    engine: str = "local"
    workers: Annotated[int | None, workers_option("--workers N")] = None
    address: str | None = None
    changed: bool = False

    def make_engine(self) -> Engine:
        """Return the selected engine (see `execution.make_engine`)."""
        if self.engine == "local":
            from srs_twin.compute.workers import start_server

            # The fork server is started early, so that it imports the worker modules
            # while this process imports other modules.
            start_server("srs_twin.studies.sweep.warm")
        from srs_twin.studies.sweep.execution import make_engine

        return make_engine(self.engine, self.workers, self.address)


DEFAULT_STUDY = StudyOptions()


def sweep(
    name: Annotated[str, argument("SWEEP", shipped=["sweep"])],
    out: str | None = None,
    study: StudyOptions = DEFAULT_STUDY,
    retry_failed: bool = False,
    exclude: list[str] | None = None,
    plants: str | None = None,
    changed_fields: ChangeOptions = NO_CHANGES,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run a scenario with grids, lists or samples of field values.

    To resume an interrupted sweep, run the command again with the same output folder.

    Options:
        name: Name of a shipped sweep, or path of a sweep file.
        --out DIR: Output folder. [default: runs/sweeps/SWEEP]
        --retry-failed: Repeat the points that failed in an earlier run.
        --exclude FIELD=VALUE: Skip all points in which FIELD has the value VALUE. Can
            be repeated.
        --plants LIST: Models to simulate: analytical, twin, or both as analytical,twin.
            [default: the models named in the sweep]
    """
    runner = study.make_engine()
    from srs_twin.studies.sweep.execution import select_points, sweep as run_sweep
    from srs_twin.studies.sweep.loading import load_sweep

    loaded = load_sweep(name, set=changed_fields.changes(), plants=parse_plants(plants))
    say(*(f"warning: {warning}" for warning in loaded.warnings), quiet=quiet)
    folder = Path(out or SWEEPS / loaded.name)
    left_out = exclude or ()
    wanted = len(select_points(loaded, left_out))
    with interruptible(), RunCounter(loaded.name, 0, quiet=quiet) as counting:

        def follow(part: str, total: int, row: Row | None) -> None:
            if row is None and total < wanted:
                text = f"{wanted - total} of {wanted} rows exist already, {total} to do"
                say(text, quiet=quiet)
            counting.follow(part, total, row)

        summary = run_sweep(
            loaded,
            out=folder,
            exclude=left_out,
            engine=runner,
            retry_failed=retry_failed,
            changed=study.changed,
            progress=follow,
        )
    if as_json:
        print_json(
            {
                "rows": summary.done,
                "failed": summary.failed,
                "sha256": summary.sha256,
                "results": str(summary.folder / "results.parquet"),
            }
        )
    elif not quiet:
        _print_summary(summary, loaded)
    say(f"files in {summary.folder}: {', '.join(summary.files)}", quiet=quiet)
    if summary.exit_code:
        _print_failures(summary)
        raise typer.Exit(summary.exit_code)


def _print_summary(summary: Summary, loaded: Sweep) -> None:
    from srs_twin.scenario.modified import marked

    if summary.ranges:
        title = marked(loaded.name, loaded.changes) if loaded.changes else None
        table = new_table("metric", "least", "median", "most", title=title)
        for name, values in summary.ranges.items():
            table.add_row(name, *(f"{value:.4g}" for value in values))
        console().print(table)
    print(f"{summary.done} of {summary.points} runs done, {summary.failed} failed")
    print(f"results sha256 {summary.sha256}")
    print(f"report {display_path(summary.folder / 'report.html')}")


def _print_failures(summary: Summary) -> None:
    for reason, count in list(summary.reasons.items())[:_MAX_REASONS]:
        say(f"{count} failed: {reason}")
    others = len(summary.reasons) - _MAX_REASONS
    if others > 0:
        say(f"and for {others} other reasons: see results.parquet")
