"""Command `srs-twin doctor`, which checks the installation and the machine."""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from srs_twin.cli.console import as_started
from srs_twin.cli.options import JsonOption, print_json
from srs_twin.errors import InputError

if TYPE_CHECKING:
    from srs_twin.cli.doctor.checks import Check


def doctor(
    out: str = "runs",
    as_json: JsonOption = False,
) -> None:
    """Check the installation and the output folder.

    Options:
        --out DIR: Output folder that is checked for write access.
    """
    from srs_twin.cli.doctor.checks import failed_checks

    checks = run_checks(Path(out))
    failed = failed_checks(checks)
    if as_json:
        print_json({"works": not failed, "checks": [asdict(check) for check in checks]})
    else:
        _show(checks)
    if failed:
        names = ", ".join(check.name for check in failed)
        raise InputError(f"runs would fail due to {names}; see the remedies above")
    if not as_json:
        typer.echo("\nall requirements for runs are met")


def run_checks(folder: Path) -> list[Check]:
    """Run all checks and return the results, sorted by topic.

    Raises:
        InputError: temporary files cannot be written.
    """
    from srs_twin.cli.doctor.checks import (
        TOPICS,
        checks_of_installation,
        output_check,
    )
    from srs_twin.cli.doctor.probes import probed_checks

    found = [
        *checks_of_installation(),
        *probed_checks(),
        output_check(folder),
    ]
    return sorted(found, key=lambda check: TOPICS.index(check.topic))


def _show(checks: Sequence[Check]) -> None:
    if sys.stdout.isatty():
        width = shutil.get_terminal_size((100, 24)).columns
    else:
        width = 10_000
    name_width = max(len(check.name) for check in checks)
    for topic, group in groupby(checks, key=lambda check: check.topic):
        typer.echo(topic)
        for check in group:
            head = f"  {check.status:10}{check.name:{name_width}}  "
            indent = " " * len(head)
            wrapper = textwrap.TextWrapper(
                width, initial_indent=head, subsequent_indent=indent
            )
            wrapper.break_on_hyphens = wrapper.break_long_words = False
            typer.echo(wrapper.fill(as_started(check.detail)))
            if check.remedy:
                # Remedies are not wrapped, because they contain commands to copy.
                typer.echo(as_started(f"{indent}→ {check.remedy}"))
