"""`srs-twin run`: scenarios on the plants that each names; `compare`: on both, and how far apart they are."""

from __future__ import annotations

from typing import Annotated

import typer

from srs_twin.cli.batch import (
    CheckOption,
    OneOutOption,
    OutOption,
    QuietOption,
    StrictOption,
    cases_of,
    failing,
    run_all,
)


def compare(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="A shipped scenario or a file.")],
    out: OneOutOption = None,
    check: CheckOption = False,
    strict: StrictOption = False,
    quiet: QuietOption = False,
    explain: Annotated[
        bool, typer.Option("--explain", help="Say why the plants differ: the share of each assumption.")
    ] = False,
) -> None:
    """Run a scenario on both plants and measure the difference."""
    cases, fails, both = cases_of([scenario]), failing(check=check, strict=strict), ("analytical", "twin")
    run_all(cases, out=out, fails=fails, quiet=quiet, plants=both, explain=explain)


def run(
    scenarios: Annotated[
        list[str],
        typer.Argument(metavar="SCENARIO", help="Shipped scenarios, files, folders of files."),
    ],
    out: OutOption = None,
    check: CheckOption = False,
    strict: StrictOption = False,
    junit: Annotated[
        str | None,
        typer.Option(
            "--junit", metavar="FILE.xml", help="Write a JUnit report: expectations, divergences, bad input."
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs",
            "-j",
            metavar="N",
            min=1,
            max=4096,
            help="Scenarios at once; 1: one after the other. [default: one a processor]",
        ),
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Run scenarios on the plants they name."""
    cases, fails = cases_of(scenarios), failing(check=check, strict=strict)
    run_all(cases, out=out, fails=fails, quiet=quiet, jobs=jobs, junit=junit)
