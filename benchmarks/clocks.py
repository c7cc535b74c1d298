"""Alignment of the clocks of motion capture and logs, and errors of a whole gait period.

    uv run python benchmarks/clocks.py [--draws 500] [--seed 0] [--spread 0.1]

Each draw consists of a robot, a run with rests and gaits, a time window that the
cameras record, and another window that is logged. The clocks differ by up to 20 s. With
`--spread`, gains and time constants differ from those in the robot file. Logs contain
valves, valves switched by a carrier of 20 to 50 Hz, or pressures. The cases are named
after what both windows contain: `start` and `end` of a gait, a `change` of frequency or
offset, `steady` (only the gait), and `log start` and `motion start` (the start in one
window only).
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from common.grid import table

from srs_twin import (
    AnalyticalSnake,
    Gait,
    InputError,
    RobotSpec,
    Trajectory,
    load_robot,
    rollout,
)
from srs_twin.control.replay import Replay
from srs_twin.identification.parameters import with_values
from srs_twin.pneumatics import Schedule
from srs_twin.recordings.recording import read_motion
from srs_twin.recordings.signals.clock import join
from srs_twin.recordings.signals.logs import read_valves

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from synthetic_takes import Take, write_motive

CASES = ("start", "end", "change", "steady", "log start", "motion start")
TOLD = ("start", "end", "change")
TICK = 0.02


def vented(spec: RobotSpec) -> np.ndarray:
    return np.full((spec.segments, 2), -1, dtype=np.int8)


def schedule(
    spec: RobotSpec, intervals: list[tuple[float, float | None, float]]
) -> Schedule:
    """Return the valve states of intervals: (duration in s, frequency in Hz or None at rest, offset)."""
    starts = []
    states = []
    begun = 0.0
    for duration, frequency, offset in intervals:
        if frequency is None:
            own = Schedule(duration, np.zeros(1), vented(spec)[None])
        else:
            gait = Gait(frequency, offset)
            gait.reset(spec, TICK)
            own = gait.script(duration)
        starts.append(own.starts + begun)
        states.append(own.states)
        begun += duration
    return Schedule(begun, np.concatenate(starts), np.concatenate(states))


def switched(valves: Schedule, carrier: float, duty: float) -> Schedule:
    """Return valves that fill only for the duty of each carrier period."""
    edges = np.arange(0, valves.span, 1 / carrier)
    times = np.unique(np.concatenate([valves.starts, edges, edges + duty / carrier]))
    times = times[times < valves.span - 1e-6]
    states = valves.states[
        np.searchsorted(valves.starts, times + 1e-9, side="right") - 1
    ].copy()
    venting = (times + 1e-9) * carrier % 1 >= duty
    states[venting[:, None, None] & (states == 1)] = -1
    return Schedule(valves.span, times, states)


def write_log(
    path: Path,
    valves: Schedule,
    run: Trajectory,
    window: tuple[float, float],
    kind: str,
    later: float,
) -> None:
    """Write the log of a window, with `later` (s) added to its times."""
    low, high = window
    names = [f"{j}" for j in range(1, valves.states.shape[1] + 1)]
    sides = ("plus", "minus")
    if kind == "pressure":
        time = np.arange(low, high, 0.02)
        values = np.stack(
            [
                np.interp(time, run.time, run[f"pressure_{side}_{j}"]) / 1e3
                for j in names
                for side in sides
            ],
            axis=1,
        )
        head = [f"pressure_{side}_{j}_kpa" for j in names for side in sides]
    else:
        inside = (valves.starts > low) & (valves.starts < high)
        time = np.concatenate([[low], valves.starts[inside], [high]])
        rows = np.searchsorted(valves.starts, time + 1e-9, side="right") - 1
        values = valves.states[rows].reshape(len(time), -1)
        head = [f"valve_{side}_{j}" for j in names for side in sides]
    lines = [
        ",".join(f"{item:.7g}" for item in row)
        for row in np.column_stack([time + later, values])
    ]
    path.write_text("\n".join([",".join(["time", *head]), *lines, ""]))


def draw(seed: int, spread: float) -> tuple[str, str, float, float]:
    """Return case, reason for a refusal, error of the clock offset and gait period, s."""
    random = np.random.default_rng(seed)
    nominal = load_robot("gen2")
    case = str(random.choice(CASES))
    names = [
        f"modules.gain_{side}_{j}"
        for j in range(1, nominal.segments + 1)
        for side in ("plus", "minus")
    ]
    factors = 1 + spread * random.standard_normal(len(names) + 2).clip(-2, 2)
    tau = {
        "tau_fill_s": nominal.actuator.tau_fill,
        "tau_vent_s": nominal.actuator.tau_vent,
    }
    changed = dict(zip(names, factors, strict=False))
    changed |= {
        f"actuator.{name}": value * f
        for (name, value), f in zip(tau.items(), factors[-2:], strict=True)
    }
    robot = with_values(nominal, changed) if spread else nominal
    frequency = random.uniform(0.5, 2.5)
    offset = random.uniform(-0.2, 0.2)
    rest = random.uniform(0.4, 1.5)
    long = random.uniform(4, 9)
    intervals: list[tuple[float, float | None, float]] = [
        (rest, None, 0.0),
        (long + 3, frequency, offset),
    ]
    if case == "change":
        intervals.append(
            (
                long,
                frequency * random.choice([0.7, 0.85, 1.2]),
                offset + random.choice([-0.2, 0, 0.2]),
            )
        )
    intervals = [(round(item[0] / TICK) * TICK, *item[1:]) for item in intervals]
    intervals.append((1.5, None, 0.0))
    valves = schedule(robot, intervals)
    kind = str(random.choice(["valve", "valve", "valve", "pwm", "pressure"]))
    if kind == "pwm":
        valves = switched(valves, random.uniform(20, 50), random.uniform(0.5, 0.9))
    plant = AnalyticalSnake(robot, supply_pa=48e3, model="compliant")
    run = rollout(plant, Replay(valves), valves.span, record_hz=500)
    on = rest
    gait_end = valves.span - 1.5
    settled = on + max(1.5, 2 / frequency)
    windows = {
        "start": ((0, gait_end), (0, gait_end)),
        "end": ((settled, valves.span), (settled, valves.span)),
        "change": ((settled, gait_end), (settled, gait_end)),
        "steady": ((settled, gait_end), (settled, gait_end)),
        "log start": ((settled, gait_end), (0, gait_end)),
        "motion start": ((0, gait_end), (settled, gait_end)),
    }[case]
    seen, logged = (
        (
            low + random.uniform(0, 0.3),
            high - random.uniform(0, 0.3) * (high < valves.span),
        )
        for low, high in windows
    )
    later = random.uniform(-20, 20)
    rows = (run.time >= seen[0]) & (run.time <= seen[1])
    part = replace(
        run, columns={name: column[rows] for name, column in run.columns.items()}
    )
    take = Take(
        layout=str(random.choice(["pair", "head"])),
        noise=float(random.choice([2e-4, 4e-4])),
        seed=seed,
        rate_hz=float(random.integers(60, 361)),
        lost=random.uniform(0, 0.03),
        labeled=True,
    )
    with tempfile.TemporaryDirectory() as folder:
        motion = Path(folder) / "m.csv"
        log = Path(folder) / "m.valves.csv"
        write_motive(part, take, motion)
        write_log(log, valves, run, logged, kind, later)
        head = "snake:1a" if take.layout == "pair" else None
        try:
            body = read_motion(motion, nominal, layout=take.layout, head=head)
            joined = join(body, read_valves(log, nominal), nominal)
        except InputError as error:
            return case, re.sub(r"^\S+: ", "", str(error)), np.nan, 1 / frequency
    result = joined.trajectory.metadata["valve_log"]["offset_s"]
    # Times of motion capture start at its first frame.
    return case, "", float(result + later + part.time[0]), 1 / frequency


def main() -> None:
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--draws", type=int, default=500)
    words.add_argument("--seed", type=int, default=0)
    words.add_argument("--spread", type=float, default=0.0)
    words.add_argument("--json", type=Path, help="also write the draws to this file")
    options = words.parse_args()
    with ProcessPoolExecutor() as pool:
        result = list(
            pool.map(
                partial(draw, spread=options.spread),
                range(options.seed, options.seed + options.draws),
            )
        )
    rows = []
    for case in CASES:
        own = [item for item in result if item[0] == case]
        errors = np.array([item[2] for item in own if not item[1]])
        periods = np.array([item[3] for item in own if not item[1]])
        rows.append(
            [
                case,
                str(len(own)),
                str(sum(bool(item[1]) for item in own)),
                str((np.abs(errors) < 0.005).sum()),
                str(
                    (
                        (np.abs(errors) >= 0.005) & (np.abs(errors) < 0.25 * periods)
                    ).sum()
                ),
                str((np.abs(errors) >= 0.25 * periods).sum()),
                f"{1e3 * np.median(np.abs(errors)):.1f}" if len(errors) else "–",
            ]
        )
    head = [
        "case",
        "draws",
        "refused",
        "within 5 ms",
        "larger",
        "half a period or more",
        "median error, ms",
    ]
    print(table(head, rows), flush=True)
    if options.json:
        keys = ("case", "refused", "offset_error_s", "period_s")
        options.json.write_text(
            json.dumps([dict(zip(keys, item, strict=True)) for item in result]), "utf-8"
        )
    for reason in sorted(
        {
            f"{item[0]}: {item[1][:150]}"
            for item in result
            if item[1] and item[0] in TOLD
        }
    ):
        print(reason)
    for seed, item in enumerate(result, start=options.seed):
        if not item[1] and abs(item[2]) >= 0.005:
            print(
                f"seed {seed}, {item[0]}: {1e3 * item[2]:.1f} ms of a period of"
                f" {1e3 * item[3]:.0f}"
            )


if __name__ == "__main__":
    main()
