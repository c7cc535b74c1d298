"""Success, time and path length of each planner in the 900 worlds of Fig. 55, and safety of the plans.

    uv run --group benchmarks python benchmarks/planning.py           # 1 to 18 obstacles, 50 draws each
    uv run python benchmarks/planning.py --draws 5 --worlds 100       # a short run
    uv run --group benchmarks python benchmarks/planning.py --json out.json --plot out.png

Times are wall times of one process after a warm-up. The fields of the dissertation are
easy for any planner with backtracking, so fields of 35 to 55 circles are planned as
well. The safety part uses separate worlds with different bodies, polygons, gaps and
tolerances; an independent check by sampling tests every plan.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from common.greedy import greedy
from common.grid import table
from common.timing import machine

from srs_twin.io.files import atomic_write
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.planner import plan
from srs_twin.planning.problem import Plan, PlanOutcome, Problem, Settings
from srs_twin.robot.world import (
    FIG54_BOUNDS,
    FIG54_GOAL,
    FIG54_SITES,
    FIG54_START,
    Bounds,
    Goal,
    Polygon,
    Pose,
    World,
    random_circles,
)
from srs_twin.scenario.map_file import read_map

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from plan_sampling import TOUCH, deepest, is_faulty, misses
from plan_worlds import ARCS, drawn_problem, fig54_problem
from witnessed_worlds import bodies, walls

OMPL_S = 1.0
COUNTS = range(1, len(FIG54_SITES) + 1)
NARROW_COUNTS = (35, 40, 45, 50, 55)
DRIVABLE = 0.1
RATIOS = (1.05, 1.1, 1.3, 1.8)
"""Widths of narrow passages, in widths of the straight body."""
"""Largest kink of a path that a snake can follow, rad."""


def narrow_problem(count: int, seed: int, *, arcs: bool) -> Problem:
    """Return a field of many circles between the same start and goal, with gaps of at least 45 mm."""
    body = load_footprint("gen2_section52")
    ends = (FIG54_START, FIG54_GOAL)
    clear = tuple((end.x, end.y, 0.06) for end in ends)
    seeded = 1000 * count + seed
    circles = random_circles(
        count, FIG54_BOUNDS, seeded, radius=(0.04, 0.09), gap=0.045, clear=clear
    )
    return Problem(
        FIG54_START,
        FIG54_GOAL,
        World(circles, FIG54_BOUNDS),
        body,
        ARCS if arcs else None,
    )


class Baseline(NamedTuple):
    """Planner with its settings.

    Attributes:
        search: function that plans.
        settings: budget and options.
        arcs: whether the planner needs the motion primitives of the dissertation.
    """

    search: Callable[[Problem, Settings], Plan]
    settings: Settings
    arcs: bool = False

    def timed(self, problem: Problem) -> Plan:
        """Return the plan of a problem with its wall time."""
        begun = time.perf_counter()
        answer = self.search(problem, self.settings)
        return replace(answer, seconds=time.perf_counter() - begun)


def planners() -> dict[str, Baseline]:
    """Return the installed planners by name."""
    result = {
        "greedy": Baseline(greedy, Settings(), arcs=True),
        "best_first": Baseline(plan, Settings()),
    }
    if find_spec("ompl"):
        from common.rrt_connect import rrt_connect

        result["ompl"] = Baseline(rrt_connect, Settings(seconds=OMPL_S))
    return result


def study(
    draws: int,
    counts: Sequence[int] = COUNTS,
    problem: Callable[..., Problem] = fig54_problem,
) -> dict[str, dict[int, list[Plan]]]:
    """Return all plans by planner and number of obstacles."""
    answers: dict[str, dict[int, list[Plan]]] = {}
    for name, planner in planners().items():
        # The first call compiles and imports; it is not timed.
        planner.timed(problem(max(counts), 0, arcs=planner.arcs))
        answers[name] = {
            count: [
                planner.timed(problem(count, seed, arcs=planner.arcs))
                for seed in range(draws)
            ]
            for count in counts
        }
    return answers


def summary(answers: dict[str, dict[int, list[Plan]]]) -> dict[str, Any]:
    """Return the statistics of the planners over all worlds and by number of obstacles."""
    solved = {
        name: {
            (count, seed)
            for count, plans in by.items()
            for seed, p in enumerate(plans)
            if p.found
        }
        for name, by in answers.items()
    }
    everyone = set[tuple[int, int]]().union(*solved.values())
    result: dict[str, Any] = {"solved_by_any": len(everyone)}
    for name, by in answers.items():
        plans = [p for item in by.values() for p in item]
        ms = [1e3 * p.seconds for p in plans]
        lengths = [p.length for p in plans if p.found]
        success = {
            count: sum(p.found for p in item) / len(item) for count, item in by.items()
        }
        result[name] = {
            "solved": len(solved[name]),
            "drivable": sum(p.found and p.max_heading_jump < DRIVABLE for p in plans),
            "fraction_of_solved_by_any": len(solved[name]) / max(1, len(everyone)),
            "misses_of_greedy": len(solved["greedy"] - solved[name]),
            "median_ms": float(np.median(ms)),
            "p95_ms": float(np.percentile(ms, 95)),
            "most_ms": max(ms),
            "mean_length_m": float(np.mean(lengths)) if lengths else None,
            "outcomes": dict(Counter(p.outcome.value for p in plans)),
            "success": success,
            "trend": trend(success),
        }
    return result


def trend(success: dict[int, float]) -> float | None:
    """Return the rank correlation of the success rate with the number of obstacles.

    It is −1 if the rate decreases at every step, and None if the rate is constant.
    """
    from scipy.stats import spearmanr

    if len(set(success.values())) == 1:
        return None
    return float(spearmanr(list(success), list(success.values())).statistic)


def safety(worlds: int) -> dict[str, Any]:
    """Return the outcomes of random problems, and the number of plans that are faulty."""
    outcomes: Counter[str] = Counter()
    bad: list[int] = []
    seconds = []
    deepest_m = -math.inf
    for seed in range(worlds):
        problem = drawn_problem(seed)
        answer = plan(problem)
        outcomes[answer.outcome.value] += 1
        seconds.append(answer.seconds)
        if answer.found:
            depth = deepest(answer, problem)
            deepest_m = max(deepest_m, depth)
            if is_faulty(answer, problem):
                bad.append(seed)
    return {
        "worlds": worlds,
        "outcomes": dict(outcomes),
        "bad_seeds": bad,
        "deepest_m": deepest_m,
        "median_ms": 1e3 * float(np.median(seconds)),
        "p95_ms": 1e3 * float(np.percentile(seconds, 95)),
    }


MAP = (364, 242, 0.033)
"""Columns, rows, side of a cell (m) of a map of 12 m by 8 m."""
FULL = 10_000
"""Smallest number of occupied cells of the map."""


def full_map(seed: int) -> tuple[Polygon, ...]:
    """Return the rectangles of a random map, 5 or more cells from each other, with two free corners."""
    from PIL import Image

    columns, rows, cell = MAP
    drawn = np.random.default_rng(seed)
    picture = np.full((rows, columns), 255, dtype=np.uint8)
    while np.sum(picture == 0) < FULL:
        wide, high = drawn.integers(3, 10, 2)
        x = drawn.integers(0, columns - wide)
        y = drawn.integers(0, rows - high)
        ends = (x < 40 and y > rows - 40) or (x > columns - 40 and y < 40)
        if (
            not ends
            and (
                picture[max(y - 5, 0) : y + high + 5, max(x - 5, 0) : x + wide + 5] > 0
            ).all()
        ):
            picture[y : y + high, x : x + wide] = 0
    with TemporaryDirectory() as room:
        Image.fromarray(picture).save(Path(room, "map.pgm"))
        lines = (
            "image: map.pgm",
            f"resolution: {cell}",
            "origin: [0, 0, 0]",
            "occupied_thresh: 0.65",
            "free_thresh: 0.2",
        )
        Path(room, "map.yaml").write_text("\n".join(lines), "utf-8")
        return read_map(Path(room, "map.yaml"))


def maps(count: int) -> str:
    """Plan between opposite corners of maps, with and without transients; return a table."""
    rows = []
    for name in ("gen2_section52", "gen2_gait"):
        seconds = []
        lengths = []
        for seed in range(count):
            world = World((), Bounds((0.0, 12.0), (0.0, 8.0)), polygons=full_map(seed))
            problem = Problem(
                Pose(0.5, 0.5, 0.3),
                Goal(11.5, 7.4, None, radius=0.03),
                world,
                load_footprint(name),
            )
            begun = time.process_time()
            answer = plan(problem)
            seconds.append(time.process_time() - begun)
            if answer.found:
                lengths.append(f"{answer.length:.1f}")
        least = min(seconds)
        most = max(seconds)
        rows.append(
            [
                name,
                f"{least:.2f} to {most:.2f}",
                f"{len(lengths)} of {count}",
                ", ".join(lengths),
            ]
        )
    return table(["footprint", "processor time, s", "found", "lengths, m"], rows)


def tables(result: dict[str, Any]) -> str:
    """Return the statistics as Markdown tables."""
    names = [name for name in result if name in planners()]
    success = {name: result[name]["success"] for name in names}
    total = sum(result[names[0]]["outcomes"].values())
    rows = [
        [
            name,
            str(r["solved"]),
            str(r["drivable"]),
            f"{100 * r['fraction_of_solved_by_any']:.1f} %",
            str(r["misses_of_greedy"]),
            f"{r['median_ms']:.2f}",
            f"{r['p95_ms']:.2f}",
            f"{r['most_ms']:.1f}",
            f"{r['mean_length_m']:.3f}" if r["mean_length_m"] else "-",
        ]
        for name, r in ((name, result[name]) for name in names)
    ]
    head = ["planner", f"solved of {total}", "drivable", "of the solvable worlds"]
    head += [
        "unsolved, but solved by greedy",
        "median, ms",
        "95 %, ms",
        "max, ms",
        "mean length, m",
    ]
    by_count = []
    for name in names:
        fractions = [f"{100 * fraction:.0f}" for fraction in success[name].values()]
        correlation = result[name]["trend"]
        said = "–" if correlation is None else f"{correlation:.2f}"
        by_count.append([name, *fractions, said])
    counts = ["success %", *map(str, success[names[0]]), "rank correlation"]
    return f"{table(head, rows)}\n\n{table(counts, by_count)}"


def draw(result: dict[str, Any], path: Path) -> None:
    """Plot success against the number of obstacles, as in Fig. 55."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 3.2), layout="constrained")
    # Different sizes keep coinciding curves visible.
    for name, size in (("greedy", 5), ("best_first", 9), ("ompl", 4)):
        if name in result:
            fraction = [100 * result[name]["success"][c] for c in COUNTS]
            axes.plot(list(COUNTS), fraction, "o-", label=name, markersize=size)
    axes.set(
        xlabel="obstacles of 18",
        ylabel="success, %",
        ylim=(-4, 104),
        xticks=list(COUNTS),
    )
    axes.legend()
    with atomic_write(path) as part:
        figure.savefig(part, dpi=150)


def passages(worlds: int, first: int = 0) -> None:
    """Print the success rate in narrow passages that are known to be solvable, and count false proofs.

    The worlds have one to three walls of polygons or circles. Each wall has one gap of
    1.05 to 1.8 widths of the straight body, margin included. Plans are checked by
    sampling.

    Args:
        worlds: number of worlds of each kind, for each of six footprints.
        first: seed of the first world.
    """
    solved: dict[tuple[float, str], list[bool]] = defaultdict(list)
    seconds = []
    wrong = 0
    proofs = 0
    for ratio in RATIOS:
        for name, body in bodies().items():
            for count in (1, 2, 3):
                for seed in range(first, first + worlds):
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


def main(words: Sequence[str] | None = None) -> int:
    """Print the tables; return 1 if a plan is faulty or the default planner misses a target."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--draws", type=int, default=50, help="draws for each number of obstacles"
    )
    parser.add_argument(
        "--worlds", type=int, default=1000, help="number of problems of the safety part"
    )
    parser.add_argument(
        "--maps", type=int, default=5, help="number of maps with many occupied cells"
    )
    parser.add_argument("--json", type=Path, help="write all values to this file")
    parser.add_argument(
        "--plot", type=Path, help="write the plot of success to this file"
    )
    parser.add_argument(
        "--passages",
        type=int,
        metavar="N",
        help="plan in N worlds with narrow passages of each kind instead",
    )
    parser.add_argument(
        "--first", type=int, default=0, help="seed of the first world with passages"
    )
    options = parser.parse_args(words)
    if options.passages:
        passages(options.passages, options.first)
        return 0
    result = summary(study(options.draws))
    narrow = summary(study(options.draws, NARROW_COUNTS, narrow_problem))
    print(f"{tables(result)}\n\nNarrow fields:\n\n{tables(narrow)}")
    if options.maps:
        print(f"\nMaps of {FULL} occupied cells:\n\n{maps(options.maps)}")
    safe = safety(options.worlds)
    print("\n" + "\n".join(f"{key}: {value}" for key, value in safe.items()))
    if options.json:
        with atomic_write(options.json) as part:
            part.write_text(
                json.dumps(
                    {
                        "study": result,
                        "narrow": narrow,
                        "safety": safe,
                        "machine": machine(),
                    },
                    indent=1,
                ),
                "utf-8",
            )
    if options.plot:
        draw(result, options.plot)
    default = result["best_first"]
    good = (
        default["misses_of_greedy"] == 0
        and default["fraction_of_solved_by_any"] >= 0.98
    )
    if (
        good
        and default["median_ms"] < 50
        and default["p95_ms"] < 250
        and not safe["bad_seeds"]
    ):
        return 0
    return 1


if __name__ == "__main__":
    sys.exit(main())
