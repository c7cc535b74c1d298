"""Accuracy against cost: which numerical settings are worth what they cost.

    uv run python benchmarks/front.py

Every setting runs the same gaits of generation 2 (1, 1.5, 2 Hz, offset 0 and 0.2; for
the twin at the shipped stiffness and at 20 N·m/rad). Its error is the largest
difference of the mean speed from that of a much finer one, its cost the processor time
of one run over that of the default's, the settings timed in turns.

Contacts of the twin are compared with the values of `load_reference.py` instead, at all
its points with a single axle per connector: largest errors of speed, and of the yaw
rate where a snake turns.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from agreement import MATCHED_STIFFNESS
from grid import Run, run_all, table
from timing import ROUNDS

from srs_twin import LoadedContact, PreloadedContact
from srs_twin.comparison.metrics import plant_metrics

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from load_reference import POINTS, stored, turns
from twin_at_reference import crawled

GAITS = list(product((1.0, 1.5, 2.0), (0.0, 0.2)))
STIFFNESSES = {"analytical": (None,), "twin": (None, MATCHED_STIFFNESS)}
FINEST: dict[str, dict[str, Any]] = {
    "analytical": {"timestep": 0.0001, "slip_speed": 0.00005, "tolerance": 0.00002},
    "twin": {"timestep": 0.000125},
}
SETTINGS: dict[str, list[tuple[str, dict[str, Any]]]] = {
    "analytical": [
        ("2 ms, tolerance 0.2 mm/s, ε 0.25 mm/s (default)", {}),
        *(
            (f"tolerance {1e3 * most:g} mm/s", {"tolerance": most})
            for most in (0.00005, 0.0001, 0.0004, 0.0008)
        ),
        *(
            (f"{1e3 * step:g} ms, no subdivision", {"timestep": step, "tolerance": 1.0})
            for step in (0.001, 0.002)
        ),
        *((f"{1e3 * step:g} ms", {"timestep": step}) for step in (0.001, 0.004)),
        *((f"ε {1e3 * slip:g} mm/s", {"slip_speed": slip}) for slip in (0.0001, 0.001)),
    ],
    "twin": [
        ("1 ms, 2 hinges (default)", {}),
        ("0.5 ms", {"timestep": 0.0005}),
        ("1.25 ms", {"timestep": 0.00125, "tick": 0.02}),
        ("2 ms", {"timestep": 0.002}),
        ("1 hinge", {"hinges_per_segment": 1}),
        ("4 hinges", {"hinges_per_segment": 4}),
        *(
            (f"slip speed {1e3 * v:g} mm/s", {"contact": LoadedContact(slip_speed=v)})
            for v in (0.0005, 0.002)
        ),
        ("preloaded, 1 ms", {"contact": PreloadedContact()}),
    ],
}
CONTACTS: list[tuple[str, dict[str, Any]]] = [
    ("loaded, 1 ms (default)", {}),
    *((f"loaded, {1e3 * step:g} ms", {"timestep": step}) for step in (0.0005, 0.002)),
    ("loaded, 1 ms, 1 hinge", {"hinges_per_segment": 1}),
    ("loaded, 1 ms, 4 hinges", {"hinges_per_segment": 4}),
    *(
        (f"preloaded, {1e3 * step:g} ms", {"contact": "preloaded", "timestep": step})
        for step in (0.001, 0.002)
    ),
    ("loaded, 1 ms, static loads", {"contact": LoadedContact(load="static")}),
]


def main() -> None:
    """Print one table a plant, and one of the contacts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    tables = [*SETTINGS, "contacts"]
    parser.add_argument(
        "--only", nargs="+", choices=tables, default=tables, help="which tables"
    )
    for plant in parser.parse_args().only:
        if plant == "contacts":
            _contacts()
            continue
        settings = SETTINGS[plant]
        fine = _speeds(run_all(_runs(plant, FINEST[plant])))
        costs = _costs({name: _runs(plant, options)[-1] for name, options in settings})
        rows = []
        for name, options in settings:
            errors = 100 * (_speeds(run_all(_runs(plant, options))) / fine - 1)
            cost = costs[name] / costs[settings[0][0]]
            worst = np.abs(errors).max()
            rms = np.sqrt((errors**2).mean())
            rows.append([name, f"{cost:.2f}", f"{worst:.2f}", f"{rms:.2f}"])
        print(f"\n{plant}\n")
        print(
            table(["setting", "cost", "largest error, %", "RMS error, %"], rows),
            flush=True,
        )


def _contacts() -> None:
    names = [name for name, point in POINTS.items() if point.tail is None]
    runs = {
        label: Run("twin", supply_pa=48.3e3, offset=0.4, options=more)
        for label, more in CONTACTS
    }
    costs = _costs(runs)
    rows = []
    values = stored()
    with ProcessPoolExecutor() as pool:
        for label, options in CONTACTS:
            results = [pool.submit(crawled, name, **options) for name in names]
            both = [
                (item.result(), values[name])
                for item, name in zip(results, names, strict=True)
            ]
            speed = 100 * np.array([a.speed_mm_s / b.speed[0] - 1 for a, b in both])
            turn = 100 * np.array(
                [a.yaw_rate / b.yaw[0] - 1 for a, b in both if turns(b)]
            )
            cells = [
                f"{np.abs(errors).max():.1f} ({np.sqrt((errors**2).mean()):.1f})"
                for errors in (speed, turn)
            ]
            rows.append([label, f"{costs[label] / costs[CONTACTS[0][0]]:.2f}", *cells])
            print(
                label,
                *(f"{n} {a:+.1f}" for n, a in zip(names, speed, strict=True)),
                file=sys.stderr,
            )
    print(
        table(["contact", "cost", "speed: largest (RMS) error, %", "yaw rate"], rows),
        flush=True,
    )


def _runs(plant: str, options: dict[str, Any]) -> list[Run]:
    if plant == "analytical":
        friction = {"friction": "wheel"}
    else:
        friction = {}
    return [
        Run(
            plant,
            frequency=f,
            offset=o,
            supply_pa=48.3e3,
            stiffness=k,
            duration=8.0,
            options=friction | options,
        )
        for k in STIFFNESSES[plant]
        for f, o in GAITS
    ]


def _costs(runs: dict[str, Run]) -> dict[str, float]:
    """Return the processor time of each run, s: the median of rounds in which they take turns."""
    taken: dict[str, list[float]] = {name: [] for name in runs}
    plants = {name: run.build() for name, run in runs.items()}
    for k in range(ROUNDS + 1):
        for name, run in runs.items():
            begun = time.process_time()
            run.trajectory(plants[name])
            if k:  # the first round compiles and loads
                taken[name].append(time.process_time() - begun)
    return {name: statistics.median(times) for name, times in taken.items()}


def _speeds(trajectories: list[Any]) -> np.ndarray:
    return np.array([plant_metrics(item)["com_speed_m_s"] for item in trajectories])


if __name__ == "__main__":
    main()
