"""The follower of the dissertation and the project's follower in the shipped following scenarios.

    uv run python benchmarks/following.py                              # three fields, 20 seeds each
    uv run python benchmarks/following.py --seeds 2 --scenarios follow_fig57 --json out.json

Each seed draws the modules of generation 4 and the camera noise, for both plants. A run
succeeds if it reaches the goal without contact. Contacts are detected by the obstacle
forces on the twin, and by distance on the analytical model, which obstacles do not
stop. All followers have the same plan, delay and camera.
"""

from __future__ import annotations

import argparse
import copy
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from common.grid import table

from srs_twin.comparison.metrics import plant_metrics
from srs_twin.compute.workers import run_tasks
from srs_twin.io.files import atomic_write
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.metrics import following_metrics, legs
from srs_twin.planning.path import ReferencePath
from srs_twin.rollout import rollout
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.trajectory import Trajectory

FIELDS = ("follow_gen4_a", "follow_gen4_b", "follow_gen4_c")
PLANTS = ("analytical", "twin")
FOLLOWERS = ("bearing", "path")
OF_PATH = ("lookahead_m", "response_length_m")
BEARING = {"gain_per_rad": 0.6, "node_m": 0.4, "near_m": 0.3}
"""Unpublished setting of the dissertation's follower: one of the two best of 18 (docs/course.md)."""
TEXT_BOX = {"gen2": "gen2_section52", "gen4": "gen4_table9"}
"""Robot → bounding box used for planning in the dissertation; the scenarios use the measured footprint."""
LONGEST_S = 60
LEARNT_S = 4
"""Duration of learning and of the run-up, s; later deviations are not caused by learning."""
Order = tuple[str, str, str, int]


def run(order: Order) -> dict[str, Any]:
    """Run one scenario with a follower, a plant and a seed."""
    name, follower, plant, seed = order
    document = copy.deepcopy(dict(load_scenario(name).document)) | {
        "expect": [],
        "seed": seed,
    }
    document["duration_s"] = LONGEST_S
    ours = parse_scenario(document, name=name).planner
    assert ours is not None, "it follows"
    if "margin_probability" in document["planner"]:
        # The setting belongs to the project's follower; both followers have the same
        # plan.
        del document["planner"]["margin_probability"]
        document["planner"]["margin_m"] = round(ours.margin.path, 4)
    controller = document["controller"]
    controller["follower"] = follower
    if follower == "bearing":
        for key in OF_PATH:
            controller.pop(key, None)
        controller.update(BEARING)
    scenario = parse_scenario(document, name=name)
    motion = rollout(
        scenario.build_plant(plant),
        scenario.build_controller(),
        scenario.duration,
        pose=scenario.pose,
        seed=seed,
        record_hz=scenario.record_hz,
    )
    ending = motion.metadata["control"]["following"]["ending"] or "time_out"
    names = (
        "goal_reached",
        "cross_track_rms_m",
        "cross_track_max_m",
        "inside_fraction",
        "contacts",
        "clearance_m",
        "arrival_error_m",
        "arrival_heading_error_rad",
        "following_time_s",
        "replans",
    )
    metrics = plant_metrics(motion)
    return {
        "order": order,
        "ending": ending,
        "inside_text_share": inside_text_fraction(motion, scenario.robot.name),
        "cross_track_later_m": cross_track_later(motion),
    } | {name: metrics[name] for name in names}


def cross_track_later(motion: Trajectory) -> float:
    """Return the largest cross-track error after learning, m; 0 if the run ended before."""
    lateral = [
        np.abs(ReferencePath(leg.segments).coordinates(motion.com[leg.samples])[1])
        for leg in legs(motion)
    ]
    later = np.concatenate(lateral)[motion.time[: sum(map(len, lateral))] > LEARNT_S]
    return float(later.max(initial=0.0))


def inside_text_fraction(motion: Trajectory, robot: str) -> float:
    """Return the fraction of time in which the body is inside the dissertation's box about the path."""
    control = motion.metadata["control"]
    text = control["following"] | {"footprint": asdict(load_footprint(TEXT_BOX[robot]))}
    dissertation_run = replace(
        motion, metadata=motion.metadata | {"control": control | {"following": text}}
    )
    return float(following_metrics(dissertation_run)["inside_fraction"])


def succeeded(row: dict[str, Any]) -> bool:
    """Return whether a run reached the goal without contact."""
    clear = row["clearance_m"] is None or row["clearance_m"] > 0
    return bool(row["goal_reached"]) and (
        clear if row["contacts"] is None else row["contacts"] == 0
    )


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """Return one row of the table, from runs that differ only in their seeds."""
    name, follower, plant, _ = rows[0]["order"]

    def median(metric: str, factor: float = 1.0) -> str:
        known = [row[metric] for row in rows if row[metric] is not None]
        if known:
            return f"{factor * np.median(known):.3g}"
        return "–"

    return [
        name,
        plant,
        follower,
        f"{sum(map(succeeded, rows))} of {len(rows)}",
        str(sum(row["goal_reached"] for row in rows)),
        median("cross_track_rms_m", 1e3),
        f"{1e3 * max(row['cross_track_max_m'] for row in rows):.3g}",
        f"{1e3 * max(row['cross_track_later_m'] for row in rows):.3g}",
        median("inside_fraction", 100),
        median("inside_text_share", 100),
        least_clearance(rows),
        median("arrival_error_m", 1e3),
        median("arrival_heading_error_rad"),
        median("following_time_s"),
        str(sum(row["replans"] for row in rows)),
    ]


def least_clearance(rows: list[dict[str, Any]]) -> str:
    """Return the smallest clearance, mm; a dash if there are no obstacles."""
    known = [row["clearance_m"] for row in rows if row["clearance_m"] is not None]
    if known:
        return f"{1e3 * min(known):.3g}"
    return "–"


HEADINGS = (
    "field",
    "plant",
    "follower",
    "reached without contact",
    "reached",
    "cross-track RMS, median, mm",
    "largest, mm",
    "largest after 4 s, mm",
    "inside, median, %",
    "inside the dissertation's box, %",
    "minimum clearance, mm",
    "distance from the goal, median, mm",
    "heading error, median, rad",
    "time, median, s",
    "new plans, total",
)


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    options.add_argument("--scenarios", nargs="+", default=FIELDS, metavar="NAME")
    options.add_argument("--seeds", type=int, default=20)
    options.add_argument("--plants", nargs="+", default=PLANTS, choices=PLANTS)
    options.add_argument("--followers", nargs="+", default=FOLLOWERS, choices=FOLLOWERS)
    options.add_argument("--workers", type=int, default=2)
    options.add_argument(
        "--json", type=Path, metavar="FILE", help="also write every run to this file"
    )
    selected = options.parse_args()
    orders = [
        (name, follower, plant, seed)
        for name in selected.scenarios
        for plant in selected.plants
        for follower in selected.followers
        for seed in range(selected.seeds)
    ]
    rows: list[dict[str, Any]] = [{}] * len(orders)
    for done in run_tasks(run, orders, workers=selected.workers):
        if done.result is None:
            raise SystemExit(f"{orders[done.number]}: {done.error}")
        rows[done.number] = done.result
    groups = [rows[k : k + selected.seeds] for k in range(0, len(rows), selected.seeds)]
    print(table(HEADINGS, [summary(group) for group in groups]))
    if selected.json:
        with atomic_write(selected.json) as part:
            part.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    import following

    following.main()  # use the module, because workers import `run` from it and not from the main program
