"""Time to read a recording of 20,000 frames, and the error of the reconstructed motion.

    uv run python benchmarks/logs.py [--frames 20000]

The recording is a gait of generation 2 at 120 Hz with unlabeled columns that are
swapped and 5 % lost positions. Errors are given for frames with all markers and for
frames with an interpolated marker.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from grid import table
from scipy.interpolate import CubicSpline
from timing import ROUNDS

from srs_twin import AnalyticalSnake, Gait, Trajectory, load_robot, rollout
from srs_twin.recordings.recording import Recording, read_motion

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from synthetic_takes import Take, write_motive

RATE = 120.0
SPEC = load_robot("gen2")


def motion(frames: int) -> Trajectory:
    plant = AnalyticalSnake(SPEC, supply_pa=48e3)
    return rollout(
        plant, Gait(2.0, 0.1), np.ceil(frames / RATE * 50) / 50, record_hz=200
    )


def errors(result: Recording, truth: Trajectory) -> list[str]:
    """Return RMS and largest error of the bends (mrad), for measured and interpolated frames."""
    trajectory = result.trajectory
    bend = trajectory.stack("bend") - CubicSpline(truth.time, truth.stack("bend"))(
        trajectory.time
    )
    whole = (trajectory.stack("filled") == 0).all(axis=1)
    cells = []
    for rows in (whole, ~whole):
        some = 1e3 * np.abs(bend[rows])
        cells.append(
            f"{np.sqrt((some**2).mean()):.0f}, {some.max():.0f}" if rows.any() else "–"
        )
    return cells


def main() -> None:
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--frames", type=int, default=20_000)
    frames = words.parse_args().frames
    truth = motion(frames)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "take.csv"
        for layout, count, shuffled in (
            ("single", 5, False),
            ("head", 6, False),
            ("pair", 10, False),
            ("head", 6, True),
        ):
            take = Take(
                layout=layout,
                rate_hz=RATE,
                swaps=200,
                lost=0.05,
                gap_frames=2,
                shuffled=shuffled,
            )
            write_motive(truth, take, path)
            took = []
            for _ in range(ROUNDS):
                begun = time.perf_counter()
                result = read_motion(path, SPEC)
                took.append(1e3 * (time.perf_counter() - begun))
            rows.append(
                [
                    layout + ", columns shuffled" * shuffled,
                    str(count),
                    f"{path.stat().st_size / 1e6:.1f}",
                    f"{np.median(took):.0f}",
                    f"{took[0]:.0f}",
                    str(result.summary.frames_kept),
                    str(result.summary.markers.moves),
                    str(result.summary.samples_filled),
                    *errors(result, truth),
                ]
            )
    head = [
        "layout",
        "markers",
        "MB",
        "ms",
        "first, ms",
        "frames kept",
        "moves",
        "filled",
    ]
    head += ["bends measured: rms, max mrad", "filled: rms, max mrad"]
    print(table(head, rows), flush=True)


if __name__ == "__main__":
    main()
