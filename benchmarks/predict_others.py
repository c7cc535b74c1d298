"""Predicted speeds and yaw rates of robots that others built.

    uv run python benchmarks/predict_others.py [--robots 146] [--seed 0] [--only NAME …]

Robots are drawn by Latin hypercube from the intervals in
calibration/robots/others/NAME.yaml and crawl on the twin. Gait settings that are
unknown are drawn as well. Speeds of pneumatic robots are multiplied by the known error
of the twin (`drawn_robots.model_errors`), those of servo robots are not: their angles
are prescribed. The intervals are quantiles over the robots. The files are written to
calibration/predictions/recomputed. Move the first prediction of a robot to
calibration/predictions and commit it before the published results.

The spatial robot (spatial_530mm) has few published parameters, so two alternatives are
drawn as well: wheels (probability 0.75, as all planar generations of the laboratory) or
skin, and four chambers (0.75) or three at 120°. Every robot crawls with all gaits of a
grid. Its fastest serpentine is the fastest planar wave, its fastest sidewinding the
fastest wave in both directions. A robot takes 20 s. `--runs
calibration/predictions/spatial_530mm.yaml --robots 40` uses the speeds of the committed
prediction again.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from common.drawn_robots import (
    RECOMPUTED,
    ROBOTS,
    ROOT,
    draw,
    interval,
    model_errors,
    motion,
    twin_of,
    with_values,
)
from common.grid import table

from srs_twin import Gait
from srs_twin.control.gait import PitchWave
from srs_twin.io.documents import dump_yaml
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.file import RobotFile, load_robot_file
from srs_twin.robot.spec import RobotSpec
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

SPATIAL = "spatial_530mm"
WHEELS_PROBABILITY = 0.75
"""Probability of wheels: the planar generations have them, but a body that lifts itself need not."""
FOUR_PROBABILITY = 0.75
"""Probability of four chambers per module, two for each degree of freedom."""
SKIN_FORWARD = (0.4, 0.9)
"""Friction coefficient of silicone on a hard floor, along the body, 1."""
SKIN_RATIO = (1.0, 1.6)
"""Friction across over friction along a skin, 1."""
THREE_CHAMBERS = [90, 210, 330]
"""Directions of three chambers, deg."""

FREQUENCIES_HZ = (0.4, 0.8, 1.4)
SERPENTINE = ((math.pi / 2, None), (math.pi / 3, None))
SIDEWINDING = (
    (math.pi / 2, PitchWave(0.3, math.pi / 2)),
    (math.pi / 2, PitchWave(0.5, math.pi / 2)),
    (math.pi / 3, PitchWave(0.4, math.pi / 2)),
)
NAMES = ("serpentine", "sidewinding")
TIMESTEP_S = 0.004


def onal(file: RobotFile, u: np.ndarray) -> Cases:
    """Yield quantity, robot and gait: one wave along the body or five connectors, at an unknown frequency."""
    low, high = ONAL_FREQUENCIES_HZ
    frequency = low * (high / low) ** u[0]
    step = 2 * math.pi / (4 if u[1] < 0.5 else 5)
    twin = twin_of(file.spec(), 0.002)
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
        bent = with_values(file, {"actuator.bend_rad": full * amplitude})
        twin = twin_of(bent.spec(), 0.002)
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


def draw_robots(count: int, seed: int) -> list[tuple[RobotFile, dict[str, Any]]]:
    """Return robots and the facts about each of them."""
    file = load_robot_file(ROBOTS / f"{SPATIAL}.yaml")
    robots = []
    for u, values in zip(*draw(file, count, 4, seed), strict=True):
        wheels = bool(u[0] < WHEELS_PROBABILITY)
        four = bool(u[1] < FOUR_PROBABILITY)
        changes: dict[str, Any] = dict(values)
        if not wheels:
            changes["contact.forward"] = np.interp(u[2], (0, 1), SKIN_FORWARD)
            changes["contact.transverse"] = changes["contact.forward"] * np.interp(
                u[3], (0, 1), SKIN_RATIO
            )
        if not four:
            changes["chamber.directions_deg"] = THREE_CHAMBERS
        robots.append(
            (with_values(file, changes), {"wheels": wheels, "four_chambers": four})
        )
    return robots


def speed(
    twin: TwinSnake, frequency: float, step: float, pitch: PitchWave | None
) -> float:
    """Return the speed of a gait over its last two periods, m/s; 0 for a run that diverged."""
    return motion(twin, Gait(frequency, phase_step=step, pitch=pitch))[0]


def fastest(spec: RobotSpec) -> dict[str, Any]:
    """Return the speeds of the fastest gaits of a robot, m/s, and their settings."""
    twin = twin_of(spec, TIMESTEP_S)
    result: dict[str, Any] = {}
    for name, gaits in (("serpentine", SERPENTINE), ("sidewinding", SIDEWINDING)):
        speeds = {
            (f, k): speed(twin, f, *gaits[k])
            for f in FREQUENCIES_HZ
            for k in range(len(gaits))
        }
        best = max(speeds, key=lambda key: speeds[key])
        result[name] = {
            "speed_m_s": round(speeds[best], 4),
            "frequency_hz": best[0],
            "gait": best[1],
        }
    return result


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the prediction over all robots, and under each alternative."""

    def of(name: str, group: list[dict[str, Any]]) -> dict[str, Any]:
        return {
            **interval([row[name]["speed_m_s"] * row["model_error"] for row in group]),
            "robots": len(group),
        }

    groups = {
        "wheels": [r for r in rows if r["wheels"]],
        "skin": [r for r in rows if not r["wheels"]],
        "four_chambers": [r for r in rows if r["four_chambers"]],
        "three_chambers": [r for r in rows if not r["four_chambers"]],
    }
    return {
        "quantities": {f"fastest_{name}": of(name, rows) for name in NAMES},
        "alternatives": {
            f"fastest_{name}": {
                key: of(name, group) for key, group in groups.items() if group
            }
            for name in NAMES
        },
    }


def predict_spatial(
    count: int, seed: int, stored: Path | None, folder: Path
) -> dict[str, Any]:
    """Draw spatial robots, run their gaits, and write the prediction after every robot.

    Returns:
        The prediction from all robots, as written.

    Args:
        count: number of robots.
        seed: random seed.
        stored: file of earlier runs, whose speeds are used again.
        folder: folder of the prediction.
    """
    command = (
        f"benchmarks/predict_others.py --only {SPATIAL} --robots {count} --seed {seed}"
    )
    if stored:
        command += f" --runs {stored}"
    rows: list[dict[str, Any]] = []
    document: dict[str, Any] = {}
    errors = model_errors(count, seed)
    if stored:
        earlier = yaml.safe_load(stored.read_text("utf-8"))["robots"]
    else:
        earlier = None
    for k, (file, facts) in enumerate(draw_robots(count, seed)):
        if earlier is None:
            speeds = fastest(file.spec())
        else:
            speeds = {n: earlier[k][n] for n in NAMES}
        if earlier is not None and facts != {key: earlier[k][key] for key in facts}:
            raise SystemExit(
                f"robot {k} of {stored} was drawn with other options or distributions"
            )
        rows.append({**facts, "model_error": round(float(errors[k]), 3), **speeds})
        document = {
            "robot": (ROBOTS / f"{SPATIAL}.yaml").relative_to(ROOT).as_posix(),
            "plant": "twin",
            "command": command,
            **summary(rows),
            "robots": rows,
        }
        (folder / f"{SPATIAL}.yaml").write_text(dump_yaml(document), encoding="utf-8")
        print(len(rows), rows[-1], flush=True)
    return document


def main() -> None:
    """Predict the chosen robots and write a file for each."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--robots", type=int, default=MIN_BOUNDING_SAMPLES, help="number of robots"
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=[*ROBOT_CASES, SPATIAL],
        default=[*ROBOT_CASES, SPATIAL],
        help="robots to predict",
    )
    parser.add_argument(
        "--runs",
        type=Path,
        help="file of earlier runs of the spatial robots, whose speeds are used again",
    )
    parser.add_argument(
        "--out", type=Path, default=RECOMPUTED, help="folder of the predictions"
    )
    options = parser.parse_args()
    rows: list[list[str]] = []
    if SPATIAL in options.only:
        document = predict_spatial(
            options.robots, options.seed, options.runs, options.out
        )
        rows += quantity_rows(SPATIAL, document["quantities"], options.robots)
    for name in ROBOT_CASES:
        if name not in options.only:
            continue
        quantities = predict(name, options.robots, options.seed)
        document = {
            "robot": (ROBOTS / f"{name}.yaml").relative_to(ROOT).as_posix(),
            "plant": "twin",
            "command": (
                f"benchmarks/predict_others.py --robots {options.robots} --seed"
                f" {options.seed}"
            ),
            "robots": options.robots,
            "quantities": quantities,
        }
        text = dump_yaml(document)
        (options.out / f"{name}.yaml").write_text(text, encoding="utf-8")
        rows += quantity_rows(name, quantities, options.robots)
    print(table(["robot", "quantity", "median", "95 % interval", "robots"], rows))


def quantity_rows(
    robot: str, quantities: Mapping[str, dict[str, Any]], count: int
) -> list[list[str]]:
    """Return the cells of the predicted quantities of a robot."""
    rows = []
    for name, row in quantities.items():
        low, high = row["interval_95"]
        interval_95 = f"{low:.3g} to {high:.3g}"
        rows.append([robot, name, f"{row['median']:.3g}", interval_95, str(count)])
    return rows


if __name__ == "__main__":
    main()
