"""Errors of the live twin with each refinement switched off.

    uv run python benchmarks/live_ablation.py [--seeds 2] [--first 5300] [--json FILE]

Robots walk for 30 s; motion capture fails after 20 s. The same messages are given to every version. Figures:
RMS errors of bends and place (from 5 to 20 s, predicted to now), of the place one second ahead, and of the
place after ten seconds without motion capture, as a share of the way.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from grid import table
from live_runs import POSES, conditioned, recorded

from srs_twin import load_robot
from srs_twin.compute.workers import run_tasks
from srs_twin.live.shadow import Shadow

SETTLED_S, BLIND_S, END_S = 5.0, 20.0, 30.0


def _none(*given: Any, **named: Any) -> None:
    """Do nothing."""


def _no_table(shadow: Shadow) -> None:
    shadow.ensemble.rates.update = _none  # type: ignore[method-assign]


def _no_noise_estimate(shadow: Shadow) -> None:
    shadow.ensemble._estimate_noise = _none  # type: ignore[method-assign]


def _no_connection(shadow: Shadow) -> None:
    shadow.ensemble.connection.learn = _none  # type: ignore[method-assign]


def _no_modules(shadow: Shadow) -> None:
    shadow.ensemble.set_modules = _none  # type: ignore[method-assign]


PARTS: dict[str, Callable[[Shadow], None]] = {
    "all": _none,
    "no table of pressure rates": _no_table,
    "noise of frames not estimated": _no_noise_estimate,
    "connection not fitted": _no_connection,
    "modules not estimated": _no_modules,
}


def figures(order: tuple[str, int]) -> dict[str, Any]:
    """Return the errors of one version for one robot."""
    part, seed = order
    recording = recorded(conditioned("nominal", seed, END_S))
    shadow = Shadow(load_robot("gen4"), seed=seed)
    PARTS[part](shadow)
    truth, rows, predictions = recording.truth, [], []
    for time, messages in recording.updates:
        found = shadow.update(time, [m for m in messages if m.kind != POSES or time < BLIND_S])
        if found is None:
            continue
        if SETTLED_S < time < BLIND_S:
            rows.append(np.array([found.time, *found.bend, *found.pose, *found.bend_sd, *found.pose_sd]))
            if round(time * 50) % 25 == 0 and time < BLIND_S - 1:
                predictions.append(shadow.predict())
    n = truth.shape[1] - 4

    def true(times: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(times, truth[:, 0], truth[:, k]) for k in range(1, n + 4)], axis=1)

    table_ = np.array(rows)
    off, sd = table_[:, 1 : n + 4] - true(table_[:, 0]), table_[:, n + 4 :]
    ahead = [np.hypot(*(p.pose[-1, :2] - true(p.time[-1:])[0, n : n + 2])) for p in predictions]
    way = np.hypot(*np.diff(truth[truth[:, 0] >= BLIND_S][:, n + 1 : n + 3], axis=0).T).sum()
    assert found is not None
    blind = np.hypot(*(found.pose[:2] - true(np.array([time]))[0, n : n + 2]))
    return {
        "part": part, "seed": seed, "bend": float(np.sqrt(np.mean(off[:, :n] ** 2))),
        "inside": float(np.mean(np.abs(off) < 1.96 * sd)),
        "place": float(np.sqrt(np.mean((off[:, n : n + 2] ** 2).sum(axis=1)))),
        "ahead": float(np.sqrt(np.mean(np.square(ahead)))), "blind": float(blind / way),
    }  # fmt: skip


def main() -> None:
    """Run and print."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--seeds", type=int, default=2)
    words.add_argument("--first", type=int, default=5300)
    words.add_argument("--json", type=Path, metavar="FILE")
    given = words.parse_args()
    seeds = range(given.first, given.first + given.seeds)
    for seed in seeds:
        recorded(conditioned("nominal", seed, END_S))
    orders = [(part, seed) for part in PARTS for seed in seeds]
    rows = [done.result for done in run_tasks(figures, orders) if done.result]
    lines = []
    for part in PARTS:
        mine = [row for row in rows if row["part"] == part]
        mean = {
            name: np.mean([row[name] for row in mine]) for name in mine[0] if name not in ("part", "seed")
        }
        lines.append([
            part, f"{mean['bend']:.4f}", f"{100 * mean['inside']:.0f}", f"{1e3 * mean['place']:.2f}",
            f"{1e3 * mean['ahead']:.1f}", f"{100 * mean['blind']:.1f}",
        ])  # fmt: skip
    print(table(["part", "bends, rad", "inside, %", "place, mm", "1 s ahead, mm", "blind, %"], lines))
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
