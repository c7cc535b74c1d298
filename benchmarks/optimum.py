"""How near two fidelities come to the optimum of the twin alone, and with how few of its runs.

    uv run python benchmarks/optimum.py [--studies gen2_speed gen2_transport] [--seeds 20] [--truth 1000]
    uv run --with pymoo python benchmarks/optimum.py --studies gen2_front --seeds 6 --truth 2000 [--rival]

The truth is a CMA-ES of so many twin runs, without the cheap model. Each seed of the two-fidelity search is
held against it, by its best run of the twin with at most 50 of them. All runs are kept in --out.

Of two objectives the truth is the front of CMA-ES with ten weights, and what is compared is the area that
fronts beat, from the scenario as it stands on. With --rival that of NSGA-II (pymoo) is shown: on the twin,
and on the cheap model with its best designs run on the twin.
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

from srs_twin.studies.optimization.loading import OptimizationStudy, load_study
from srs_twin.studies.optimization.runs import Run, StudyRuns
from srs_twin.studies.optimization.search import costs, excesses, front, search
from srs_twin.studies.sweep.execution import local

POPULATION = 12


def truth(study: OptimizationStudy, runs: StudyRuns, budget: int) -> float:
    """Return the least cost that CMA-ES finds on the twin, restarted until the budget is spent."""
    best, restarts = np.inf, 0
    rng, asked = np.random.default_rng(99), 0
    while asked < budget:
        options = {"bounds": [0, 1], "seed": 500 + restarts, "verbose": -9, "popsize": POPULATION}
        strategy = cma.CMAEvolutionStrategy(rng.uniform(0.2, 0.8, study.space.size), 0.25, options)
        while asked < budget and not strategy.stop():
            designs = study.space.snapped(np.array(strategy.ask()))
            found = runs.run("twin", designs)
            asked += len(designs)
            values = penalised(study, found)
            strategy.tell(list(designs), values.tolist())
            best = min(best, kept(study, found))
        restarts += 1
    return best


def true_front(study: OptimizationStudy, runs: StudyRuns, budget: int) -> np.ndarray:
    """Return costs of all runs that CMA-ES asks for with ten weights of the two objectives."""
    found: list[Run] = runs.run(
        "twin", study.space.snapped(np.random.default_rng(98).random((100, study.space.size)))
    )
    scale = np.nanstd(costs(study, found), axis=0)
    for k, weight in enumerate(np.linspace(0.05, 0.95, 10)):
        options = {"bounds": [0, 1], "seed": 700 + k, "verbose": -9, "popsize": POPULATION}
        start = found[int(np.argmin(_weighed(study, found, weight, scale)))].shares
        strategy = cma.CMAEvolutionStrategy(np.clip(start, 0.02, 0.98), 0.2, options)
        asked = 0
        while asked < (budget - 100) // 10 and not strategy.stop():
            designs = study.space.snapped(np.array(strategy.ask()))
            mine = runs.run("twin", designs)
            strategy.tell(list(designs), _weighed(study, mine, weight, scale).tolist())
            found, asked = found + mine, asked + len(designs)
    return fine(study, found)


def _weighed(study: OptimizationStudy, found: list[Run], weight: float, scale: np.ndarray) -> np.ndarray:
    cost, excess = costs(study, found) / scale, np.maximum(excesses(study, found), 0).sum(axis=1)
    value = cost @ [weight, 1 - weight]
    return np.where(np.isnan(value) | np.isnan(excess), 1e6, np.where(excess > 0, 1e3 * (1 + excess), value))


def fine(study: OptimizationStudy, found: list[Run]) -> np.ndarray:
    """Return costs of runs that keep the constraints, shape (runs, objectives)."""
    cost, excess = costs(study, found), excesses(study, found)
    return cost[np.isfinite(cost).all(axis=1) & (excess <= 0).all(axis=1)]


def area(points: np.ndarray, worst: np.ndarray) -> float:
    """Return the area that points with two costs beat, up to the worst."""
    points = points[(points < worst).all(axis=1)]
    points = points[np.argsort(points[:, 0])]
    ends = np.append(points[1:, 0], worst[0])
    return float(np.sum((ends - points[:, 0]) * (worst[1] - np.minimum.accumulate(points[:, 1]))))


def genetic(study: OptimizationStudy, runs: StudyRuns, part: str, budget: int, seed: int = 1) -> list[Run]:
    """Return what NSGA-II asks for."""
    from pymoo.algorithms.moo.nsga2 import NSGA2
    from pymoo.core.problem import Problem
    from pymoo.optimize import minimize

    found: list[Run] = []

    class Designs(Problem):
        def _evaluate(self, x: np.ndarray, out: dict[str, Any], *_: Any, **__: Any) -> None:
            mine = runs.run(part, study.space.snapped(x))
            found.extend(mine)
            out["F"] = np.nan_to_num(costs(study, mine), nan=1e3)
            out["G"] = np.nan_to_num(excesses(study, mine), nan=1e3)

    limits = sum((each.below is not None) + (each.above is not None) for each in study.file.constraints)
    asked = Designs(n_var=study.space.size, n_obj=2, n_ieq_constr=limits, xl=0.0, xu=1.0)
    minimize(asked, NSGA2(pop_size=40), ("n_eval", budget), seed=seed, verbose=False)
    return found


def rival(study: OptimizationStudy, runs: StudyRuns, budget: int, worst: np.ndarray) -> float:
    """Print the areas of NSGA-II; return the largest."""
    found = genetic(study, runs, "twin", budget)
    areas = {n: area(fine(study, found[:n]), worst) for n in (60, 200, 500, 1000, budget) if n <= budget}
    print("NSGA-II on the twin:", {n: round(each, 4) for n, each in areas.items()}, flush=True)
    cheap, chosen = genetic(study, runs, "compliant", 1000), list[Run]()
    while len(chosen) < 60 and cheap:
        members = front(costs(study, cheap))
        chosen += [run for run, member in zip(cheap, members, strict=True) if member]
        cheap = [run for run, member in zip(cheap, members, strict=True) if not member and run not in chosen]
    there = runs.run("twin", np.array([run.shares for run in chosen[:60]]))
    print(f"NSGA-II on compliant, 60 on the twin: {area(fine(study, there), worst):.4f}", flush=True)
    return max(areas.values())


def fronts(study: OptimizationStudy, runs: StudyRuns, seeds: int, budget: int, *, rivals: bool) -> list[str]:
    """Compare areas; return a line of the table."""
    begun = Run("twin", np.zeros(study.space.size), runs.rows("twin", [{}])[0])
    worst = costs(study, [begun])[0]
    truth = area(true_front(study, runs, budget), worst)
    if rivals:
        truth = max(truth, rival(study, runs, budget, worst))
    shares, most = [], 0
    for seed in range(seeds):
        runs.reset()
        answer = search(replace(study, file=study.file.model_copy(update={"seed": seed})), runs)
        shares.append(area(costs(study, answer.best), worst) / truth)
        most = max(most, sum(run.part == "twin" for run in answer.runs))
        print(study.name, seed, f"{100 * shares[-1]:.1f} % of the area", flush=True)
    near = sum(share >= 0.97 for share in shares)
    return [
        study.name,
        f"area {truth:.4g}",
        f"{near} of {seeds} within 3 %",
        f"{100 * (1 - min(shares)):.1f} %",
        str(most),
    ]


def penalised(study: OptimizationStudy, found: list[Run]) -> np.ndarray:
    """Return costs for CMA-ES: failed runs and those that miss a constraint are worse than any other."""
    cost, excess = costs(study, found)[:, 0], np.maximum(excesses(study, found), 0).sum(axis=1)
    return np.where(np.isnan(cost) | np.isnan(excess), 1e6, np.where(excess > 0, 1e3 * (1 + excess), cost))


def kept(study: OptimizationStudy, found: list[Run]) -> float:
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
    words.add_argument("--rival", action="store_true", help="show NSGA-II beside, of two objectives")
    words.add_argument("--out", type=Path, default=Path("runs/optimum"))
    words.add_argument("--json", type=Path, metavar="FILE")
    given = words.parse_args()
    lines, told = [], dict[str, Any]()
    for name in given.studies:
        study = load_study(name)
        with StudyRuns(study, given.out / name, local()) as runs:
            if len(study.file.objectives) == 2:
                lines.append(fronts(study, runs, given.seeds, given.truth, rivals=given.rival))
                continue
            best = truth(study, runs, given.truth)
            found = []
            for seed in range(given.seeds):
                file = study.file.model_copy(update={"seed": seed})
                runs.reset()
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
