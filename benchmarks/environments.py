"""Cost of a vector of environments compared with batched rollouts of the same twins.

    uv run python benchmarks/environments.py --environments 64 --seconds 3
    uv run python benchmarks/environments.py --check    # compare the distances travelled instead

All contenders run the same gait in turns on the same number of threads. The plain
rollout is a `TwinBatch` that plays the script of the gait in chunks of one environment
step (0.1 s), and again in chunks of 1 s. The vector also processes actions,
observations and rewards. The goals are out of reach, so no episode ends.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from common.grid import table
from common.timing import (
    ROUNDS,
    Ratio,
    Result,
    Task,
    Timing,
    interleaved,
    machine,
    three_figures,
)

from srs_twin import Gait, TwinBatch, load_robot
from srs_twin.envs.crawling import OPEN, CrawlTask
from srs_twin.envs.gymnasium import SnakeVectorEnv
from srs_twin.envs.observed import STEP_S

OFFSET = 0.1
FREQUENCY_HZ = 2.0
PRESSURE_KPA = 48.3


class Vector:
    """Environments under one action."""

    def __init__(self, count: int, threads: int | None) -> None:
        self._envs = SnakeVectorEnv("GoTo", count, threads=threads, limit_s=1e4)
        for env in self._envs.envs:
            assert isinstance(env.task, CrawlTask)
            env.task.arena = replace(OPEN, distances=(2.4, 2.4))
        action = self._envs.envs[0].task.from_physical(
            [OFFSET, FREQUENCY_HZ, PRESSURE_KPA]
        )
        self._actions = np.tile(action, (count, 1))
        self._envs.reset(seed=0)

    def run(self, seconds: float) -> None:
        """Simulate a duration (s)."""
        for _ in range(round(seconds / STEP_S)):
            self._envs.step(self._actions)


class Plain:
    """Twins under the script of one gait, played in chunks."""

    def __init__(self, count: int, threads: int | None, chunk: float) -> None:
        robot = load_robot("gen2")
        self._batch = TwinBatch(
            [robot] * count, supply_pa=1e3 * PRESSURE_KPA, threads=threads, tick=STEP_S
        )
        self._gait = Gait(FREQUENCY_HZ, OFFSET)
        self._chunk = chunk
        self._time = 0.0
        self._gait.reset(robot, STEP_S)

    def run(self, seconds: float) -> None:
        """Simulate a duration (s)."""
        script = self._gait.script(self._time + seconds)
        for _ in range(round(seconds / self._chunk)):
            part = script.slice(self._time, self._time + self._chunk)
            self._batch.play([part] * len(self._batch), round(self._chunk / STEP_S))
            self._time += self._chunk


def measure(count: int, seconds: float, rounds: int, threads: int | None) -> Result:
    """Time all three in turns."""
    contenders: dict[str, Vector | Plain] = {
        "vector": Vector(count, threads),
        "plain, 0.1 s": Plain(count, threads, STEP_S),
        "plain, 1 s": Plain(count, threads, 1.0),
    }
    for item in contenders.values():
        item.run(1.0)
    spent: dict[str, list[float]] = {name: [] for name in contenders}

    def metered(name: str) -> None:
        begun = time.process_time()
        contenders[name].run(seconds)
        spent[name].append((time.process_time() - begun) / (count * seconds))

    tasks = {name: Task(partial(metered, name), count * seconds) for name in contenders}
    times = interleaved(tasks, rounds)
    # On a busy machine processor times are more reliable than wall times.
    work = {name: Timing(tuple(seconds)) for name, seconds in spent.items()}
    # Ratio of rates: time of the plain rollout over time of the vector.
    ratios = {name: Ratio.between(times[name], times["vector"]) for name in times}
    fractions = {name: Ratio.between(work[name], work["vector"]) for name in times}
    rows = [
        [
            name,
            three_figures(1 / times[name].median),
            str(ratios[name]),
            str(fractions[name]),
        ]
        for name in times
    ]
    values: dict[str, Any] = {"environments": count, "seconds": seconds} | {
        name: (
            times[name].json()
            | {
                "vector_fraction": ratios[name].json(),
                "vector_share_processor": fractions[name].json(),
            }
        )
        for name in times
    }
    return Result(
        f"{count} environments compared with batched rollouts of the same twins",
        [
            "contender",
            "simulated s per s",
            "relative rate of the vector",
            "relative rate in processor time",
        ],
        rows,
        values,
    )


def check() -> None:
    """Raise an error unless both contenders travel the same distance."""
    vector = Vector(2, 1)
    plain = Plain(2, 1, STEP_S)
    whole = Plain(2, 1, 1.0)
    for contender in (vector, plain, whole):
        contender.run(1.0)
    distance = np.hypot(*plain._batch.state.com.T)
    np.testing.assert_allclose(
        np.hypot(*whole._batch.state.com.T), distance, rtol=1e-6, atol=1e-9
    )
    env_distance = [np.hypot(*env.episode.state.com) for env in vector._envs.envs]
    np.testing.assert_allclose(env_distance, distance, rtol=1e-6, atol=1e-5)
    if min(distance) < 0.1 or any(env.episode.ending for env in vector._envs.envs):
        raise AssertionError(
            f"distances {distance}: the snakes must crawl, and no episode may end"
        )
    print("distances travelled, m:", *(f"{item:.6f}" for item in distance))


def main() -> None:
    """Print the table and the values."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument(
        "--environments", type=int, default=64, help="number of environments"
    )
    arguments.add_argument(
        "--seconds", type=float, default=2.0, help="simulated time per round, s"
    )
    arguments.add_argument(
        "--rounds", type=int, default=ROUNDS, help="number of rounds"
    )
    arguments.add_argument(
        "--threads", type=int, default=None, help="number of threads"
    )
    arguments.add_argument(
        "--check", action="store_true", help="compare the distances travelled and stop"
    )
    options = arguments.parse_args()
    if options.check:
        check()
        return
    result = measure(
        options.environments, options.seconds, options.rounds, options.threads
    )
    print(f"{result.title}\n\n{table(result.head, result.rows)}\n")
    print(json.dumps(result.values | {"machine": machine()}, indent=1))


if __name__ == "__main__":
    main()
