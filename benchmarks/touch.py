"""Plans that lean on obstacles and plans that keep clear, in fields with gaps narrower than the footprint.

    uv run python benchmarks/touch.py [--fields 12] [--first 100]

Two rows of posts cross the room. All gaps are 75 to 95 mm wide; the straight footprint
of generation 2 is 100 mm wide and its body 40 mm. In the fields with a detour, one gap
of each row is 250 mm wide. Robots have modules with a gain spread of 10 %. A run
succeeds if the centre of mass reaches the goal within 60 s. Seeds below 100 served to
choose the settings.
"""

from __future__ import annotations

import argparse
import math
from typing import Any

import numpy as np
from grid import table

from srs_twin.comparison.contacts import obstacle_force
from srs_twin.compute.workers import run_tasks
from srs_twin.planning.metrics import following_metrics
from srs_twin.rollout import rollout
from srs_twin.scenario.loading import parse_scenario

PLANTS = ("analytical", "twin")
PLANNERS = {
    "clear, 10 mm margin": {"margin_m": 0.01},
    "clear, no margin": {"margin_m": 0.0},
    "touch": {"margin_m": 0.01, "contact": "allowed"},
}
GAPS_M = (0.075, 0.095)
DETOUR_M = 0.25
RADII_M = (0.04, 0.08)
ROWS_X_M = (0.5, 1.2)
ROOM_Y_M = 0.8
DURATION_S = 60.0

Order = tuple[bool, str, str, int]


def posts(x: float, detour: bool, rng: np.random.Generator) -> list[dict[str, float]]:
    """Return a row of posts across the room with random radii and gaps."""
    wide = int(rng.integers(6)) if detour else -1
    row = []
    y = -ROOM_Y_M - rng.uniform(0.0, 0.1)
    while y < ROOM_Y_M:
        radius = rng.uniform(*RADII_M)
        row.append({"x_m": x, "y_m": y + radius, "radius_m": radius})
        y += 2 * radius + (DETOUR_M if len(row) - 1 == wide else rng.uniform(*GAPS_M))
    return row


def field(detour: bool, planner: str, seed: int) -> dict[str, Any]:
    """Return the scenario of a field."""
    rng = np.random.default_rng((seed, detour))
    obstacles = [post for x in ROWS_X_M for post in posts(x, detour, rng)]
    # The posts touch the room's sides, so nothing passes between a row and the bounds.
    bounds = {"x_m": [-0.7, 2.2], "y_m": [-ROOM_Y_M, ROOM_Y_M]}
    goal = {"x_m": 1.75, "y_m": float(rng.uniform(-0.3, 0.3)), "radius_m": 0.08}
    return {
        "robot": {"base": "gen2", "modules": {"gain_spread": 0.1}},
        "duration_s": DURATION_S,
        "seed": seed,
        "record_hz": 50,
        "supply": {"pressure_kpa": 48.3},
        "start": {"x_m": -0.3, "y_m": 0.0, "heading_rad": 0.0},
        "world": {"bounds": bounds, "obstacles": obstacles, "goal": goal},
        "planner": {
            "kind": "best_first",
            "footprint": "gen2_gait",
            "turn_fraction": 0.5,
            "lead_in_m": 0.3,
            **PLANNERS[planner],
        },
        "controller": {
            "kind": "follow",
            "follower": "path",
            "gait": {"kind": "gait", "frequency_hz": 2.0},
            "camera": {
                "rate_hz": 120,
                "position_noise_m": 0.001,
                "heading_noise_rad": 0.005,
            },
            "delay_s": 0.1,
            "lookahead_m": 0.1,
            "response_length_m": 0.035,
            "replan_beyond_m": 0.1,
            "replans": 10,
        },
        "plants": {
            "analytical": {
                "model": "compliant",
                "friction": "ellipse",
                "load": "instantaneous",
                "contact": True,
            },
            "twin": {"hinges_per_segment": 3},
        },
    }


def run(order: Order) -> dict[str, Any]:
    """Plan and follow in one field."""
    detour, planner, plant, seed = order
    scenario = parse_scenario(field(detour, planner, seed))
    assert scenario.planner is not None, "it follows"
    plan = scenario.planner.plan()
    result: dict[str, Any] = {
        "order": order,
        "planned": plan.found,
        "ms": 1e3 * plan.seconds,
        "reached": False,
    }
    if not plan.found:
        return result
    motion = rollout(
        scenario.build_plant(plant),
        scenario.build_controller(),
        DURATION_S,
        pose=scenario.pose,
        seed=seed,
        record_hz=scenario.record_hz,
    )
    metrics = following_metrics(motion)
    force = obstacle_force(motion)
    assert force is not None, "there are obstacles"
    body = scenario.planner.footprint
    speed = scenario.planner.footprint.at(0.0).speed
    # Every point of the body passes the obstacle once.
    lengths = [
        (t.force, t.end - t.begin + body.ahead + body.behind)
        for t in plan.touches or ()
    ]
    return result | {
        "reached": bool(metrics["goal_reached"]),
        "ending": motion.metadata["control"]["following"]["ending"],
        "seconds": metrics["following_time_s"],
        "length": plan.length,
        "contact_s": metrics["contact_time_s"],
        "overlap_m": max(0.0, -metrics["clearance_m"]),
        "impulse": float(force.sum() / scenario.record_hz),
        "estimated_impulse": math.fsum(
            mean * length / speed for mean, length in lengths
        ),
    }


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """Return one row of the table."""
    ran = [r for r in rows if r["planned"]]
    reached = [r for r in rows if r["reached"]]

    def median(key: str, among: list[dict[str, Any]], digits: int) -> str:
        if among:
            return f"{np.median([r[key] for r in among]):.{digits}f}"
        return "–"

    return [
        f"{len(ran)} of {len(rows)}",
        f"{len(reached)} of {len(rows)}",
        median("length", reached, 2),
        median("seconds", reached, 1),
        median("contact_s", reached, 1),
        median("impulse", reached, 2),
        median("estimated_impulse", reached, 2),
        f"{1e3 * max((r['overlap_m'] for r in ran), default=0):.1f}",
        median("ms", rows, 0),
    ]


HEADINGS = (
    "detour",
    "planner",
    "plant",
    "planned",
    "reached",
    "path, m",
    "time, s",
    "contact, s",
    "impulse, N s",
    "estimated impulse, N s",
    "largest penetration, mm",
    "planning, ms",
)


def main() -> None:
    """Run all fields and print the table."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--fields", type=int, default=12)
    words.add_argument("--first", type=int, default=100)
    words.add_argument(
        "--planners", nargs="+", choices=PLANNERS, default=list(PLANNERS)
    )
    options = words.parse_args()
    seeds = range(options.first, options.first + options.fields)
    groups = [
        (d, name, p) for d in (False, True) for name in options.planners for p in PLANTS
    ]
    orders = [(*group, seed) for group in groups for seed in seeds]
    rows: list[dict[str, Any]] = []
    for done in run_tasks(run, orders):
        if done.result is None:
            raise SystemExit(f"{orders[done.number]}: {done.error}")
        rows.append(done.result)
    lines = []
    for group in groups:
        some = [row for row in rows if row["order"][:3] == group]
        lines.append(["yes" if group[0] else "no", *group[1:], *summary(some)])
        for row in some:
            if row["planned"] and not row["reached"]:
                print(f"{row['order']}: {row['ending'] or 'time_out'}")
    print(table(HEADINGS, lines))


if __name__ == "__main__":
    import touch

    touch.main()  # use the module, because workers import `run` from it
