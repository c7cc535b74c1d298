"""How well the clocks of motions and logs are aligned, and whether a gait's period is ever mistaken.

    uv run python benchmarks/clocks.py [--draws 500] [--seed 0] [--spread 0.1]

Each draw is a robot (with `--spread` its gains and time constants differ from those of the robot file that
reads it), a run of rests and gaits, a window of it that cameras saw, and one that was logged, on a clock that
shows up to 20 s more or less. Logs are of valves, of valves that a carrier of 20 to 50 Hz switches, or of
pressures. Windows: `start` and `end` of a gait in both, `change` of frequency or offset in both, `steady`,
nothing but the gait in both, `log start` and `motion start`, the start in one of the two alone.
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
from grid import table

from srs_twin import AnalyticalSnake, Gait, InputError, RobotSpec, Trajectory, load_robot, rollout
from srs_twin.control.replay import Replay
from srs_twin.identification.unknowns import with_values
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


def schedule(spec: RobotSpec, parts: list[tuple[float, float | None, float]]) -> Schedule:
    """Return the valves of parts: (duration in s, frequency in Hz or None at rest, offset)."""
    starts, states, begun = [], [], 0.0
    for duration, frequency, offset in parts:
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


def switched(given: Schedule, carrier: float, duty: float) -> Schedule:
    """Return valves that fill for a share of each carrier period only."""
    edges = np.arange(0, given.span, 1 / carrier)
    times = np.unique(np.concatenate([given.starts, edges, edges + duty / carrier]))
    times = times[times < given.span - 1e-6]
    states = given.states[np.searchsorted(given.starts, times + 1e-9, side="right") - 1].copy()
    off = (times + 1e-9) * carrier % 1 >= duty
    states[off[:, None, None] & (states == 1)] = -1
    return Schedule(given.span, times, states)


def write_log(
    path: Path, given: Schedule, run: Trajectory, window: tuple[float, float], kind: str, later: float
) -> None:
    """Write the log of a window, on a clock that shows `later` (s) more."""
    low, high = window
    names = [f"{j}" for j in range(1, given.states.shape[1] + 1)]
    sides = ("plus", "minus")
    if kind == "pressure":
        time = np.arange(low, high, 0.02)
        values = np.stack(
            [np.interp(time, run.time, run[f"pressure_{side}_{j}"]) / 1e3 for j in names for side in sides],
            axis=1,
        )
        head = [f"pressure_{side}_{j}_kpa" for j in names for side in sides]
    else:
        inside = (given.starts > low) & (given.starts < high)
        time = np.concatenate([[low], given.starts[inside], [high]])
        rows = np.searchsorted(given.starts, time + 1e-9, side="right") - 1
        values = given.states[rows].reshape(len(time), -1)
        head = [f"valve_{side}_{j}" for j in names for side in sides]
    lines = [",".join(f"{each:.7g}" for each in row) for row in np.column_stack([time + later, values])]
    path.write_text("\n".join([",".join(["time", *head]), *lines, ""]))


def draw(seed: int, spread: float) -> tuple[str, str, float, float]:
    """Return case, what was refused, the offset's error and the gait's period, s."""
    random = np.random.default_rng(seed)
    nominal, case = load_robot("gen2"), str(random.choice(CASES))
    names = [f"modules.gain_{side}_{j}" for j in range(1, nominal.segments + 1) for side in ("plus", "minus")]
    factors = 1 + spread * random.standard_normal(len(names) + 2).clip(-2, 2)
    tau = {"tau_fill_s": nominal.actuator.tau_fill, "tau_vent_s": nominal.actuator.tau_vent}
    changed = dict(zip(names, factors, strict=False))
    changed |= {
        f"actuator.{name}": value * f for (name, value), f in zip(tau.items(), factors[-2:], strict=True)
    }
    robot = with_values(nominal, changed) if spread else nominal
    frequency, offset = random.uniform(0.5, 2.5), random.uniform(-0.2, 0.2)
    rest, long = random.uniform(0.4, 1.5), random.uniform(4, 9)
    parts: list[tuple[float, float | None, float]] = [(rest, None, 0.0), (long + 3, frequency, offset)]
    if case == "change":
        parts.append(
            (long, frequency * random.choice([0.7, 0.85, 1.2]), offset + random.choice([-0.2, 0, 0.2]))
        )
    parts = [(round(each[0] / TICK) * TICK, *each[1:]) for each in parts]
    parts.append((1.5, None, 0.0))
    given = schedule(robot, parts)
    kind = str(random.choice(["valve", "valve", "valve", "pwm", "pressure"]))
    if kind == "pwm":
        given = switched(given, random.uniform(20, 50), random.uniform(0.5, 0.9))
    plant = AnalyticalSnake(robot, supply_pa=48e3, model="compliant")
    run = rollout(plant, Replay(given), given.span, record_hz=500)
    on, off = rest, given.span - 1.5
    settled = on + max(1.5, 2 / frequency)
    windows = {
        "start": ((0, off), (0, off)),
        "end": ((settled, given.span), (settled, given.span)),
        "change": ((settled, off), (settled, off)),
        "steady": ((settled, off), (settled, off)),
        "log start": ((settled, off), (0, off)),
        "motion start": ((0, off), (settled, off)),
    }[case]
    seen, logged = (
        (low + random.uniform(0, 0.3), high - random.uniform(0, 0.3) * (high < given.span))
        for low, high in windows
    )
    later = random.uniform(-20, 20)
    rows = (run.time >= seen[0]) & (run.time <= seen[1])
    part = replace(run, columns={name: column[rows] for name, column in run.columns.items()})
    take = Take(
        layout=str(random.choice(["pair", "head"])), noise=float(random.choice([2e-4, 4e-4])), seed=seed,
        rate_hz=float(random.integers(60, 361)), lost=random.uniform(0, 0.03), labeled=True,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        motion, log = Path(folder) / "m.csv", Path(folder) / "m.valves.csv"
        write_motive(part, take, motion)
        write_log(log, given, run, logged, kind, later)
        head = "snake:1a" if take.layout == "pair" else None
        try:
            body = read_motion(motion, nominal, layout=take.layout, head=head)
            joined = join(body, read_valves(log, nominal), nominal)
        except InputError as error:
            return case, re.sub(r"^\S+: ", "", str(error)), np.nan, 1 / frequency
    found = joined.trajectory.metadata["valve_log"]["offset_s"]
    # Frames count from the first one that cameras saw.
    return case, "", float(found + later + part.time[0]), 1 / frequency


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--draws", type=int, default=500)
    words.add_argument("--seed", type=int, default=0)
    words.add_argument("--spread", type=float, default=0.0)
    words.add_argument("--json", type=Path, help="also write the draws to this file")
    given = words.parse_args()
    with ProcessPoolExecutor() as pool:
        found = list(
            pool.map(partial(draw, spread=given.spread), range(given.seed, given.seed + given.draws))
        )
    rows = []
    for case in CASES:
        own = [each for each in found if each[0] == case]
        errors = np.array([each[2] for each in own if not each[1]])
        periods = np.array([each[3] for each in own if not each[1]])
        rows.append([
            case, str(len(own)), str(sum(bool(each[1]) for each in own)), str((np.abs(errors) < 0.005).sum()),
            str(((np.abs(errors) >= 0.005) & (np.abs(errors) < 0.25 * periods)).sum()),
            str((np.abs(errors) >= 0.25 * periods).sum()),
            f"{1e3 * np.median(np.abs(errors)):.1f}" if len(errors) else "–",
        ])  # fmt: skip
    head = [
        "in view",
        "draws",
        "refused",
        "within 5 ms",
        "farther",
        "a half period or more",
        "median error, ms",
    ]
    print(table(head, rows), flush=True)
    if given.json:
        keys = ("case", "refused", "offset_error_s", "period_s")
        given.json.write_text(json.dumps([dict(zip(keys, each, strict=True)) for each in found]), "utf-8")
    for reason in sorted({f"{each[0]}: {each[1][:150]}" for each in found if each[1] and each[0] in TOLD}):
        print(reason)
    for seed, each in enumerate(found, start=given.seed):
        if not each[1] and abs(each[2]) >= 0.005:
            print(f"seed {seed}, {each[0]}: {1e3 * each[2]:.1f} ms of a period of {1e3 * each[3]:.0f}")


if __name__ == "__main__":
    main()
