"""(c) Both plants compared with the continuum snake of PyElastica, each with its default settings.

The bodies and the models differ. The comparison shows how many seconds of a snake one
second of computing time simulates. `agreement.py --refine shipped` shows the error of the twin's speed
with its default settings.
"""

from __future__ import annotations

from functools import partial

from common.timing import Ratio, Result, Task, interleaved

from srs_twin import AnalyticalSnake, Gait, TwinSnake, load_robot, rollout

SIMULATED = (
    1.0  # s; our plants simulate longer so that every task takes a measurable time
)
NEEDS = (
    "PyElastica is not installed: `uv run --group benchmarks python"
    " benchmarks/speed.py`"
)


def run(quick: bool) -> Result:
    """Time PyElastica with and without the records of its example, the twin and the analytical model.

    Args:
        quick: simulate a fifth of the time with PyElastica.

    Raises:
        ModuleNotFoundError: PyElastica is not installed.
    """
    from common.elastica_snake import ContinuumSnake

    simulated = SIMULATED / 5 if quick else SIMULATED
    spec = load_robot("gen2")
    plain = ContinuumSnake(record=False)
    recording = ContinuumSnake(record=True)
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
        f"{plant} over {theirs}": Ratio.between(times[theirs], times[plant])
        for plant in snakes
        for theirs in ("PyElastica", "PyElastica, recording")
    }
    rows = [
        [
            name,
            f"{1 / timing.median:.3g}",
            *(
                str(Ratio.between(times[theirs], timing))
                for theirs in ("PyElastica", "PyElastica, recording")
            ),
        ]
        for name, timing in times.items()
    ]
    return Result(
        "(c) gen2 compared with the continuum snake of PyElastica",
        [
            "what",
            "simulated s per wall s",
            "relative to PyElastica",
            "relative to PyElastica, recording",
        ],
        rows,
        {
            "ratios": {name: ratio.json() for name, ratio in ratios.items()},
            "times": {name: timing.json() for name, timing in times.items()},
            "simulated_s_per_wall_s": {
                name: 1 / timing.median for name, timing in times.items()
            },
        },
        [
            (
                "PyElastica: 50 elements, steps of 0.1 ms; with 60 records per second"
                " or none."
            ),
            (
                "Our plants record 100 samples per second. Error of the twin:"
                " `benchmarks/agreement.py --refine shipped`."
            ),
        ],
    )
