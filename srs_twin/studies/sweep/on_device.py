"""The sweep engine that steps twins on an accelerator, many points at a time, and measures them here."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any

from srs_twin.compute.workers import Done
from srs_twin.errors import EngineWarning, InputError, SrsError
from srs_twin.plants.twin.batch import warp_batch
from srs_twin.rollout import run_scripts
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.scenario import Scenario
from srs_twin.studies.sweep.execution import Engine, local
from srs_twin.studies.sweep.points import Experiment, Point
from srs_twin.studies.sweep.task import Row, run_point

TOGETHER = 1024
"""Worlds at a time: each distinct robot is built by the processor first and kept until its run is done."""


def on_device(device: str | None = None, workers: int | None = None) -> Engine:
    """Return the engine that runs twins by MuJoCo Warp, and by `local` what that cannot do, with a warning.

    Args:
        device: as Warp calls it; None: an accelerator, and `local` for everything where there is none.
        workers: of `local`.

    Raises:
        InputError: MuJoCo Warp is not installed.
    """
    kind = warp_batch()
    if device is None and not kind.accelerated():
        told = "engine 'warp' finds no accelerator; all points run on the processor (engine 'local')"
        warnings.warn(told, EngineWarning, stacklevel=1)
        return local(workers)

    def run(experiment: Experiment, points: Sequence[Point]) -> Iterator[Done[Row]]:
        left: dict[int, str] = {}
        for first in range(0, len(points), TOGETHER):
            chunk = range(first, min(first + TOGETHER, len(points)))
            groups: dict[Any, list[tuple[int, Scenario, Any]]] = defaultdict(list)
            for k in chunk:
                try:
                    scenario = parse_scenario(experiment.document(points[k].changes))
                    twin = scenario.build_plant("twin")
                    kind.check(twin)
                    groups[_alike(experiment, scenario)].append((k, scenario, twin))
                except SrsError as error:
                    left[k] = str(error)
            for group in groups.values():
                try:
                    ran = _run(kind, device, group)
                except InputError as error:
                    left |= dict.fromkeys([k for k, _, _ in group], str(error))
                    continue
                for (k, _, _), done in zip(group, ran, strict=True):
                    yield Done(k, run_point(experiment, points[k], {"twin": done}), None)
        if left:
            why = next(iter(left.values()))
            told = f"{len(left)} of {len(points)} points run on the processor: {why}"
            warnings.warn(told, EngineWarning, stacklevel=1)
            numbers = list(left)
            for row in local(workers)(experiment, [points[k] for k in numbers]):
                yield Done(numbers[row.number], row.result, row.error)

    return run


def _alike(experiment: Experiment, scenario: Scenario) -> tuple[Any, ...]:
    """Return what runs that go together have in common.

    Raises:
        InputError: a scenario that no batch of scripts can run.
    """
    timing = scenario.timing
    if "twin" not in experiment.plants:
        raise InputError("engine 'warp' runs twins; there is none")
    if timing["begin"] is not None:
        raise InputError("engine 'warp' cannot do a start that moves; the processor can")
    return tuple(timing[name] for name in ("duration", "seed", "record_hz"))


def _run(kind: Any, device: str | None, group: Sequence[tuple[int, Scenario, Any]]) -> list[Any]:
    """Run scenarios of like timing; raises InputError for what the device cannot do."""
    scenarios = [scenario for _, scenario, _ in group]
    timing = scenarios[0].timing
    return list(
        run_scripts(
            kind([twin for _, _, twin in group], device=device),
            [scenario.build_controller() for scenario in scenarios],
            timing["duration"], seed=timing["seed"], record_hz=timing["record_hz"],
            poses=[scenario.timing["pose"] for scenario in scenarios],
        )
    )  # fmt: skip
