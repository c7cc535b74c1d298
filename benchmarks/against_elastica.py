"""(c) Both plants against PyElastica's continuum snake, each at its own defaults.

Different bodies and different models: what is compared is how many seconds of a snake a second of computing
buys. How far the twin's speed at its defaults is from its own refined limit, `refinement.py` shows.
"""

from __future__ import annotations

from functools import partial

from timing import Ratio, Result, Task, interleaved

from srs_twin import AnalyticalSnake, Gait, TwinSnake, load_robot, rollout

SIMULATED = 1.0  # s of PyElastica's; ours longer, so that every task takes long enough to be timed
NEEDS = "PyElastica is not installed: `uv run --group benchmarks python benchmarks/speed.py`"


def run(quick: bool) -> Result:
    """Time PyElastica with and without what its example records, twin and analytical model.

    Args:
        quick: a fifth of PyElastica's simulated time.

    Raises:
        ModuleNotFoundError: PyElastica is not installed.
    """
    from elastica_snake import ContinuumSnake

    simulated = SIMULATED / 5 if quick else SIMULATED
    spec = load_robot("gen2")
    plain, recording = ContinuumSnake(record=False), ContinuumSnake(record=True)
    snakes = {
        "twin": (TwinSnake(spec), 4 * simulated),
        "twin, 2 ms": (TwinSnake(spec, timestep=0.002), 4 * simulated),
        "twin, preloaded": (TwinSnake(spec, contact="preloaded"), 4 * simulated),
        "analytical": (AnalyticalSnake(spec), 10 * simulated),
    }
    tasks = {
        "PyElastica": Task(lambda: plain.advance(simulated), simulated),
        "PyElastica, recording": Task(lambda: recording.advance(simulated), simulated),
    }
    for name, (snake, time) in snakes.items():
        tasks[name] = Task(partial(rollout, snake, Gait(2.0), time), time)
    for task in tasks.values():
        task.run()  # compiles
    times = interleaved(tasks)
    ratios = {
        f"{plant} over {theirs}": Ratio.of(times[theirs], times[plant])
        for plant in snakes
        for theirs in ("PyElastica", "PyElastica, recording")
    }
    rows = [
        [
            name,
            f"{1 / timing.median:.3g}",
            *(str(Ratio.of(times[theirs], timing)) for theirs in ("PyElastica", "PyElastica, recording")),
        ]
        for name, timing in times.items()
    ]
    return Result(
        "(c) gen2 against PyElastica's continuum snake",
        ["what", "simulated s per wall s", "over PyElastica", "over PyElastica, recording"],
        rows,
        {
            "ratios": {name: ratio.json() for name, ratio in ratios.items()},
            "times": {name: timing.json() for name, timing in times.items()},
            "simulated_s_per_wall_s": {name: 1 / timing.median for name, timing in times.items()},
        },
        [
            "PyElastica: 50 elements, steps of 0.1 ms; recording 60 times a second or never.",
            "Ours record 100 times a second. The twin's error at its defaults: `benchmarks/refinement.py`.",
        ],
    )
