"""`srs-twin run` and `compare`: execution of scenarios, and comparison of the two plants."""

from __future__ import annotations

from typing import Annotated

from srs_twin.cli.batch import failing_verdicts, make_cases, run_all
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
    parse_plants,
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
        explain: Attribute the difference to modelling assumptions.
    """
    run_all(
        make_cases([scenario]),
        out=out,
        fails=failing_verdicts(check=check, strict=strict),
        quiet=quiet,
        plants=("analytical", "twin"),
        explain=explain,
        changes=changed.changes(),
        as_json=as_json,
    )


def run(
    scenarios: Annotated[list[str], argument("SCENARIO", shipped=["scenario"])],
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
    """Run scenarios on the plants that they select.

    Options:
        scenarios: Shipped scenarios, scenario files, or folders of files.
        out: Output folder; several scenarios get one subfolder each. [default: runs/SCENARIO]
        junit: Write a JUnit XML report of runs and expectations.
        plants: Plants to run: analytical, twin, or both separated by a comma. [default: those of the
            scenario]
    """
    run_all(
        make_cases(scenarios),
        out=out,
        fails=failing_verdicts(check=check, strict=strict),
        quiet=quiet,
        jobs=jobs,
        junit=junit,
        plants=parse_plants(plants),
        changes=changed.changes(),
        as_json=as_json,
    )
