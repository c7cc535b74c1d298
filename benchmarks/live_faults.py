"""Faults of a robot on the air: what its shadow names rightly, how fast, and false alarms.

    uv run python benchmarks/live_faults.py [--seeds 12] [--first 5000] [--hours 1] [--json FILE]

Conditions are those of `live_runs.CONDITIONS`: supplies that droop and wander, robots that differ from
their file, other gaits, poor sensors; `--condition NAME` (repeatable) picks some. A fault is observable from
the time at which a sound robot, without noise, would have answered otherwise by three times the noise; it is
in time within a gait period of that. Two faults look alike as long as the chambers take turns (one that never
vents bends as if the other one never filled) and may be named together. Sound hours are shared equally among
the conditions. SRS_LIVE_RECORDINGS=FOLDER keeps the messages, so that they are simulated once.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from grid import table
from live_runs import CONDITIONS, NAMES, alarms, isolated

from srs_twin.compute.workers import run_tasks

STILL = ("standing", "held bends", "stop and go")
"""Conditions in which faults need not show within a period: false alarms only."""
RUN_S = 120.0


def main() -> None:
    """Run and print."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--seeds", type=int, default=12, help="robots of each kind of fault and condition")
    words.add_argument("--first", type=int, default=5000, help="first seed")
    words.add_argument("--hours", type=float, default=1.0, help="sound hours, simulated, of all conditions")
    words.add_argument("--condition", action="append", choices=CONDITIONS, help="default: all")
    words.add_argument("--json", type=Path, metavar="FILE")
    given = words.parse_args()
    conditions = given.condition or list(CONDITIONS)
    seeds = range(given.first, given.first + given.seeds)
    kinds = tuple(NAMES)
    orders = [(seed, name, kinds) for name in conditions if name not in STILL for seed in seeds]
    done = [row for each_ in run_tasks(isolated, orders) for row in each_.result or ()]
    lines = []
    for condition in conditions:
        for kind in kinds:
            rows = [row for row in done if row["fault"] == kind and row["condition"] == condition]
            if not rows:
                continue
            shares = [
                f"{sum(row[what] for row in rows)} of {len(rows)}" for what in ("in_time", "among", "right")
            ]
            since = [row["at"] - row["observable"] for row in rows if row["among"]]
            after = f"{np.median(since):.2f}" if since else "–"
            others = str(sum(len(row["others"]) for row in rows))
            name = kind.replace("{j}", "j").replace("{side}", "±")
            lines.append([condition, name, *shares, after, others])
    heads = ["condition", "fault", "in time", "named", "alone", "after, median, s", "others accused"]
    print(table(heads, lines), flush=True)
    runs = max(round(given.hours * 3600 / RUN_S / len(conditions)), 1)
    healthy = [
        (given.first + 100 + runs * i + k, RUN_S, name)
        for i, name in enumerate(conditions) for k in range(runs)
    ]  # fmt: skip
    found = [
        {"condition": order[2], "seed": order[0], "named": name}
        for order, ended in zip(healthy, run_tasks(alarms, healthy), strict=True)
        for name in ended.result or ()
    ]  # fmt: skip
    hours = len(healthy) * RUN_S / 3600
    print(f"{len(found)} false alarms in {hours:.2f} sound hours")
    for row in found:
        print(f"  {row['condition']}, seed {row['seed']}: {row['named']}")
    if given.json:
        kept: dict[str, Any] = {"faults": done, "alarms": found}
        given.json.write_text(json.dumps(kept, indent=1, default=float) + "\n", "utf-8")


if __name__ == "__main__":
    main()
