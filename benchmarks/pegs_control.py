"""Speed among pegs of the open-loop wave, shape-based compliance, and blocked segments that hold or vent.

    uv run python benchmarks/pegs_control.py                # an hour; twin: --plant twin --seeds 6
    uv run python benchmarks/pegs_control.py --plant twin --seeds 6 --cell 0.16,0.44

Seeds from 101 displace the posts and draw the gains and time constants of the modules
(5 % spread). They were not used for the choice of amplitude, gain and threshold (seeds
1 to 4).
"""

from __future__ import annotations

import argparse
import math
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

from srs_twin.comparison.metrics import plant_metrics
from srs_twin.extensions import allow_plugin
from srs_twin.rollout import rollout
from srs_twin.scenario.loading import load_scenario

CELLS = ((0.13, 0.44), (0.16, 0.44), (0.19, 0.44), (0.16, 0.15), (0.16, 4.0))
"""Spacing of the posts (m) and stiffness of the segments (N·m/rad)."""

FIRST_SEED = 101
DURATION_S = 4.0

CONTROLLERS = {
    "wave": {"gain": 0.0, "amplitude": 1.0},
    "wave, amplitude 0.8": {"gain": 0.0},
    "amplitude, gain 0.5": {"gain": 0.5},
    "amplitude, gain −0.5": {"gain": -0.5},
    "lag, gain 0.5": {"response": "wave_number"},
    "hold": {"response": "hold"},
    "vent": {"response": "vent"},
    "vent, amplitude 1": {"response": "vent", "amplitude": 1.0},
}
"""Keys of the controller `yielding_gait:YieldingGait`; a gain of 0 is the open-loop wave."""


def speed(
    seed: int, cell: tuple[float, float], keys: dict[str, object], plant: str
) -> float:
    """Return the speed of the centre of mass along its path, m/s."""
    pitch, stiffness = cell
    changes = {
        "seed": seed,
        "duration_s": DURATION_S,
        "controller": {"kind": "yielding_gait:YieldingGait", "frequency": 1.0} | keys,
        "world.pegs.spacing_m": pitch,
        "robot.bending.stiffness_nm_per_rad": stiffness,
        "robot.modules.gain_spread": 0.05,
        "robot.modules.tau_spread": 0.05,
    }
    allow_plugin(Path(__file__).with_name("yielding_gait.py"))
    scenario = load_scenario("pegs_skin", set=changes)
    snake = scenario.build_plant(plant)
    controller = scenario.build_controller()
    run = rollout(
        snake, controller, scenario.duration, pose=scenario.pose, seed=scenario.seed
    )
    return float(plant_metrics(run)["com_speed_m_s"])


def main() -> None:
    """Print mean speeds with 95 % intervals."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--plant", default="analytical", choices=("analytical", "twin"))
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--cell", help="spacing and stiffness; default: all cells")
    options = parser.parse_args()
    if options.cell:
        cells = [tuple(map(float, options.cell.split(",")))]
    else:
        cells = CELLS
    seeds = range(FIRST_SEED, FIRST_SEED + options.seeds)
    print(
        "| controller | "
        + " | ".join(f"{p:g} m, {k:g} N·m/rad" for p, k in cells)
        + " |"
    )
    print("|---" * (1 + len(cells)) + "|")
    with ProcessPoolExecutor() as pool:
        for name, keys in CONTROLLERS.items():
            row = []
            for cell in cells:
                job = partial(speed, cell=cell, keys=keys, plant=options.plant)
                speeds = np.array(list(pool.map(job, seeds)))
                half = 2.2 * speeds.std(ddof=1) / math.sqrt(len(speeds))
                row.append(f"{speeds.mean():.3f} ± {half:.3f}")
            print(f"| {name} | " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
