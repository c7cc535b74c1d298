"""What a vector of environments costs beside the plain batched rollout of the same twins.

    uv run python benchmarks/environments.py --environments 64 --seconds 3

All run the same gait in turns, over as many threads. The plain rollout is a `TwinBatch` under the gait's
script, played in pieces of a step of the environments (0.1 s), and again in pieces of a second; the vector
besides takes actions, observes, rewards and tells. Goals are out of reach, so that no episode begins within
the time.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from grid import table
from timing import ROUNDS, Ratio, Result, Task, Timing, interleaved, machine, three_figures

from srs_twin import Gait, TwinBatch, load_robot
from srs_twin.envs.crawling import OPEN, STEP_S, CrawlTask
from srs_twin.envs.gymnasium import SnakeVectorEnv

OFFSET, FREQUENCY_HZ, PRESSURE_KPA = 0.1, 2.0, 48.3


class Vector:
    """Environments under one action."""

    def __init__(self, count: int, threads: int | None) -> None:
        self._envs = SnakeVectorEnv("GoTo", count, threads=threads, limit_s=1e4)
        for env in self._envs.envs:
            assert isinstance(env.task, CrawlTask)
            env.task.arena = replace(OPEN, distances=(2.4, 2.4))
        self._actions = np.tile(np.float32([OFFSET, FREQUENCY_HZ, PRESSURE_KPA]), (count, 1))
        self._envs.reset(seed=0)

    def run(self, seconds: float) -> None:
        """Step so many simulated seconds."""
        for _ in range(round(seconds / STEP_S)):
            self._envs.step(self._actions)


class Plain:
    """Twins under the script of one gait, played in pieces."""

    def __init__(self, count: int, threads: int | None, piece: float) -> None:
        robot = load_robot("gen2")
        self._batch = TwinBatch([robot] * count, supply_pa=1e3 * PRESSURE_KPA, threads=threads, tick=STEP_S)
        self._gait, self._piece, self._time = Gait(FREQUENCY_HZ, OFFSET), piece, 0.0
        self._gait.reset(robot, STEP_S)

    def run(self, seconds: float) -> None:
        """Play so many simulated seconds."""
        script = self._gait.script(self._time + seconds)
        for _ in range(round(seconds / self._piece)):
            part = script.slice(self._time, self._time + self._piece)
            self._batch.play([part] * len(self._batch), round(self._piece / STEP_S))
            self._time += self._piece


def measure(count: int, seconds: float, rounds: int, threads: int | None) -> Result:
    """Time all three in turns."""
    contenders: dict[str, Vector | Plain] = {
        "vector": Vector(count, threads),
        "plain, 0.1 s": Plain(count, threads, STEP_S),
        "plain, 1 s": Plain(count, threads, 1.0),
    }
    for each in contenders.values():
        each.run(1.0)
    spent: dict[str, list[float]] = {name: [] for name in contenders}

    def metered(name: str) -> None:
        begun = time.process_time()
        contenders[name].run(seconds)
        spent[name].append((time.process_time() - begun) / (count * seconds))

    tasks = {name: Task(partial(metered, name), count * seconds) for name in contenders}
    times = interleaved(tasks, rounds)
    # On a busy machine the processor time tells more than the wall's.
    work = {name: Timing(tuple(seconds)) for name, seconds in spent.items()}
    # How much of the plain rate the vector reaches: the plain one's time over the vector's.
    ratios = {name: Ratio.of(times[name], times["vector"]) for name in times}
    shares = {name: Ratio.of(work[name], work["vector"]) for name in times}
    rows = [
        [name, three_figures(1 / times[name].median), str(ratios[name]), str(shares[name])] for name in times
    ]
    values: dict[str, Any] = {"environments": count, "seconds": seconds} | {
        name: times[name].json()
        | {"vector_share": ratios[name].json(), "vector_share_processor": shares[name].json()}
        for name in times
    }
    return Result(
        f"{count} environments beside plain batched rollouts of the same twins",
        ["what", "simulated seconds a second", "the vector's rate over its", "the same in processor time"],
        rows, values,
    )  # fmt: skip


def main() -> None:
    """Print the table and the values."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--environments", type=int, default=64)
    arguments.add_argument("--seconds", type=float, default=2.0)
    arguments.add_argument("--rounds", type=int, default=ROUNDS)
    arguments.add_argument("--threads", type=int, default=None)
    given = arguments.parse_args()
    found = measure(given.environments, given.seconds, given.rounds, given.threads)
    print(f"{found.title}\n\n{table(found.head, found.rows)}\n")
    print(json.dumps(found.values | {"machine": machine()}, indent=1))


if __name__ == "__main__":
    main()
