"""How the benchmarks time: tasks take turns, medians of at least five rounds, ratios with their spread."""

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
PACKAGES = ("srs-twin", "numpy", "scipy", "numba", "mujoco", "dm-control", "pyelastica")


@dataclass(frozen=True)
class Timing:
    """Times of one task.

    Attributes:
        seconds: one a round, per simulated second where the task says how many it simulates.
    """

    seconds: tuple[float, ...]

    @property
    def median(self) -> float:
        """The middle round, s."""
        return statistics.median(self.seconds)

    def json(self) -> dict[str, Any]:
        """Return JSON values."""
        return {"median_s": self.median, "rounds_s": list(self.seconds)}


@dataclass(frozen=True)
class Ratio:
    """How many times as long one task takes as another.

    Attributes:
        value: ratio of the medians.
        least, most: among the rounds, each of which timed both tasks within a moment.
    """

    value: float
    least: float
    most: float

    @classmethod
    def of(cls, slow: Timing, fast: Timing) -> Ratio:
        """Compare two tasks that took turns."""
        rounds = [a / b for a, b in zip(slow.seconds, fast.seconds, strict=True)]
        return cls(slow.median / fast.median, min(rounds), max(rounds))

    def json(self) -> dict[str, float]:
        """Return JSON values."""
        return {"value": self.value, "least": self.least, "most": self.most}

    def __str__(self) -> str:
        return f"{three_figures(self.value)} ({three_figures(self.least)} to {three_figures(self.most)})"


@dataclass(frozen=True)
class Task:
    """What is timed.

    Attributes:
        run: called once a round; what it returns is dropped.
        simulated: seconds it simulates; 1: the time stands for itself.
        clock: which time, s.
    """

    run: Callable[[], object]
    simulated: float = 1.0
    clock: Callable[[], float] = time.perf_counter


@dataclass(frozen=True)
class Result:
    """One benchmark's outcome.

    Attributes:
        title: what was compared.
        head, rows: its table.
        values: the same and more, as JSON values.
        remarks: lines to read with the table.
    """

    title: str
    head: list[str]
    rows: list[list[str]]
    values: dict[str, Any]
    remarks: list[str] = field(default_factory=list)


def interleaved(tasks: Mapping[str, Task], rounds: int = ROUNDS) -> dict[str, Timing]:
    """Time all tasks in every round, so that a noisy moment of the machine hits them alike.

    The order turns from round to round. Warm up before: nothing is left out here.

    Args:
        tasks: by name.
        rounds: how often.

    Returns:
        Seconds per simulated second, by name.
    """
    seconds: dict[str, list[float]] = {name: [] for name in tasks}
    for k in range(rounds):
        for name in list(tasks)[:: 1 if k % 2 == 0 else -1]:
            seconds[name].append(once(tasks[name]))
    return {name: Timing(tuple(values)) for name, values in seconds.items()}


def once(task: Task) -> float:
    """Run a task and return its time per simulated second, s."""
    begun = task.clock()
    task.run()
    return (task.clock() - begun) / task.simulated


def machine() -> dict[str, Any]:
    """Return what the numbers depend on: processor, Python, versions. No names of hosts or folders."""
    return {
        "cpu": _cpu_model(),
        "cpus": os.cpu_count(),
        "system": platform.system(),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
    }


def _cpu_model() -> str:
    table = Path("/proc/cpuinfo")
    lines = table.read_text("utf-8").splitlines() if table.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def three_figures(value: float) -> str:
    """Return a number with three figures, without an exponent."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
