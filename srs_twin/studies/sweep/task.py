"""What a worker does for one point: run it, measure it, and say it in a row of plain values."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from srs_twin.comparison.compare import MeasuredDifference, compare
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.errors import InputError, SrsError
from srs_twin.io.files import printable
from srs_twin.planning.metrics import plan_metrics
from srs_twin.rollout import rollout
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.plants import PLANTS
from srs_twin.scenario.scenario import Scenario
from srs_twin.studies.sweep.points import Experiment, Point
from srs_twin.trajectory import Trajectory

DONE, FAILED = "done", "failed"
PLAN = "plan"
"""Whose metrics those of a scenario are that is only planned."""
PLAN_TIME = f"{PLAN}.plan_s"

# Wall times of two runs are never the same: one column has them all.
_TIMES = ("wall_s", "realtime_factor")
_planned_before: set[str] = set()


@dataclass(frozen=True)
class Row:
    """What came of one point.

    Attributes:
        key: of the point.
        status: "done" or "failed".
        values: ``<plant>.<metric>``, ``comparison.<metric>`` and ``plan.<metric>`` → number, None where
            there is none.
        wall_s: what it took, s.
        reason: why it failed.
        exit_code: what that failure means on the command line; 0 where there is none.
        files: plant → trajectory as Parquet, for the runs that keep them.
    """

    key: str
    status: str
    values: Mapping[str, float | None] = field(default_factory=dict)
    wall_s: float = 0.0
    reason: str | None = None
    exit_code: int = 0
    files: Mapping[str, bytes] = field(default_factory=dict, repr=False)


def run_point(
    experiment: Experiment, point: Point, ran: Mapping[str, Trajectory | SrsError] = MappingProxyType({})
) -> Row:
    """Run the plants of a point, or only plan it, and measure; what it does wrong becomes a failed row.

    Args:
        experiment: whose point.
        point: which.
        ran: plants that have run already → what came of them.
    """
    start = time.perf_counter()
    trajectories: dict[str, Trajectory] = {}
    values: dict[str, float | None] = {}
    reason, exit_code = None, 0
    try:
        scenario = parse_scenario(experiment.document(point.changes))
        if not experiment.plants:
            values |= flat_metrics(PLAN, _planned(scenario))
        for plant in experiment.plants:
            done = ran.get(plant)
            if isinstance(done, SrsError):
                raise done
            if done is None:
                done = rollout(scenario.build_plant(plant), scenario.build_controller(), **scenario.timing)
            trajectories[plant] = done
            metrics = plant_metrics(trajectories[plant])
            if scenario.measured is not None:
                metrics |= MeasuredDifference.of(scenario.measured, trajectories[plant]).metrics
            values |= flat_metrics(plant, metrics)
        if len(trajectories) == 2:
            analytical, twin = (trajectories[plant] for plant in PLANTS)
            comparison = compare(analytical, twin, gap_factor=scenario.file.comparison.gap_factor)
            values |= flat_metrics("comparison", comparison.metrics)
    except SrsError as error:
        trajectories |= _begun(error, experiment.plants, trajectories)
        reason, exit_code, values = " ".join(str(error).split()), error.exit_code, {}
    files = {plant: _parquet(each) for plant, each in trajectories.items()} if experiment.trajectories else {}
    wall = time.perf_counter() - start
    return Row(point.key, FAILED if reason else DONE, values, wall, reason, exit_code, files)


def failed_row(key: str, error: Exception | None, wall_s: float = 0.0) -> Row:
    """Return the row of what an error ended, or a worker that went down."""
    code = error.exit_code if isinstance(error, SrsError) else SrsError.exit_code
    return Row(key, FAILED, {}, wall_s, printable(" ".join(str(error).split())), code)


def _planned(scenario: Scenario) -> dict[str, Any]:
    """Return the metrics of a plan, and its wall time.

    Raises:
        InputError: there is nothing to plan, or the planner cannot.
    """
    planner = scenario.planner
    if planner is None:
        raise InputError("there is no planner; give planner, and controller.kind: follow")
    if planner.file.kind not in _planned_before:
        # What is loaded and compiled once a process is in no point's time.
        planner.plan_uncached()
        _planned_before.add(planner.file.kind)
    found = planner.plan_uncached()
    return plan_metrics(found.found, found.segments, found.expanded) | {"plan_s": found.seconds}


def _begun(error: SrsError, plants: tuple[str, ...], done: Mapping[str, Trajectory]) -> dict[str, Trajectory]:
    """Return what a plant that diverged did up to there."""
    trajectory = getattr(error, "trajectory", None)
    plant = next((plant for plant in plants if plant not in done), None)
    return {} if trajectory is None or plant is None else {plant: trajectory}


def flat_metrics(prefix: str, metrics: Mapping[str, Any]) -> dict[str, float | None]:
    """Return metrics as single numbers; elements of lists are numbered, chambers are plus and minus.

    Args:
        prefix: whose they are, in front of each name: a plant, "comparison" or "plan".
        metrics: by name, as metrics.json has them.
    """
    found: dict[str, float | None] = {}
    for name, value in metrics.items():
        if name in _TIMES:
            continue
        for ending, number in _leaves(value):
            found[f"{prefix}.{name}{ending}"] = None if number is None else float(number)
    return found


def _leaves(value: Any) -> Iterator[tuple[str, float | None]]:
    """Yield the ends of names and the numbers of a metric: a number, or a list of segments or of periods."""
    if not isinstance(value, list | tuple):
        yield "", value
        return
    for i, each in enumerate(value, start=1):
        if not isinstance(each, list | tuple):
            yield f"_{i}", each
        elif each and isinstance(each[0], list | tuple):
            yield from ((f"{ending}_period_{i}", number) for ending, number in _leaves(each))
        else:
            yield from (
                (f"_{side}_{i}", number) for side, number in zip(("plus", "minus"), each, strict=True)
            )


def _parquet(trajectory: Trajectory) -> bytes:
    stream = io.BytesIO()
    trajectory.to_parquet(stream)
    return stream.getvalue()
