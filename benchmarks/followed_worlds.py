"""Following of plans in six kinds of solvable worlds, by snakes with unequal modules.

    uv run python benchmarks/followed_worlds.py [--worlds 100] [--spread 0.1] [--robots
    gen2 gen4]

If `--spread` exceeds the spread of the scenario, plans are still made with the margin
for the scenario. Each world has its own seed, which draws the modules, the camera noise
(twice that of the scenario) and the world. A run succeeds if it reaches the goal
without contact. Contacts are detected by MuJoCo on the twin, and on both plants by
polygons through the recorded connectors. A refused plan counts as a failure.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from common.grid import table

from srs_twin.comparison.contacts import contact_metrics
from srs_twin.compute.workers import run_tasks
from srs_twin.planning.metrics import beyond, following_metrics
from srs_twin.rollout import rollout
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.trajectory import Trajectory

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from witnessed_worlds import KINDS, Witnessed, drawn

SCENARIOS = {"gen2": "follow_fig57", "gen4": "follow_gen4_a"}
PLANTS = ("analytical", "twin")
Order = tuple[str, str, int, float]


def run(order: Order) -> dict[str, Any]:
    """Follow the plan in one world."""
    robot, plant, seed, spread = order
    document = copy.deepcopy(dict(load_scenario(SCENARIOS[robot]).document))
    document |= {
        "expect": [],
        "seed": seed,
        "start": {"x_m": 0.0, "y_m": 0.0, "heading_rad": 0.0},
    }
    planner = parse_scenario(document).planner
    assert planner is not None, "it follows"
    # No deviations were measured under the conditions below, so plans are made with the
    # margin for the conditions of the scenario.
    del document["planner"]["margin_probability"]
    document["planner"]["margin_m"] = planner.margin.path
    for key in ("position_noise_m", "heading_noise_rad"):
        document["controller"]["camera"][key] *= 2
    document["robot"]["modules"]["gain_spread"]["value"] = spread
    kind = list(KINDS)[seed % len(KINDS)]
    lead_in = getattr(planner.file, "lead_in_m", 0.0)
    case = drawn(
        kind,
        seed,
        planner.problem.footprint,
        lead_in,
        planner.margin.lead_in - planner.margin.path,
    )
    document["world"] = _world(case)
    scenario = parse_scenario(document)
    results = {
        "order": order,
        "kind": kind,
        "ending": "no_plan",
        "succeeded": False,
        "touched": False,
    }
    assert scenario.planner is not None, "it follows"
    plan = scenario.planner.plan()
    if not plan.found:
        return results
    duration = float(math.ceil(20 + 2 * plan.length / min(planner.footprint.speeds)))
    motion = rollout(
        scenario.build_plant(plant),
        scenario.build_controller(),
        duration,
        pose=scenario.pose,
        seed=seed,
        record_hz=scenario.record_hz,
    )
    metrics = following_metrics(motion)
    touched = touches(motion, case) or bool(contact_metrics(motion)["contacts"])
    # Steering has no effect during the run-up, so it has a separate margin.
    begun = [
        e.time
        for e in motion.events
        if e.kind in ("replanned", "no_new_plan") and "run_up" in e.text
    ]
    later = motion.time >= (begun[0] if begun else math.inf if lead_in else 0.0)
    return results | {
        "ending": motion.metadata["control"]["following"]["ending"] or "time_out",
        "touched": touched,
        "succeeded": bool(metrics["goal_reached"]) and not touched,
        "inside": bool((beyond(motion)[later] <= 0).all()),
        "clearance_m": contact_metrics(motion)["clearance_m"],
        "replans": metrics["replans"],
        "realtime": motion.metadata.get("realtime_factor"),
    }


def _world(case: Witnessed) -> dict[str, Any]:
    world = case.problem.world
    goal = case.problem.goal
    assert world.bounds is not None, "drawn with bounds"
    return {
        "bounds": {"x_m": list(world.bounds.x), "y_m": list(world.bounds.y)},
        "obstacles": [
            {"x_m": c.x, "y_m": c.y, "radius_m": c.radius} for c in world.obstacles
        ],
        "polygons": [
            {"corners_m": [list(corner) for corner in p.corners]}
            for p in world.polygons
        ],
        "goal": {
            "x_m": goal.x,
            "y_m": goal.y,
            "heading_rad": math.remainder(goal.heading or 0.0, 2 * math.pi),
            "radius_m": max(goal.radius, 0.05),
            "heading_tolerance_rad": goal.heading_tolerance,
        },
    }


def touches(motion: Trajectory, case: Witnessed) -> bool:
    """Return whether the body, straight between adjacent connectors, ever overlaps an obstacle."""
    body = shapely.buffer(
        shapely.linestrings(motion.position),
        motion.metadata["body_width_m"] / 2 - 1e-3,
        cap_style="flat",
    )
    things = [
        shapely.Point(c.x, c.y).buffer(c.radius) for c in case.problem.world.obstacles
    ]
    things += [shapely.Polygon(p.corners) for p in case.problem.world.polygons]
    return bool(shapely.intersects(body, shapely.union_all(things)).any())


def main() -> None:
    """Follow all plans and print the table."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--worlds", type=int, default=100)
    words.add_argument("--first", type=int, default=0)
    words.add_argument("--spread", type=float, default=0.1)
    words.add_argument(
        "--robots", nargs="+", choices=SCENARIOS, default=list(SCENARIOS)
    )
    words.add_argument("--plants", nargs="+", choices=PLANTS, default=PLANTS)
    words.add_argument(
        "--json", type=Path, metavar="FILE", help="also write every run to this file"
    )
    options = words.parse_args()
    seeds = range(options.first, options.first + options.worlds)
    orders = [
        (r, p, seed, options.spread)
        for r in options.robots
        for p in options.plants
        for seed in seeds
    ]
    rows: list[dict[str, Any]] = []
    for done in run_tasks(run, orders):
        if done.result is None:
            raise SystemExit(f"{orders[done.number]}: {done.error}")
        rows.append(done.result)
    lines = []
    for robot in options.robots:
        for plant in options.plants:
            some = [row for row in rows if row["order"][:2] == (robot, plant)]
            lines.append([robot, plant, *summary(some)])
    print(table(HEADINGS, lines))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")


HEADINGS = (
    "robot",
    "plant",
    "reached without contact",
    "touched",
    "no plan",
    "other endings",
    "inside the margin",
    "new plans, median",
    "minimum clearance, mm",
)


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """Return one row of the table."""
    ran = [row for row in rows if row["ending"] != "no_plan"]
    known = [row["clearance_m"] for row in ran if row["clearance_m"] is not None]
    return [
        f"{sum(row['succeeded'] for row in rows)} of {len(rows)}",
        str(sum(row["touched"] for row in rows)),
        str(len(rows) - len(ran)),
        str(sum(row["ending"] != "goal_reached" for row in ran)),
        f"{sum(row['inside'] for row in ran)} of {len(ran)}",
        f"{np.median([row['replans'] for row in ran]):g}",
        f"{1000 * min(known):.0f}",
    ]


if __name__ == "__main__":
    import followed_worlds

    followed_worlds.main()  # use the module, because workers import `run` from it
