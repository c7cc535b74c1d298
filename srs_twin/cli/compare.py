"""`srs-twin compare`: both plants under the same valves, and how far apart they are."""

from __future__ import annotations

from typing import Annotated

import typer

from srs_twin.cli.batch import CheckOption, OneOutOption, QuietOption, StrictOption, failing, run_all


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
    both = ("analytical", "twin")
    run_all(
        [scenario],
        out=out,
        fails=failing(check=check, strict=strict),
        quiet=quiet,
        plants=both,
        explain=explain,
    )
