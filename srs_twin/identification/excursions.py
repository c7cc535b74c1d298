"""Excursions: how far the body of a snake that follows leaves its planned footprint, over whole runs.

The runs are those of a scenario but for what they follow: drawn ways without obstacles, `LENGTH` long behind
the scenario's run-up. Each run has another seed, which draws the modules, the camera's noise and the way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from srs_twin.compute.workers import each
from srs_twin.errors import InputError
from srs_twin.planning.follower import ENDINGS, Follower
from srs_twin.planning.margins import LOST_M, ExcursionsFile
from srs_twin.planning.metrics import beyond, following
from srs_twin.planning.path import path_from_arcs
from srs_twin.planning.problem import Outcome, Plan
from srs_twin.planning.scenario import FollowFile
from srs_twin.robot.file import RobotFile
from srs_twin.robot.world import Goal, Pose, World
from srs_twin.rollout import rollout
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.plants import PlantsFile
from srs_twin.scenario.scenario import Scenario

LENGTH = 3.5
"""Of a drawn way, m."""
_PIECES, _LEAST = (0.3, 0.8), 0.05
_AWAY = 1.4
"""Largest heading of a way, rad."""
_SLOWEST = 0.5
"""Of the footprint's slowest speed: whoever needs longer has not arrived."""
_DIGITS = 4


@dataclass(frozen=True)
class Tried:
    """One run of a scenario's follower along a drawn way; picklable.

    Attributes:
        document: of the scenario, with a straight path to follow.
        run_up: straight beginning of the drawn one, m.
        plant: that runs.
        seed: of modules, noise and way.
    """

    document: dict[str, Any]
    run_up: float
    plant: str
    seed: int

    def run(self) -> tuple[float, float]:
        """Return how far the body left its footprint at most, over the run-up and after it, m."""
        scenario = parse_scenario(self.document | {"seed": self.seed})
        planner, follower = scenario.planner, scenario.build_controller()
        assert planner is not None and isinstance(follower, Follower), "checked by `excursions`"
        body = planner.problem.footprint
        rng = np.random.default_rng([self.seed, 0x5EED])
        pieces = _way(rng, body.curvatures[0], body.curvatures[-1])

        def planned(start: Pose, *begin: tuple[float, float]) -> Plan:
            return Plan(Outcome.FOUND, "drawn", path_from_arcs(start, [*begin, *pieces], body))

        plan = planned(Pose(*scenario.pose), *([(0.0, self.run_up)] if self.run_up else []))
        assert plan.end is not None, "it has segments"
        alone = replace(follower.conditions, stray=math.inf, run_up=self.run_up)
        driven = replace(
            follower, plan=plan, goal=Goal(plan.end.x, plan.end.y, None, math.inf), world=World(),
            conditions=alone, body=body, replan=lambda pose, share: planned(pose),
        )  # fmt: skip
        longest = (self.run_up + LENGTH + 1) / (_SLOWEST * min(body.speeds))
        # A whole number of the scenario's own durations is one of ticks.
        duration = scenario.duration * math.ceil(longest / scenario.duration)
        way = rollout(
            scenario.build_plant(self.plant), driven, duration,
            pose=scenario.pose, seed=self.seed, record_hz=scenario.record_hz,
        )  # fmt: skip
        about = following(way)
        assert about is not None, "a follower ran"
        begun = about["plans"][-1]["time"]
        out, later = beyond(way), way.time >= begun
        first = float(out[~later].max(initial=0.0)) if self.run_up else 0.0
        return first, float(out[later].max()) if about["ending"] == next(iter(ENDINGS)) else LOST_M


def _way(rng: np.random.Generator, low: float, high: float) -> list[tuple[float, float]]:
    """Return curvature and length of each piece of a way: straight or as tight as can be, as plans are.

    They begin with a turn, as plans do from where a run-up has ended.
    """
    pieces, left, heading, curvature = [], LENGTH, 0.0, 0.0
    while left > _LEAST:
        curvature = float(rng.choice([each for each in (low, 0.0, high) if each != curvature]))
        length = min(float(rng.uniform(*_PIECES)), left)
        # A way that crosses itself would not say which part of it the body has left.
        if curvature and abs(heading + curvature * length) > _AWAY:
            length = (math.copysign(_AWAY, curvature) - heading) / curvature
        if length > _LEAST:
            pieces.append((curvature, length))
            heading, left = heading + curvature * length, left - length
    return pieces


def excursions(
    scenario: Scenario,
    plant: str,
    runs: int,
    *,
    workers: int | None = None,
    progress: Callable[[], None] | None = None,
) -> ExcursionsFile:
    """Measure a scenario's excursions on a plant.

    Args:
        scenario: that follows a plan.
        plant: analytical or twin.
        runs: how many; seeds are 0 and up.
        workers: processes; default one a processor.
        progress: called as each is done.

    Returns:
        What a footprint file keeps, in its units.

    Raises:
        InputError: the scenario does not follow, or a run failed.
    """
    planner, controller = scenario.file.section("planner"), scenario.controller
    if planner is None or not isinstance(controller, FollowFile):
        raise InputError(f"{scenario.name}: it follows no plan; margins belong to controller.kind: follow")
    robot = RobotFile.model_validate(scenario.document["robot"])
    settings = {plant: scenario.document["plants"].get(plant, {})}
    contact = getattr(PlantsFile.model_validate(settings).running[plant], "contact", None)
    conditions = controller.conditions(plant, contact, scenario.file.pneumatics.kind, robot, planner)
    straight = {"kind": "given", "turns_rad": [0.0], "step_m": 1.0}
    same = {"footprint": planner.footprint, "turn_share": planner.turn_share}
    alone = {
        **scenario.document,
        "world": {},
        "expect": [],
        "planner": straight | same,
        "plants": settings,
    }
    tried = [Tried(alone, conditions.run_up_m, plant, seed) for seed in range(runs)]
    found: list[tuple[float, float]] = []
    for done in each(Tried.run, tried, workers=workers):
        if done.result is None:
            raise InputError(f"{scenario.name}, seed {done.number}: {done.error}")
        found.append(done.result)
        if progress:
            progress()
    first, path = (sorted(round(value, _DIGITS) for value in column) for column in zip(*found, strict=True))
    return ExcursionsFile(
        conditions=conditions,
        source=f"`srs-twin calibrate margin {scenario.name}`: {runs} drawn ways of {LENGTH:g} m",
        path_m=path,
        run_up_m=first if conditions.run_up_m else None,
    )
