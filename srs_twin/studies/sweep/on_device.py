"""Sweep engine that steps the twins of many points together on an accelerator; metrics use the CPU."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any

from srs_twin.compute.workers import TaskResult
from srs_twin.errors import EngineWarning, InputError, SrsError
from srs_twin.plants.twin.batch import warp_batch
from srs_twin.rollout import run_scripts
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.scenario import Scenario
from srs_twin.studies.sweep.execution import Engine, local
from srs_twin.studies.sweep.points import Experiment, Point
from srs_twin.studies.sweep.task import Row, run_point

BATCH_SIZE = 1024
"""Largest number of worlds at a time; distinct robots are compiled on the CPU and kept until their run is
done."""


def on_device(device: str | None = None, workers: int | None = None) -> Engine:
    """Return the engine that runs twins with MuJoCo Warp, and all others with `local` and a warning.

    Args:
        device: Warp device; None: an accelerator, or `local` for all points if there is none.
        workers: number of workers of `local`.

    Raises:
        InputError: MuJoCo Warp is not installed.
    """
    batch_class = warp_batch()
    if device is None and not batch_class.accelerated():
        message = "engine 'warp' finds no accelerator; all points run on the processor (engine 'local')"
        warnings.warn(message, EngineWarning, stacklevel=1)
        return local(workers)

    def run(experiment: Experiment, points: Sequence[Point]) -> Iterator[TaskResult[Row]]:
        unsupported: dict[int, str] = {}
        for first in range(0, len(points), BATCH_SIZE):
            chunk = range(first, min(first + BATCH_SIZE, len(points)))
            groups: dict[Any, list[tuple[int, Scenario, Any]]] = defaultdict(list)
            for k in chunk:
                try:
                    scenario = parse_scenario(experiment.document(points[k].changes))
                    twin = scenario.build_plant("twin")
                    batch_class.check(twin)
                    groups[_group_key(experiment, scenario)].append((k, scenario, twin))
                except SrsError as error:
                    unsupported[k] = str(error)
            for group in groups.values():
                try:
                    trajectories = _run(batch_class, device, group)
                except InputError as error:
                    unsupported |= dict.fromkeys([k for k, _, _ in group], str(error))
                    continue
                for (k, _, _), trajectory in zip(group, trajectories, strict=True):
                    yield TaskResult(k, run_point(experiment, points[k], {"twin": trajectory}), None)
        if unsupported:
            why = next(iter(unsupported.values()))
            message = f"{len(unsupported)} of {len(points)} points run on the processor: {why}"
            warnings.warn(message, EngineWarning, stacklevel=1)
            numbers = list(unsupported)
            for row in local(workers)(experiment, [points[k] for k in numbers]):
                yield TaskResult(numbers[row.number], row.result, row.error)

    return run


def _group_key(experiment: Experiment, scenario: Scenario) -> tuple[Any, ...]:
    """Return the timing that runs of one batch must share.

    Raises:
        InputError: the scenario cannot run in a batch.
    """
    timing = scenario.timing
    if "twin" not in experiment.plants:
        raise InputError("engine 'warp' runs only twins; add twin to plants")
    if timing["begin"] is not None:
        raise InputError("engine 'warp' cannot start from a moving state")
    return tuple(timing[name] for name in ("duration", "seed", "record_hz"))


def _run(batch_class: Any, device: str | None, group: Sequence[tuple[int, Scenario, Any]]) -> list[Any]:
    """Run scenarios with the same timing in one batch; raises InputError if the device cannot."""
    scenarios = [scenario for _, scenario, _ in group]
    timing = scenarios[0].timing
    return list(
        run_scripts(
            batch_class([twin for _, _, twin in group], device=device),
            [scenario.build_controller() for scenario in scenarios],
            timing["duration"], seed=timing["seed"], record_hz=timing["record_hz"],
            poses=[scenario.timing["pose"] for scenario in scenarios],
        )
    )  # fmt: skip
