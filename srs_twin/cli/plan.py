"""`srs-twin plan`: the plan of a scenario, and nothing moves."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from srs_twin.cli import say
from srs_twin.cli.batch import EXPECTATION_FAILED, RUNS, OneOutOption, QuietOption
from srs_twin.errors import InputError
from srs_twin.io.files import shown

if TYPE_CHECKING:
    from srs_twin.planning import Plan
    from srs_twin.scenario import Outcome, Scenario
    from srs_twin.scenario.following import FollowSettings

PLAN, PICTURE = "plan.json", "plan.png"


def plan(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="A shipped scenario or a file.")],
    out: OneOutOption = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Exit with 1 when an expectation of the plan fails, or no plan is found."
        ),
    ] = False,
    quiet: QuietOption = False,
) -> None:
    """Plan the way of a scenario; nothing is simulated."""
    from srs_twin.cli.table import WORDS
    from srs_twin.comparison.following import plan_metrics
    from srs_twin.io.files import open_folder
    from srs_twin.scenario import load_scenario
    from srs_twin.scenario.following import FollowSettings

    loaded = load_scenario(scenario)
    if not isinstance(loaded.controller, FollowSettings):
        raise InputError(f"{scenario}: it has no planner; add planner, and controller.kind: follow")
    folder = Path(out) if out else RUNS / loaded.name
    open_folder(folder, (PLAN, PICTURE))
    with loaded.named_in_errors():
        found = loaded.controller.planner.plan()
    metrics = plan_metrics(found.found, found.segments, found.expanded)
    outcomes = _outcomes(loaded, metrics)
    _write(folder, loaded, loaded.controller, found, metrics)
    if not quiet:
        _show(loaded, found, folder)
    missed = [each for each in outcomes if each.verdict == "missed"]
    for each in outcomes if not quiet else missed if check else ():
        print(f"{WORDS[each.verdict]:6} {each.metric} = {each.value}, allowed {each.allowed}")
    judged = any(each.metric == "plan_found" for each in outcomes)
    if check and (missed or not (found.found or judged)):
        raise typer.Exit(EXPECTATION_FAILED)


def _outcomes(scenario: Scenario, metrics: dict[str, Any]) -> list[Outcome]:
    """Return what the scenario expects of its plan, once each, checked."""
    expected = {(e.metric, e.low, e.high): e for e in scenario.expect if e.metric in metrics}
    return [e.check({"plants": {e.of: metrics}}) for e in expected.values()]


def _show(scenario: Scenario, found: Plan, folder: Path) -> None:
    print(f"{scenario.name}: {found.outcome.value}: {found.reason}")
    if found.found:
        print(
            f"length {found.length:.3f} m, {found.duration:.1f} s at the footprint's speeds, "
            f"{len(found.segments)} segments, kink {found.kink:.3g} rad"
        )
    print(f"{found.expanded} nodes, {1000 * found.seconds:.1f} ms")
    say(f"files in {shown(folder)}: {PLAN}, {PICTURE}")


def _write(
    folder: Path, scenario: Scenario, settings: FollowSettings, found: Plan, metrics: dict[str, Any]
) -> None:
    """Write the plan as data and as a picture."""
    from srs_twin.io.files import replaced
    from srs_twin.viewing.plots.plan_view import plan_plot

    problem = settings.planner.problem
    about = {"world": asdict(problem.world), "goal": asdict(problem.goal)}
    document = {
        "scenario": scenario.name,
        "outcome": found.outcome.value,
        "reason": found.reason,
        "start": asdict(problem.start),
        **about,
        "segments": [asdict(each) for each in found.segments],
        "metrics": metrics,
    }
    figure = plan_plot(about, found.segments, problem.footprint, f"{scenario.title}: {found.outcome.value}")
    with replaced(folder, (PLAN, PICTURE)) as fresh:
        (fresh / PLAN).write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", "utf-8")
        figure.savefig(fresh / PICTURE, format="png", dpi=150)
