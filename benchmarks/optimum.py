"""How near two fidelities come to the optimum of the twin alone, and with how few of its runs.

    uv run python benchmarks/optimum.py [--studies gen2_speed gen2_transport] [--seeds 20] [--truth 1000]

The truth is a CMA-ES of so many twin runs, without the cheap model. Each seed of the two-fidelity search is
held against it, by its best run of the twin with at most 50 of them. All runs are kept in --out.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cma
import numpy as np
from grid import table

from srs_twin.optimization import load_study, search
from srs_twin.optimization.loading import Study
from srs_twin.optimization.runs import Run, Runs
from srs_twin.optimization.search import costs, excesses
from srs_twin.sweep.execution import local

POPULATION = 12


def truth(study: Study, runs: Runs, budget: int) -> float:
    """Return the least cost that CMA-ES finds on the twin, restarted until the budget is spent."""
    best, restarts = np.inf, 0
    rng, asked = np.random.default_rng(99), 0
    while asked < budget:
        options = {"bounds": [0, 1], "seed": 500 + restarts, "verbose": -9, "popsize": POPULATION}
        strategy = cma.CMAEvolutionStrategy(rng.uniform(0.2, 0.8, study.space.size), 0.25, options)
        while asked < budget and not strategy.stop():
            designs = study.space.settled(np.array(strategy.ask()))
            found = runs.run("twin", designs)
            asked += len(designs)
            values = penalised(study, found)
            strategy.tell(list(designs), values.tolist())
            best = min(best, kept(study, found))
        restarts += 1
    return best


def penalised(study: Study, found: list[Run]) -> np.ndarray:
    """Return costs for CMA-ES: failed runs and those that miss a constraint are worse than any other."""
    cost, excess = costs(study, found)[:, 0], np.maximum(excesses(study, found), 0).sum(axis=1)
    return np.where(np.isnan(cost) | np.isnan(excess), 1e6, np.where(excess > 0, 1e3 * (1 + excess), cost))


def kept(study: Study, found: list[Run]) -> float:
    """Return the least cost of runs that keep the constraints."""
    cost, excess = costs(study, found)[:, 0], excesses(study, found)
    fine = np.isfinite(cost) & (excess <= 0).all(axis=1)
    return float(cost[fine].min(initial=np.inf))


def main() -> None:
    """Search and print."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--studies", nargs="+", default=["gen2_speed", "gen2_transport"])
    words.add_argument("--seeds", type=int, default=20)
    words.add_argument("--truth", type=int, default=1000, help="runs of the twin alone")
    words.add_argument("--out", type=Path, default=Path("runs/optimum"))
    words.add_argument("--json", type=Path, metavar="FILE")
    given = words.parse_args()
    lines, told = [], dict[str, Any]()
    for name in given.studies:
        study = load_study(name)
        with Runs(study, given.out / name, local()) as runs:
            best = truth(study, runs, given.truth)
            found = []
            for seed in range(given.seeds):
                file = study.file.model_copy(update={"seed": seed})
                runs.forget()
                answer = search(replace(study, file=file), runs)
                twin = [run for run in answer.runs if run.part == "twin"]
                found.append((kept(study, list(answer.best)), len(twin)))
                print(name, seed, f"{found[-1][0]:.5g} with {found[-1][1]}, truth {best:.5g}", flush=True)
        off = np.array([(value - best) / abs(best) for value, _ in found])
        near, most = int((off <= 0.02).sum()), max(count for _, count in found)
        lines.append(
            [name, f"{abs(best):.4g}", f"{near} of {len(found)}", f"{100 * off.max():.1f} %", str(most)]
        )
        told[name] = {"truth": best, "off": off.tolist(), "runs": most}
    print(table(["study", "optimum of the twin alone", "within 2 %", "farthest", "runs of the twin"], lines))
    if given.json:
        given.json.write_text(json.dumps(told, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
