"""(d) Cost of a simulated second by the number of segments; (e) speed-up by a second thread."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from common.timing import Ratio, Result, Task, Timing, interleaved, once, three_figures
from numba import njit

from srs_twin import (
    AnalyticalSnake,
    DivergedError,
    Gait,
    Job,
    Plant,
    RobotSpec,
    SnakeState,
    TwinBatch,
    TwinSnake,
    load_robot,
    rollout,
    run_batch,
    run_many,
)
from srs_twin.compute.workers import Workers

SEGMENTS = (2, 4, 8, 16, 32, 64)
PLANTS: dict[str, Callable[[RobotSpec], Plant]] = {
    "complete": AnalyticalSnake,
    "compliant": lambda spec: AnalyticalSnake(spec, model="compliant"),
    "twin": TwinSnake,
    "twin, preloaded": lambda spec: TwinSnake(spec, contact="preloaded"),
}
PROBE = 0.02  # simulated s; a first run to estimate the cost
LEAST = 25  # smallest number of probe lengths: a reset costs several of them
AIM = 1.0  # s of processor time per round, within 0.5 to 4 simulated seconds
TOO_SLOW = 3.0  # s of processor time; a slower probe is the only measurement
THREADS = 2
RUNS = 8
MANY = 12  # rounds; other programs disturb two threads more than one, so the best round counts
ALONE = 0.4  # s of wall time for one thread
ARITHMETIC = "arithmetic only"
Work = Callable[[int], object]


def chain(segments: int) -> RobotSpec:
    """Return generation 2 with another number of equal segments; four segments are one wavelength.

    >>> robot, base = chain(16), load_robot("gen2")
    >>> robot.segments, robot.geometry.pitch == base.geometry.pitch, robot.phase_step == base.phase_step
    (16, True, True)
    >>> round(robot.mass.total / base.mass.total, 9) == round(17 / 5, 9)
    True
    """
    spec = load_robot("gen2")
    return replace(
        spec,
        geometry=replace(spec.geometry, connectors=segments + 1),
        mass=replace(spec.mass, connectors=(spec.mass.connectors[0],) * (segments + 1)),
    )


def by_segments(quick: bool) -> Result:
    """Time all models with every number of segments.

    Args:
        quick: use at most 16 segments.
    """
    lengths = SEGMENTS[:4] if quick else SEGMENTS
    for make in PLANTS.values():
        rollout(make(chain(lengths[0])), Gait(2.0), PROBE)  # compiles
    costs = {
        segments: _cost(chain(segments), AIM / 10 if quick else AIM)
        for segments in lengths
    }
    rows = [
        [name, *(_cell(costs[n][name], costs[4][name]) for n in lengths)]
        for name in PLANTS
    ]
    return Result(
        "(d) processor milliseconds per simulated second by segments (relative to 4)",
        ["model", *map(str, lengths)],
        rows,
        {
            "processor_s_per_simulated_s": {
                name: {n: costs[n][name] for n in lengths} for name in PLANTS
            }
        },
        [
            f"Best of all rounds; a single one where a tick of {PROBE:g} s took more"
            f" than {TOO_SLOW:g} s."
        ],
    )


def _cost(spec: RobotSpec, aim: float) -> dict[str, float | str]:
    """Return processor seconds per simulated second by model, or the reason for a failure."""
    result: dict[str, float | str] = {}
    tasks = {}
    for name, make in PLANTS.items():
        plant = make(spec)
        try:
            slow = once(_task(plant, PROBE))
            if slow * PROBE > TOO_SLOW:
                result[name] = slow
                continue
            tasks[name] = _task(
                plant, PROBE * max(LEAST, min(200, round(aim / slow / PROBE)))
            )
            tasks[name].run()
        except DivergedError as error:
            result[name] = f"diverged: {error}"
            tasks.pop(name, None)
    return result | {
        name: min(timing.seconds) for name, timing in interleaved(tasks).items()
    }


def _task(plant: Plant, duration: float) -> Task:
    return Task(
        lambda: rollout(plant, Gait(2.0), duration), duration, time.process_time
    )


def _cell(cost: float | str, four: float | str) -> str:
    if isinstance(cost, str):
        return "diverged"
    if isinstance(four, str):
        times = ""
    else:
        times = f" ({three_figures(cost / four)})"
    return f"{three_figures(1e3 * cost)}{times}"


def by_threads(quick: bool) -> Result:
    """Time many runs on one thread and on two.

    Args:
        quick: use a third of the rounds.
    """
    kinds = {
        ARITHMETIC: _arithmetic(ALONE),
        "analytical": many(AnalyticalSnake, ALONE),
        "twin": many(TwinSnake, ALONE),
        "twin, commanded every tick": steered(ALONE),
    }
    costs = _turns(kinds, MANY // 3 if quick else MANY)
    machine = costs[ARITHMETIC].efficiency
    rows = [
        [
            name,
            str(cost.speedup),
            f"{cost.efficiency:.2f}",
            f"{cost.efficiency / machine:.2f}",
            f"{cost.overhead:.2f}",
        ]
        for name, cost in costs.items()
    ]
    return Result(
        f"(e) {RUNS} runs on {THREADS} threads against one",
        ["what", "speed-up", "efficiency", "relative to the machine", "processor time"],
        rows,
        {name: cost.json() for name, cost in costs.items()},
        [
            (
                "Speed-up: ratio of medians. Efficiency: best round on one thread over"
                " twice the best on two."
            ),
            (
                "The first row needs neither memory nor locks: it is the possible"
                " speed-up of this machine."
            ),
            (
                "Processor time: two threads relative to one, best rounds; independent"
                " of other programs."
            ),
        ],
    )


@dataclass(frozen=True)
class ThreadCost:
    """Cost of runs by number of threads.

    Attributes:
        wall: wall times.
        processor: processor times, summed over the threads.

    >>> wall = {1: Timing((4.0, 9.0, 4.4)), 2: Timing((7.0, 2.5, 8.0))}
    >>> cost = ThreadCost(wall, processor={1: Timing((4.0, 4.2, 4.1)), 2: Timing((4.6, 4.4, 5.0))})
    >>> cost.efficiency, cost.overhead, round(cost.speedup.value, 3), cost.json()["wall"][2]["median_s"]
    (0.8, 1.1, 0.629, 7.0)
    """

    wall: dict[int, Timing]
    processor: dict[int, Timing]

    @property
    def speedup(self) -> Ratio:
        """Speed of several threads relative to one."""
        return Ratio.between(self.wall[1], self.wall[THREADS])

    @property
    def efficiency(self) -> float:
        """Parallel efficiency, from the best round of each number of threads."""
        return min(self.wall[1].seconds) / min(self.wall[THREADS].seconds) / THREADS

    @property
    def overhead(self) -> float:
        """Processor time on several threads relative to one, from the best round of each."""
        return min(self.processor[THREADS].seconds) / min(self.processor[1].seconds)

    def json(self) -> dict[str, Any]:
        """Return JSON values."""
        values = {
            "speedup": self.speedup.json(),
            "efficiency": self.efficiency,
            "overhead": self.overhead,
        }
        for name, times in (("wall", self.wall), ("processor", self.processor)):
            values[name] = {n: timing.json() for n, timing in times.items()}
        return values


def _turns(kinds: Mapping[str, Work], rounds: int) -> dict[str, ThreadCost]:
    """Time all kinds of work in turns, on one thread and on two."""
    result: dict[tuple[str, int], list[tuple[float, float]]] = defaultdict(list)
    for work in kinds.values():
        work(THREADS)
    for k in range(rounds):
        for name, work in kinds.items():
            for threads in (1, THREADS) if k % 2 else (THREADS, 1):
                begun = time.perf_counter(), time.process_time()
                work(threads)
                result[name, threads].append(
                    (time.perf_counter() - begun[0], time.process_time() - begun[1])
                )
    return {
        name: ThreadCost(
            *(
                {
                    n: Timing(tuple(pair[k] for pair in result[name, n]))
                    for n in (1, THREADS)
                }
                for k in (0, 1)
            )
        )
        for name in kinds
    }


def many(make: Callable[[RobotSpec], Plant], aim: float) -> Work:
    """Return a function that runs one robot with gaits of different offsets on a number of threads.

    Args:
        make: function that builds the plant.
        aim: wall time of all runs on one thread, s.
    """
    spec = load_robot("gen2")
    plants = [make(spec) for _ in range(RUNS)]
    duration = _duration(lambda probe: rollout(plants[0], Gait(2.0), probe), aim)

    def work(threads: int) -> None:
        run_many(
            [
                Job(plant, gait, duration)
                for plant, gait in zip(plants, _gaits(), strict=True)
            ],
            threads=threads,
        )

    return work


def steered(aim: float) -> Work:
    """Return a function that runs a batch of twins whose valves are set every tick.

    Args:
        aim: as in `many`.
    """
    batches = {
        n: TwinBatch([load_robot("gen2")] * RUNS, threads=n) for n in (1, THREADS)
    }

    def policy(state: SnakeState) -> np.ndarray:
        signs = np.where(state.measured_bend > 0, -1, 1).astype(
            np.int8
        )  # a segment reverses as soon as allowed
        return np.stack([signs, -signs], axis=-1)

    duration = _duration(lambda probe: run_batch(batches[1], policy, probe), aim * RUNS)
    return lambda threads: run_batch(batches[threads], policy, duration)


def _gaits() -> list[Gait]:
    return [Gait(2.0, 0.4 * k / RUNS) for k in range(RUNS)]


def _duration(run: Callable[[float], object], aim: float) -> float:
    """Return the duration, in multiples of 0.2 s, with which RUNS runs take the wanted time."""
    run(PROBE)  # compiles
    slow = once(Task(lambda: run(0.2), 0.2))
    return 0.2 * max(1, round(aim / RUNS / slow / 0.2))


def _arithmetic(aim: float) -> Work:
    """Return a function that computes for the wanted time in compiled code without locks."""
    probe = 1_000_000
    _spin(1)  # compiles
    steps = round(aim / RUNS / once(Task(lambda: _spin(probe))) * probe)

    def work(threads: int) -> None:
        Workers(threads).run(RUNS, lambda k, stopped: _spin(steps))

    return work


@njit(nogil=True, cache=True)
def _spin(steps):  # type: ignore[no-untyped-def]
    value = 0.1
    for _ in range(steps):
        value = 3.7 * value * (1.0 - value)
    return value
