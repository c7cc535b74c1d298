"""Straightening by learning in snakes with unequal modules: twenty draws, two carriers, two kinds of target.

    uv run python benchmarks/learning.py [--draws 20] [--spread 0.15]

A draw counts if the radius of the open-loop path is below 5 m. The study takes 10 to 15
minutes.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from common.grid import table

from srs_twin.io.files import atomic_write
from srs_twin.studies.sweep.execution import local, open_sweep
from srs_twin.studies.sweep.loading import load_sweep

CARRIERS_HZ = (60, 120)
CURLS = 0.2  # 1/m
SWEEP = """\
scenario: {scenario}
fixed: {{robot.modules.gain_spread: {spread}{fixed}}}
vary:
  seed: {seeds}
  controller.carrier_hz: {carriers}
metrics: [periods_to_converge, path_bend_before_per_m, path_bend_per_m, path_bend_left_rel]
"""
TARGETS = {
    "0.7 rad": ("ilc_curve", ", controller.offset: 0.0"),
    "the smallest": ("ilc_straight", ""),
}


def main() -> None:
    """Run the draws and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--spread", type=float, default=0.15)
    options = parser.parse_args()
    rows = []
    for target, (scenario, fixed) in TARGETS.items():
        with tempfile.TemporaryDirectory() as folder:
            columns = results(
                Path(folder), scenario, fixed, options.draws, options.spread
            )
        for carrier in CARRIERS_HZ:
            chosen = np.array(columns["controller.carrier_hz"]) == carrier
            for plant in ("analytical", "twin"):
                rows.append(
                    [target, f"{carrier} Hz", plant, *line(columns, plant, chosen)]
                )
    headings = [
        "target",
        "carrier",
        "plant",
        "within 5 % by period 12",
        "initially curved",
        "ten times straighter",
        "straightening factor, median (least)",
        "final curvature, median (largest), 1/m",
    ]
    print(table(headings, rows))


def results(
    folder: Path, scenario: str, fixed: str, draws: int, spread: float
) -> dict[str, list[float]]:
    """Run one sweep and return its columns."""
    path = folder / "learning.yaml"
    text = SWEEP.format(
        scenario=scenario,
        fixed=fixed,
        spread=spread,
        seeds=list(range(draws)),
        carriers=list(CARRIERS_HZ),
    )
    with atomic_write(path) as part:
        part.write_text(text, "utf-8")
    with open_sweep(load_sweep(path), folder / "out") as opened:
        opened.run(local(), opened.missing())
        opened.finish()
    result: dict[str, list[float]] = pq.read_table(
        folder / "out" / "results.parquet"
    ).to_pydict()
    return result


def line(columns: dict[str, list[float]], plant: str, chosen: np.ndarray) -> list[str]:
    """Return the cells of one carrier and plant."""

    def column(metric: str) -> np.ndarray:
        return np.array(columns[f"{plant}.{metric}"], dtype=float)[chosen]

    curled = column("path_bend_before_per_m") > CURLS
    left = column("path_bend_left_rel")
    after = column("path_bend_per_m")
    within = column("periods_to_converge") <= 12
    times = 1 / left[curled]
    reduction = "–"
    if len(times):
        reduction = f"{np.median(times):.0f} ({times.min():.1f})"
    return [
        f"{within.sum()} of {len(within)}",
        str(curled.sum()),
        f"{(left[curled] <= 0.1).sum()}",
        reduction,
        f"{np.median(after):.3f} ({after.max():.3f})",
    ]


if __name__ == "__main__":
    main()
