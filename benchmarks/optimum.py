"""Error of the two-fidelity optimum relative to the optimum of the twin, and the number of twin runs.

    uv run python benchmarks/optimum.py [--studies gen2_speed gen2_transport]
        [--seeds 20] [--truth 1000] [--constrained 20]
    uv run --with pymoo python benchmarks/optimum.py --studies gen2_front --seeds 6
        --truth 2000 [--rival]

The reference is a CMA-ES search with the given number of twin runs, without the
low-fidelity plant. The two-fidelity search with each seed is compared with it, by its
best twin run out of at most 50. All runs are kept in --out.

For two objectives the reference is the front of CMA-ES with ten weights, and the
compared value is the area that a front dominates, starting from the unchanged scenario.
With --rival the area of NSGA-II (pymoo) is printed too: on the twin, and on the
low-fidelity plant with its best designs repeated on the twin.

With --constrained, a second table compares searches with one constraint, from seed 800
on, with optima of interpolated gaits (`common/constrained.py`).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cma
import numpy as np
from common.constrained import constrained_searches
from common.grid import table

from srs_twin.studies.optimization.loading import OptimizationStudy, load_study
from srs_twin.studies.optimization.runs import Run, StudyRuns
from srs_twin.studies.optimization.search import costs, excesses, front, search
from srs_twin.studies.sweep.execution import local

POPULATION = 12


def truth(study: OptimizationStudy, runs: StudyRuns, budget: int) -> float:
    """Return the smallest cost that CMA-ES reaches on the twin, restarted until the budget is spent."""
    best = np.inf
    restarts = 0
    rng = np.random.default_rng(99)
    asked = 0
    while asked < budget:
        options = {
            "bounds": [0, 1],
            "seed": 500 + restarts,
            "verbose": -9,
            "popsize": POPULATION,
        }
        strategy = cma.CMAEvolutionStrategy(
            rng.uniform(0.2, 0.8, study.space.size), 0.25, options
        )
        while asked < budget and not strategy.stop():
            designs = study.space.snapped(np.array(strategy.ask()))
            result = runs.run("twin", designs)
            asked += len(designs)
            values = penalised(study, result)
            strategy.tell(list(designs), values.tolist())
            best = min(best, kept(study, result))
        restarts += 1
    return best


def true_front(study: OptimizationStudy, runs: StudyRuns, budget: int) -> np.ndarray:
    """Return the costs of all runs of CMA-ES with ten weights of the two objectives."""
    result: list[Run] = runs.run(
        "twin",
        study.space.snapped(np.random.default_rng(98).random((100, study.space.size))),
    )
    scale = np.nanstd(costs(study, result), axis=0)
    for k, weight in enumerate(np.linspace(0.05, 0.95, 10)):
        options = {
            "bounds": [0, 1],
            "seed": 700 + k,
            "verbose": -9,
            "popsize": POPULATION,
        }
        start = result[int(np.argmin(_weighed(study, result, weight, scale)))].fractions
        strategy = cma.CMAEvolutionStrategy(np.clip(start, 0.02, 0.98), 0.2, options)
        asked = 0
        while asked < (budget - 100) // 10 and not strategy.stop():
            designs = study.space.snapped(np.array(strategy.ask()))
            mine = runs.run("twin", designs)
            strategy.tell(list(designs), _weighed(study, mine, weight, scale).tolist())
            result = result + mine
            asked = asked + len(designs)
    return fine(study, result)


def _weighed(
    study: OptimizationStudy, result: list[Run], weight: float, scale: np.ndarray
) -> np.ndarray:
    cost = costs(study, result) / scale
    excess = np.maximum(excesses(study, result), 0).sum(axis=1)
    value = cost @ [weight, 1 - weight]
    return np.where(
        np.isnan(value) | np.isnan(excess),
        1e6,
        np.where(excess > 0, 1e3 * (1 + excess), value),
    )


def fine(study: OptimizationStudy, result: list[Run]) -> np.ndarray:
    """Return the costs of runs that meet the constraints, shape (runs, objectives)."""
    cost = costs(study, result)
    excess = excesses(study, result)
    return cost[np.isfinite(cost).all(axis=1) & (excess <= 0).all(axis=1)]


def area(points: np.ndarray, worst: np.ndarray) -> float:
    """Return the area dominated by points with two costs, up to the worst point."""
    points = points[(points < worst).all(axis=1)]
    points = points[np.argsort(points[:, 0])]
    ends = np.append(points[1:, 0], worst[0])
    return float(
        np.sum((ends - points[:, 0]) * (worst[1] - np.minimum.accumulate(points[:, 1])))
    )


def genetic(
    study: OptimizationStudy, runs: StudyRuns, part: str, budget: int, seed: int = 1
) -> list[Run]:
    """Return the costs of the runs of NSGA-II."""
    from pymoo.algorithms.moo.nsga2 import NSGA2
    from pymoo.core.problem import Problem
    from pymoo.optimize import minimize

    result: list[Run] = []

    class Designs(Problem):
        def _evaluate(
            self, x: np.ndarray, out: dict[str, Any], *_: Any, **__: Any
        ) -> None:
            mine = runs.run(part, study.space.snapped(x))
            result.extend(mine)
            out["F"] = np.nan_to_num(costs(study, mine), nan=1e3)
            out["G"] = np.nan_to_num(excesses(study, mine), nan=1e3)

    limits = sum(
        (item.below is not None) + (item.above is not None)
        for item in study.file.constraints
    )
    asked = Designs(
        n_var=study.space.size, n_obj=2, n_ieq_constr=limits, xl=0.0, xu=1.0
    )
    minimize(asked, NSGA2(pop_size=40), ("n_eval", budget), seed=seed, verbose=False)
    return result


def rival(
    study: OptimizationStudy, runs: StudyRuns, budget: int, worst: np.ndarray
) -> float:
    """Print the areas of NSGA-II; return the largest."""
    result = genetic(study, runs, "twin", budget)
    areas = {
        n: area(fine(study, result[:n]), worst)
        for n in (60, 200, 500, 1000, budget)
        if n <= budget
    }
    print(
        "NSGA-II on the twin:",
        {n: round(item, 4) for n, item in areas.items()},
        flush=True,
    )
    cheap = genetic(study, runs, "compliant", 1000)
    chosen = list[Run]()
    while len(chosen) < 60 and cheap:
        members = front(costs(study, cheap))
        chosen += [run for run, member in zip(cheap, members, strict=True) if member]
        cheap = [
            run
            for run, member in zip(cheap, members, strict=True)
            if not member and run not in chosen
        ]
    there = runs.run("twin", np.array([run.fractions for run in chosen[:60]]))
    print(
        f"NSGA-II on compliant, 60 on the twin: {area(fine(study, there), worst):.4f}",
        flush=True,
    )
    return max(areas.values())


def fronts(
    study: OptimizationStudy, runs: StudyRuns, seeds: int, budget: int, *, rivals: bool
) -> list[str]:
    """Compare the areas of the fronts; return a row of the table."""
    begun = Run("twin", np.zeros(study.space.size), runs.rows("twin", [{}])[0])
    worst = costs(study, [begun])[0]
    truth = area(true_front(study, runs, budget), worst)
    if rivals:
        truth = max(truth, rival(study, runs, budget, worst))
    fractions = []
    most = 0
    for seed in range(seeds):
        runs.reset()
        answer = search(
            replace(study, file=study.file.model_copy(update={"seed": seed})), runs
        )
        fractions.append(area(costs(study, answer.best), worst) / truth)
        most = max(most, sum(run.part == "twin" for run in answer.runs))
        print(study.name, seed, f"{100 * fractions[-1]:.1f} % of the area", flush=True)
    near = sum(fraction >= 0.97 for fraction in fractions)
    return [
        study.name,
        f"area {truth:.4g}",
        f"{near} of {seeds} within 3 %",
        f"{100 * (1 - min(fractions)):.1f} %",
        str(most),
    ]


def penalised(study: OptimizationStudy, result: list[Run]) -> np.ndarray:
    """Return costs for CMA-ES, in which failed and infeasible runs have the largest costs."""
    cost = costs(study, result)[:, 0]
    excess = np.maximum(excesses(study, result), 0).sum(axis=1)
    return np.where(
        np.isnan(cost) | np.isnan(excess),
        1e6,
        np.where(excess > 0, 1e3 * (1 + excess), cost),
    )


def kept(study: OptimizationStudy, result: list[Run]) -> float:
    """Return the smallest cost of the feasible runs."""
    cost = costs(study, result)[:, 0]
    excess = excesses(study, result)
    fine = np.isfinite(cost) & (excess <= 0).all(axis=1)
    return float(cost[fine].min(initial=np.inf))


def main() -> None:
    """Search and print the tables."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--studies", nargs="+", default=["gen2_speed", "gen2_transport"])
    words.add_argument("--seeds", type=int, default=20)
    words.add_argument(
        "--truth", type=int, default=1000, help="number of twin runs of the reference"
    )
    words.add_argument(
        "--rival", action="store_true", help="also run NSGA-II for two objectives"
    )
    words.add_argument(
        "--constrained", type=int, default=0, help="searches with each constraint"
    )
    words.add_argument(
        "--points", type=int, default=24, help="gaits per variable for --constrained"
    )
    words.add_argument(
        "--runs", type=int, default=30, help="twin runs per search for --constrained"
    )
    words.add_argument("--out", type=Path, default=Path("runs/optimum"))
    words.add_argument("--json", type=Path, metavar="FILE")
    selected = words.parse_args()
    lines = []
    summary = dict[str, Any]()
    for name in selected.studies:
        study = load_study(name)
        with StudyRuns(study, selected.out / name, local()) as runs:
            if len(study.file.objectives) == 2:
                lines.append(
                    fronts(
                        study,
                        runs,
                        selected.seeds,
                        selected.truth,
                        rivals=selected.rival,
                    )
                )
                continue
            best = truth(study, runs, selected.truth)
            result = []
            for seed in range(selected.seeds):
                file = study.file.model_copy(update={"seed": seed})
                runs.reset()
                answer = search(replace(study, file=file), runs)
                twin = [run for run in answer.runs if run.part == "twin"]
                result.append((kept(study, list(answer.best)), len(twin)))
                print(
                    name,
                    seed,
                    f"{result[-1][0]:.5g} with {result[-1][1]}, truth {best:.5g}",
                    flush=True,
                )
        deviation = np.array([(value - best) / abs(best) for value, _ in result])
        near = int((deviation <= 0.02).sum())
        most = max(count for _, count in result)
        lines.append(
            [
                name,
                f"{abs(best):.4g}",
                f"{near} of {len(result)}",
                f"{100 * deviation.max():.1f} %",
                str(most),
            ]
        )
        summary[name] = {"truth": best, "off": deviation.tolist(), "runs": most}
    print(
        table(
            [
                "study",
                "optimum of the twin alone",
                "within 2 %",
                "farthest",
                "runs of the twin",
            ],
            lines,
        )
    )
    if selected.constrained:
        seeds = range(800, 800 + selected.constrained)
        out = selected.out / "constrained"
        print()
        print(constrained_searches(seeds, selected.points, selected.runs, out))
    if selected.json:
        selected.json.write_text(json.dumps(summary, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
