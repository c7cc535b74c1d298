"""How long a run's products take to write and how large they are.

    uv run python benchmarks/products.py

Ten seconds of gen2_straight with both snakes; medians of five, after one that is not counted.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from srs_twin import load_scenario
from srs_twin.comparison.compare import compare
from srs_twin.experiment import run_scenario
from srs_twin.viewing.html.report import write_report
from srs_twin.viewing.rerun.recording import write_recording


def main() -> None:
    """Print seconds and bytes of each product."""
    scenario = load_scenario("gen2_straight")
    with tempfile.TemporaryDirectory() as folder:
        result = run_scenario(scenario, Path(folder))
        runs = dict(result.trajectories)
        both = compare(runs["analytical"], runs["twin"])
        products: dict[str, Callable[[Path], object]] = {
            "twin.parquet": lambda path: runs["twin"].to_parquet(path),
            "recording.rrd": lambda path: write_recording(
                path, spec=scenario.robot, trajectories=runs, comparison=both
            ),
            "report.html": lambda path: write_report(
                path, scenario_title=scenario.title, spec=scenario.robot, trajectories=runs,
                metrics=dict(result.metrics), comparison=both,
            ),
        }  # fmt: skip
        for name, write in products.items():
            path = Path(folder) / name
            seconds = [_timed(write, path) for _ in range(6)][1:]
            print(f"{name:14} {statistics.median(seconds):6.3f} s {path.stat().st_size / 1e6:6.2f} MB")


def _timed(write: Callable[[Path], object], path: Path) -> float:
    start = time.perf_counter()
    write(path)
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
