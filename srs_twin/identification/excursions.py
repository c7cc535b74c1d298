"""Measurement of how far a path follower leaves the footprint on random paths.

The excursion of a run is the maximum distance by which the body leaves the footprint.
The runs are simulated under the conditions of a scenario. After the straight lead-in of
the scenario, the robot follows a random path of length `LENGTH_M` without obstacles.
The seed of a run determines the module properties, the camera noise and the path.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from srs_twin.compute.workers import run_tasks
from srs_twin.errors import InputError
from srs_twin.io.arguments import checked
from srs_twin.io.documents import Override, Overrides
from srs_twin.io.files import StrPath, check_output_folder, find_file, read_text
from srs_twin.planning.follow_file import FollowFile
from srs_twin.planning.follower import ENDINGS, Follower
from srs_twin.planning.footprint_file import (
    LOST_M,
    ExcursionsFile,
    load_footprint_file,
    save_footprint,
)
from srs_twin.planning.metrics import beyond, following
from srs_twin.planning.path import path_from_arcs
from srs_twin.planning.problem import Plan, PlanOutcome
from srs_twin.robot.file import RobotFile
from srs_twin.robot.world import Goal, Pose, World
from srs_twin.rollout import rollout
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.scenario.plants import PlantsFile
from srs_twin.scenario.scenario import Scenario

LENGTH_M = 3.5
"""Length of a random path, m."""

_ARC_LENGTHS_M = (0.3, 0.8)
"""Range from which the length of an arc is drawn, m."""

_MIN_ARC_M = 0.05
"""Length below which a shortened arc is discarded, m."""

_MAX_HEADING = 1.4
"""Maximum heading of a random path relative to its initial heading, rad."""

_SLOWEST_FRACTION = 0.5
"""Minimum mean speed assumed for a run, relative to the lowest footprint speed."""

_DIGITS = 4
"""Number of decimals with which excursions are written to a footprint file."""


@dataclass(frozen=True)
class FollowerRun:
    """Simulation in which the path follower of a scenario tracks a random path.

    Attributes:
        document: scenario with a straight path, as plain data.
        lead_in: length of the straight start of the path, m.
    """

    document: dict[str, object]
    lead_in: float
    plant: str
    seed: int

    def run(self) -> tuple[float, float]:
        """Return the maximum excursions during the lead-in and afterwards, m.

        The second excursion is `LOST_M` if the robot does not reach the goal.
        """
        scenario = parse_scenario(self.document | {"seed": self.seed})
        planner = scenario.planner
        follower = scenario.build_controller()
        assert planner is not None and isinstance(follower, Follower), (
            "checked by `measure_excursions`"
        )
        body = planner.problem.footprint
        rng = np.random.default_rng([self.seed, 0x5EED])
        arcs = _random_arcs(rng, body.curvatures[0], body.curvatures[-1])

        def plan_from(start: Pose, *lead_in: tuple[float, float]) -> Plan:
            return Plan(
                PlanOutcome.FOUND,
                "drawn",
                path_from_arcs(start, [*lead_in, *arcs], body),
            )

        lead_in = [(0.0, self.lead_in)] if self.lead_in else []
        plan = plan_from(Pose(*scenario.pose), *lead_in)
        assert plan.end is not None, "it has segments"
        conditions = replace(
            follower.conditions, max_cross_track_error=math.inf, lead_in=self.lead_in
        )
        controller = replace(
            follower,
            plan=plan,
            goal=Goal(plan.end.x, plan.end.y, None, math.inf),
            world=World(),
            conditions=conditions,
            body=body,
            replan=lambda pose, fraction: plan_from(pose),
        )
        longest = (self.lead_in + LENGTH_M + 1) / (_SLOWEST_FRACTION * min(body.speeds))
        # A multiple of the scenario duration is also a multiple of the tick.
        duration = scenario.duration * math.ceil(longest / scenario.duration)
        trajectory = rollout(
            scenario.build_plant(self.plant),
            controller,
            duration,
            pose=scenario.pose,
            seed=self.seed,
            record_hz=scenario.record_hz,
        )
        metadata = following(trajectory)
        assert metadata is not None, "a follower ran"
        start = metadata["plans"][-1]["time"]
        excess = beyond(trajectory)
        is_after = trajectory.time >= start
        during_lead_in = 0.0
        if self.lead_in:
            during_lead_in = float(excess[~is_after].max(initial=0.0))
        if metadata["ending"] != next(iter(ENDINGS)):  # the goal was not reached
            return during_lead_in, LOST_M
        return during_lead_in, float(excess[is_after].max())


def _random_arcs(
    rng: np.random.Generator, low: float, high: float
) -> list[tuple[float, float]]:
    """Return the curvature (1/m) and the length (m) of each arc of a random path."""
    arcs = []
    left = LENGTH_M
    heading = 0.0
    curvature = 0.0
    while left > _MIN_ARC_M:
        curvature = float(
            rng.choice([value for value in (low, 0.0, high) if value != curvature])
        )
        length = min(float(rng.uniform(*_ARC_LENGTHS_M)), left)
        # The heading is limited because the nearest point of a path that crosses itself
        # is not unique.
        if curvature and abs(heading + curvature * length) > _MAX_HEADING:
            length = (math.copysign(_MAX_HEADING, curvature) - heading) / curvature
        if length > _MIN_ARC_M:
            arcs.append((curvature, length))
            heading += curvature * length
            left -= length
    return arcs


NO_MARGIN = Override("a margin to be measured", ("planner", "margin_probability"), None)
"""Scenario override that removes the margin, because a margin would hide excursions."""


@checked
def calibrate_margin(
    scenario: StrPath | Scenario,
    *,
    out: StrPath | None = None,
    set: Overrides = (),
    runs: int = 100,
    plants: Sequence[str] | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], object] = max,
) -> tuple[ExcursionsFile, ...]:
    """Measure excursions on random paths, as `srs-twin calibrate margin` does.

    Args:
        scenario: name or path of a scenario that follows a plan, or a loaded scenario.
        out: output folder for the footprint file with the excursions, or None to write
            no file.
        set: values that override fields of the scenario, as in `load_scenario`.
        runs: number of runs per plant.
        plants: names of the plants to simulate, by default the plants of the scenario.
        workers: number of processes, by default one per processor.
        progress: function called with the number of finished runs and the total number
            of runs.

    Returns:
        Excursions for each plant.

    Raises:
        InputError: the scenario does not follow a plan, a run failed, or the file
            cannot be written.
    """
    loaded = load_scenario(scenario, set=[*Override.list_of(set), NO_MARGIN])
    kinds = loaded.plants_to_run(plants)
    done = itertools.count(1)
    source = find_file("footprint", loaded.file.section("planner").footprint)
    file = load_footprint_file(source)
    path = None if out is None else Path(out) / f"{file.name}.yaml"
    if path is not None:
        check_output_folder(path.parent, (path.name,))

    def count() -> None:
        progress(next(done), runs * len(kinds))

    measured = tuple(
        measure_excursions(loaded, plant, runs, workers=workers, progress=count)
        for plant in kinds
    )
    if path is not None:
        conditions = [result.conditions for result in measured]
        kept = [
            old for old in file.excursions or () if old.conditions not in conditions
        ]
        comments = [
            line[2:] for line in read_text(source).splitlines() if line.startswith("# ")
        ]
        save_footprint(
            file.model_copy(update={"excursions": [*kept, *measured]}),
            path,
            header=comments,
        )
    return measured


def measure_excursions(
    scenario: Scenario,
    plant: str,
    runs: int,
    *,
    workers: int | None,
    progress: Callable[[], None],
) -> ExcursionsFile:
    """Measure how far the path follower of a scenario leaves the footprint on a plant.

    The seeds of the runs are 0 to `runs` − 1.
    """
    planner = scenario.file.section("planner")
    controller = scenario.controller
    if planner is None or not isinstance(controller, FollowFile):
        raise InputError(
            f"{scenario.name}: the scenario follows no planned path, but a margin"
            " needs one; add the section `planner`, and set `controller.kind: follow`"
        )
    robot = RobotFile.model_validate(scenario.document["robot"])
    settings = {plant: scenario.document["plants"].get(plant, {})}
    section = PlantsFile.model_validate(settings).running[plant]
    contact = getattr(section, "contact", None)
    chambers = scenario.file.pneumatics.kind
    conditions = controller.conditions(plant, contact, chambers, robot, planner)
    straight = {"kind": "given", "turns_rad": [0.0], "step_m": 1.0}
    footprint = {"footprint": planner.footprint, "turn_fraction": planner.turn_fraction}
    document = {
        **scenario.document,
        "world": {},
        "expect": [],
        "planner": straight | footprint,
        "plants": settings,
    }
    jobs = [
        FollowerRun(document, conditions.lead_in_m, plant, seed) for seed in range(runs)
    ]
    lead_in = []
    path = []
    for done in run_tasks(FollowerRun.run, jobs, workers=workers):
        if done.result is None:
            raise InputError(f"{scenario.name}, seed {done.number}: {done.error}")
        during_lead_in, after = done.result
        lead_in.append(round(during_lead_in, _DIGITS))
        path.append(round(after, _DIGITS))
        progress()
    command = f"`srs-twin calibrate margin {scenario.name}`"
    sorted_lead_in = sorted(lead_in) if conditions.lead_in_m else None
    return ExcursionsFile(
        conditions=conditions,
        source=f"{command}: {runs} random paths of {LENGTH_M:g} m",
        path_m=sorted(path),
        lead_in_m=sorted_lead_in,
    )
