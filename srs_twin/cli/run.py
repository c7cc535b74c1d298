"""`srs-twin run`: scenarios on the plants that each names; `compare`: on both, and how far apart they are."""

from __future__ import annotations

from typing import Annotated

from srs_twin.cli.batch import cases_of, failing, run_all
from srs_twin.cli.options import (
    NO_CHANGES,
    ChangeOptions,
    CheckOption,
    JobsOption,
    JsonOption,
    OneOutOption,
    QuietOption,
    ScenarioArgument,
    StrictOption,
    argument,
    option,
    plants_of,
)


def compare(
    scenario: ScenarioArgument,
    out: OneOutOption = None,
    check: CheckOption = False,
    strict: StrictOption = False,
    quiet: QuietOption = False,
    explain: Annotated[bool, option("--explain")] = False,
    changed: ChangeOptions = NO_CHANGES,
    as_json: JsonOption = False,
) -> None:
    """Run a scenario on both plants and measure the difference.

    Options:
        explain: Say why they differ: each assumption's share.
    """
    cases, fails, both = cases_of([scenario]), failing(check=check, strict=strict), ("analytical", "twin")
    run_all(
        cases,
        out=out,
        fails=fails,
        quiet=quiet,
        plants=both,
        explain=explain,
        changes=changed.changes(),
        as_json=as_json,
    )


def run(
    scenarios: Annotated[list[str], argument("SCENARIO", of=["scenario"])],
    out: Annotated[str | None, option("--out DIR")] = None,
    check: CheckOption = False,
    strict: StrictOption = False,
    junit: Annotated[str | None, option("--junit FILE.xml")] = None,
    jobs: JobsOption = None,
    plants: Annotated[str | None, option("--plants LIST")] = None,
    changed: ChangeOptions = NO_CHANGES,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run scenarios on the plants they name.

    Options:
        scenarios: Shipped scenarios, files, folders of files.
        out: Folder for the files; of several scenarios, one each in it. [default: runs/SCENARIO]
        junit: Write a JUnit report: expectations, divergences, bad input.
        plants: analytical, twin or both. [default: those of the scenario]
    """
    cases, fails = cases_of(scenarios), failing(check=check, strict=strict)
    run_all(
        cases,
        out=out,
        fails=fails,
        quiet=quiet,
        jobs=jobs,
        junit=junit,
        plants=plants_of(plants),
        changes=changed.changes(),
        as_json=as_json,
    )
