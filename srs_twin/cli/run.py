"""`srs-twin run`: one scenario or many, on the plants that each names."""

from __future__ import annotations

from typing import Annotated

import typer

from srs_twin.cli.batch import CheckOption, OutOption, QuietOption, run_all


def run(
    scenarios: Annotated[
        list[str],
        typer.Argument(metavar="SCENARIO...", help="Shipped scenarios, files, folders of files."),
    ],
    out: OutOption = None,
    check: CheckOption = False,
    quiet: QuietOption = False,
) -> None:
    """Run scenarios on the plants they name."""
    run_all(scenarios, out=out, check=check, quiet=quiet)
