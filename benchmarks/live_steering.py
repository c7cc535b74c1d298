"""Faults while a shadow steers a robot: how many goals are reached, and how safely the others end.

    uv run python benchmarks/live_steering.py [--seeds 4] [--scenario NAME]
    [--pneumatics lag] [--json FILE]

Which faults can be steered with is decided here, before any run: sensors and markers
that fail, one stuck valve, a slow leak, a supply with half of its pressure. With an
empty supply, or without motion capture, nobody can steer: there a safe stop is asked
for, clear of obstacles. As many robots without a fault tell how often goals are missed
anyhow. Robot and messages: `live_runs`.
"""

from __future__ import annotations

import argparse
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from common.grid import table

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from live_runs import Run, steered

SCENARIOS = {"orifice": "follow_orifice", "lag": "follow_fig57"}
SINCE = 6.0
LIMIT_S = 90.0
STEERABLE = (
    *(f"dead_sensor:{j}" for j in (1, 2, 3, 4)),
    *(f"dead_sensor:{j}=frozen" for j in (1, 3)),
    *(f"drifting_sensor:{j}" for j in (2, 4)),
    *(f"lost_marker:{j}" for j in (1, 3, 5)),
    "stuck_valve:1+=closed",
    "stuck_valve:2-=closed",
    "stuck_valve:3+=open",
    "stuck_valve:4-=open",
    "stuck_valve:2+=open",
    "stuck_valve:4+=closed",
    "leak:2+",
    "leak:3-",
    "low_supply_pressure",
)
SOUND = "none"
NO_CAMERA = "no camera"
OTHERS = ("low_supply_pressure=empty", NO_CAMERA)
"""Faults with which nobody can steer."""


def main() -> None:
    """Run and print."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--seeds", type=int, default=1, help="robots a fault")
    words.add_argument(
        "--scenario", help="default: that with the footprint of such chambers"
    )
    words.add_argument(
        "--pneumatics",
        default="orifice",
        choices=SCENARIOS,
        help="chambers of the robot",
    )
    words.add_argument("--json", type=Path, metavar="FILE")
    given = words.parse_args()
    scenario = given.scenario or SCENARIOS[given.pneumatics]
    # Chambers that lag do not begin to leak.
    steerable = [
        each
        for each in STEERABLE
        if given.pneumatics == "orifice" or "leak" not in each
    ]
    groups = {
        "with a fault": steerable,
        "nobody can steer": OTHERS,
        "sound": [SOUND] * len(steerable),
    }
    once = [(group, fault) for group, faults in groups.items() for fault in faults]
    kinds = once * given.seeds
    runs = [
        Run(
            100 * seed + k + 1,
            LIMIT_S,
            fault="" if fault in (SOUND, NO_CAMERA) else f"{fault}@{SINCE}",
            robot="gen2",
            frequency=2.0,
            cameras_s=SINCE if fault == NO_CAMERA else LIMIT_S,
            pneumatics=given.pneumatics,
        )
        for seed in range(given.seeds)
        for k, (_, fault) in enumerate(once)
    ]
    with ProcessPoolExecutor() as pool:
        rows = list(pool.map(steered, [(run, scenario) for run in runs]))
    lines = [
        [
            fault,
            str(row["seed"]),
            str(row["ending"]),
            f"{row['time_s']:.0f}",
            f"{1e3 * row['clearance_m']:.0f}",
            "; ".join(f"{what} at {at:.1f} s" for what, at in row["faults"].items())
            or "–",
        ]
        for (_, fault), row in zip(kinds, rows, strict=True)
    ]
    print(
        table(
            ["fault", "seed", "ending", "after, s", "least clearance, mm", "named"],
            lines,
        )
    )
    for group in groups:
        mine = [row for (of, _), row in zip(kinds, rows, strict=True) if of == group]
        goals = sum(row["ending"] == "goal_reached" for row in mine)
        clear = sum(row["clearance_m"] >= 0 for row in mine)
        print(f"{group}: {goals} goals, {clear} clear of obstacles, of {len(mine)}")
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1, default=float) + "\n", "utf-8")


if __name__ == "__main__":
    main()
