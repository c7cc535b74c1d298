"""What a shadow knows of a robot on the air: bends, pose, predictions, modules; whether intervals hold.

    uv run python benchmarks/live_estimates.py [--seeds 4] [--json FILE]

The robot and what its messages suffer are those of `live_runs`: a gait that turns left
and right for 25 s. Estimates count from 5 s on. The blind cases lose motion capture
after 10, 30 or 60 s; their error is that of the place 10 s later, as a share of the way
since.
"""

from __future__ import annotations

import argparse
import json
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from common.grid import table

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from live_runs import Run, followed_estimate

SECONDS = 25.0
BLIND_FOR_S = 10.0
SETTLED_S = 5.0
CASES: dict[str, dict[str, Any]] = {
    "gen4": {},
    "gen4, no pressures": {"pressures": False},
    "gen4, 0.75 Hz": {"frequency": 0.75},
    "gen4, chambers that lag": {"pneumatics": "lag", "tau_spread": 0.1},
    "gen4, equal chambers that lag": {"pneumatics": "lag"},
    "gen2, 2 Hz": {"robot": "gen2", "frequency": 2.0},
    "gen2, 2 Hz, no pressures": {"robot": "gen2", "frequency": 2.0, "pressures": False},
    "gen4, blind after 10 s": {"cameras_s": 10.0},
    "gen4, blind after 30 s": {"cameras_s": 30.0},
    "gen2, blind after 10 s": {"robot": "gen2", "frequency": 2.0, "cameras_s": 10.0},
    "gen2, blind after 30 s": {"robot": "gen2", "frequency": 2.0, "cameras_s": 30.0},
    "gen2, blind after 60 s": {"robot": "gen2", "frequency": 2.0, "cameras_s": 60.0},
}


def judged(order: tuple[str, int]) -> dict[str, Any]:
    """Return how far one run's estimates and predictions were off."""
    name, seed = order
    since = CASES[name].get("cameras_s")
    run = Run(seed, SECONDS if since is None else since + BLIND_FOR_S, **CASES[name])
    found = followed_estimate(run)
    truth = found["truth"]
    estimate = found["estimate"]
    n = truth.shape[1] - 4

    def true(times: np.ndarray) -> np.ndarray:
        return np.stack(
            [np.interp(times, truth[:, 0], truth[:, k]) for k in range(1, n + 4)],
            axis=1,
        )

    told: dict[str, Any] = {"case": name, "seed": seed}
    if since is not None:
        there = truth[:, 0] >= since
        way = np.hypot(*np.diff(truth[there][:, n + 1 : n + 3], axis=0).T).sum()
        end = estimate[-1]
        off = np.hypot(*(end[n + 1 : n + 3] - true(end[:1])[0, n : n + 2]))
        sd = np.hypot(*end[2 * n + 4 : 2 * n + 6])
        return told | {"blind": float(off / way), "blind_inside": bool(off < 2.45 * sd)}
    late = estimate[:, 0] > SETTLED_S
    off = (estimate[:, 1 : n + 4] - true(estimate[:, 0]))[late]
    sd = estimate[late, n + 4 :]
    inside = np.abs(off) < 1.96 * sd
    told |= {
        "bend": float(np.sqrt(np.mean(off[:, :n] ** 2))),
        "bend_inside": float(inside[:, :n].mean()),
        "pose": float(np.sqrt(np.mean((off[:, n : n + 2] ** 2).sum(axis=1)))),
        "pose_inside": float(inside[:, n:].mean()),
    }
    ahead = [
        p
        for p in found["predictions"]
        if p.begun > SETTLED_S and p.time[-1] < truth[-1, 0]
    ]
    poses = [true(p.time)[:, n:] for p in ahead]
    told["ahead"] = float(
        np.sqrt(
            np.mean(
                [
                    ((t - p.pose)[-1, :2] ** 2).sum()
                    for p, t in zip(ahead, poses, strict=True)
                ]
            )
        )
    )
    told["ahead_inside"] = float(
        np.mean([p.contains(t)[-1].mean() for p, t in zip(ahead, poses, strict=True)])
    )
    # At the time of the newest message, the estimates need no extrapolation.
    filtered = found["filtered"][found["filtered"][:, 0] > SETTLED_S]
    error = filtered[:, 1:] - true(filtered[:, 0])[:, :n]
    told["newest"] = float(np.sqrt(np.mean(error**2)))
    gain, spread = found["known_gain"]
    told["gain"] = float(np.sqrt(np.mean((gain / found["gain"] - 1) ** 2)))
    told["gain_inside"] = float(np.mean(np.abs(gain - found["gain"]) < 1.96 * spread))
    return told


def main() -> None:
    """Run and print."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--seeds", type=int, default=4)
    words.add_argument("--json", type=Path, metavar="FILE")
    given = words.parse_args()
    orders = [(name, seed) for name in CASES for seed in range(1, given.seeds + 1)]
    with ProcessPoolExecutor() as pool:
        rows = list(pool.map(judged, orders))
    lines = []
    for name in CASES:
        mine = [row for row in rows if row["case"] == name]

        def pair(
            what: str, scale: float, digits: int, mine: list[dict[str, Any]] = mine
        ) -> str:
            if what not in mine[0]:
                return "–"
            off = scale * np.mean([row[what] for row in mine])
            return (
                f"{off:.{digits}f}"
                f" ({100 * np.mean([row[what + '_inside'] for row in mine]):.0f} %)"
            )

        lines.append(
            [
                name,
                pair("bend", 1, 3),
                f"{np.mean([row['newest'] for row in mine]):.3f}"
                if "newest" in mine[0]
                else "–",
                pair("pose", 1e3, 1),
                pair("ahead", 1e3, 0),
                pair("gain", 100, 1),
                pair("blind", 100, 0),
            ]
        )
    print("RMS errors, in brackets how many truths lie in the 95 % intervals")
    heads = [
        "robot",
        "bend, rad",
        "at the newest message",
        "pose, mm",
        "1 s ahead, mm",
        "gain, %",
        "blind, %",
    ]
    print(table(heads, lines))
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
