"""Proofs of infeasibility: no false proofs in solvable worlds, and the time to prove infeasible ones.

    uv run python benchmarks/proofs.py [--worlds 28]

Worlds of six kinds that are solvable by construction, for six footprints, are given to
the proofs alone at both resolutions. Infeasible problems are pockets with an outward
goal heading and closed rooms; these go to the planner with its default settings.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from grid import table

from srs_twin.planning.collision import obstacle_grid
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.infeasibility import (
    COARSE,
    FINE,
    is_disconnected,
    prove_unreachable,
)
from srs_twin.planning.planner import plan
from srs_twin.planning.problem import Problem
from srs_twin.robot.world import Polygon, Pose, World

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from witnessed_worlds import KINDS, bodies, drawn


def false_proofs(case: Problem) -> int:
    """Return the number of proofs of infeasibility in a solvable world."""
    body = case.footprint
    grid = obstacle_grid(case.world)
    proofs = [
        prove_unreachable(case.start, case.goal, body, grid, size)
        for size in (COARSE, FINE)
    ]
    return is_disconnected(case.start, case.goal, case.world, body.narrowest) + sum(
        map(bool, proofs)
    )


def impossible(seed: int, body: Footprint) -> Iterator[tuple[str, Problem]]:
    """Yield a pocket with an outward goal heading, and a goal in a closed room."""
    case = drawn("pockets", seed, body).problem
    goal = case.goal
    assert goal.heading is not None, "drawn with one"
    yield "pocket", replace(case, goal=replace(goal, heading=goal.heading + math.pi))
    half = 3 * (body.ahead + max(body.left) + goal.radius)
    c = math.cos(0.3 * seed)
    s = math.sin(0.3 * seed)

    def wall(ax: float, ay: float, bx: float, by: float) -> Polygon:
        corners = ((ax, ay), (bx, ay), (bx, by), (ax, by))
        return Polygon(
            tuple((goal.x + c * x - s * y, goal.y + s * x + c * y) for x, y in corners)
        )

    far = half + 0.03
    walls = (
        wall(-far, half, far, far),
        wall(-far, -far, far, -half),
        wall(half, -far, far, far),
        wall(-far, -far, -half, far),
    )
    away = Pose(goal.x + 3 * far, goal.y, 0.0)
    yield "room", replace(case, start=away, world=World((), None, None, walls))


def main() -> None:
    """Run the proofs and print the table."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument(
        "--worlds", type=int, default=28, help="number of worlds per kind and footprint"
    )
    words.add_argument("--first", type=int, default=0)
    options = words.parse_args()
    seeds = range(options.first, options.first + options.worlds)
    kinds = [(body, kind) for body in bodies().values() for kind in KINDS]
    wrong = [
        false_proofs(drawn(kind, seed, body).problem)
        for body, kind in kinds
        for seed in seeds
    ]
    print(f"{len(wrong)} solvable worlds: {sum(map(bool, wrong))} false proofs\n")
    planned = bodies() | {
        "gen2_gait": load_footprint("gen2_gait").reduced(turn_share=0.3, margin=0.04)
    }
    lines = []
    for name, body in planned.items():
        for kind in ("pocket", "room"):
            seconds = []
            proven = 0
            for seed in seeds:
                case = dict(impossible(seed, body))[kind]
                begin = time.process_time()
                answer = plan(case)
                spent = time.process_time() - begin
                proven += answer.proven and spent <= 0.2
                seconds.append(spent)
            lines.append(
                [
                    name,
                    kind,
                    f"{proven} of {len(seconds)}",
                    f"{1e3 * np.median(seconds):.0f}",
                    f"{1e3 * np.quantile(seconds, 0.9):.0f}",
                ]
            )
    print(
        table(
            [
                "footprint",
                "impossible",
                "proven within 200 ms",
                "median, ms",
                "90 %, ms",
            ],
            lines,
        )
    )


if __name__ == "__main__":
    main()
