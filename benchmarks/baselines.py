"""Success rates of the project's controllers and of policies that do not know the task, in every environment.

    uv run python benchmarks/baselines.py --first 2000 --json FILE
    uv run python benchmarks/baselines.py --tasks Obstacles --policies baseline blind.npz
    uv run python benchmarks/baselines.py --episodes 500 --tasks GoTo --policies goto

An environment is a test of its task only if policies fail that do not do the task:

- random: an action drawn for each step;
- random, held: an action drawn every 2 s;
- constant: the best of the actions `CONSTANTS`, counted after the runs;
- open loop: the actions of the controller in the episode of seed 0, the last one held;
- blind: the controller, which gets the numbers of `HIDDEN` in place of the goal, the
  obstacles, the object or the reference.

Episodes count as a success if they end as in `SUCCESSES`; in Module, which always lasts
until the time limit, if the mean error is at most `MODULE_ERROR_RAD`. `--json` stores
every episode. Runs that the file contains are not repeated, and several processes may
share the tasks, each with its own file.
"""

from __future__ import annotations

import argparse
import json
import math
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from fnmatch import fnmatch
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
from common.grid import table

from srs_twin.envs import TASKS, make_task
from srs_twin.envs.crawling import SPATIAL_FREQUENCIES_HZ
from srs_twin.envs.policy import Policy, baseline, load_policy, play_episode
from srs_twin.envs.task import Task, upper_bounds

SUCCESSES = ("goal_reached", "dragged")

MODULE_ERROR_RAD = 0.15
"""Largest mean error of a success in Module, rad."""

HOLD_S = 2.0
"""Time for which a random action is held, s."""

CONSTANTS = {
    "GoTo": [[0.0, 2.0, 55.5]],
    "Obstacles": [[0.0, 2.0, 55.5]],
    "Module": [[0.5, 0.5]],
    "Crawl3D": [
        [0.0, SPATIAL_FREQUENCIES_HZ[1], 28.9, 0.5, lag]
        for lag in (math.pi / 2, -math.pi / 2)
    ],
    "Pegs": [[0.0, 1.0, 48.3]],
    "Grasp": [[1.0, 0.0, 0.0, 1.2], [1.0, 1.0, 0.0, 1.2]],
}
"""Constant actions of each task in the units of its signals."""

HIDDEN = {
    "GoTo": {"goal_ahead_m": 1.0, "goal_left_m": 0.0},
    "Obstacles": {"obstacle_*_ahead_m": -5.0, "obstacle_*_left_m": -5.0},
    "Module": {"reference_rad": 0.0},
    "Crawl3D": {"goal_ahead_m": 0.0, "goal_left_m": 0.7},
    "Pegs": {"goal_ahead_m": 0.6, "goal_left_m": 0.0},
    "Grasp": {"object_ahead_m": -0.2, "object_left_m": 0.08},
}
"""Observation → what the blind controller gets in its place; in Obstacles it sees the goal."""


class Recording:
    """Policy that stores the actions of another one."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self.actions = list[np.ndarray]()

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action of the other policy."""
        self.actions.append(np.asarray(self._policy(observation)))
        return self.actions[-1]


def random_policy(task: Task, seed: int, hold_s: float) -> Policy:
    """Return a policy of uniformly distributed actions, each of which lasts `hold_s`."""
    rng = np.random.default_rng((seed, 1))
    last = list[np.ndarray]()
    steps = round(hold_s / task.step_s)
    high = upper_bounds(task.commands)

    def act(_: np.ndarray) -> np.ndarray:
        if len(last) % steps:
            action = last[-1]
        else:
            action = rng.uniform(-high, high)
        last.append(action)
        return action

    return act


def blind_policy(task: Task) -> Policy:
    """Return the controller with constant numbers in place of what the task shows."""
    controller = baseline(task)
    hidden = dict[int, float]()
    for k, signal in enumerate(task.observations):
        for pattern, value in HIDDEN[task.name].items():
            if fnmatch(signal.name, pattern):
                hidden[k] = value

    def act(observation: np.ndarray) -> np.ndarray:
        seen = observation.copy()
        seen[list(hidden)] = list(hidden.values())
        return controller(seen)

    return act


def open_loop_policy(task: Task, recorded: dict[str, list[np.ndarray]]) -> Policy:
    """Return the actions of the controller in the episode of seed 0."""
    if task.name not in recorded:
        controller = Recording(baseline(task))
        play_episode(task, controller, np.random.default_rng(0))
        recorded[task.name] = controller.actions
    left = iter(recorded[task.name])
    return lambda _: next(left, recorded[task.name][-1])


_RECORDED: dict[str, list[np.ndarray]] = {}


def policies(name: str) -> Iterator[tuple[str, Callable[[Task, int], Policy]]]:
    """Return the names of the policies of a task and functions that return them for an episode."""
    yield "baseline", lambda task, seed: baseline(task)
    yield "blind", lambda task, seed: blind_policy(task)
    yield "open loop", lambda task, seed: open_loop_policy(task, _RECORDED)
    yield "random", lambda task, seed: random_policy(task, seed, task.step_s)
    yield "random, held", lambda task, seed: random_policy(task, seed, HOLD_S)
    for k, action in enumerate(CONSTANTS[name], start=1):
        yield (
            f"constant {k}",
            lambda task, seed, action=action: lambda _: task.from_physical(action),
        )


def score(name: str, policy: str, seed: int) -> dict[str, Any]:
    """Run one episode with a policy of `policies` or a trained one."""
    task = make_task(name)
    untrained = dict(policies(name))
    if policy in untrained:
        act = untrained[policy](task, seed)
    else:
        act = load_policy(policy).bind(task)
    result = play_episode(task, act, np.random.default_rng(seed))
    succeeded = result.ending in SUCCESSES
    if name == "Module":
        succeeded = -result.reward <= MODULE_ERROR_RAD * result.time
    return {"task": name, "policy": policy, "seed": seed, "success": succeeded} | vars(
        result
    )


def rows(results: list[dict[str, Any]]) -> Iterator[list[str]]:
    """Return the cells of the table: one row per task and policy, of the constants only the best one."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for result in results:
        groups.setdefault((result["task"], result["policy"]), []).append(result)
    best: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for (task, policy), group in groups.items():
        key = task, "constant" if policy.startswith("constant") else policy
        if sum(r["success"] for r in group) >= sum(
            r["success"] for r in best.get(key, ())
        ):
            best[key] = group
    for (task, policy), group in best.items():
        endings = Counter(r["ending"] for r in group)
        counts = ", ".join(
            f"{count} `{ending}`" for ending, count in endings.most_common()
        )
        fraction = f"{sum(r['success'] for r in group)} of {len(group)}"
        reward, time = (mean(r[key] for r in group) for key in ("reward", "time"))
        yield [
            f"`{task}`",
            Path(policy).stem,
            fraction,
            counts,
            f"{reward:.2f}",
            f"{time:.1f}",
        ]


HEAD = ["environment", "policy", "successes", "endings", "mean return", "mean time, s"]


def main() -> None:
    """Print a table of all tasks."""
    arguments = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    arguments.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    arguments.add_argument("--episodes", type=int, default=30)
    arguments.add_argument("--first", type=int, default=0, help="first seed")
    arguments.add_argument(
        "--policies", nargs="+", help="names of policies, or files of trained ones"
    )
    arguments.add_argument(
        "--json", type=Path, help="file of the episodes, continued if it exists"
    )
    arguments.add_argument("--processes", type=int, default=None)
    options = arguments.parse_args()
    results = []
    if options.json and options.json.is_file():
        results = [
            json.loads(line) for line in options.json.read_text("utf-8").splitlines()
        ]
    done = {(r["task"], r["policy"], r["seed"]) for r in results}
    seeds = range(options.first, options.first + options.episodes)
    jobs = [
        (name, policy, seed)
        for name in options.tasks
        for seed in seeds
        for policy in options.policies or dict(policies(name))
        if (name, policy, seed) not in done
    ]
    with ProcessPoolExecutor(options.processes) as pool:
        for result in pool.map(score, *zip(*jobs, strict=True)) if jobs else ():
            results.append(result)
            if options.json:
                with options.json.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(result) + "\n")
    print(table(HEAD, list(rows(results))))


if __name__ == "__main__":
    main()
