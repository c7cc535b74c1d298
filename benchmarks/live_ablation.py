"""Errors and detected faults of the live twin with each refinement switched off.

    uv run python benchmarks/live_ablation.py [--seeds 3] [--first 6300] [--rows FILE]

Refinements of the estimate: robots walk for 30 s; motion capture fails after 20 s.
Figures are RMS errors of bends and position (from 5 to 20 s, predicted to now), of the
position one second ahead, and of the position after ten seconds without motion capture,
as a share of the distance. With poor cameras, seven times as noisy as assumed, only the
bends and their coverage change.

Refinements of the fault detector: faults and false alarms as in `live_faults`, under
`CONDITIONS`.

All versions of a robot get the same messages. FILE is that of `live_faults`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from grid import table
from live_faults import SLOW_LEAK, missing

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from live_runs import NAMES, POSES, alarms, conditioned, isolated, recorded, unchanged

from srs_twin import load_robot
from srs_twin.live import emulator, fault_detector, fault_hypotheses
from srs_twin.live.fault_detector import FaultDetector
from srs_twin.live.fault_hypotheses import HYPOTHESES
from srs_twin.live.shadow import Shadow

SETTLED_S = 5.0
BLIND_S = 20.0
END_S = 30.0
CONDITIONS = {"n": "nominal", "w": "wander", "p": "no pressures", "s": "poor sensors"}
ALARMS_S = 60.0
POOR_CAMERAS_M = 0.002
Part = Callable[[Shadow], None]


def _none(*given: Any, **named: Any) -> None:
    """Do nothing."""


def _never(*given: Any) -> bool:
    return False


def _no_likelihoods(time: float, pressure: np.ndarray, *given: Any) -> np.ndarray:
    return np.zeros((*pressure.shape, len(HYPOTHESES)))


def _no_table(shadow: Shadow) -> None:
    shadow.ensemble.rates.update = _none  # type: ignore[method-assign]


def _no_noise_estimate(shadow: Shadow) -> None:
    shadow.ensemble._estimate_noise = _none  # type: ignore[method-assign]


def _no_connection(shadow: Shadow) -> None:
    shadow.ensemble.odometry.connection.learn = _none  # type: ignore[method-assign]


def _no_modules(shadow: Shadow) -> None:
    shadow.ensemble.set_modules = _none  # type: ignore[method-assign]


def _no_sensor_errors(shadow: Shadow) -> None:
    with ExitStack() as changed:
        for name in ("_OFFSET_SD_RAD", "_SCALE_SD"):
            changed.enter_context(patch.object(fault_detector, name, 1e-4))
        shadow.faults = FaultDetector(
            shadow.spec, supply_pa=shadow.faults.supply.nominal
        )


def _no_levels(shadow: Shadow) -> None:
    shadow.faults._levels.update = _none  # type: ignore[method-assign]


def _no_balances(shadow: Shadow) -> None:
    shadow.faults.leaks.update = _no_likelihoods  # type: ignore[method-assign,assignment]


def _no_supply(shadow: Shadow) -> None:
    shadow.faults.supply.update = _none  # type: ignore[method-assign]


def _no_sudden_change(shadow: Shadow) -> None:
    shadow.faults.supply.follow_sudden_change = _never  # type: ignore[method-assign,assignment]


def _no_lost_commands(shadow: Shadow) -> None:
    shadow.faults.inflate = _none  # type: ignore[method-assign]


ESTIMATE_PARTS: dict[str, tuple[str, Part]] = {
    "nothing": ("good", unchanged),
    "learnt rates of the pressures": ("good", _no_table),
    "fit of the local connection": ("good", _no_connection),
    "estimate of the modules": ("good", _no_modules),
    "states for sensor errors": ("good", _no_sensor_errors),
    "nothing, poor cameras": ("poor", unchanged),
    "noise of frames, poor cameras": ("poor", _no_noise_estimate),
}
"""Refinement that is switched off: cameras, and the function that switches it off."""
_OFFSET_WALK = (fault_detector, "_OFFSET_WALK", 1e-5)
_PATIENCE = (fault_hypotheses, "_PATIENCE_FACTOR", 1.0)
DETECTOR_PARTS: dict[str, tuple[Part, Sequence[tuple[Any, str, Any]], str]] = {
    "nothing": (unchanged, (), "nwps"),
    "states for sensor errors": (_no_sensor_errors, [_OFFSET_WALK], "nws"),
    "learnt levels of the pressures": (_no_levels, (), "nw"),
    "balances of air": (_no_balances, (), "nw"),
    "supply pressure from the strokes": (_no_supply, (), "nw"),
    "sudden changes of the supply": (_no_sudden_change, (), "nw"),
    "lost commands": (_no_lost_commands, (), "nwp"),
    "longer time for several suspects": (unchanged, [_PATIENCE], "nwp"),
}
"""Part that is switched off: function that does so, changed constants, and initials of the conditions."""


def outcome(order: tuple[str, int, str]) -> dict[str, Any]:
    """Return the figures of one version and robot."""
    what, seed, condition = order
    row: dict[str, Any] = {"what": what, "seed": seed, "condition": condition}
    kind, part = what.split(": ")
    if kind == "estimate":
        return row | errors(part, seed)
    prepare, constants, _ = DETECTOR_PARTS[part]
    with ExitStack() as changed:
        for constant in constants:
            changed.enter_context(patch.object(*constant))
        rows = isolated((seed, condition, tuple(NAMES)), prepare)
        false = alarms((seed + 50, ALARMS_S, condition), prepare)
    return row | {"rows": rows, "alarms": false}


def errors(part: str, seed: int) -> dict[str, float]:
    """Return the errors of one version for one robot."""
    cameras, prepare = ESTIMATE_PARTS[part]
    run = conditioned("nominal", seed, END_S)
    if cameras == "poor":
        noise = POOR_CAMERAS_M
    else:
        noise = emulator._CAMERA_NOISE_M
    with patch.object(emulator, "_CAMERA_NOISE_M", noise):
        recording = recorded(run)
    shadow = Shadow(load_robot("gen4"), seed=seed)
    prepare(shadow)
    truth = recording.truth
    rows = []
    predictions = []
    for time, messages in recording.updates:
        found = shadow.update(
            time, [m for m in messages if m.kind != POSES or time < BLIND_S]
        )
        if found is None:
            continue
        if SETTLED_S < time < BLIND_S:
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
            if round(time * 50) % 25 == 0 and time < BLIND_S - 1:
                predictions.append(shadow.predict())
    n = truth.shape[1] - 4

    def true(times: np.ndarray) -> np.ndarray:
        return np.stack(
            [np.interp(times, truth[:, 0], truth[:, k]) for k in range(1, n + 4)],
            axis=1,
        )

    estimate = np.array(rows)
    error = estimate[:, 1 : n + 4] - true(estimate[:, 0])
    sd = estimate[:, n + 4 :]
    ahead = [
        np.hypot(*(p.pose[-1, :2] - true(p.time[-1:])[0, n : n + 2]))
        for p in predictions
    ]
    distance = np.hypot(
        *np.diff(truth[truth[:, 0] >= BLIND_S][:, n + 1 : n + 3], axis=0).T
    ).sum()
    assert found is not None
    blind = np.hypot(*(found.pose[:2] - true(np.array([time]))[0, n : n + 2]))
    inside = np.abs(error) < 1.96 * sd
    return {
        "bend": float(np.sqrt(np.mean(error[:, :n] ** 2))),
        "bend_inside": float(np.mean(inside[:, :n])),
        "pose_inside": float(np.mean(inside[:, n:])),
        "place": float(np.sqrt(np.mean((error[:, n : n + 2] ** 2).sum(axis=1)))),
        "ahead": float(np.sqrt(np.mean(np.square(ahead)))),
        "blind": float(blind / distance),
    }


def report(done: Sequence[dict[str, Any]]) -> None:
    """Print both tables."""
    lines = []
    for part in ESTIMATE_PARTS:
        mine = [row for row in done if row["what"] == f"estimate: {part}"]
        if mine:
            mean = {
                name: np.mean([row[name] for row in mine])
                for name in mine[0]
                if name in _FIGURES
            }
            lines.append(
                [
                    part,
                    *(
                        f"{scale * mean[name]:.{digits}f}"
                        for name, (scale, digits) in _FIGURES.items()
                    ),
                ]
            )
    heads = [
        "removed",
        "bends, rad",
        "inside, %",
        "position, mm",
        "inside, %",
        "1 s ahead, mm",
        "blind, %",
    ]
    print(table(heads, lines))
    lines = []
    for part in DETECTOR_PARTS:
        mine = [row for row in done if row["what"] == f"faults: {part}"]
        for condition in CONDITIONS.values():
            some = [row for row in mine if row["condition"] == condition]
            rows = [row for each in some for row in each["rows"]]
            cells = [
                [row for row in rows if (row["fault"] == SLOW_LEAK) == slow]
                for slow in (False, True)
            ]
            if rows:
                lines.append(
                    [
                        part,
                        condition,
                        *(
                            f"{sum(row['in_time'] for row in cell)} of {len(cell)}"
                            for cell in cells
                        ),
                        str(sum(len(row["others"]) for row in rows)),
                        str(sum(len(each["alarms"]) for each in some)),
                    ]
                )
    heads = [
        "removed",
        "condition",
        "in time",
        "slow leaks in time",
        "other parts",
        "false alarms",
    ]
    print(table(heads, lines))


_FIGURES = {
    "bend": (1, 4),
    "bend_inside": (100, 0),
    "place": (1e3, 2),
    "pose_inside": (100, 0),
    "ahead": (1e3, 1),
    "blind": (100, 1),
}


def main() -> None:
    """Run and print."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--seeds", type=int, default=3)
    words.add_argument("--first", type=int, default=6300)
    words.add_argument(
        "--rows", type=Path, metavar="FILE", help="file of finished runs, JSON lines"
    )
    given = words.parse_args()
    report(list(missing(planned(given.first, given.seeds), given.rows, outcome)))


def planned(first: int, seeds: int) -> list[tuple[str, int, str]]:
    """Return all orders."""
    every = range(first, first + seeds)
    orders = [
        (f"estimate: {part}", seed, "nominal")
        for seed in every
        for part in ESTIMATE_PARTS
    ]
    return orders + [
        (f"faults: {part}", seed, CONDITIONS[initial])
        for seed in every
        for part, (*_, initials) in DETECTOR_PARTS.items()
        for initial in initials
    ]


if __name__ == "__main__":
    main()
