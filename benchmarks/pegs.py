"""Speed and power among pegs on both plants, over twelve fields, at several steps and numbers of hinges.

    uv run python benchmarks/pegs.py    # five minutes

Single runs among posts diverge, so that means are compared, with standard errors.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.comparison.metrics import plant_metrics
from srs_twin.rollout import rollout
from srs_twin.scenario.loading import load_scenario

FIELDS = range(1, 13)
"""Seeds of the scenario, which displace the posts."""

DURATION_S = 6.0

CASES = {
    "compliant, 2 ms": ("analytical", {}),
    "compliant, 1 ms": ("analytical", {"plants.analytical.timestep_s": 0.001}),
    "twin, 1 hinge": ("twin", {"plants.twin.hinges_per_segment": 1}),
    "twin, 2 hinges": ("twin", {"plants.twin.hinges_per_segment": 2}),
    "twin, 3 hinges": ("twin", {"plants.twin.hinges_per_segment": 3}),
    "twin, 3 hinges, 0.5 ms": (
        "twin",
        {"plants.twin.hinges_per_segment": 3, "plants.twin.timestep_s": 0.0005},
    ),
    "twin, 6 hinges": ("twin", {"plants.twin.hinges_per_segment": 6}),
}


def measure(kind: str, seed: int, changes: dict[str, object]) -> tuple[float, float]:
    """Return the speed of the centre of mass along its path (m/s), and the mechanical power (W)."""
    scenario = load_scenario(
        "pegs_skin", set={"seed": seed, "duration_s": DURATION_S} | changes
    )
    plant = scenario.build_plant(kind)
    controller = scenario.build_controller()
    run = rollout(
        plant, controller, scenario.duration, pose=scenario.pose, seed=scenario.seed
    )
    metrics = plant_metrics(run)
    return metrics["com_speed_m_s"], metrics["mechanical_power_w"]


def main() -> None:
    """Print means and standard errors."""
    print("| plant | speed, m/s | power, W |\n|---|---|---|")
    for name, (kind, changes) in CASES.items():
        runs = np.array([measure(kind, seed, changes) for seed in FIELDS])
        (speed, power), errors = (
            runs.mean(axis=0),
            runs.std(axis=0, ddof=1) / math.sqrt(len(runs)),
        )
        print(
            f"| {name} | {speed:.4f} ± {errors[0]:.4f} | {power:.3f} ±"
            f" {errors[1]:.3f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
