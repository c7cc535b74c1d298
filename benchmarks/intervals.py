"""Coverage of the 95 % intervals of the fits, from repetitions with independent noise.

uv run python benchmarks/intervals.py [REPETITIONS]

Noise: 10 % and 8 % of the mean for pulls, 1 mm for positions, 0.01 rad for bends
(white, or with a correlation of 0.8 between samples at 100 Hz), 1 mm and 0.01 rad for
gait runs.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from srs_twin import Gait, Trajectory, load_robot
from srs_twin.identification.actuator import Response, fit_actuator, predict_response
from srs_twin.identification.estimate import FitEstimate
from srs_twin.identification.fit_file import array_hash
from srs_twin.identification.friction import (
    CoastingTest,
    Pulls,
    fit_coasting,
    fit_pulls,
)
from srs_twin.identification.locomotion import GaitRun, PlantModel, fit_locomotion
from srs_twin.identification.parameters import with_values
from srs_twin.identification.static_tables import StaticTable, fit_static
from srs_twin.plants.analytical.floor import slide, spin_fraction
from srs_twin.pneumatics import Schedule
from srs_twin.pneumatics.chambers import air_bend

GEN2 = load_robot("gen2")
MODULE = load_robot("gen4_module")
FRICTION = {"friction.mu_t": 0.06, "friction.mu_n": 0.5}
ACTUATOR = {
    "actuator.tau_fill_s": 0.15,
    "actuator.tau_vent_s": 0.09,
    "actuator.tau_mode_s": 0.01,
    "modules.gain_plus_1": 1.2,
    "modules.gain_minus_1": 0.8,
    "modules.bias_rad_1": 0.05,
}
STATIC = {
    "modules.gain_plus_1": 1.2,
    "modules.gain_minus_1": 0.8,
    "modules.bias_rad_1": 0.05,
    "actuator.bend_limit_rad": 1.4,
}
GAIT = {"friction.mu_t": 0.055, "friction.mu_n": 0.48, "geometry.rigid_gap_m": 0.022}
Fit = Callable[[np.random.Generator], FitEstimate]


def correlated(rng: np.random.Generator, count: int, rho: float) -> np.ndarray:
    """Return noise of unit variance with correlation rho between adjacent samples."""
    noise = rng.normal(size=count)
    for k in range(1, count):
        noise[k] = rho * noise[k - 1] + math.sqrt(1 - rho**2) * noise[k]
    return noise


def pulls(rng: np.random.Generator) -> FitEstimate:
    factor = 0.25 * 9.81 / 120.0
    return fit_pulls(
        Pulls(
            factor * rng.normal(0.06, 0.006, 10),
            factor * rng.normal(0.5, 0.04, 10),
            120.0,
            0.25,
        )
    )


def coasting(rng: np.random.Generator) -> FitEstimate:
    time = np.arange(0.0, 1.0, 0.01)
    runs = []
    for k, velocity in enumerate([(0.5, 0.0), (0.0, 0.8)]):
        path = slide(
            velocity,
            time,
            friction_law="wheel",
            mu_t=0.06,
            mu_n=0.5,
            fraction=spin_fraction(GEN2),
        )
        x, y = (path + 1e-3 * rng.normal(size=path.shape)).T
        straight = {f"bend_{j}": 0 * time for j in range(1, 5)}
        seen = Trajectory(
            {"time": time, "com_x": x, "com_y": y, "heading": 0 * time} | straight
        )
        runs.append(CoastingTest.from_trajectory(seen, f"throw_{k}", start=0.0))
    return fit_coasting(runs, GEN2)


def actuator(rho: float) -> Fit:
    states = np.array([[[1, -1]], [[-1, -1]], [[-1, 1]], [[-1, -1]]], dtype=np.int8)
    time = np.arange(0.0, 3.0, 0.01)
    blank = Response(
        "steps",
        "0" * 64,
        Schedule(3.0, np.array([0.0, 0.5, 1.5, 2.0]), states),
        48e3,
        time,
        np.zeros((300, 1)),
    )
    bend, _ = predict_response(blank, with_values(MODULE, ACTUATOR))
    return lambda rng: fit_actuator(
        [replace(blank, bend=bend + 0.01 * correlated(rng, len(time), rho)[:, None])],
        MODULE,
    )


def static(rng: np.random.Generator) -> FitEstimate:
    pressure = np.zeros((14, 1, 2))
    pressure[:7, 0, 0] = pressure[7:, 0, 1] = np.linspace(0, 90e3, 7)
    robot = with_values(MODULE, STATIC)
    bend = (
        robot.modules.array("bias")
        + air_bend(robot, pressure)
        + 0.01 * rng.normal(size=(14, 1))
    )
    return fit_static([StaticTable("table", array_hash(bend), pressure, bend)], MODULE)


def gaits() -> Fit:
    model = PlantModel(settings={"friction": "wheel"})
    truth = []
    for frequency, offset in [(2.0, 0.0), (1.5, 0.2)]:
        run = GaitRun(
            Trajectory({"time": np.array([0.0, 3.0])}),
            Gait(frequency, offset),
            48e3,
            f"{frequency} Hz",
        )
        truth.append(
            replace(run, trajectory=model.simulate(run, with_values(GEN2, GAIT)))
        )

    def noisy(run: GaitRun, rng: np.random.Generator) -> GaitRun:
        columns = dict(run.trajectory.columns)
        for name in ("com_x", "com_y", "heading", *(f"bend_{j}" for j in range(1, 5))):
            columns[name] = columns[name] + (
                1e-3 if name[0] == "c" else 1e-2
            ) * rng.normal(size=len(run.trajectory))
        return replace(
            run, trajectory=Trajectory(columns, metadata=run.trajectory.metadata)
        )

    return lambda rng: fit_locomotion(
        [noisy(run, rng) for run in truth],
        GEN2,
        list(GAIT),
        model=model,
        compare_signals="shapes",
        starts=1,
    )


def main() -> None:
    """Repeat every fit and print the coverage of its intervals."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "repetitions", nargs="?", type=int, default=100, help="repetitions of each fit"
    )
    repetitions = parser.parse_args().repetitions
    fits: tuple[tuple[str, Fit, dict[str, float], int], ...] = (
        ("pulls", pulls, FRICTION, repetitions),
        ("coasting", coasting, FRICTION, repetitions),
        ("actuator, white noise", actuator(0.0), ACTUATOR, repetitions),
        ("actuator, correlated noise", actuator(0.8), ACTUATOR, repetitions),
        ("static table", static, STATIC, repetitions),
        ("gait runs, complete", gaits(), GAIT, repetitions),
    )
    print(
        "| data | parameter | true value in the interval | no value | mean error /"
        " standard error |"
    )
    print("|---|---|---|---|---|")
    for name, fit, truth, count in fits:
        result = [fit(np.random.default_rng([seed, 8])) for seed in range(count)]
        for parameter, value in truth.items():
            item = [f[parameter] for f in result if f[parameter].value is not None]
            held = sum(p.low <= value <= p.high for p in item)  # type: ignore[operator]
            bias = np.mean([(p.value - value) / p.standard_error for p in item])  # type: ignore[operator]
            print(
                f"| {name} | {parameter} | {held} of {count} | {count - len(item)} |"
                f" {bias:+.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
