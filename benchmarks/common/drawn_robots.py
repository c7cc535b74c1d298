"""Robots drawn from the intervals of a robot file, and the speeds of their gaits: shared by predictions."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

from srs_twin import Gait, rollout
from srs_twin.errors import DivergedError
from srs_twin.identification.priors import Priors
from srs_twin.io.validation import StrictModel
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.file import RobotFile
from srs_twin.robot.spec import RobotSpec

ROOT = Path(__file__).parents[2]
ROBOTS = ROOT / "calibration" / "robots" / "others"
PREDICTIONS = ROOT / "calibration" / "predictions"
RECOMPUTED = PREDICTIONS / "recomputed"
"""Folder of later numbers; the files in `PREDICTIONS` were committed before the published values."""
INTERVALS = ROOT / "calibration" / "intervals"

BOOTSTRAP_SAMPLES = 2000
PERIODS = 5
"""Gait periods of a run; a motion is that of the last two."""


def draw(
    file: RobotFile, count: int, choices: int, seed: int
) -> tuple[np.ndarray, list[dict[str, float]]]:
    """Draw robots by Latin hypercube.

    Returns:
        uniform numbers for further choices, shape (count, choices), and the drawn
        values by path, one dictionary per robot.
    """
    priors = Priors.from_robot(file)
    units = qmc.LatinHypercube(len(priors.parameters) + choices, seed=seed).random(
        count
    )
    values = [
        dict(zip(priors.paths, priors.quantile(u[choices:]), strict=True))
        for u in units
    ]
    return units[:, :choices], values


def with_values(file: RobotFile, values: Mapping[str, Any]) -> RobotFile:
    """Return a robot file with other numbers, by path, and without distributions."""
    data = copy.deepcopy(file.model_dump())
    for path, value in values.items():
        section, key = path.split(".")
        plain = value if isinstance(value, list) else float(value)
        data[section][key] = {**data[section][key], "value": plain, "uncertain": None}
    data["correlated"] = None
    model: type[StrictModel] = RobotFile
    return model.model_validate(data)  # type: ignore[return-value]


def twin_of(spec: RobotSpec, longest: float) -> TwinSnake:
    """Return the twin of a drawn robot.

    The time step is halved until it is at most the damping time of the segments, because
    the twin refuses steps that are longer than 1.5 damping times.

    Args:
        spec: drawn robot.
        longest: longest time step, s.
    """
    shortest = min(spec.bending.damping_time, spec.bending.out_of_plane_damping_time)
    timestep = longest
    while timestep > shortest:
        timestep /= 2
    return TwinSnake(spec, timestep=timestep)


def motion(twin: TwinSnake, gait: Gait) -> tuple[float, float]:
    """Return speed, m/s, and yaw rate, rad/s, over the last two periods; zeros for a run that diverged."""
    duration = math.ceil(PERIODS / gait.frequency / twin.tick) * twin.tick
    try:
        run = rollout(twin, gait, duration, record_hz=50)
    except DivergedError:
        return 0.0, 0.0
    before = int(np.searchsorted(run.time, run.time[-1] - 2 / gait.frequency))
    span = run.time[-1] - run.time[before]
    turned = run["heading"][-1] - run["heading"][before]
    return float(np.hypot(*(run.com[-1] - run.com[before])) / span), float(
        turned / span
    )


def published_over_twin() -> np.ndarray:
    """Return the ratio of published to simulated speed of generations 1 to 4, from the stored intervals."""
    files = [INTERVALS / f"gen{generation}_straight.json" for generation in range(1, 5)]
    rows = [
        json.loads(file.read_text("utf-8"))["plants"]["twin"]["com_speed_m_s"]
        for file in files
    ]
    return np.array([row["published"] / row["value"] for row in rows])


def interval(values: Sequence[float]) -> dict[str, Any]:
    """Return the median, the ends of the 95 % interval and their standard errors (bootstrap over robots)."""
    ends = [0.025, 0.975]
    drawn = np.random.default_rng(0).choice(values, (BOOTSTRAP_SAMPLES, len(values)))
    errors = np.quantile(drawn, ends, axis=1).std(axis=1)
    return {
        "median": float(f"{np.median(values):.4g}"),
        "interval_95": [float(f"{end:.4g}") for end in np.quantile(values, ends)],
        "interval_95_error": [float(f"{error:.2g}") for error in errors],
    }


def model_errors(count: int, seed: int) -> np.ndarray:
    """Return the true speed over that of the twin for some robots, a lognormal fit to four robots."""
    logs = np.log(published_over_twin())
    n = len(logs)
    units = qmc.LatinHypercube(1, seed=seed + 1).random(count)[:, 0]
    draws = ndtri(units) * logs.std(ddof=1) * math.sqrt(1 + 1 / n)
    return np.exp(logs.mean() + draws)
