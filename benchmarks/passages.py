"""Success rate of the planner in narrow passages that are known to be solvable, and its false proofs.

    uv run python benchmarks/passages.py [--worlds 2] [--first 0]

The worlds have one to three walls of polygons or circles. Each wall has one gap of 1.05
to 1.8 widths of the straight body, margin included. There are `--worlds` worlds of each
kind for six footprints. Plans are checked by sampling.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from grid import table

from srs_twin.planning.planner import plan
from srs_twin.planning.problem import PlanOutcome

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from plan_sampling import TOUCH, deepest, misses
from witnessed_worlds import bodies, walls

RATIOS = (1.05, 1.1, 1.3, 1.8)


def main() -> None:
    """Plan in all worlds and print the table."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--worlds", type=int, default=3)
    words.add_argument("--first", type=int, default=0)
    options = words.parse_args()
    solved: dict[tuple[float, str], list[bool]] = defaultdict(list)
    seconds = []
    wrong = 0
    proofs = 0
    for ratio in RATIOS:
        for name, body in bodies().items():
            for count in (1, 2, 3):
                for seed in range(options.first, options.first + options.worlds):
                    case = walls(100 * seed + count, body, ratio, count)
                    begin = time.process_time()
                    answer = plan(case.problem)
                    seconds.append(time.process_time() - begin)
                    bad = answer.found and (
                        deepest(answer, case.problem) > TOUCH
                        or misses(answer, case.problem)
                    )
                    wrong = wrong + bad
                    proofs += answer.outcome is PlanOutcome.PROVEN_IMPOSSIBLE
                    solved[ratio, name].append(answer.found and not bad)
    lines = []
    for ratio in RATIOS:
        counts = [solved[ratio, name] for name in bodies()]
        every = [item for some in counts for item in some]
        lines.append(
            [
                f"{ratio:g}",
                *(f"{sum(c)} of {len(c)}" for c in counts),
                f"{100 * np.mean(every):.1f} %",
            ]
        )
    print(table(["widths", *bodies(), "all"], lines))
    p95 = np.quantile(seconds, 0.95)
    print(
        f"\n{len(seconds)} worlds; {wrong} plans in collision, {proofs} false proofs; "
        f"median {1e3 * np.median(seconds):.0f} ms, 95 % within {1e3 * p95:.0f} ms"
    )


if __name__ == "__main__":
    main()
