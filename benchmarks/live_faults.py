"""Faults of a robot on the air: how many are named rightly, how fast, and how often a healthy one is accused.

    uv run python benchmarks/live_faults.py [--seeds 20] [--healthy-h 1] [--json FILE]

The robot is the stand-in of `srs-twin emulate`: modules spread by 10 %, chambers of compressible flow, 0.02
rad of noise. Of its messages 5 % are lost, the rest late by up to 20 ms; motion capture has 30 frames a
second. A fault is observable from when a healthy robot, without noise, would have answered otherwise by three
times the noise; it is in time within a gait period of that.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from grid import table

from srs_twin import Gait, load_robot
from srs_twin.live.emulator import EmulatedRobot
from srs_twin.live.faults import FaultBank
from srs_twin.parallel import each

ROBOT, FREQUENCY, BREAKS_S, AFTER_S = "gen4", 1.5, 5.0, 3.0
NOISE, LOSS, JITTER_S, CAMERA_HZ = 0.02, 0.05, 0.02, 30.0
KINDS = {
    "stuck_valve:{j}{side}=open": "stuck_valve {side}=open",
    "stuck_valve:{j}{side}=closed": "stuck_valve {side}=closed",
    "leak:{j}{side}=fast": "leak {side}",
    "leak:{j}{side}=slow": "leak {side}",
    "dead_sensor:{j}=silent": "dead_sensor",
    "dead_sensor:{j}=frozen": "dead_sensor frozen",
    "drifting_sensor:{j}": "drifting_sensor",
    "starved=half": "starved",
}
"""Fault → the name that it should get."""
Order = tuple[str, int, float, bool]


def walked(robot: EmulatedRobot, seconds: float) -> Iterator[tuple[np.ndarray, Any]]:
    """Yield commands and states of a robot that walks, offset by offset."""
    gait = Gait(FREQUENCY)
    gait.reset(robot.twin.spec, robot.tick)
    for k in range(round(seconds / robot.tick)):
        if k % 250 == 0:
            gait.offset = (0.0, 0.15, -0.15)[k // 250 % 3]
        valves = gait.valves_at(k * robot.tick)
        command = valves if valves.ndim == 2 else valves[-1]
        yield command, robot.step(command)


def by_markers(robot: EmulatedRobot) -> np.ndarray:
    """Return bends by what motion capture sees now, rad; NaN where a body is lost."""
    bodies = robot.bodies().values()
    turns = [2 * np.arctan2(b.turn[1], b.turn[3]) if b.tracked else np.nan for b in bodies]
    return np.asarray((-np.diff(turns) + np.pi) % (2 * np.pi) - np.pi)


def run(order: Order) -> dict[str, Any]:
    """Let a robot walk beside a bank; return what was named and when, by ticks that a fault lasts."""
    fault, seed, seconds, pressures = order
    robot = EmulatedRobot(ROBOT, seed=seed, faults=[f"{fault}@{BREAKS_S}"] if fault else ())
    spec = load_robot(ROBOT)
    bank = FaultBank(spec, supply_pa=spec.supply.nominal, tick=robot.tick)
    rng, named, begun = np.random.default_rng((seed, 5)), dict[int, tuple[str, float]](), False
    readings, pending = np.full(spec.segments, np.nan), None
    alarms: list[str] = []
    for k, (command, state) in enumerate(walked(robot, seconds)):
        # What comes late by more than a tick's rest is taken with the next one.
        fresh = robot.bends() if rng.random() >= LOSS else None
        late = rng.random() * JITTER_S > 0.5 * robot.tick
        readings, pending = (pending, fresh) if late else (fresh, None)
        told = np.full(spec.segments, np.nan) if readings is None else readings
        seen = by_markers(robot) if rng.random() < CAMERA_HZ * robot.tick else None
        air = state.pressure if pressures and rng.random() >= LOSS else None
        bank.step(command, told, seen, air)
        for j, name in bank.named.items():
            if j not in named:
                named[j] = name, (k + 1) * robot.tick
                alarms.append(name)
                begun = begun or (k + 1) * robot.tick > BREAKS_S
        if not fault and bank.named:
            bank.named.clear()
            named.clear()
    return {"order": order, "named": named, "alarms": alarms}


def observable(fault: str, seed: int) -> float:
    """Return from when on readings without noise differ from a healthy robot's, s; infinite: never."""
    sick = EmulatedRobot(ROBOT, seed=seed, faults=[f"{fault}@{BREAKS_S}"], noise_rad=0.0)
    sound = EmulatedRobot(ROBOT, seed=seed, noise_rad=0.0)
    pairs = zip(walked(sick, BREAKS_S + AFTER_S), walked(sound, BREAKS_S + AFTER_S), strict=True)
    for k, _ in enumerate(pairs):
        apart = np.nan_to_num(sick.bends() - sound.bends(), nan=9.0)
        if np.abs(apart).max() >= 3 * NOISE:
            return (k + 1) * sick.tick
    return np.inf


def judged(order: Order) -> dict[str, Any]:
    """Run a fault and say whether it was named rightly and in time."""
    fault, seed, _, _ = order
    kind = next(k for k in KINDS if k.split(":")[0] == fault.split(":")[0].split("=")[0].split("@")[0])
    for kind in KINDS:
        sides = [kind.format(j=j, side=s) for j in range(1, 9) for s in "+-"]
        if fault in sides:
            break
    number = int(fault.split(":")[1][0]) if ":" in fault else 0
    side = "+" if "+" in fault else "-"
    found = run(order)
    name, at = found["named"].get(number, ("", np.inf))
    right = name == KINDS[kind].format(side=side)
    since = observable(fault, seed)
    return {
        "fault": kind, "seed": seed, "named": name, "at": at, "observable": since,
        "right": right, "in_time": right and at <= since + 1 / FREQUENCY,
        "among": KINDS[kind].format(side=side) in name, "others": len(found["named"]) - bool(name),
    }  # fmt: skip


def main() -> None:
    """Run and print."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--seeds", type=int, default=20)
    words.add_argument("--first", type=int, default=0)
    words.add_argument("--healthy-h", type=float, default=1.0, help="healthy hours, simulated")
    words.add_argument("--json", type=Path, metavar="FILE")
    given = words.parse_args()
    kept: dict[str, Any] = {"faults": [], "alarms": []}
    for pressures in (True, False):
        lines = []
        for kind in KINDS:
            orders = []
            for seed in range(given.first, given.first + given.seeds):
                rng = np.random.default_rng((seed, 9))
                fault = kind.format(j=rng.integers(1, 5), side="+-"[rng.integers(2)])
                orders.append((fault, seed, BREAKS_S + AFTER_S, pressures))
            rows = [done.result for done in each(judged, orders)]
            kept["faults"] += [{"pressures": pressures} | row for row in rows]
            since = [row["at"] - row["observable"] for row in rows if row["right"]]
            shares = [
                f"{sum(row[what] for row in rows)} of {len(rows)}" for what in ("right", "in_time", "among")
            ]
            after = f"{np.median(since):.2f}" if since else "–"
            shown = kind.replace("{j}", "j").replace("{side}", "±")
            lines.append([shown, *shares, after, str(sum(row["others"] for row in rows))])
        print("with pressures" if pressures else "without pressures", flush=True)
        print(table(["fault", "named", "in time", "one of two", "after, median, s", "others accused"], lines))
        hours = 600.0
        healthy = [("", 10_000 + k, hours, pressures) for k in range(round(given.healthy_h * 3600 / hours))]
        alarms = [name for done in each(partial(run), healthy) for name in done.result["alarms"]]
        kept["alarms"] += [{"pressures": pressures, "named": name} for name in alarms]
        print(f"{len(alarms)} false alarms in {given.healthy_h:g} healthy hours: {alarms}\n", flush=True)
    if given.json:
        given.json.write_text(json.dumps(kept, indent=1, default=float) + "\n", "utf-8")


if __name__ == "__main__":
    main()
