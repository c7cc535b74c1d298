"""Worker task that runs one point of a sweep and returns the metrics as a row."""

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
from srs_twin.io.files import escape_unprintable
from srs_twin.planning.metrics import plan_metrics
from srs_twin.rollout import rollout
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.plants import PLANTS
from srs_twin.scenario.scenario import Scenario
from srs_twin.studies.sweep.points import Experiment, Point
from srs_twin.trajectory import Trajectory

DONE = "done"

FAILED = "failed"

PLAN = "plan"
"""Prefix of metrics for scenarios that are planned but not simulated."""

PLAN_TIME = f"{PLAN}.plan_s"
"""Column of the planning time, which differs between identical runs."""

# Wall times differ between identical runs, so they are not stored as metrics.
_TIMES = ("wall_s", "realtime_factor")

_warmed_planners: set[str] = set()


@dataclass(frozen=True)
class Row:
    """Result of one sweep point.

    Attributes:
        key: key of the point.
        status: `DONE` or `FAILED`.
        values: value of each metric, or None if it is undefined, keyed by name
            (``<plant>.<metric>``, ``comparison.<metric>`` or ``plan.<metric>``).
        wall_s: wall time, s.
        reason: error message, or None if the run succeeded.
        exit_code: exit code of the command for the error, or 0 if the run succeeded.
        files: trajectory of each plant in Parquet format, if trajectories are stored.
    """

    key: str
    status: str
    values: Mapping[str, float | None] = field(default_factory=dict)
    wall_s: float = 0.0
    reason: str | None = None
    exit_code: int = 0
    files: Mapping[str, bytes] = field(default_factory=dict, repr=False)


def run_point(
    experiment: Experiment,
    point: Point,
    ran: Mapping[str, Trajectory | SrsError] = MappingProxyType({}),
) -> Row:
    """Simulate or plan one sweep point, and compute its metrics.

    Plants with a trajectory or an error in `ran` are not simulated again. If an
    `SrsError` occurs, the returned row contains the error message.
    """
    start = time.perf_counter()
    trajectories: dict[str, Trajectory] = {}
    values: dict[str, float | None] = {}
    reason = None
    exit_code = 0
    try:
        scenario = parse_scenario(experiment.document(point.changes))
        if not experiment.plants:
            values |= flat_metrics(PLAN, _plan_metrics(scenario))
        for plant in experiment.plants:
            result = ran.get(plant)
            if isinstance(result, SrsError):
                raise result
            if result is None:
                result = rollout(
                    scenario.build_plant(plant),
                    scenario.build_controller(),
                    **scenario.timing,
                )
            trajectories[plant] = result
            metrics = plant_metrics(result)
            if scenario.measured is not None:
                metrics |= MeasuredDifference.between(scenario.measured, result).metrics
            values |= flat_metrics(plant, metrics)
        if len(trajectories) == 2:
            analytical, twin = (trajectories[plant] for plant in PLANTS)
            comparison = compare(
                analytical, twin, gap_factor=scenario.file.comparison.gap_factor
            )
            values |= flat_metrics("comparison", comparison.metrics)
    except SrsError as error:
        trajectories |= _partial_trajectory(error, experiment.plants, trajectories)
        reason = " ".join(str(error).split())
        exit_code = error.exit_code
        values = {}
    stored = trajectories if experiment.trajectories else {}
    files = {plant: _parquet(trajectory) for plant, trajectory in stored.items()}
    wall = time.perf_counter() - start
    return Row(
        point.key, FAILED if reason else DONE, values, wall, reason, exit_code, files
    )


def failed_row(key: str, error: Exception | None, wall_s: float = 0.0) -> Row:
    """Return a failed row for a task that raised an error or whose worker crashed."""
    code = error.exit_code if isinstance(error, SrsError) else SrsError.exit_code
    return Row(
        key, FAILED, {}, wall_s, escape_unprintable(" ".join(str(error).split())), code
    )


def _plan_metrics(scenario: Scenario) -> dict[str, object]:
    planner = scenario.planner
    if planner is None:
        raise InputError(
            "the scenario has no planner; add the section `planner`, and set"
            " `controller.kind: follow`"
        )
    if planner.file.kind not in _warmed_planners:
        # The first plan includes imports and compilation, which must not count as
        # planning time.
        planner.plan_uncached()
        _warmed_planners.add(planner.file.kind)
    result = planner.plan_uncached()
    return plan_metrics(result.found, result.segments, result.expanded) | {
        "plan_s": result.seconds
    }


def _partial_trajectory(
    error: SrsError, plants: tuple[str, ...], done: Mapping[str, Trajectory]
) -> dict[str, Trajectory]:
    trajectory = getattr(error, "trajectory", None)
    plant = next((plant for plant in plants if plant not in done), None)
    return {} if trajectory is None or plant is None else {plant: trajectory}


def flat_metrics(prefix: str, metrics: Mapping[str, object]) -> dict[str, float | None]:
    """Return metrics as scalars with names of the form ``<prefix>.<metric>``.

    The elements of list metrics are numbered from 1. The two chambers of a segment are
    named `plus` and `minus`.
    """
    scalars: dict[str, float | None] = {}
    for name, value in metrics.items():
        if name in _TIMES:
            continue
        for ending, number in _scalars(value):
            scalars[f"{prefix}.{name}{ending}"] = (
                None if number is None else float(number)
            )
    return scalars


def _scalars(value: Any) -> Iterator[tuple[str, float | None]]:
    if not isinstance(value, list | tuple):
        yield "", value
        return
    for i, entry in enumerate(value, start=1):
        if not isinstance(entry, list | tuple):
            yield f"_{i}", entry
        elif entry and isinstance(entry[0], list | tuple):
            yield from (
                (f"{ending}_period_{i}", number) for ending, number in _scalars(entry)
            )
        else:
            # A segment of a spatial robot has more than two chambers.
            sides = (
                ("plus", "minus")
                if len(entry) == len("+-")
                else range(1, len(entry) + 1)
            )
            yield from (
                (f"_{side}_{i}", number)
                for side, number in zip(sides, entry, strict=True)
            )


def _parquet(trajectory: Trajectory) -> bytes:
    stream = io.BytesIO()
    trajectory.to_parquet(stream)
    return stream.getvalue()
