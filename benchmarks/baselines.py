"""Success rates and tracking errors of the project's controllers as policies of the environments.

uv run python benchmarks/baselines.py --episodes 20
"""

from __future__ import annotations

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from statistics import mean

import numpy as np
from grid import table

from srs_twin.envs import TASKS, make_task
from srs_twin.envs.baseline import PathFollowing, ProportionalIntegral, Score, play_episode
from srs_twin.envs.crawling import CrawlTask
from srs_twin.envs.module import ModuleTask


def scored(name: str, seed: int) -> Score:
    """Run one episode of a task with the project's own policy; return its scores."""
    task = make_task(name)
    policy = PathFollowing(task) if isinstance(task, CrawlTask) else None
    if isinstance(task, ModuleTask):
        policy = ProportionalIntegral(task)
    assert policy is not None
    return play_episode(task, policy, np.random.default_rng(seed))


def row(name: str, scores: list[Score]) -> list[str]:
    endings = Counter(score.ending for score in scores)
    counts = ", ".join(f"{ending} {count}" for ending, count in endings.most_common())
    return [name, counts, f"{mean(s.reward for s in scores):.3g}", f"{mean(s.time for s in scores):.3g}"]


def main() -> None:
    """Print a table of all tasks."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--episodes", type=int, default=20)
    arguments.add_argument("--processes", type=int, default=None)
    options = arguments.parse_args()
    with ProcessPoolExecutor(options.processes) as pool:
        rows = []
        for name in TASKS:
            seeds = range(options.episodes)
            rows.append(row(name, list(pool.map(scored, [name] * options.episodes, seeds))))
    print(table(["task", "endings", "mean return", "mean time, s"], rows))


if __name__ == "__main__":
    main()
