"""Faults while a shadow steers a robot: how many goals are reached, and how safely the others end.

    uv run python benchmarks/live_steering.py [--scenario NAME] [--pneumatics lag] [--json FILE]

Which faults can be steered with is decided here, before any run: sensors and markers that fail, one stuck
valve, a slow leak, a supply with half of its pressure. With an empty supply, or without motion capture,
nobody can steer: there a safe stop is asked for, clear of obstacles. Robot and messages: `live_runs`.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from grid import table
from live_runs import Run, steered

SCENARIOS = {"orifice": "follow_orifice", "lag": "follow_fig57"}
SINCE, LIMIT_S = 6.0, 90.0
STEERABLE = (
    *(f"dead_sensor:{j}" for j in (1, 2, 3, 4)), *(f"dead_sensor:{j}=frozen" for j in (1, 3)),
    *(f"drifting_sensor:{j}" for j in (2, 4)), *(f"lost_marker:{j}" for j in (1, 3, 5)),
    "stuck_valve:1+=closed", "stuck_valve:2-=closed", "stuck_valve:3+=open", "stuck_valve:4-=open",
    "stuck_valve:2+=open", "stuck_valve:4+=closed", "leak:2+", "leak:3-", "starved",
)  # fmt: skip
OTHERS = ("starved=empty", "")
"""Faults with which nobody can steer; the empty one: motion capture fails."""


def main() -> None:
    """Run and print."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--scenario", help="default: that with the footprint of such chambers")
    words.add_argument("--pneumatics", default="orifice", choices=SCENARIOS, help="chambers of the robot")
    words.add_argument("--json", type=Path, metavar="FILE")
    given = words.parse_args()
    scenario = given.scenario or SCENARIOS[given.pneumatics]
    # Chambers that lag do not begin to leak.
    steerable = [each for each in STEERABLE if given.pneumatics == "orifice" or "leak" not in each]
    runs = [
        Run(
            k + 1, LIMIT_S, fault=fault and f"{fault}@{SINCE}", robot="gen2", frequency=2.0,
            cameras_s=LIMIT_S if fault else SINCE, pneumatics=given.pneumatics,
        )
        for k, fault in enumerate((*steerable, *OTHERS))
    ]  # fmt: skip
    with ProcessPoolExecutor() as pool:
        rows = list(pool.map(steered, [(run, scenario) for run in runs]))
    lines = [
        [
            row["fault"] or "no camera", str(row["ending"]), f"{row['time_s']:.0f}",
            f"{1e3 * row['clearance_m']:.0f}",
            "; ".join(f"{what} at {at:.1f} s" for what, at in row["faults"].items()) or "–",
        ]
        for row in rows
    ]  # fmt: skip
    print(table(["fault", "ending", "after, s", "least clearance, mm", "named"], lines))
    goals = [row for row in rows[: len(steerable)] if row["ending"] == "goal_reached"]
    clear = sum(row["clearance_m"] >= 0 for row in rows)
    print(f"{len(goals)} of {len(steerable)} goals, {clear} of {len(rows)} clear of obstacles")
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1, default=float) + "\n", "utf-8")


if __name__ == "__main__":
    main()
