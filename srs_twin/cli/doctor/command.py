"""`srs-twin doctor`: what is installed, what of it works here, and what to do about what does not."""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from srs_twin.cli.options import JsonOption, option, print_json
from srs_twin.errors import InputError

if TYPE_CHECKING:
    from srs_twin.cli.doctor.checks import Check


def doctor(
    out: Annotated[str, option("--out DIR")] = "runs",
    as_json: JsonOption = False,
) -> None:
    """Say what works on this machine, and how to mend the rest.

    Options:
        out: Where results would go, to see if they can.
    """
    from srs_twin.cli.doctor.checks import failing
    from srs_twin.cli.doctor.examination import examine

    checks = examine(Path(out))
    bad = failing(checks)
    if as_json:
        document = {"works": not bad, "checks": [asdict(check) for check in checks]}
        print_json(document)
    else:
        _show(checks)
    if bad:
        named = ", ".join(check.name for check in bad)
        raise InputError(f"not fit for runs: {named}; the remedies stand above")
    if not as_json:
        typer.echo("\neverything that a run needs works")


def _show(checks: Sequence[Check]) -> None:
    """Print a line a check under its topic, the remedy below where there is one."""
    width = shutil.get_terminal_size((100, 24)).columns if sys.stdout.isatty() else 10_000
    longest = max(len(check.name) for check in checks)
    for topic, group in groupby(checks, key=lambda check: check.topic):
        typer.echo(f"{topic}")
        for check in group:
            head = f"  {check.status:10}{check.name:{longest}}  "
            inset = " " * len(head)
            words = textwrap.TextWrapper(width, initial_indent=head, subsequent_indent=inset)
            words.break_on_hyphens = words.break_long_words = False
            typer.echo(words.fill(check.detail))
            if check.remedy:
                # Not wrapped: a command is to be copied as it stands.
                typer.echo(f"{inset}→ {check.remedy}")
