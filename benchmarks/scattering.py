"""Snakes among posts: exit angles behind one row of posts, and speed and power in fields of posts.

    uv run python benchmarks/scattering.py [--picture docs/images/scattering.png]    # half an hour
    uv run python benchmarks/scattering.py --fields 12

The snake `skin_example` crawls towards the middle of a row of posts. The exit angle is
the direction in which it moves during one period after its tail has left the row, minus
the direction in which it moves at the same time without posts. Phases of the wave and
lateral places of the snake are equally spaced.

`--fields 12` compares speed and power of both plants in fields of posts, at several
steps and numbers of hinges, in five minutes. Seeds of the scenario displace the posts.
Single runs among posts diverge, so means are compared, with standard errors.
"""

from __future__ import annotations

import argparse
import math
from concurrent.futures import ProcessPoolExecutor
from functools import cache

import numpy as np
from scipy.stats import ks_2samp

from srs_twin import Gait, Plant, rollout
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.plants.base import SnakeState
from srs_twin.scenario.loading import load_scenario

PITCHES = (0.12, 0.15, 0.18)
"""Distance between the centres of neighbouring posts, m."""
PHASES = 16
PLACES = 2
"""Lateral places of the snake, over one pitch."""
FREQUENCY_HZ = 2.0
ROW_M = 0.27  # from the centre of the straight body to the row
LEFT_M = 0.03  # distance behind the row that all connectors must have
DURATION_S = 6.0
RECORD_HZ = 100

FIELD_DURATION_S = 6.0

FIELD_CASES = {
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
"""Plant and settings of each row of the table of fields."""


def track(kind: str, pitch: float, phase: int, place: int = 0) -> np.ndarray:
    """Return the path of the centre of mass until a period after the row, shape (samples, 2), m.

    Args:
        kind: plant.
        pitch: distance between posts, m; 0 without posts, for the whole duration.
        phase: number of the phase.
        place: number of the lateral place.

    Returns:
        An empty array if the snake does not leave the row in time.
    """
    left: list[float] = []

    def passed(state: SnakeState) -> bool:
        if not left and state.position[:, 0].min() > ROW_M + LEFT_M:
            left.append(float(state.time))
        return bool(left) and float(state.time) >= left[0] + 1 / FREQUENCY_HZ

    gait = Gait(FREQUENCY_HZ, phase=2 * math.pi * phase / PHASES)
    pose = (0.0, pitch * place / PLACES, 0.0)
    until = passed if pitch else None
    run = rollout(
        snake(kind, pitch),
        gait,
        DURATION_S,
        pose=pose,
        record_hz=RECORD_HZ,
        until=until,
    )
    if left or not pitch:
        return run.com
    return run.com[:0]


@cache
def snake(kind: str, pitch: float) -> Plant:
    """Return the plant in front of a row of posts (none if the pitch is 0)."""
    if pitch:
        posts = [
            {"x_m": ROW_M, "y_m": k * pitch, "radius_m": 0.02} for k in range(-6, 7)
        ]
    else:
        posts = []
    changes = {
        "robot": "skin_example",
        "world": {"obstacle_friction": 0.2, "obstacles": posts},
    }
    return load_scenario("pegs_skin", set=changes).build_plant(kind)


def exit_angle(path: np.ndarray, straight: np.ndarray) -> float:
    """Return the angle between the last period of a path and the same period without posts, rad."""
    period = round(RECORD_HZ / FREQUENCY_HZ)
    if len(path) <= period:
        return math.nan
    ways = [
        each[len(path) - 1] - each[len(path) - 1 - period] for each in (path, straight)
    ]
    first, second = (math.atan2(way[1], way[0]) for way in ways)
    return math.remainder(first - second, 2 * math.pi)


def measure(kind: str, seed: int, changes: dict[str, object]) -> tuple[float, float]:
    """Return the speed of the centre of mass along its path (m/s), and the mechanical power (W)."""
    scenario = load_scenario(
        "pegs_skin", set={"seed": seed, "duration_s": FIELD_DURATION_S} | changes
    )
    plant = scenario.build_plant(kind)
    controller = scenario.build_controller()
    run = rollout(
        plant, controller, scenario.duration, pose=scenario.pose, seed=scenario.seed
    )
    metrics = plant_metrics(run)
    return metrics["com_speed_m_s"], metrics["mechanical_power_w"]


def fields(count: int) -> None:
    """Print means and standard errors of speed and power over fields of posts."""
    print("| plant | speed, m/s | power, W |\n|---|---|---|")
    for name, (kind, changes) in FIELD_CASES.items():
        runs = np.array([measure(kind, seed, changes) for seed in range(1, count + 1)])
        (speed, power), errors = (
            runs.mean(axis=0),
            runs.std(axis=0, ddof=1) / math.sqrt(len(runs)),
        )
        print(
            f"| {name} | {speed:.4f} ± {errors[0]:.4f} | {power:.3f} ±"
            f" {errors[1]:.3f} |",
            flush=True,
        )


def main() -> None:
    """Print the distributions and draw them, or print the table of fields."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--picture", help="file of the picture")
    parser.add_argument(
        "--every", type=int, default=1, metavar="N", help="every N-th phase only"
    )
    parser.add_argument(
        "--fields", type=int, metavar="N", help="compare the plants in N fields instead"
    )
    options = parser.parse_args()
    if options.fields:
        fields(options.fields)
        return
    angles: dict[tuple[str, float], np.ndarray] = {}
    print(
        "| pitch, m | plant | left the row | spread, ° | 10, 50, 90 %, ° | within 5° |"
        " KS p |"
    )
    print("|---|---|---|---|---|---|---|")
    with ProcessPoolExecutor() as pool:
        for kind in ("analytical", "twin"):
            chosen = range(0, PHASES, options.every)
            count = len(chosen)
            straight = pool.map(track, [kind] * count, [0.0] * count, chosen)
            free = dict(zip(chosen, straight, strict=True))
            for pitch in PITCHES:
                phases, places = (
                    grid.ravel() for grid in np.mgrid[: PHASES : options.every, :PLACES]
                )
                count = len(phases)
                paths = pool.map(
                    track,
                    [kind] * count,
                    [pitch] * count,
                    phases.tolist(),
                    places.tolist(),
                )
                angles_of = [
                    exit_angle(path, free[k])
                    for path, k in zip(paths, phases, strict=True)
                ]
                found = np.degrees(angles_of)
                angles[kind, pitch] = known = found[np.isfinite(found)]
                low, middle, high = np.percentile(known, [10, 50, 90])
                if kind == "twin":
                    p = ks_2samp(known, angles["analytical", pitch]).pvalue
                else:
                    p = math.nan
                print(
                    f"| {pitch:g} | {kind} | {len(known)} of {len(found)} |"
                    f" {known.std():.1f} | {low:.0f}, {middle:.0f}, {high:.0f} |"
                    f" {np.mean(np.abs(known) < 5):.2f} | {p:.2g} |",
                    flush=True,
                )
    if options.picture:
        draw(angles, options.picture)


def draw(angles: dict[tuple[str, float], np.ndarray], path: str) -> None:
    """Draw histograms of both plants for each pitch."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        1, len(PITCHES), figsize=(8, 2.6), sharey=True, layout="constrained"
    )
    for axis, pitch in zip(axes, PITCHES, strict=True):
        bins = np.arange(-90, 91, 10)
        for kind, name in (("analytical", "compliant"), ("twin", "twin")):
            axis.hist(
                angles[kind, pitch], bins, histtype="step", density=True, label=name
            )
        axis.set(
            title=f"{100 * pitch:g} cm",
            xlabel="exit angle, °",
            xticks=[-90, -45, 0, 45, 90],
        )
    axes[0].set_ylabel("density, 1/°")
    axes[0].legend()
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    main()
