"""Memory, files, threads and processes during an hour of work in one process.

    uv run python tools/soak.py [--minutes 60] [--json FILE]

Every cycle runs a scenario on both plants with all its files, sweeps a small grid with
two workers, steers a batch of twins, and reads a trajectory. The growth of memory is
the slope of a straight line through the cycles after the first quarter, in which caches
fill.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import sys
import tempfile
import threading
import time
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np

from srs_twin import Trajectory, TwinBatch, load_robot, load_scenario, run_batch
from srs_twin.experiment import run_scenario
from srs_twin.studies.sweep.execution import local, open_sweep
from srs_twin.studies.sweep.loading import load_sweep

SWEEP = """\
scenario: gen2_straight
plants: [analytical, twin]
fixed: {duration_s: 2}
trajectories: true
vary:
  supply.pressure_kpa: {from: 41, to: 55, count: 4}
plots: [{kind: line, x: supply.pressure_kpa, metric: com_speed_m_s}]
"""
MIB = 2**20


@dataclass(frozen=True)
class Sample:
    """Resources of the process after a cycle.

    Attributes:
        minutes: time since the start, min.
        memory: resident memory, MiB.
        files: number of open descriptors.
        threads: number of interpreter threads.
        children: number of running child processes.
    """

    minutes: float
    memory: float
    files: int
    threads: int
    children: int


def measure(begun: float) -> Sample:
    """Return the resources of this process."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return Sample(
        minutes=(time.monotonic() - begun) / 60,
        memory=pages * os.sysconf("SC_PAGE_SIZE") / MIB,
        files=len(os.listdir("/proc/self/fd")),
        threads=threading.active_count(),
        children=len(
            Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
        ),
    )


def cycle(folder: Path) -> None:
    """Run one cycle of work."""
    run_scenario(load_scenario("gen2_straight"), folder / "run")
    Trajectory.from_parquet(folder / "run" / "twin.parquet")
    path = folder / "sweep.yaml"
    path.write_text(SWEEP)
    with open_sweep(load_sweep(path), folder / "sweep") as opened:
        opened.run(local(2), opened.missing())
        opened.finish()
    batch = TwinBatch([load_robot("gen2")] * 2, threads=2)
    run_batch(batch, partial(_hold, batch), 0.5)


def _hold(batch: TwinBatch, state: object) -> np.ndarray:
    return np.full((2, batch.twins[0].spec.segments, 2), -1, dtype=np.int8)


def slope(samples: list[Sample]) -> float:
    """Return the growth of memory after the first quarter, MiB/h."""
    late = [item for item in samples if item.minutes >= samples[-1].minutes / 4]
    times, memory = (
        [getattr(item, name) for item in late] for name in ("minutes", "memory")
    )
    return 60 * float(np.polyfit(times, memory, 1)[0])


def main() -> None:
    """Print one line per minute, then the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="also write the samples to this file"
    )
    arguments = parser.parse_args()
    begun = time.monotonic()
    samples = list[Sample]()
    cycles = 0
    next_report = 0
    while time.monotonic() - begun < 60 * arguments.minutes:
        with tempfile.TemporaryDirectory() as name:
            cycle(Path(name))
        cycles += 1
        samples.append(measure(begun))
        if samples[-1].minutes >= next_report:
            next_report += 1
            print(cycles, samples[-1], flush=True)
    first = samples[len(samples) // 4]
    last = samples[-1]
    print(
        f"{cycles} cycles in {last.minutes:.0f} min, memory after a quarter"
        f" {slope(samples):+.1f} MiB/h"
    )
    print(f"from {first} to {last}")
    if arguments.json:
        arguments.json.write_text(
            json.dumps([asdict(item) for item in samples]) + "\n", "utf-8"
        )
    left = [
        name
        for name in ("files", "threads", "children")
        if getattr(last, name) > getattr(first, name)
    ]
    sys.exit(f"remaining: {', '.join(left)}" if left else 0)


if __name__ == "__main__":
    main()
