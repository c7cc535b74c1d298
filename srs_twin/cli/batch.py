"""Runs scenarios one after the other: what `run` and `compare` share."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from srs_twin.cli import INTERRUPTED
from srs_twin.cli.progress import Progress
from srs_twin.errors import InputError

if TYPE_CHECKING:
    from srs_twin.running import Explain, PreparedRun, RunResult

EXPECTATION_FAILED = 1
RUNS = Path("runs")

OutOption = Annotated[
    str | None,
    typer.Option(
        "--out",
        metavar="DIR",
        help="Folder for the files; of several scenarios, one each in it. [default: runs/SCENARIO]",
    ),
]
CheckOption = Annotated[bool, typer.Option("--check", help="Exit with 1 when an expectation fails.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="No table and no progress; errors only.")]


def run_all(
    given: Sequence[str],
    *,
    out: str | None,
    check: bool,
    quiet: bool,
    plants: Sequence[str] | None = None,
    explain: bool = False,
) -> None:
    """Find what is bad in any scenario, then run the good ones; exit with the highest code.

    Args:
        given: shipped names, files, folders of files.
        out: where the files go; the folder itself for one scenario, a folder in it for each of several.
        check: let failed expectations decide the exit code.
        quiet: print errors only.
        plants: which plants; None takes those that each scenario names.
        explain: also say why the plants differ.

    Raises:
        typer.Exit: with the exit code, where it is not 0.
    """
    jobs, code = _prepare_all(_expand(given), out, plants)
    finished: list[str] = []
    try:
        for job in jobs:
            code = max(code, _run(job, check=check, quiet=quiet, explain=explain))
            finished += [str(job.folder)] if job.complete else []
    except KeyboardInterrupt:
        kept = ", ".join(finished) or "nothing"
        _say(f"interrupted; finished before: {kept}")
        code = INTERRUPTED
    if code:
        raise typer.Exit(code)


def _expand(given: Sequence[str]) -> list[str]:
    """Put the files of a folder in its place, sorted by name; a shipped scenario goes before a folder."""
    from srs_twin.files import shipped_names

    found: list[str] = []
    for each in given:
        files = [] if each in shipped_names("scenario") else sorted(map(str, Path(each).glob("*.yaml")))
        found += files or [each]
    return list(dict.fromkeys(found))


def _prepare_all(
    sources: Sequence[str], out: str | None, plants: Sequence[str] | None
) -> tuple[list[PreparedRun], int]:
    """Load and build every scenario; say what is wrong with the bad ones and return the rest."""
    from srs_twin.running import prepare
    from srs_twin.scenario import load_scenario

    jobs: dict[Path, PreparedRun] = {}
    code = 0
    for source in sources:
        try:
            scenario = load_scenario(source)
            base = Path(out) if out else RUNS
            folder = base if out and len(sources) == 1 else base / scenario.name
            if folder in jobs:
                raise InputError(f"{source}: another '{scenario.name}' is given, and both write to {folder}")
            jobs[folder] = prepare(scenario, folder, plants=plants)
        except InputError as error:
            _say(str(error))
            code = max(code, error.exit_code)
    return list(jobs.values()), code


def _run(job: PreparedRun, *, check: bool, quiet: bool, explain: bool) -> int:
    """Run one scenario and show what it gave; return its exit code."""
    for warning in () if quiet else job.scenario.warnings:
        _say(f"warning: {warning}")
    try:
        with Progress(job.scenario.name, quiet=quiet) as progress:
            result = job.execute(progress, explain=_explainer()) if explain else job.execute(progress)
    except InputError as error:
        _say(str(error))
        return error.exit_code
    return _report(result, check=check, quiet=quiet)


def _explainer() -> Explain:
    from srs_twin.attribution import explain

    return explain


def _report(result: RunResult, *, check: bool, quiet: bool) -> int:
    """Show what a run gave; return its exit code."""
    if result.diverged:
        for error in result.diverged:
            _say(str(error))
        return max(error.exit_code for error in result.diverged)
    from srs_twin.cli.table import missed_lines, show

    failed = check and not all(outcome.met for outcome in result.outcomes)
    if not quiet:
        show(result)
        _say(f"files in {result.folder}; `srs-twin view {result.folder}` shows the run")
    elif failed:
        for line in missed_lines(result.metrics):
            _say(line)
    for error in result.unexplained:
        _say(str(error))
    codes = [error.exit_code for error in result.unexplained]
    return max([*codes, EXPECTATION_FAILED if failed else 0])


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
