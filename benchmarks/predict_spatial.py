"""Predicted fastest serpentine and sidewinding speed of a spatial snake with few published parameters.

    uv run python benchmarks/predict_spatial.py [--robots 146] [--seed 0] [--runs FILE]

Robots are drawn from the priors of calibration/robots/others/spatial_530mm.yaml by
Latin hypercube, together with the two alternatives: wheels (probability 0.75, as all
planar generations of the laboratory) or skin, and four chambers (0.75) or three at
120°. Every robot crawls with all gaits of a grid; its fastest serpentine is the one of
a planar wave, its fastest sidewinding that of a wave in both directions. The twin is
the only plant. Its speeds are multiplied by a random factor, its known error: published
speed over that of the twin for the four planar generations of the same laboratory. The
intervals are quantiles over the robots. A robot takes 20 s. `--runs
calibration/predictions/spatial_530mm.yaml --robots 40` uses the speeds of the committed
prediction again.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml
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
from srs_twin.control.gait import PitchWave
from srs_twin.io.documents import dump_yaml
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.file import RobotFile, load_robot_file
from srs_twin.robot.spec import RobotSpec
from srs_twin.studies.uncertainty.metric_uncertainty import MIN_BOUNDING_SAMPLES

ROBOT = ROBOTS / "spatial_530mm.yaml"
OUT = RECOMPUTED / "spatial_530mm.yaml"

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


def draw_robots(count: int, seed: int) -> list[tuple[RobotFile, dict[str, Any]]]:
    """Return robots and the facts about each of them."""
    file = load_robot_file(ROBOT)
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
    twin = TwinSnake(spec, timestep=TIMESTEP_S)
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


def main() -> None:
    """Draw robots, run their gaits, and write the prediction after every robot."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--robots", type=int, default=MIN_BOUNDING_SAMPLES, help="number of robots"
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed")
    parser.add_argument(
        "--runs", type=Path, help="file of earlier runs, whose speeds are used again"
    )
    options = parser.parse_args()
    command = (
        f"benchmarks/predict_spatial.py --robots {options.robots} --seed {options.seed}"
    )
    if options.runs:
        command += f" --runs {options.runs}"
    rows: list[dict[str, Any]] = []
    errors = model_errors(options.robots, options.seed)
    if options.runs:
        earlier = yaml.safe_load(options.runs.read_text("utf-8"))["robots"]
    else:
        earlier = None
    for k, (file, facts) in enumerate(draw_robots(options.robots, options.seed)):
        if earlier is None:
            speeds = fastest(file.spec())
        else:
            speeds = {n: earlier[k][n] for n in NAMES}
        if earlier is not None and facts != {key: earlier[k][key] for key in facts}:
            raise SystemExit(
                f"robot {k} of {options.runs} was drawn with other options or"
                " distributions"
            )
        rows.append({**facts, "model_error": round(float(errors[k]), 3), **speeds})
        document = {
            "robot": ROBOT.relative_to(ROOT).as_posix(),
            "plant": "twin",
            "command": command,
            **summary(rows),
            "robots": rows,
        }
        OUT.write_text(dump_yaml(document), encoding="utf-8")
        print(len(rows), rows[-1], flush=True)


if __name__ == "__main__":
    main()
