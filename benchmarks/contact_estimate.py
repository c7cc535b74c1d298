"""Contact forces from valve commands, pressures and bends, on robots that were not used to choose settings.

    uv run python benchmarks/contact_estimate.py [--first 0] [--robots 100] [--data FOLDER] [--json FILE]

docs/contact-forces.md states the conditions, which were fixed before the evaluation. A robot crawls freely
for 12 s; then a known force presses on its body every 4 s. After that it crawls freely for `--free` seconds,
for false alarms: the twin's gait is periodic, so its last two seconds before the first contact are repeated
with new noise. Seeds from 1000 are robots for the choice of settings. `--data` keeps the simulated robots.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from grid import table

from srs_twin import load_robot
from srs_twin.control.contact_observer import THRESHOLD, WINDOW_S, ContactObserver
from srs_twin.control.gait import Gait
from srs_twin.plants.twin.mjcf.numerics import hinge_stations
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.spec import Modules, RobotSpec

NOMINAL = load_robot("gen2")
LEAST_FORCE_N = 0.55
TICK_S, LEARNING_S, SPACING_S, CONTACTS, REPEATED_S = 0.02, 12.0, 4.0, 3, 2.0
SPREAD, BIAS_RAD, PRESSURE_NOISE_PA = 0.1, 0.03, 100.0
PERIOD_SAMPLES = {1.0: 50, 1.5: 100, 2.0: 25}  # by frequency, Hz; 1.5 Hz repeats after three periods
FREQUENCIES_HZ, CHAMBERS = tuple(PERIOD_SAMPLES), ("lag", "orifice")
RECOVERY_S = 1.0  # after a contact, in which alarms count neither way
HINGES = 2


def drawn_robot(seed: int) -> RobotSpec:
    """Return generation 2 with modules that differ by 10 %."""
    n, rng = NOMINAL.segments, np.random.default_rng((seed, 1))

    def factors(*shape: int) -> np.ndarray:
        return np.exp(SPREAD * rng.standard_normal(shape))

    modules = Modules.from_arrays(
        gain=factors(n, 2), bias=BIAS_RAD * rng.standard_normal(n), tau_fill=factors(n, 2),
        tau_vent=factors(n, 2), sensor_gain=np.ones(n), sensor_bias=np.zeros(n),
    )  # fmt: skip
    return replace(NOMINAL, variation=modules)


class Finger:
    """Force on a twin's body at a distance behind its first connector, normal to the body."""

    def __init__(self, twin: TwinSnake) -> None:
        self._twin, model, g = twin, twin.physics.model.ptr, twin.spec.geometry
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_forward(model, data)
        hinges = hinge_stations(HINGES, g.segment_length, g.rigid_gap)
        starts = np.arange(twin.spec.segments)[:, None] * g.pitch + hinges
        names = [f"{kind}_{j + 1}{end}" for j in range(twin.spec.segments)
                 for kind, end in (("connector", ""), ("link", "_1"))]  # fmt: skip
        self._edges = starts.ravel()
        self._bodies = [model.body(name).id for name in [*names, f"connector_{g.connectors}"]]
        head = data.body("connector_1").xpos[0]
        self._origins = [head - data.xpos[body][0] for body in self._bodies]

    def press(self, force: float, place: float) -> None:
        """Apply a force (N, to the left if positive) at a place (m) until the next call."""
        data, k = self._twin.physics.data.ptr, int(np.searchsorted(self._edges, place))
        data.xfrc_applied[:] = 0.0
        body = self._bodies[k]
        frame = data.xmat[body].reshape(3, 3)
        point = data.xpos[body] + frame @ [self._origins[k] - place, 0.0, 0.0]
        left = np.array([-frame[1, 0], frame[0, 0], 0.0])
        vector = force * left / np.linalg.norm(left)
        data.xfrc_applied[body] = [*vector, *np.cross(point - data.xipos[body], vector)]


def recorded(seed: int, free_s: float) -> dict[str, np.ndarray]:
    """Return samples of one robot, and its contacts: begin, duration (s), force (N), place (m)."""
    spec, rng = drawn_robot(seed), np.random.default_rng((seed, 2))
    frequency, chambers = FREQUENCIES_HZ[seed % 3], CHAMBERS[seed % 2]
    twin, gait = TwinSnake(spec, pneumatics=chambers, sensor="hall"), Gait(frequency)
    gait.reset(spec, twin.tick)
    state, finger = twin.reset(seed=seed), Finger(twin)
    begins = LEARNING_S + SPACING_S * np.arange(CONTACTS) + rng.uniform(0.0, 1.0, CONTACTS)
    force = rng.uniform(LEAST_FORCE_N, 1.5 * LEAST_FORCE_N, CONTACTS) * rng.choice([-1, 1], CONTACTS)
    contacts = np.stack(
        [begins, rng.uniform(0.3, 0.6, CONTACTS), force,
         rng.uniform(0.0, spec.geometry.body_length, CONTACTS)], axis=1
    )  # fmt: skip
    rows: list[tuple[np.ndarray, ...]] = []
    for _ in range(round((LEARNING_S + SPACING_S * CONTACTS) / TICK_S)):
        now = [c for c in contacts if c[0] <= float(state.time) < c[0] + c[1]]
        finger.press(*(now[0][2:] if now else (0.0, 0.0)))
        valves = gait.step(state)
        state = twin.step(valves)
        mean = np.asarray(valves, dtype=float).reshape(-1, *valves.shape[-2:]).mean(axis=0)
        rows.append((np.asarray(state.time), mean, state.pressure, state.sensed, state.bend))
    time, command, pressure, sensed, bend = (np.array(column) for column in zip(*rows, strict=True))
    # The free gait from before the first contact is repeated as a whole number of periods.
    first, last = round((LEARNING_S - REPEATED_S) / TICK_S), round(LEARNING_S / TICK_S)
    copies = math.ceil(free_s / REPEATED_S)
    later = time[-1] + TICK_S * np.arange(1, copies * (last - first) + 1)
    again = np.tile(bend[first:last], (copies, 1))
    sensed = np.concatenate([sensed, twin.sensor.read(again, later, seed)])
    pressure = np.concatenate([pressure, np.tile(pressure[first:last], (copies, 1, 1))])
    pressure = np.maximum(pressure + PRESSURE_NOISE_PA * rng.standard_normal(pressure.shape), 0.0)
    command = np.concatenate([command, np.tile(command[first:last], (copies, 1, 1))])
    return {
        "time": np.append(time, later), "command": command, "pressure": pressure, "sensed": sensed,
        "contacts": contacts, "period": np.array(PERIOD_SAMPLES[frequency]),
    }  # fmt: skip


def estimates(data: dict[str, np.ndarray]) -> np.ndarray:
    """Return score, force, place and their intervals over time, shape (samples, 7); NaN while learning."""
    observer = ContactObserver(NOMINAL, TICK_S, int(data["period"]))
    rows = []
    for command, pressure, sensed in zip(data["command"], data["pressure"], data["sensed"], strict=True):
        e = observer.update(command, pressure, sensed)
        row = (math.nan,) * 7 if e is None else (
            e.score, e.force, e.place, *e.force_interval, *e.place_interval
        )  # fmt: skip
        rows.append(row)
    return np.array(rows)


def judged(seed: int, data: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the estimates of the contacts of one robot, and the scores of its free crawling."""
    time, rows, contacts = data["time"], estimates(data), []
    busy = np.isnan(rows[:, 0])
    for begin, duration, force, place in data["contacts"]:
        during = (time > begin) & (time <= begin + duration + WINDOW_S / 3)
        best = rows[np.flatnonzero(during)[np.nanargmax(rows[during, 0])]]
        contacts.append([force, place, duration, *best.tolist()])
        busy |= (time > begin) & (time <= begin + duration + RECOVERY_S)
    return {"seed": seed, "contacts": contacts, "free": rows[~busy, 0].tolist()}


def alarms(scores: np.ndarray, threshold: float) -> int:
    """Return the number of separate alarms; scores above the threshold within one second are one alarm."""
    high = np.flatnonzero(scores > threshold)
    return int(len(high) > 0) + int((np.diff(high) > 1.0 / TICK_S).sum())


def main() -> None:
    """Simulate, estimate and print."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--first", type=int, default=0)
    words.add_argument("--robots", type=int, default=100)
    words.add_argument("--free", type=float, default=120.0, metavar="S")
    words.add_argument("--data", type=Path, metavar="FOLDER")
    words.add_argument("--simulate-only", action="store_true")
    words.add_argument("--json", type=Path, metavar="FILE")
    given = words.parse_args()
    results = []
    for seed in range(given.first, given.first + given.robots):
        stored = given.data / f"{seed}.npz" if given.data else None
        if stored and stored.exists():
            data = dict(np.load(stored))
        else:
            data = recorded(seed, given.free)
            if stored:
                stored.parent.mkdir(parents=True, exist_ok=True)
                np.savez(stored, **data)
        count = round((LEARNING_S + SPACING_S * CONTACTS + given.free) / TICK_S)
        data |= {name: data[name][:count] for name in ("time", "command", "pressure", "sensed")}
        if not given.simulate_only:
            results.append(judged(seed, data))
    if results:
        report(results)
    if given.json:
        given.json.write_text(json.dumps(results) + "\n", "utf-8")


def report(results: list[dict[str, Any]]) -> None:
    """Print detection over threshold, and the errors of force and place."""
    pitch, rows = NOMINAL.geometry.pitch, np.array([row for r in results for row in r["contacts"]])
    force, place, score = rows[:, 0], rows[:, 1] / pitch, rows[:, 3]
    hours = sum(len(r["free"]) for r in results) * TICK_S / 3600
    lines = [
        [f"{threshold:g}", f"{100 * (score > threshold).mean():.1f}",
         f"{sum(alarms(np.array(r['free']), threshold) for r in results) / hours:.1f}"]
        for threshold in (3.5, 4.0, 4.5, 5.0, 5.5, 6.0, 7.0, 8.0)
    ]  # fmt: skip
    print(f"{len(results)} robots, {len(rows)} contacts of {LEAST_FORCE_N} N and more, {hours:.2f} h free")
    print(table(["threshold", "detected, %", "false alarms per hour"], lines))
    error, off = np.abs(rows[:, 4] / force - 1), np.abs(rows[:, 5] / pitch - place)
    lines = []
    for name, chosen in [("all", score > 0)] + [
        (f"{a} to {a + 1}", (place >= a) & (place < a + 1)) for a in range(NOMINAL.segments)
    ]:
        share = [
            (score > THRESHOLD)[chosen].mean(), (off <= 1)[chosen].mean(),
            ((rows[:, 6] <= force) & (force <= rows[:, 7]))[chosen].mean(),
            ((rows[:, 8] <= rows[:, 1]) & (rows[:, 1] <= rows[:, 9]))[chosen].mean(),
        ]  # fmt: skip
        medians = [100 * np.median(error[chosen]), np.median(off[chosen])]
        lines.append([
            name, str(chosen.sum()), f"{100 * share[0]:.0f}", f"{medians[0]:.0f}", f"{medians[1]:.2f}",
            *(f"{100 * value:.0f}" for value in share[1:]),
        ])  # fmt: skip
    heads = ["place, segments", "contacts", "detected, %", "median force error, %", "median place error",
             "within one segment, %", "force in interval, %", "place in interval, %"]  # fmt: skip
    print(table(heads, lines))


if __name__ == "__main__":
    main()
