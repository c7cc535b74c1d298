"""Accuracy and cost of candidate presets of the twin: error of each metric by time step and hinges.

    uv run python benchmarks/presets.py

The shipped gait scenarios, with 8 s or five periods each, are compared with a time step
of 0.0625 ms, two hinges per segment and the same contact. The cost is the processor
time relative to the default, as the minimum over rounds in which all settings are timed
in turns. Steps above 2 ms are refused, because the damping time c/k of the segments is
2.14 ms.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from common.grid import table
from common.timing import ROUNDS

from srs_twin import rollout
from srs_twin.plants.twin.mjcf.numerics import PRESETS, ModelSettings
from srs_twin.scenario.loading import load_scenario

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from preset_errors import FINE_S, METRICS, Settings, errors, measured

SCENARIOS = [
    "gen1_straight",
    "gen2_straight",
    "gen2_turn",
    "gen3_straight",
    "gen3_turn",
    "gen4_straight",
    "gen4_turn",
]
STEPS_S = {
    "loaded": (0.001, 0.00025, 0.0005, 0.00125, 0.002),
    "preloaded": (0.001, 0.002),
}


def costs(settings: Sequence[Settings]) -> np.ndarray:
    """Return the processor time of each setting relative to the first."""
    scenario = load_scenario("gen2_turn")
    plants = [scenario.build_plant("twin", **item) for item in settings]
    taken = np.zeros((ROUNDS + 1, len(plants)))
    for turn, (k, plant) in product(range(ROUNDS + 1), enumerate(plants)):
        begun = time.process_time()
        rollout(plant, scenario.build_controller(), 8.0)
        taken[turn, k] = time.process_time() - begun
    least = taken[1:].min(axis=0)  # the first round compiles and loads
    return np.asarray(least / least[0])


def main() -> None:
    """Print a table of the candidates, and a table of the default and the presets by metric."""
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    candidates: list[dict[str, Any]] = [
        {"contact": contact, "timestep": step, "hinges_per_segment": hinges}
        for contact, steps in STEPS_S.items()
        for step, hinges in product(steps, (2, 1))
    ]
    fine = [
        {"contact": contact, "timestep": FINE_S, "hinges_per_segment": 2}
        for contact in STEPS_S
    ]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        futures = [
            [pool.submit(measured, name, item) for name in SCENARIOS]
            for item in candidates + fine
        ]
        results = [[future.result() for future in row] for row in futures]
    converged = dict(zip(STEPS_S, results[-len(fine) :], strict=True))
    deviations = [
        errors(outcome, converged[item["contact"]])
        for outcome, item in zip(results, candidates, strict=False)
    ]
    rows = []
    for item, error, cost in zip(
        candidates, deviations, costs(candidates), strict=True
    ):
        contact, step, hinges = item.values()
        numbers = [1e3 * step, hinges, cost, *np.nanmax(np.abs(error), axis=1)]
        rows.append([contact, *(f"{float(f'{number:.3g}'):g}" for number in numbers)])
    print(
        table(["contact", "step, ms", "hinges", "cost", *METRICS.values()], rows),
        flush=True,
    )
    named = {"default": ModelSettings.timestep} | {
        name: item["timestep"] for name, item in PRESETS.items()
    }
    steps = [item["timestep"] for item in candidates if item["contact"] == "loaded"]
    shown = [deviations[steps.index(step)] for step in named.values()]
    rows = [
        [
            title,
            *(
                f"{np.nanmax(np.abs(e[i])):.2g} ({np.sqrt(np.nanmean(e[i] ** 2)):.2g})"
                for e in shown
            ),
        ]
        for i, title in enumerate(METRICS.values())
    ]
    print("", table(["largest (RMS) error", *named], rows), sep="\n")


if __name__ == "__main__":
    main()
