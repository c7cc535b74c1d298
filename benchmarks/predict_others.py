"""Predicted speeds and yaw rates of robots that others built.

    uv run python benchmarks/predict_others.py [--robots 146] [--seed 0]

Robots are drawn by Latin hypercube from the intervals in
calibration/robots/others/NAME.yaml and crawl on the twin. Gait settings that are
unknown are drawn as well. Speeds of pneumatic robots are multiplied by the known error
of the twin (`drawn_robots.model_errors`), those of servo robots are not: their angles
are prescribed. The intervals are quantiles over the robots. The files are written to
calibration/predictions/recomputed. Move the first prediction of a robot to
calibration/predictions and commit it before the published results.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from drawn_robots import (
    RECOMPUTED,
    ROBOTS,
    ROOT,
    draw,
    interval,
    model_errors,
    motion,
    with_values,
)

from srs_twin import Gait
from srs_twin.io.documents import dump_yaml
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.file import RobotFile, load_robot_file
from srs_twin.studies.uncertainty.metric_uncertainty import MIN_BOUNDING_SAMPLES

Cases = Iterator[tuple[str, TwinSnake, Gait]]

OMEGA_RAD_S = 0.8
"""Angular frequency of the gaits of Zhao and Cheng (Section 4.3.2), rad/s."""
ZHAO_GAITS = ((1.0, 1.0), (0.8, 1.0), (0.6, 1.0), (1.0, 0.8), (1.0, 0.6))
"""Amplitudes A, rad, and phase parameters k of their Section 4.3.2."""
ZHAO_BIAS_RAD = 0.2
"""Bias γ of the joints in a turning gait (Section 4.3.2), rad."""
ONAL_FREQUENCIES_HZ = (0.25, 1.0)
"""The dissertation does not state the frequency; generation 1 crawled at a third of a hertz."""
ONAL_OFFSET = 0.2


def onal(file: RobotFile, u: np.ndarray) -> Cases:
    """Yield quantity, robot and gait: one wave along the body or five connectors, at an unknown frequency."""
    low, high = ONAL_FREQUENCIES_HZ
    frequency = low * (high / low) ** u[0]
    step = 2 * math.pi / (4 if u[1] < 0.5 else 5)
    twin = TwinSnake(file.spec(), timestep=0.002)
    yield "speed_m_s", twin, Gait(frequency, phase_step=step)
    yield (
        f"yaw_rate_rad_s, offset {ONAL_OFFSET:g}",
        twin,
        Gait(frequency, ONAL_OFFSET, phase_step=step),
    )


def zhao(file: RobotFile, u: np.ndarray) -> Cases:
    """Yield quantity, robot and gait; yaw joints lag by 2 k (every second joint is one), or by k."""
    joints = 2 if u[0] < 0.5 else 1
    full = file.actuator.bend_rad.value
    frequency = OMEGA_RAD_S / (2 * math.pi)
    # The mean of sign(sin x + φ) is 2/π asin φ.
    offset = math.sin(math.pi / 2 * ZHAO_BIAS_RAD / full)
    for amplitude, k in ZHAO_GAITS:
        twin = TwinSnake(
            with_values(file, {"actuator.bend_rad": full * amplitude}).spec(),
            timestep=0.002,
        )
        name = f"A {amplitude:g} rad, k {k:g}"
        yield f"speed_m_s, {name}", twin, Gait(frequency, phase_step=joints * k)
        if amplitude == k == 1:
            yield (
                f"yaw_rate_rad_s, {name}, γ {ZHAO_BIAS_RAD:g} rad",
                twin,
                Gait(frequency, offset, phase_step=joints * k),
            )


ROBOT_CASES: dict[str, Callable[[RobotFile, np.ndarray], Cases]] = {
    "onal_rus_2013": onal,
    "zhao_cheng_2025": zhao,
}


def predict(name: str, count: int, seed: int) -> dict[str, Any]:
    """Return median and 95 % interval of every quantity of a robot."""
    file = load_robot_file(ROBOTS / f"{name}.yaml")
    if file.has_servos:
        errors = np.ones(count)
    else:
        errors = model_errors(count, seed)
    samples: dict[str, list[float]] = {}
    for u, values, error in zip(*draw(file, count, 2, seed), errors, strict=True):
        for quantity, twin, gait in ROBOT_CASES[name](with_values(file, values), u):
            speed, yaw_rate = motion(twin, gait)
            if quantity.startswith("yaw_rate"):
                result = yaw_rate
            else:
                result = speed * error
            samples.setdefault(quantity, []).append(result)
    return {quantity: interval(values) for quantity, values in samples.items()}


def main() -> None:
    """Predict all robots and write a file for each."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--robots", type=int, default=MIN_BOUNDING_SAMPLES, help="number of robots"
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    options = parser.parse_args()
    for name in ROBOT_CASES:
        document = {
            "robot": (ROBOTS / f"{name}.yaml").relative_to(ROOT).as_posix(),
            "plant": "twin",
            "command": (
                f"benchmarks/predict_others.py --robots {options.robots} --seed"
                f" {options.seed}"
            ),
            "robots": options.robots,
            "quantities": predict(name, options.robots, options.seed),
        }
        text = dump_yaml(document)
        (RECOMPUTED / f"{name}.yaml").write_text(text, encoding="utf-8")
        print(text, flush=True)


if __name__ == "__main__":
    main()
