"""Time to write a ten-second run as a recording of both snakes, and the size of the file.

    uv run python benchmarks/recording.py

The goal is at most 0.5 s and 5 MB.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from srs_twin import compare, load_scenario, rollout
from srs_twin.viewing.content import RunContent
from srs_twin.viewing.rerun.recording import write_recording

SCENARIO = "gen2_straight"
TIMES = 7


def main() -> None:
    """Simulate once, write several times, and print the median and the minimum."""
    scenario = load_scenario(SCENARIO)
    runs = {
        kind: rollout(
            scenario.build_plant(kind), scenario.build_controller(), scenario.duration
        )
        for kind in ("analytical", "twin")
    }
    comparison = compare(runs["analytical"], runs["twin"])
    walls = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.rrd"
        for _ in range(TIMES):
            begun = time.perf_counter()
            write_recording(path, RunContent(scenario.robot, runs, comparison))
            walls.append(time.perf_counter() - begun)
        size = path.stat().st_size
    walls.sort()
    print(
        f"{SCENARIO}, {scenario.duration:g} s: median {walls[TIMES // 2]:.3f} s, least"
        f" {walls[0]:.3f} s,"
    )
    print(f"{size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
