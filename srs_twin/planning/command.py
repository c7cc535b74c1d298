"""`srs-twin plan`: the plan of a scenario, and nothing moves."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from srs_twin.cli.batch import RUNS
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
from srs_twin.errors import InputError
from srs_twin.io.files import shown

if TYPE_CHECKING:
    from srs_twin.planning.plan import Plan
    from srs_twin.planning.problem import Problem
    from srs_twin.scenario.scenario import Scenario

_ROUNDING = 1e-9
"""Lengths below are 0, m."""

PLAN, PICTURE, SEARCH, RECORDING = "plan.json", "plan.png", "search.png", "search.rrd"


def plan(
    scenario: ScenarioArgument,
    out: OneOutOption = None,
    check: Annotated[bool, option("--check")] = False,
    search: Annotated[bool, option("--search")] = False,
    changed: ChangeOptions = NO_CHANGES,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Plan the way of a scenario; nothing is simulated.

    Options:
        check: Exit with 1 when an expectation of the plan fails, or no plan is found.
        search: Also a picture and a recording of what the search explored and rejected.
    """
    from srs_twin.cli.table import WORDS
    from srs_twin.io.file_sets import replaced
    from srs_twin.io.files import open_folder
    from srs_twin.planning.metrics import plan_metrics
    from srs_twin.scenario.expectation import verdict
    from srs_twin.scenario.loading import load_scenario
    from srs_twin.scenario.modified import left_out_line

    loaded = load_scenario(scenario, set=changed.changes())
    if loaded.planner is None:
        raise InputError(f"{scenario}: it has no planner; add planner, and controller.kind: follow")
    folder = Path(out) if out else RUNS / loaded.name
    files = (PLAN, PICTURE, *((SEARCH, RECORDING) if search else ()))
    open_folder(folder, files)
    with loaded.named_in_errors():
        found = loaded.planner.plan_anew(keep=True) if search else loaded.planner.plan()
    metrics = plan_metrics(found.found, found.segments, found.expanded)
    checked = _checked(loaded, metrics)
    with replaced(folder, (PLAN, PICTURE, SEARCH, RECORDING)) as fresh:
        _write(fresh, loaded, loaded.planner.problem, found, metrics)
        if search:
            _write_search(fresh, loaded.title, found)
    if as_json:
        print((folder / PLAN).read_text("utf-8"), end="")
    elif not quiet:
        _show(loaded, found)
    say(f"files in {shown(folder)}: {', '.join(files)}", quiet=quiet)
    missed = [each for each in checked if verdict(each) == "missed"]
    for each in checked if not quiet else missed if check else ():
        (say if as_json else print)(
            f"{WORDS[verdict(each)]:6} {each['metric']} = {each['value']}, allowed {each['allowed']}"
        )
    left_out = [each for each in loaded.left_out if each["metric"] in metrics]
    for line in left_out_line(left_out) if not quiet else ():
        (say if as_json else print)(line)
    judged = any(each["metric"] == "plan_found" for each in checked)
    if check and (missed or not (found.found or judged)):
        raise typer.Exit(EXPECTATION_FAILED)


def _checked(scenario: Scenario, metrics: dict[str, Any]) -> list[dict[str, Any]]:
    """Return what the scenario expects of its plan, once each, checked."""
    expected = {(each.metric, each.allowed): each for each in scenario.expect if each.metric in metrics}
    return [each.check({"plants": {each.subject: metrics}}) for each in expected.values()]


def _show(scenario: Scenario, found: Plan) -> None:
    print(f"{scenario.label}: {found.outcome.value}: {found.reason}")
    if found.found:
        print(
            f"length {found.length:.3f} m, {found.duration:.1f} s at the footprint's speeds, "
            f"{_counted(len(found.segments), 'segment')}, kink {found.kink:.3g} rad"
        )
        print(_quality_words(_quality(found)))
    print(f"{_counted(found.expanded, 'node')}, {1000 * found.seconds:.1f} ms")


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _quality_words(quality: Mapping[str, float | None]) -> str:
    """Return in words what `_quality` returns."""
    from srs_twin.planning.collision import FINENESS, MOST_CLEARANCE

    ratio, room = quality["length_over_least"], quality["clearance_m"] or 0.0
    length = "least length 0: the start is within the goal's radius"
    if ratio is not None:
        length = f"{ratio:.2f} times the least length around the obstacles"
    more = "at least " if room > MOST_CLEARANCE - FINENESS else ""  # wider edges are not tried
    return f"{length}, {more}{1000 * room:.0f} mm of room beside the swept area, margin included"


def _quality(found: Plan) -> dict[str, float | None]:
    """Return the length of a path as a multiple of the least length, and the room that it leaves, m.

    The multiple is None where the least length is 0: the start is within the goal's radius.
    """
    from srs_twin.planning.collision import Checker

    assert found.problem is not None, "a planner's answer"
    checker = Checker(found.problem.world, found.problem.footprint)
    return {
        "length_over_least": found.length / found.least_length if found.least_length > _ROUNDING else None,
        "clearance_m": checker.clearance(found.segments),
    }


def _write(folder: Path, scenario: Scenario, problem: Problem, found: Plan, metrics: dict[str, Any]) -> None:
    """Write the plan as data and as a picture."""
    from srs_twin.planning.pictures import plan_plot

    about = {"world": asdict(problem.world), "goal": asdict(problem.goal)}
    document = {
        "scenario": scenario.name,
        "outcome": found.outcome.value,
        "reason": found.reason,
        "start": asdict(problem.start),
        **about,
        "segments": [asdict(each) for each in found.segments],
        "quality": _quality(found) if found.found else None,
        "metrics": metrics,
        "changes": list(scenario.changes),
    }
    figure = plan_plot(about, found.segments, problem.footprint, f"{scenario.title}: {found.outcome.value}")
    (folder / PLAN).write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", "utf-8")
    figure.savefig(folder / PICTURE, format="png", dpi=150)


def _write_search(folder: Path, title: str, found: Plan) -> None:
    """Write what the search has seen as a picture and as a recording."""
    from srs_twin.planning.explored import explored
    from srs_twin.planning.pictures import search_plot, write_search

    assert found.problem is not None, "a planner's answer"
    problem, seen = found.problem, explored(found.trees, found.problem)
    about = {"world": asdict(problem.world), "goal": asdict(problem.goal)}
    figure = search_plot(about, found.segments, problem.footprint, seen)
    figure.savefig(folder / SEARCH, format="png", dpi=150)
    write_search(folder / RECORDING, found, seen, title)
