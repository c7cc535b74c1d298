"""Module at rest with a leak: effect of the sensor noise on the differences (Section 4.3).

Runs the shipped scenarios module_hold_leak_… with many draws of the sensor noise on
both benches, which takes some minutes. Prints each metric as mean ± standard deviation
over the draws, and the difference of the means (twin minus analytical) with its 95 %
interval (Welch). Then repeats this for direct SMC with single effects switched. `drift`
is the peak-to-peak value of the bend averaged over a carrier period (1/60 s), the part
of an oscillation that is not ripple of the carrier.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np
from common.grid import table
from scipy.stats import ttest_ind

from srs_twin import Trajectory, load_scenario, rollout
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.control.smc import CARRIER_HZ
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.scenario import Scenario

PLANTS = ("analytical", "twin")
SHOWN = {
    "steady_rms_rad": "RMS error (°)",
    "ripple_pp_rad": "peak to peak (°)",
    "drift": "drift (°)",
    "inlet_openings": "openings in 6 s",
}
SWITCHED: Mapping[str, Mapping[str, Any]] = {
    "as shipped": {},
    "end of 0.1 g": {
        "robot.mass.connectors_kg.value": 0.0001,
        "robot.mass.wheel_kg.value": 0.00002,
    },
    "time step of the twin 0.1 ms": {"plants.twin.timestep_s": 0.0001},
    "time step of the twin 1 ms": {"plants.twin.timestep_s": 0.001},
    "no noise": {"sensor.noise_uv": 0.0},
    "no noise, no quantisation": {"sensor.noise_uv": 0.0, "sensor.bits": 32},
    "half the leak": {"pneumatics.leak_per_s": 0.25},
    "twice the leak": {"pneumatics.leak_per_s": 1.0},
    "half of ε": {"controller.epsilon_rad_per_s": 0.733},
}


def changed(kind: str, changes: Mapping[str, Any]) -> Scenario:
    """Return the scenario of a controller with changed fields."""
    document = copy.deepcopy(dict(load_scenario(f"module_hold_leak_{kind}").document))
    for path, value in changes.items():
        *above, last = path.split(".")
        place: Any = document
        for name in above:
            place = place[name]
        place[last] = value
    return parse_scenario(document)


def drift(run: Trajectory) -> float:
    """Return the peak-to-peak value of the bend averaged over a carrier period, second half of a run, rad."""
    time = run.time
    bend = run["bend_1"]
    turned = np.append(0.0, np.cumsum(np.diff(time) * (bend[1:] + bend[:-1]) / 2))
    later = time[time >= time[-1] / 2 + 1 / CARRIER_HZ]
    means = CARRIER_HZ * (
        np.interp(later, time, turned) - np.interp(later - 1 / CARRIER_HZ, time, turned)
    )
    return float(np.ptp(means))


def measured(job: tuple[str, str, str, int]) -> dict[str, float]:
    """Run one draw, given by controller, key of `SWITCHED`, plant and seed."""
    kind, switch, plant, seed = job
    scenario = changed(kind, SWITCHED[switch])
    run = rollout(
        scenario.build_plant(plant),
        scenario.build_controller(),
        scenario.duration,
        seed=seed,
        record_hz=scenario.record_hz,
    )
    result = plant_metrics(run) | {"drift": drift(run)}
    return {
        name: (
            float(result[name])
            if name == "inlet_openings"
            else math.degrees(result[name])
        )
        for name in SHOWN
    }


def draws(
    pool: ProcessPoolExecutor, kind: str, switch: str, count: int
) -> dict[str, dict[str, np.ndarray]]:
    """Return the values over the draws by plant and metric."""
    jobs = [(kind, switch, plant, seed) for plant in PLANTS for seed in range(count)]
    rows = list(pool.map(measured, jobs))
    return {
        plant: {
            name: np.array(
                [
                    row[name]
                    for job, row in zip(jobs, rows, strict=True)
                    if job[2] == plant
                ]
            )
            for name in SHOWN
        }
        for plant in PLANTS
    }


def spread(values: np.ndarray) -> str:
    """Return '55.4 ± 3.3', or the value alone for a single draw."""
    digits = 1 if abs(values.mean()) >= 10 else 2
    alone = f"{values.mean():.{digits}f}"
    if len(values) < 2:
        return alone
    return f"{alone} ± {values.std(ddof=1):.{digits}f}"


def apart(ours: np.ndarray, theirs: np.ndarray) -> str:
    """Return the difference of the second mean from the first in per cent, with its 95 % interval."""
    fraction = 100 * (theirs.mean() / ours.mean() - 1)
    if len(ours) < 2 or not (np.ptp(ours) or np.ptp(theirs)):
        return f"{fraction:+.1f} %"
    between = ttest_ind(theirs, ours, equal_var=False).confidence_interval(0.95)
    low, high = (100 * float(end) / ours.mean() for end in (between.low, between.high))
    return f"{fraction:+.1f} % ({low:+.1f} to {high:+.1f})"


def by_controller(pool: ProcessPoolExecutor, count: int) -> str:
    """Return the table of both shipped controllers."""
    rows = []
    for kind in ("direct", "iterative"):
        result = draws(pool, kind, "as shipped", count)
        for name, words in SHOWN.items():
            ours, theirs = (result[plant][name] for plant in PLANTS)
            rows.append(
                [kind, words, spread(ours), spread(theirs), apart(ours, theirs)]
            )
    return table(["SMC", "", *PLANTS, "twin minus analytical"], rows)


def by_switch(pool: ProcessPoolExecutor, count: int) -> str:
    """Return the table of direct SMC with single effects switched."""
    rows = []
    for switch, changes in SWITCHED.items():
        result = draws(
            pool, "direct", switch, 1 if "sensor.noise_uv" in changes else count
        )
        ours, theirs = (result[plant]["inlet_openings"] for plant in PLANTS)
        errors = (spread(result[plant]["steady_rms_rad"]) for plant in PLANTS)
        rows.append(
            [switch, spread(ours), spread(theirs), apart(ours, theirs), *errors]
        )
    heads = [f"openings, {plant}" for plant in PLANTS]
    return table(
        [
            "direct SMC",
            *heads,
            "twin minus analytical",
            *(f"RMS error (°), {p}" for p in PLANTS),
        ],
        rows,
    )


def tables(count: int) -> None:
    """Print both tables.

    Args:
        count: number of draws of the sensor noise.
    """
    with ProcessPoolExecutor(2) as pool:
        print(by_controller(pool, count), flush=True)
        print("\n" + by_switch(pool, count), flush=True)
