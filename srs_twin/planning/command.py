"""Command `srs-twin plan`: plan the path of a scenario without simulating it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
    option,
)
from srs_twin.cli.run import RUNS_FOLDER
from srs_twin.errors import InputError
from srs_twin.io.files import display_path

if TYPE_CHECKING:
    from srs_twin.planning.problem import Plan
    from srs_twin.scenario.scenario import Scenario

Quality = Mapping[str, float | None]

_ROUNDING = 1e-9
"""Lengths below this count as 0, m."""

PLAN = "plan.json"
"""File of the plan."""
PICTURE = "plan.png"
"""Picture of the plan."""
SEARCH = "search.png"
"""Picture of the search."""
RECORDING = "search.rrd"
"""Rerun recording of the search."""


def plan(
    scenario: ScenarioArgument,
    out: OneOutOption = None,
    check: Annotated[bool, option("--check")] = False,
    search: Annotated[bool, option("--search")] = False,
    changed: ChangeOptions = NO_CHANGES,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Plan the path of a scenario without simulating it.

    Options:
        check: Exit with 1 if an expectation of the plan fails or no plan is found.
        search: Also write a picture and a recording of the explored and rejected arcs.
    """
    from srs_twin.cli.table import STATE_LABELS
    from srs_twin.io.file_sets import replace_files
    from srs_twin.io.files import check_output_folder
    from srs_twin.planning.metrics import plan_metrics
    from srs_twin.scenario.expectation import result_text, verdict
    from srs_twin.scenario.loading import load_scenario
    from srs_twin.scenario.modified import left_out_line

    loaded = load_scenario(scenario, set=changed.changes())
    if loaded.planner is None:
        raise InputError(f"{scenario}: there is no planner section; add planner, and controller.kind: follow")
    folder = Path(out) if out else RUNS_FOLDER / loaded.name
    files = (PLAN, PICTURE, *((SEARCH, RECORDING) if search else ()))
    check_output_folder(folder, files)
    with loaded.named_in_errors():
        result = loaded.planner.plan_uncached(keep=True) if search else loaded.planner.plan()
    metrics = plan_metrics(result.found, result.segments, result.expanded)
    quality = _quality(result) if result.found else None
    checked = _check_expectations(loaded, metrics)
    with replace_files(folder, (PLAN, PICTURE, SEARCH, RECORDING)) as fresh:
        _write(fresh, loaded, result, {"quality": quality, "metrics": metrics})
        if search:
            _write_search(fresh, loaded.title, result)
    if as_json:
        print((folder / PLAN).read_text("utf-8"), end="")
    elif not quiet:
        _print_plan(loaded, result, quality)
    say(f"files in {display_path(folder)}: {', '.join(files)}", quiet=quiet)
    write = say if as_json else print  # stdout is for the JSON document
    missed = [row for row in checked if verdict(row) == "missed"]
    for row in checked if not quiet else missed if check else ():
        write(f"{STATE_LABELS[verdict(row)]:6} {row['metric']} {result_text(row)}")
    left_out = [row for row in loaded.left_out if row["metric"] in metrics]
    for line in left_out_line(left_out) if not quiet else ():
        write(line)
    judged = any(row["metric"] == "plan_found" for row in checked)
    if check and (missed or not (result.found or judged)):
        raise typer.Exit(EXPECTATION_FAILED)


def _check_expectations(scenario: Scenario, metrics: Mapping[str, object]) -> list[dict[str, object]]:
    """Return the results of the scenario's expectations of its plan, without duplicates."""
    expected = {(item.metric, item.allowed): item for item in scenario.expect if item.metric in metrics}
    return [item.check({"plants": {item.subject: metrics}}) for item in expected.values()]


def _print_plan(scenario: Scenario, result: Plan, quality: Quality | None) -> None:
    """Print the outcome of a plan, with its length and quality if there is a path."""
    print(f"{scenario.label}: {result.outcome.value}: {result.reason}")
    if quality is not None:
        print(
            f"length {result.length:.3f} m, {result.duration:.1f} s at the footprint's speeds, "
            f"{_counted(len(result.segments), 'segment')}, kink {result.kink:.3g} rad"
        )
        edges = "the footprint and margin" if result.touches is None else "the edges that must stay free"
        print(_quality_words(quality, edges))
        for touch in result.touches or ():
            print(
                f"leans on {touch.obstacle} from {touch.begin:.2f} to {touch.end:.2f} m: footprint and "
                f"margin overlap by {1000 * touch.depth:.0f} mm, estimated mean force {touch.force:.2g} N"
            )
    print(f"{_counted(result.expanded, 'node')}, {1000 * result.seconds:.1f} ms")


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _quality_words(quality: Quality, edges: str) -> str:
    """Return the values of `_quality` as a sentence; `edges` names the edges with the clearance."""
    from srs_twin.planning.collision import CLEARANCE_ERROR_M, MAX_CLEARANCE_M

    ratio, clearance = quality["length_over_least"], quality["clearance_m"] or 0.0
    length = "least length 0: the start is within the goal's radius"
    if ratio is not None:
        length = f"{ratio:.2f} times the least length around the obstacles"
    # Clearances above the largest one are not measured.
    more = "at least " if clearance > MAX_CLEARANCE_M - CLEARANCE_ERROR_M else ""
    return f"{length}, {more}{1000 * clearance:.0f} mm of clearance beyond {edges}"


def _quality(result: Plan) -> Quality:
    """Return the length of a path relative to the least length, and its clearance, m.

    The relative length is None if the least length is 0: the start is within the goal's radius.
    """
    from srs_twin.planning.collision import Checker

    assert result.problem is not None, "set by plan()"
    checker = Checker(result.problem.world, result.problem.footprint)
    return {
        "length_over_least": result.length / result.least_length if result.least_length > _ROUNDING else None,
        "clearance_m": checker.clearance(result.segments),
    }


def _write(folder: Path, scenario: Scenario, result: Plan, values: Mapping[str, object]) -> None:
    """Write the plan and its values as a JSON document, and a picture."""
    from srs_twin.planning.pictures import plan_plot
    from srs_twin.viewing.plots.style import save

    assert scenario.planner is not None, "checked by the command"
    problem = scenario.planner.problem
    document = {
        "scenario": scenario.name,
        "outcome": result.outcome.value,
        "reason": result.reason,
        "start": asdict(problem.start),
        "world": asdict(problem.world),
        "goal": asdict(problem.goal),
        "segments": [asdict(segment) for segment in result.segments],
        **({} if result.touches is None else {"touches": [asdict(touch) for touch in result.touches]}),
        **values,
        "changes": list(scenario.changes),
    }
    figure = plan_plot(problem, result.segments, f"{scenario.title}: {result.outcome.value}")
    (folder / PLAN).write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", "utf-8")
    save(figure, folder / PICTURE, dpi=150)


def _write_search(folder: Path, title: str, result: Plan) -> None:
    """Write a picture and a Rerun recording of the search."""
    from srs_twin.planning.pictures import search_plot, write_search
    from srs_twin.planning.search_tree import trace_search
    from srs_twin.viewing.plots.style import save

    assert result.problem is not None, "set by plan()"
    trace = trace_search(result.trees, result.problem.world)
    figure = search_plot(result.problem, result.segments, trace)
    save(figure, folder / SEARCH, dpi=150)
    write_search(folder / RECORDING, result, trace, title)
