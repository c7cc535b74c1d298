"""Faults on the shipped example recordings: what a bank names of takes with valve logs, sound and broken.

    uv run python benchmarks/live_recordings.py

The robot of calibration/examples/my_snake is not the one that the bank knows (gen2):
modules, lags and stiffness differ. Bends by its markers stand for readings, with 0.02
rad of noise; its log for the commands. A recording holds no broken valve, so sensors
break here, one a run, in the middle of what is left after the two seconds in which
nothing is named.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from grid import table

from srs_twin import RobotSpec, load_robot
from srs_twin.live.fault_detector import FaultDetector
from srs_twin.live.fault_hypotheses import START_S
from srs_twin.recordings.recording import Recording, read_motion
from srs_twin.recordings.signals.clock import join
from srs_twin.recordings.signals.logs import read_valves

FOLDER = Path("calibration/examples/my_snake")
TAKES = {
    "walk_straight": None,
    "walk_left": None,
    "walk_check": None,
    "steps": "snake:1a",
    "steps_check": "snake:1a",
}
"""Name → the marker at the head, where it does not crawl."""
NOISE_RAD = 0.02
BREAKS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "dead_sensor": lambda bend, since: np.full_like(bend, np.nan),
    "dead_sensor frozen": lambda bend, since: np.full_like(bend, bend[0]),
    "drifting_sensor": lambda bend, since: bend + 0.1 * since,
}
"""Name of a fault → readings from when it begins, s before."""


def named(
    take: Recording, spec: RobotSpec, fault: str, segment: int, seed: int
) -> tuple[float, dict[int, str]]:
    """Return how long after it began (s) a fault was named, and what was named first, if anything."""
    way = take.trajectory
    log = take.valves
    assert log is not None, "it was joined"
    time = way.time
    bends = np.stack([way[f"bend_{j}"] for j in range(1, spec.segments + 1)], axis=1)
    bends = bends + NOISE_RAD * np.random.default_rng(seed).normal(size=bends.shape)
    begun = (time[-1] + time[0] + START_S) / 2
    if fault:
        broken = time >= begun
        bends[broken, segment] = BREAKS[fault](
            bends[broken, segment], time[broken] - begun
        )
    bank = FaultDetector(spec, supply_pa=spec.supply.nominal)
    for k in range(1, len(time)):
        row = np.searchsorted(log.time, (time[k] + time[k - 1]) / 2, side="right") - 1
        bank.predict((log.values[max(row, 0)] > 0).astype(float), time[k] - time[k - 1])
        bank.update(bends[k])
        if bank.detected_faults:
            return float(time[k] - begun), bank.detected_faults
    return np.nan, {}


def main() -> None:
    """Break and print."""
    spec = load_robot("gen2")
    rows = []
    takes = []
    for name, head in TAKES.items():
        motion = read_motion(FOLDER / f"{name}.csv", spec, head=head)
        takes.append(
            join(motion, read_valves(FOLDER / f"{name}.valves.csv", spec), spec)
        )
    sound = [named(take, spec, "", 0, seed) for take in takes for seed in range(4)]
    rows.append(
        [
            "none",
            f"{sum(not what for _, what in sound)} of {len(sound)} name nothing",
            "",
        ]
    )
    for fault in BREAKS:
        found = [
            (segment + 1, *named(take, spec, fault, segment, segment))
            for take in takes
            for segment in range(spec.segments)
        ]
        right = [
            after
            for segment, after, what in found
            if what == {segment: fault} and after > 0
        ]
        after = f"{np.median(right):.2f}" if right else "–"
        rows.append([fault, f"{len(right)} of {len(found)} named rightly", after])
    print(table(["fault", "outcome", "after, median, s"], rows))


if __name__ == "__main__":
    main()
