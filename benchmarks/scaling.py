"""(d) What a second of a snake costs by its number of segments; (e) what a second thread buys."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

from numba import njit
from timing import Ratio, Result, Task, interleaved, once, three_figures

from srs_twin import AnalyticalSnake, DivergedError, Gait, Plant, RobotSpec, TwinSnake, load_robot, rollout

SEGMENTS = (2, 4, 8, 16, 32, 64)
PLANTS: dict[str, Callable[[RobotSpec], Plant]] = {
    "complete": AnalyticalSnake,
    "compliant": lambda spec: AnalyticalSnake(spec, model="compliant"),
    "twin": TwinSnake,
}
PROBE = 0.02  # s simulated, to see what a case costs
AIM = 0.3  # s of wall time a round, as far as 0.02 to 4 simulated seconds allow
TOO_SLOW = 3.0  # s of wall time for the probe alone, beyond which it stands for all rounds
THREADS = 2
RUNS = 8
ALONE = 1.0  # s of wall time that one thread should need


def chain(segments: int) -> RobotSpec:
    """Return a gen2 with that many segments, each like its own, and its wave: one in four segments."""
    spec = load_robot("gen2")
    return replace(
        spec,
        geometry=replace(spec.geometry, connectors=segments + 1),
        mass=replace(spec.mass, connectors=(spec.mass.connectors[0],) * (segments + 1)),
    )


def by_segments(quick: bool) -> Result:
    """Time all three models at every length.

    Args:
        quick: up to 16 segments.
    """
    lengths = SEGMENTS[:4] if quick else SEGMENTS
    for make in PLANTS.values():
        rollout(make(chain(lengths[0])), Gait(2.0), PROBE)  # compiles
    costs = {segments: _cost(chain(segments), AIM / 10 if quick else AIM) for segments in lengths}
    rows = [[name, *(_cell(costs[n][name], costs[4][name]) for n in lengths)] for name in PLANTS]
    return Result(
        "(d) wall milliseconds a simulated second by segments (times those of 4)",
        ["model", *map(str, lengths)],
        rows,
        {"wall_s_per_simulated_s": {name: {n: costs[n][name] for n in lengths} for name in PLANTS}},
        [f"Without a median where a tick of {PROBE:g} s took more than {TOO_SLOW:g} s."],
    )


def _cost(spec: RobotSpec, aim: float) -> dict[str, float | str]:
    """Return wall seconds a simulated second by model, or why there are none."""
    found: dict[str, float | str] = {}
    tasks = {}
    for name, make in PLANTS.items():
        plant = make(spec)
        try:
            slow = once(_task(plant, PROBE))
            if slow * PROBE > TOO_SLOW:
                found[name] = slow
                continue
            tasks[name] = _task(plant, PROBE * max(1, min(200, round(aim / slow / PROBE))))
            tasks[name].run()
        except DivergedError as error:
            found[name] = f"diverged: {error}"
            tasks.pop(name, None)
    return found | {name: timing.median for name, timing in interleaved(tasks).items()}


def _task(plant: Plant, duration: float) -> Task:
    return Task(lambda: rollout(plant, Gait(2.0), duration), duration)


def _cell(cost: float | str, four: float | str) -> str:
    if isinstance(cost, str):
        return "diverged"
    times = "" if isinstance(four, str) else f" ({three_figures(cost / four)})"
    return f"{three_figures(1e3 * cost)}{times}"


def by_threads(quick: bool) -> Result:
    """Time many runs on one thread and on two.

    Args:
        quick: a third of the time.
    """
    aim = ALONE / 3 if quick else ALONE
    kinds = {
        "analytical": many(AnalyticalSnake, aim),
        "twin": many(TwinSnake, aim),
        "nothing but arithmetic": _arithmetic(aim),
    }
    rows, values = [], {}
    for name, work in kinds.items():
        work(THREADS)
        tasks = {str(n): Task(partial(work, n)) for n in (1, THREADS)}
        times = interleaved(tasks)
        speedup = Ratio.of(times["1"], times[str(THREADS)])
        efficiency = speedup.value / THREADS
        rows.append([name, str(speedup), f"{efficiency:.2f}"])
        values[name] = {"speedup": speedup.json(), "efficiency": efficiency}
        values[name]["times"] = {n: timing.json() for n, timing in times.items()}
    return Result(
        f"(e) {RUNS} runs on {THREADS} threads against one",
        ["what", "speed-up", "efficiency"],
        rows,
        values,
        ["The last row needs no memory and no lock: what this machine's second processor is worth just now."],
    )


def many(make: Callable[[RobotSpec], Plant], aim: float) -> Callable[[int], None]:
    """Return what runs one robot under gaits of different offsets over so many threads.

    Args:
        make: the plant.
        aim: wall time that one thread should need for all, s.
    """
    spec = load_robot("gen2")
    plants = [make(spec) for _ in range(RUNS)]
    gaits = [Gait(2.0, 0.4 * k / RUNS) for k in range(RUNS)]
    rollout(plants[0], gaits[0], 0.2)  # compiles
    slow = once(_task(plants[0], 0.2))
    duration = 0.2 * max(1, round(aim / RUNS / slow / 0.2))

    def work(threads: int) -> None:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(lambda plant, gait: rollout(plant, gait, duration), plants, gaits))

    return work


def _arithmetic(aim: float) -> Callable[[int], None]:
    """Return what spins for as long, by compiled code that holds no lock."""
    probe = 1_000_000
    _spin(1)  # compiles
    steps = round(aim / RUNS / once(Task(lambda: _spin(probe))) * probe)

    def work(threads: int) -> None:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(lambda _: _spin(steps), range(RUNS)))

    return work


@njit(nogil=True, cache=True)
def _spin(steps):  # type: ignore[no-untyped-def]
    value = 0.1
    for _ in range(steps):
        value = 3.7 * value * (1.0 - value)
    return value
