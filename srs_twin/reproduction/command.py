"""Command `srs-twin reproduce`, which checks the claims of the dissertation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from srs_twin.cli.console import RunCounter, interruptible, say
from srs_twin.cli.options import JsonOption, QuietOption, WorkersOption
from srs_twin.io.files import display_path

if TYPE_CHECKING:
    from srs_twin.studies.sweep.task import Row


CHANGED = 1
"""Exit code if a verdict differs from the baseline."""

OUT = Path("runs/reproduce")


def reproduce(
    only: list[str] | None = None,
    quick: bool = False,
    out: Path = OUT,
    jobs: WorkersOption = None,
    no_figures: bool = False,
    write_baseline: bool = False,
    scorecard: bool = False,
    others: bool = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Check the claims of the dissertation with both models.

    The command runs the simulations that the claims need, judges every claim, and
    compares the verdicts with the stored baseline.

    Options:
        --only ID: Judge only the claim with this name, or the claims whose names begin
            with ID and a dot, for example gen3-yaw. Can be repeated.
        --quick: Judge only the claims that need short simulations.
        --out DIR: Output folder, in which finished runs are kept and reused.
        --no-figures: Omit the figures, and skip simulations that are needed only for
            figures.
        --write-baseline: Store the verdicts as the new baseline.
        --scorecard: Print the credibility grades according to NASA-STD-7009, without
            running simulations.
        --others: Print the predicted and the published motion of robots from other
            laboratories, without running simulations.
    """
    if others or scorecard:
        from srs_twin.reproduction.printing import print_others, print_scorecard

        (print_others if others else print_scorecard)(as_json=as_json)
        return
    from srs_twin.compute.workers import start_server

    # The server imports the worker modules while this process imports the modules
    # below.
    start_server("srs_twin.studies.sweep.warm")
    from srs_twin.reproduction.printing import print_rows
    from srs_twin.reproduction.reproduce import reproduce as judge_claims
    from srs_twin.reproduction.runs import HTML, JSON, JUNIT

    with (
        interruptible("finished runs are kept; start the command again to resume"),
        RunCounter("runs", 0, quiet=quiet) as counting,
    ):

        def follow(part: str, total: int, row: Row | None) -> None:
            counting.follow(part, total, row)
            if row is not None and row.exit_code:
                say(f"a run failed: {row.reason}", quiet=quiet)

        result = judge_claims(
            only or (),
            quick=quick,
            out=out,
            workers=jobs,
            figures=not no_figures,
            write_baseline=write_baseline,
            progress=follow,
        )
    if as_json:
        print((out / JSON).read_text("utf-8"), end="")
    elif not quiet:
        print_rows(result.rows)
    say(f"files in {display_path(out)}: {HTML}, {JSON}, {JUNIT}", quiet=quiet)
    for line in result.changes:
        say(f"changed from the baseline: {line}")
    if result.changes:
        say(
            "if the changes are intended, explain them, and store the new"
            " baseline with --write-baseline"
        )
        raise typer.Exit(CHANGED)
