"""Success rates and tracking errors of the project's controllers as policies of the environments.

    uv run python benchmarks/baselines.py --episodes 20
    uv run python benchmarks/baselines.py --episodes 500 --first 10000 --policy goto

With a policy, only its task is run, once with the controller and once with the policy, on the same episodes.
"""

from __future__ import annotations

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from statistics import mean

import numpy as np
from grid import table

from srs_twin.envs import TASKS, make_task
from srs_twin.envs.policy import Score, baseline, load_policy, play_episode


def score(name: str, seed: int, policy_file: str | None = None) -> Score:
    """Run one episode of a task with a stored policy, or else with the project's controller."""
    task = make_task(name)
    generator = np.random.default_rng(seed)
    if policy_file is not None:
        return play_episode(task, load_policy(policy_file).bind(task), generator)
    return play_episode(task, baseline(task), generator)


def row(name: str, scores: list[Score]) -> list[str]:
    """Return the cells of a table row."""
    endings = Counter(score.ending for score in scores)
    counts = ", ".join(f"{ending} {count}" for ending, count in endings.most_common())
    return [name, counts, f"{mean(s.reward for s in scores):.3g}", f"{mean(s.time for s in scores):.3g}"]


def comparison(controller: list[Score], policy: list[Score]) -> str:
    """Return a sentence on the durations of the episodes in which both reach the goal."""
    both = [
        (one.time, other.time)
        for one, other in zip(controller, policy, strict=True)
        if one.ending == other.ending == "goal_reached"
    ]
    slow, fast = map(mean, zip(*both, strict=True))
    gain = 100 * (1 - fast / slow)
    return (
        f"both reach {len(both)} of {len(policy)} goals: {slow:.2f} s and {fast:.2f} s, {gain:.1f} % shorter"
    )


def main() -> None:
    """Print a table of all tasks."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--episodes", type=int, default=20)
    arguments.add_argument("--first", type=int, default=0, help="first seed")
    arguments.add_argument("--policy", help="file or name of a policy to compare with the controller")
    arguments.add_argument("--processes", type=int, default=None)
    options = arguments.parse_args()
    seeds = range(options.first, options.first + options.episodes)
    # No controller steers a spatial robot to a goal.
    steered = [name for name in TASKS if name != "Crawl3D"]
    names = steered if options.policy is None else [load_policy(options.policy).task]
    with ProcessPoolExecutor(options.processes) as pool:
        scores = {name: list(pool.map(partial(score, name), seeds)) for name in names}
        if options.policy is not None:
            stored = partial(score, names[0], policy_file=options.policy)
            scores[f"{names[0]}, policy"] = list(pool.map(stored, seeds))
    rows = [row(name, results) for name, results in scores.items()]
    print(table(["task", "endings", "mean return", "mean time, s"], rows))
    if options.policy is not None:
        print(comparison(*scores.values()))


if __name__ == "__main__":
    main()
