"""Command `srs-twin plan`, which plans the path of a scenario."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from srs_twin.cli.cases import EXPECTATION_FAILED
from srs_twin.cli.console import say
from srs_twin.cli.options import (
    NO_CHANGES,
    ChangeOptions,
    JsonOption,
    OneOutOption,
    QuietOption,
    ScenarioArgument,
)
from srs_twin.cli.run import RUNS_FOLDER
from srs_twin.io.files import display_path

if TYPE_CHECKING:
    from srs_twin.planning.planned import PathQuality, ScenarioPlan
    from srs_twin.scenario.expectation import ExpectationRow
    from srs_twin.scenario.scenario import Scenario


def plan(
    scenario: ScenarioArgument,
    out: OneOutOption = None,
    check: bool = False,
    changed: ChangeOptions = NO_CHANGES,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Plan the path of a scenario without simulating it.

    Options:
        --check: Exit with code 1 if an expectation of the scenario is not met. Also
            exit with code 1 if no plan is found, unless the scenario states an
            expectation for `plan_found`.
    """
    from srs_twin.cli.table import STATE_LABELS
    from srs_twin.planning.planned import PLAN, plan_scenario
    from srs_twin.scenario.expectation import result_text, verdict
    from srs_twin.scenario.loading import load_scenario
    from srs_twin.scenario.modified import left_out_line

    loaded = load_scenario(scenario, set=changed.changes())
    # The other warnings concern the simulation.
    warnings = [text for text in loaded.warnings if text.startswith("planner.")]
    say(*(f"warning: {text}" for text in warnings), quiet=quiet)
    folder = Path(out) if out else RUNS_FOLDER / loaded.name
    planned = plan_scenario(loaded, out=folder)
    result = planned.plan
    metrics = planned.metrics
    checked = _check_expectations(loaded, metrics)
    if as_json:
        print((folder / PLAN).read_text("utf-8"), end="")
    elif not quiet:
        _print_plan(planned)
    say(f"files in {display_path(folder)}: {', '.join(planned.files)}", quiet=quiet)
    # With --json, standard output must contain only the JSON document.
    write = say if as_json else print
    missed = [row for row in checked if verdict(row) == "missed"]
    for row in checked if not quiet else missed if check else ():
        write(f"{STATE_LABELS[verdict(row)]:6} {row['metric']} {result_text(row)}")
    left_out = [row for row in loaded.left_out if row["metric"] in metrics]
    for line in left_out_line(left_out) if not quiet else ():
        write(line)
    judged = any(row["metric"] == "plan_found" for row in checked)
    if check and (missed or not (result.found or judged)):
        raise typer.Exit(EXPECTATION_FAILED)


def _check_expectations(
    scenario: Scenario, metrics: Mapping[str, object]
) -> list[ExpectationRow]:
    expected = {
        (item.metric, item.allowed): item
        for item in scenario.expect
        if item.metric in metrics
    }
    return [
        item.check({"plants": {item.subject: metrics}}) for item in expected.values()
    ]


def _print_plan(planned: ScenarioPlan) -> None:
    result = planned.plan
    quality = planned.quality
    print(f"{planned.scenario.label}: {result.outcome.value}: {result.reason}")
    if quality is not None:
        print(
            f"length {result.length:.3f} m, {result.duration:.1f} s at the footprint's"
            f" speeds, {_counted(len(result.segments), 'segment')}, maximum"
            f" heading jump {result.max_heading_jump:.3g} rad"
        )
        if result.touches is None:
            edges = "the footprint and margin"
        else:
            edges = "the edges that must stay free"
        is_given = planned.scenario.planner.file.kind == "given"
        print(_quality_words(quality, edges, is_given))
        for touch in result.touches or ():
            print(
                f"leans on {touch.obstacle} from {touch.begin:.2f} to {touch.end:.2f}"
                f" m: footprint and margin overlap by {1000 * touch.depth:.0f} mm,"
                f" estimated mean force {touch.force:.2g} N"
            )
    print(f"{_counted(result.expanded, 'node')}, {1000 * result.seconds:.1f} ms")


def _counted(count: int, noun: str) -> str:
    if count == 1:
        return f"{count} {noun}"
    return f"{count} {noun}s"


def _quality_words(quality: PathQuality, edges: str, is_given: bool) -> str:
    from srs_twin.planning.collision import CLEARANCE_ERROR_M, MAX_CLEARANCE_M

    ratio = quality.length_over_least
    clearance = quality.clearance_m
    if ratio is not None:
        length = f"{ratio:.2f} times the least length around the obstacles"
    elif is_given:
        length = "a given path, which may ignore obstacles"
    else:
        length = "least length 0: the start is within the goal's radius"
    # The checker does not compute clearances above `MAX_CLEARANCE_M`.
    if clearance > MAX_CLEARANCE_M - CLEARANCE_ERROR_M:
        more = "at least "
    else:
        more = ""
    return f"{length}, {more}{1000 * clearance:.0f} mm of clearance beyond {edges}"
