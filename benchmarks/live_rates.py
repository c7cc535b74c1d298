"""Coverage of 95 % intervals and processor time of a shadow by the rate of its messages.

    uv run python benchmarks/live_rates.py [--seeds 1] [--first 5200] [--json FILE]

Robot and motion capture send as many messages in a second; the shadow is updated at 50
Hz and its estimate is for the time of the update. Robot and messages are those of
`live_runs`. Figures count from 5 s on. Set OPENBLAS_NUM_THREADS=1: threads that wait
for each other count as processor time.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from grid import table
from live_runs import conditioned, recorded

from srs_twin import load_robot
from srs_twin.live.session import warm_up
from srs_twin.live.shadow import Shadow

RATES_HZ = (5.0, 10.0, 30.0, 50.0, 100.0, 200.0)
SECONDS = 15.0
SETTLED_S = 5.0


def judged(rate: float, seed: int) -> dict[str, Any]:
    """Return coverage, errors and processor time at one rate."""
    recording = recorded(
        conditioned("nominal", seed, SECONDS, rate_hz=rate, camera_hz=rate)
    )
    shadow = Shadow(load_robot("gen4"), seed=seed)
    rows = []
    begun = time.process_time()
    for now, messages in recording.updates:
        found = shadow.update(now, messages)
        if found is not None:
            rows.append(
                np.array(
                    [
                        found.time,
                        *found.bend,
                        *found.pose,
                        *found.bend_sd,
                        *found.pose_sd,
                    ]
                )
            )
    used = (time.process_time() - begun) / SECONDS
    estimate = np.array(rows)
    truth = recording.truth
    estimate = estimate[estimate[:, 0] > SETTLED_S]
    n = truth.shape[1] - 4
    true = np.stack(
        [np.interp(estimate[:, 0], truth[:, 0], truth[:, k]) for k in range(1, n + 4)],
        axis=1,
    )
    off = estimate[:, 1 : n + 4] - true
    sd = estimate[:, n + 4 :]
    inside = np.abs(off) < 1.96 * sd
    return {
        "rate": rate,
        "seed": seed,
        "processor": used,
        "bend": float(np.sqrt(np.mean(off[:, :n] ** 2))),
        "bend_inside": float(inside[:, :n].mean()),
        "place": float(np.sqrt(np.mean((off[:, n : n + 2] ** 2).sum(axis=1)))),
        "pose_inside": float(inside[:, n:].mean()),
    }


def main() -> None:
    """Run and print."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--seeds", type=int, default=1)
    words.add_argument("--first", type=int, default=5200)
    words.add_argument("--json", type=Path, metavar="FILE")
    given = words.parse_args()
    warm_up(load_robot("gen4"))
    rows = []
    lines = []
    for rate in RATES_HZ:
        mine = [
            judged(rate, seed) for seed in range(given.first, given.first + given.seeds)
        ]
        mean = {name: np.mean([row[name] for row in mine]) for name in mine[0]}
        rows += mine
        lines.append(
            [
                f"{rate:g}",
                f"{mean['bend']:.3f}",
                f"{100 * mean['bend_inside']:.0f}",
                f"{1e3 * mean['place']:.1f}",
                f"{100 * mean['pose_inside']:.0f}",
                f"{mean['processor']:.2f}",
            ]
        )
    heads = [
        "Hz",
        "bends, rad",
        "inside, %",
        "place, mm",
        "inside, %",
        "processor, s/s",
    ]
    print(table(heads, lines))
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
