"""Errors and number of runs of fits with the twin, from recordings with and without noise.

uv run python benchmarks/twin_fit.py [DRAWS]

Each draw hides the true stiffness, gap and μ_t, which differ by up to 25 % (gap: 5 mm)
from the initial values. The recordings are 1 s of a straight and 1 s of a curved gait.
Noise: positions 1 mm, headings and bends 0.01 rad, white at 50 Hz.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np

from srs_twin import Gait, Trajectory, load_robot
from srs_twin.identification.locomotion import GaitRun, PlantModel, fit_locomotion
from srs_twin.identification.parameters import with_values

SPEC = load_robot("gen2")
TWIN = PlantModel("twin")
GAITS = ((2.0, 0.0), (1.6, 0.2))
SUPPLY = 48e3
NOISE = {
    "com_x": 1e-3,
    "com_y": 1e-3,
    "heading": 1e-2,
    **{f"bend_{j}": 1e-2 for j in range(1, 5)},
}


def hidden(rng: np.random.Generator) -> dict[str, float]:
    """Return the true parameters of a draw."""
    return {
        "bending.stiffness_nm_per_rad": (
            SPEC.bending.stiffness * float(np.exp(rng.uniform(-0.25, 0.25)))
        ),
        "geometry.rigid_gap_m": (
            SPEC.geometry.rigid_gap + float(rng.uniform(-0.005, 0.005))
        ),
        "friction.mu_t": SPEC.friction.mu_t * float(np.exp(rng.uniform(-0.25, 0.25))),
    }


def recorded(
    truth: dict[str, float], noise: float, rng: np.random.Generator
) -> list[GaitRun]:
    """Return the recordings of a robot."""
    blank = Trajectory({"time": np.array([0.0, 1.0])})
    runs = []
    for frequency, offset in GAITS:
        gait = Gait(frequency, offset)
        name = f"{frequency:g} Hz, offset {offset:g}"
        seen = TWIN.simulate(
            GaitRun(blank, gait, SUPPLY, name), with_values(SPEC, truth)
        )
        columns = dict(seen.columns)
        for column, scale in NOISE.items():
            columns[column] = columns[column] + noise * scale * rng.normal(
                size=len(seen)
            )
        runs.append(GaitRun(replace(seen, columns=columns), gait, SUPPLY, name))
    return runs


def main(draws: int) -> None:
    """Print the table."""
    print(
        "| draw | noise | runs | s | converged | stiffness | gap | μ_t"
        " |\n|---|---|---|---|---|---|---|---|"
    )
    for draw in range(draws):
        for noise in (0.0, 1.0):
            rng = np.random.default_rng(draw)
            truth = hidden(rng)
            counts: list[int] = []
            start = time.perf_counter()
            result = fit_locomotion(
                recorded(truth, noise, rng),
                SPEC,
                list(truth),
                model=TWIN,
                compare_signals="shapes",
                starts=1,
                watch=lambda runs, _, counts=counts: counts.append(runs),
            )
            took = time.perf_counter() - start
            cells = [
                f"{draw}",
                f"{noise:g}",
                f"{counts[-1]}",
                f"{took:.0f}",
                "yes" if result.converged else "no",
            ]
            for name, value in truth.items():
                item = result[name].value
                cells.append(
                    "none" if item is None else f"{100 * (item / value - 1):+.2f} %"
                )
            print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 6)
