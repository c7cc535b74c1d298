"""Timing for the benchmarks: tasks in turns, medians of five or more rounds, ratios with their range."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

ROUNDS = 5
PACKAGES = ("srs-twin", "numpy", "scipy", "numba", "mujoco", "pyelastica")


@dataclass(frozen=True)
class Timing:
    """Times of one task.

    Attributes:
        seconds: one time per round, divided by the simulated seconds of the task if it
            has any.
    """

    seconds: tuple[float, ...]

    @property
    def median(self) -> float:
        """Median over the rounds, s."""
        return statistics.median(self.seconds)

    def json(self) -> dict[str, Any]:
        """Return JSON values."""
        return {"median_s": self.median, "rounds_s": list(self.seconds)}


@dataclass(frozen=True)
class Ratio:
    """Ratio of the times of two tasks.

    Attributes:
        value: ratio of the medians.
        least, most: smallest and largest ratio in one round.

    >>> ratio = Ratio.between(Timing((2.0, 30.0, 4.0, 5.0, 6.0)), Timing((1.0, 1.0, 1.0, 2.0, 1.0)))
    >>> (ratio.value, ratio.least, ratio.most), str(ratio)
    ((5.0, 2.0, 30.0), '5 (2 to 30)')
    """

    value: float
    least: float
    most: float

    @classmethod
    def between(cls, slow: Timing, fast: Timing) -> Ratio:
        """Compare two tasks that were timed in turns."""
        rounds = [a / b for a, b in zip(slow.seconds, fast.seconds, strict=True)]
        return cls(slow.median / fast.median, min(rounds), max(rounds))

    def json(self) -> dict[str, float]:
        """Return JSON values."""
        return {"value": self.value, "least": self.least, "most": self.most}

    def __str__(self) -> str:
        return (
            f"{three_figures(self.value)} ({three_figures(self.least)} to"
            f" {three_figures(self.most)})"
        )


@dataclass(frozen=True)
class Task:
    """Function to be timed.

    Attributes:
        run: function that is called once per round; its result is ignored.
        simulated: simulated time that divides the measured time, s.
        clock: clock that measures the time, s.
    """

    run: Callable[[], object]
    simulated: float = 1.0
    clock: Callable[[], float] = time.perf_counter


@dataclass(frozen=True)
class Result:
    """Result of one benchmark.

    Attributes:
        title: the comparison in one line.
        head, rows: headings and rows of the table.
        values: all numbers, as JSON values.
        remarks: remarks on the table.
    """

    title: str
    head: list[str]
    rows: list[list[str]]
    values: dict[str, Any]
    remarks: list[str] = field(default_factory=list)


def interleaved(tasks: Mapping[str, Task], rounds: int = ROUNDS) -> dict[str, Timing]:
    """Time all tasks in every round, so that a disturbance of the machine affects all of them.

    The order is reversed in every other round. There is no warm-up: call the tasks once
    before.

    Args:
        tasks: tasks by name.
        rounds: number of rounds.

    Returns:
        Seconds per simulated second, by name.

    >>> calls = []
    >>> times = interleaved({name: Task(lambda name=name: calls.append(name)) for name in "abc"}, rounds=3)
    >>> "".join(calls), {name: len(timing.seconds) for name, timing in times.items()}
    ('abccbaabc', {'a': 3, 'b': 3, 'c': 3})
    >>> interleaved({"nap": Task(lambda: time.sleep(0.02), simulated=0.1)}, rounds=1)["nap"].median >= 0.2
    True
    """
    seconds: dict[str, list[float]] = {name: [] for name in tasks}
    for k in range(rounds):
        for name in list(tasks)[:: 1 if k % 2 == 0 else -1]:
            seconds[name].append(once(tasks[name]))
    return {name: Timing(tuple(values)) for name, values in seconds.items()}


def once(task: Task) -> float:
    """Run a task and return its time per simulated second, s."""
    start = task.clock()
    task.run()
    return (task.clock() - start) / task.simulated


def machine() -> dict[str, Any]:
    """Return processor, Python and package versions, without names of hosts, users or folders."""
    return {
        "cpu": _cpu_model(),
        "cpus": os.cpu_count(),
        "system": platform.system(),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
    }


def _cpu_model() -> str:
    table = Path("/proc/cpuinfo")
    if table.exists():
        lines = table.read_text("utf-8").splitlines()
    else:
        lines = []
    models = [
        line.partition(":")[2].strip()
        for line in lines
        if line.startswith("model name")
    ]
    if models:
        return models[0]
    return platform.machine()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def three_figures(value: float) -> str:
    """Return a number with three significant figures, without an exponent."""
    if abs(value) >= 100:
        return f"{value:.0f}"
    return f"{value:.3g}"
