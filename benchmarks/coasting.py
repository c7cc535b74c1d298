"""Coasting tests of bent bodies: do the intervals contain the coefficients of the simulated floor?

uv run python benchmarks/coasting.py [ROBOTS] [SEED]

Each robot is a gen2 twin with drawn coefficients. Its segments have rest bends of the
stated size and of random sign. It is pushed along its body at 0.4 and 0.6 m/s and
across at 0.8 m/s. The recording adds noise with a standard deviation of 1 mm to each
coordinate and of 0.01 rad to the heading and the bends. "none": bends are not recorded.
"shifted": each recorded bend also has a constant error with a standard deviation of
0.01 rad. The fit starts from the shipped robot, which is straight.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from srs_twin import (
    LoadedContact,
    RobotSpec,
    SnakeState,
    Trajectory,
    TwinSnake,
    load_robot,
)
from srs_twin.errors import InputError
from srs_twin.identification.estimate import FitEstimate
from srs_twin.identification.friction import CoastingTest, fit_coasting
from srs_twin.identification.parameters import with_values

GEN2 = load_robot("gen2")
BENDS_RAD = (0.0, 0.01, 0.02, 0.05)
THROWS_M_S = ((0.4, 0.0), (0.6, 0.0), (0.0, 0.8))
RECORDS = ("none", "exact", "shifted")
TICK_S = 0.01
SECONDS = 1.0
HEADING_RAD = 0.3
CAMERA_M = 1e-3
CAMERA_RAD = 0.01
SHIFT_RAD = 0.01


def drawn(rng: np.random.Generator, bend: float) -> RobotSpec:
    """Return gen2 with drawn coefficients and rest bends of one size and random signs."""
    bends = bend * rng.choice([-1.0, 1.0], GEN2.segments)
    values = {
        f"modules.bias_rad_{k}": float(value) for k, value in enumerate(bends, start=1)
    }
    values |= {
        "friction.mu_t": rng.uniform(0.03, 0.08),
        "friction.mu_n": rng.uniform(0.4, 0.7),
    }
    return with_values(GEN2, values)


def throw(spec: RobotSpec, velocity: tuple[float, float]) -> list[SnakeState]:
    """Return the states of a twin that rests in its bent shape and is then pushed on rolling wheels."""
    plant = TwinSnake(spec, contact=LoadedContact("wheel"), tick=TICK_S)
    vented = np.full((spec.segments, 2), -1, dtype=np.int8)
    rest = plant.reset()
    for _ in range(20):
        rest = plant.step(vented)
    c = np.cos(HEADING_RAD)
    s = np.sin(HEADING_RAD)
    world = np.array(
        [c * velocity[0] - s * velocity[1], s * velocity[0] + c * velocity[1]]
    )
    first = plant.set_state(replace(rest, com_velocity=world, heading=HEADING_RAD))
    return [first, *(plant.step(vented) for _ in range(round(SECONDS / TICK_S)))]


def recorded(
    states: Sequence[SnakeState],
    record: str,
    shift: np.ndarray,
    rng: np.random.Generator,
) -> Trajectory:
    """Return the states as a camera records them, with noise."""
    com = np.array([state.com for state in states])
    com = com + CAMERA_M * rng.normal(size=com.shape)
    heading = np.array([state.heading for state in states])
    heading = heading + CAMERA_RAD * rng.normal(size=heading.shape)
    bends = np.array([state.bend for state in states])
    bends = (
        bends
        + CAMERA_RAD * rng.normal(size=bends.shape)
        + (shift if record == "shifted" else 0.0)
    )
    columns = {
        "time": TICK_S * np.arange(len(com)),
        "com_x": com[:, 0],
        "com_y": com[:, 1],
    }
    columns["heading"] = heading
    if record != "none":
        columns |= {f"bend_{k}": column for k, column in enumerate(bends.T, start=1)}
    return Trajectory(columns)


def fitted(
    throws: Sequence[list[SnakeState]], record: str, seed: int
) -> FitEstimate | None:
    """Return the fit of the recorded throws; None if a test is refused because the body turns."""
    rng = np.random.default_rng([seed, RECORDS.index(record)])
    shift = SHIFT_RAD * rng.normal(size=GEN2.segments)
    runs = []
    try:
        for k, states in enumerate(throws):
            seen = recorded(states, record, shift, rng)
            runs.append(CoastingTest.from_trajectory(seen, f"throw_{k}", start=0.0))
    except InputError:
        return None
    return fit_coasting(runs, GEN2)


def row(
    bend: float,
    record: str,
    name: str,
    fits: Sequence[FitEstimate | None],
    truths: Sequence[float],
) -> str:
    """Return a row of the table for one coefficient."""
    known = [
        (fit[name], truth)
        for fit, truth in zip(fits, truths, strict=True)
        if fit is not None and fit[name].value is not None
    ]
    held = [parameter.low <= truth <= parameter.high for parameter, truth in known]  # type: ignore[operator]
    sure = [
        contains
        for contains, (found, _) in zip(held, known, strict=True)
        if found.verdict == "identified"
    ]
    errors = [100 * (parameter.value / truth - 1) for parameter, truth in known]  # type: ignore[operator]
    widths = [50 * (p.high - p.low) / p.value for p, _ in known]  # type: ignore[operator]
    if known:
        span = f"{min(errors):+.1f} to {max(errors):+.1f} | {np.median(widths):.1f}"
    else:
        span = "| "
    return (
        f"| {bend:g} | {record} | {name.removeprefix('friction.')} | {sum(held)} of"
        f" {len(held)} | {sum(sure)} of {len(sure)} | {len(fits) - len(known)} |"
        f" {span} |"
    )


def main(robots: int, first_seed: int) -> None:
    print(
        "| rest bends, ± rad | bends recorded | coefficient | true value in the"
        " interval | true value in the interval, identified only | refused | errors, %"
        " | median half width, % |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for bend in BENDS_RAD:
        seeds = range(first_seed, first_seed + robots)
        specs = [drawn(np.random.default_rng(seed), bend) for seed in seeds]
        thrown = [[throw(spec, velocity) for velocity in THROWS_M_S] for spec in specs]
        for record in RECORDS:
            fits = [
                fitted(throws, record, seed)
                for throws, seed in zip(thrown, seeds, strict=True)
            ]
            for name, truths in (
                ("friction.mu_t", [spec.friction.mu_t for spec in specs]),
                ("friction.mu_n", [spec.friction.mu_n for spec in specs]),
            ):
                print(row(bend, record, name, fits, truths), flush=True)


if __name__ == "__main__":
    numbers = [int(argument) for argument in sys.argv[1:]]
    main(*(numbers + [20, 500][len(numbers) :]))
