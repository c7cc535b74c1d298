"""Faults of a robot on the air: what its shadow names rightly, how fast, and false alarms.

    uv run python benchmarks/live_faults.py [--seeds 20] [--hours 1] [--json FILE]

The robot and what its messages suffer are those of `live_runs`. A fault is observable from when a healthy
robot, without noise, would have answered otherwise by three times the noise; it is in time within a gait
period of that. Two faults look alike as long as the chambers take turns (one that never vents bends as if the
other one never filled) and may be named together.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from grid import table

from srs_twin.compute.workers import each

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from live_runs import NAMES, alarms, isolated


def main() -> None:
    """Run and print."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--seeds", type=int, default=20)
    words.add_argument("--first", type=int, default=0)
    words.add_argument("--hours", type=float, default=1.0, help="healthy hours, simulated")
    words.add_argument("--json", type=Path, metavar="FILE")
    given = words.parse_args()
    kept: dict[str, Any] = {"faults": [], "alarms": []}
    seeds = range(given.first, given.first + given.seeds)
    for pressures in (True, False):
        orders = [(kind, seed, pressures) for kind in NAMES for seed in seeds]
        found = [done.result or {"fault": done.error} for done in each(isolated, orders)]
        kept["faults"] += found
        lines = []
        for kind in NAMES:
            rows = [row for row in found if row["fault"] == kind]
            shares = [
                f"{sum(row[what] for row in rows)} of {len(rows)}" for what in ("in_time", "among", "right")
            ]
            since = [row["at"] - row["observable"] for row in rows if row["among"]]
            after = f"{np.median(since):.2f}" if since else "–"
            others = str(sum(len(row["others"]) for row in rows))
            lines.append([kind.replace("{j}", "j").replace("{side}", "±"), *shares, after, others])
        print("with pressures" if pressures else "without pressures", flush=True)
        print(table(["fault", "in time", "named", "alone", "after, median, s", "others accused"], lines))
        hour = 600.0
        healthy = [(10_000 + k, hour, pressures) for k in range(round(given.hours * 3600 / hour))]
        accused = [name for done in each(alarms, healthy) for name in done.result or ()]
        kept["alarms"] += [{"pressures": pressures, "named": name} for name in accused]
        print(f"{len(accused)} false alarms in {given.hours:g} healthy hours: {accused}\n", flush=True)
    if given.json:
        given.json.write_text(json.dumps(kept, indent=1, default=float) + "\n", "utf-8")


if __name__ == "__main__":
    main()
