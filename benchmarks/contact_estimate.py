"""Contact forces from valve commands, pressures and bends, on robots that were not used to choose settings.

    uv run python benchmarks/contact_estimate.py [--robot gen2] [--first 0] [--robots
    36] [--free 300]
        [--data FOLDER] [--json FILE] [--picture]

docs/objects.md states the conditions, which were fixed before the evaluation. A
twin crawls freely for 12 s; then a known force presses on its body every 4 s. False
alarms are counted while the same robot crawls freely for `--free` seconds on the
analytical model `compliant`, the cheapest plant with bends that deflect. Robots with
seeds from 1000 serve to choose settings. `--data` stores the records of the twins, and
`--picture` writes docs/images/contact_roc.png.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from common.grid import table
from matplotlib.figure import Figure

from srs_twin import AnalyticalSnake, load_robot
from srs_twin.control.gait import Gait
from srs_twin.live.contact_observer import (
    COVERAGE,
    THRESHOLD,
    WINDOW_S,
    ContactObserver,
)
from srs_twin.plants.base import Plant
from srs_twin.plants.twin.mjcf.numerics import hinge_stations
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.spec import GRAVITY, Modules, RobotSpec

IMAGE = Path(__file__).parents[1] / "docs" / "images" / "contact_roc.png"
FRICTIONS = 3.28
"""Smallest force as a multiple of the mean floor friction of a connector; 0.55 N for generation 2."""
TICK_S = 0.02
LEARNING_S = 12.0
SPACING_S = 4.0
CONTACTS = 3
SPREAD = 0.1
BIAS_RAD = 0.03
PRESSURE_NOISE_PA = 100.0
FREQUENCIES_HZ = {"gen2": (1.0, 1.5, 2.0), "gen3": (1.0,), "gen4": (1.0, 1.5)}
CHAMBERS = ("lag", "orifice")
RECOVERY_S = 0.1
"""Time after the end of a contact in which its estimate may still appear, s."""
HINGES = 2
THRESHOLDS = (3.5, 4.0, 4.5, 5.0, 5.5, 6.0, 7.0, 8.0)


def drawn_robot(nominal: RobotSpec, seed: int) -> RobotSpec:
    """Return a robot with modules that differ by 10 %."""
    n = nominal.segments
    rng = np.random.default_rng((seed, 1))

    def factors(*shape: int) -> np.ndarray:
        return np.exp(SPREAD * rng.standard_normal(shape))

    modules = Modules.from_arrays(
        gain=factors(n, 2),
        bias=BIAS_RAD * rng.standard_normal(n),
        tau_fill=factors(n, 2),
        tau_vent=factors(n, 2),
        sensor_gain=np.ones(n),
        sensor_bias=np.zeros(n),
    )
    return replace(nominal, variation=modules)


def gait_of(robot: str, seed: int) -> tuple[float, int, str]:
    """Return frequency (Hz), period in samples, and kind of chambers of a seed."""
    choices = FREQUENCIES_HZ[robot]
    frequency = choices[seed % len(choices)]
    # The smallest whole number of periods that is a whole number of samples.
    period = Fraction(1 / TICK_S / frequency).limit_denominator(100)
    return (
        frequency,
        period.numerator,
        CHAMBERS[seed // (2 if len(choices) == 2 else 1) % 2],
    )


class Finger:
    """Force on a twin's body at a distance behind its first connector, normal to the body."""

    def __init__(self, twin: TwinSnake) -> None:
        self._twin = twin
        model = twin.physics.model
        g = twin.spec.geometry
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_forward(model, data)
        hinges = hinge_stations(HINGES, g.segment_length, g.rigid_gap)
        starts = np.arange(twin.spec.segments)[:, None] * g.pitch + hinges
        names = [
            f"{kind}_{j + 1}{end}"
            for j in range(twin.spec.segments)
            for kind, end in (("connector", ""), ("link", "_1"))
        ]
        self._edges = starts.ravel()
        self._bodies = [
            model.body(name).id for name in [*names, f"connector_{g.connectors}"]
        ]
        head = data.body("connector_1").xpos[0]
        self._origins = [head - data.xpos[body][0] for body in self._bodies]

    def press(self, force: float, place: float) -> None:
        """Apply a force (N, to the left if positive) at a place (m) until the next call."""
        data = self._twin.physics.data
        k = int(np.searchsorted(self._edges, place))
        data.xfrc_applied[:] = 0.0
        body = self._bodies[k]
        frame = data.xmat[body].reshape(3, 3)
        point = data.xpos[body] + frame @ [self._origins[k] - place, 0.0, 0.0]
        left = np.array([-frame[1, 0], frame[0, 0], 0.0])
        vector = force * left / np.linalg.norm(left)
        data.xfrc_applied[body] = [*vector, *np.cross(point - data.xipos[body], vector)]


def crawl(
    plant: Plant,
    frequency: float,
    seconds: float,
    seed: int,
    press: Callable[[float], None],
) -> dict[str, np.ndarray]:
    """Return the samples of a crawling robot: time, command, pressure with noise, reading."""
    gait = Gait(frequency)
    rng = np.random.default_rng((seed, 3))
    gait.reset(plant.spec, plant.tick)
    state = plant.reset(seed=seed)
    rows = []
    for _ in range(round(seconds / TICK_S)):
        press(float(state.time))
        valves = gait.step(state)
        state = plant.step(valves)
        mean = (
            np.asarray(valves, dtype=float).reshape(-1, *valves.shape[-2:]).mean(axis=0)
        )
        rows.append((np.asarray(state.time), mean, state.pressure, state.measured_bend))
    time, command, pressure, measured_bend = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    pressure = np.maximum(
        pressure + PRESSURE_NOISE_PA * rng.standard_normal(pressure.shape), 0.0
    )
    return {
        "time": time,
        "command": command,
        "pressure": pressure,
        "measured_bend": measured_bend,
    }


def touched(robot: str, seed: int) -> dict[str, np.ndarray]:
    """Return samples of a twin, and its contacts: begin, duration (s), force (N), place (m)."""
    nominal = load_robot(robot)
    rng = np.random.default_rng((seed, 2))
    frequency, _, chambers = gait_of(robot, seed)
    twin = TwinSnake(
        drawn_robot(nominal, seed), pneumatics=chambers, sensor="hall", tick=TICK_S
    )
    least = (
        FRICTIONS * nominal.friction.mu_n * np.mean(nominal.mass.connectors) * GRAVITY
    )
    begins = (
        LEARNING_S + SPACING_S * np.arange(CONTACTS) + rng.uniform(0.0, 1.0, CONTACTS)
    )
    force = rng.uniform(least, 1.5 * least, CONTACTS) * rng.choice([-1, 1], CONTACTS)
    contacts = np.stack(
        [
            begins,
            rng.uniform(0.3, 0.6, CONTACTS),
            force,
            rng.uniform(0.0, nominal.geometry.body_length, CONTACTS),
        ],
        axis=1,
    )
    finger: list[Finger] = []

    def press(time: float) -> None:
        if not finger:
            finger.append(Finger(twin))
        now = [c for c in contacts if c[0] <= time < c[0] + c[1]]
        finger[0].press(*(now[0][2:] if now else (0.0, 0.0)))

    samples = crawl(twin, frequency, LEARNING_S + SPACING_S * CONTACTS, seed, press)
    return samples | {"contacts": contacts}


def estimates(robot: str, seed: int, samples: dict[str, np.ndarray]) -> np.ndarray:
    """Return score, force, place and their intervals over time, shape (samples, 7); NaN while learning."""
    observer = ContactObserver(load_robot(robot), TICK_S, gait_of(robot, seed)[1])
    rows = []
    for sample in zip(
        samples["command"], samples["pressure"], samples["measured_bend"], strict=True
    ):
        e = observer.update(*sample)
        if e is None:
            row = (math.nan,) * 7
        else:
            row = (e.score, e.force, e.place, *e.force_interval, *e.place_interval)
        rows.append(row)
    return np.array(rows)


def judged(robot: str, seed: int, samples: dict[str, np.ndarray]) -> list[list[float]]:
    """Return the contacts of one robot with the estimates at their largest score."""
    time = samples["time"]
    rows = estimates(robot, seed, samples)
    contacts = []
    for begin, duration, force, place in samples["contacts"]:
        during = (time > begin) & (time <= begin + duration + RECOVERY_S)
        best = rows[np.flatnonzero(during)[np.nanargmax(rows[during, 0])]]
        contacts.append([force, place, duration, *best.tolist()])
    return contacts


def free_scores(robot: str, seed: int, seconds: float) -> np.ndarray:
    """Return the scores of a robot that crawls freely on the model `compliant`."""
    spec = drawn_robot(load_robot(robot), seed)
    plant = AnalyticalSnake(
        spec, model="compliant", friction="wheel", sensor="hall", tick=TICK_S
    )
    samples = crawl(
        plant,
        gait_of(robot, seed)[0],
        LEARNING_S + WINDOW_S + seconds,
        seed,
        lambda _: None,
    )
    scores = estimates(robot, seed, samples)[:, 0]
    return np.asarray(scores[np.isfinite(scores)])


def alarms(scores: np.ndarray, threshold: float) -> int:
    """Return the number of separate alarms; scores above the threshold within one second are one alarm."""
    high = np.flatnonzero(scores > threshold)
    return int(len(high) > 0) + int((np.diff(high) > 1.0 / TICK_S).sum())


def main() -> None:
    """Simulate, estimate and print."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--robot", default="gen2", choices=FREQUENCIES_HZ)
    words.add_argument("--first", type=int, default=0)
    words.add_argument("--robots", type=int, default=36)
    words.add_argument("--free", type=float, default=300.0, metavar="S")
    words.add_argument("--data", type=Path, metavar="FOLDER")
    words.add_argument("--json", type=Path, metavar="FILE")
    words.add_argument("--picture", action="store_true")
    given = words.parse_args()
    results = []
    for seed in range(given.first, given.first + given.robots):
        if given.data:
            stored = given.data / f"{given.robot}_{seed}.npz"
        else:
            stored = None
        if stored and stored.exists():
            samples = dict(np.load(stored))
        else:
            samples = touched(given.robot, seed)
            if stored:
                stored.parent.mkdir(parents=True, exist_ok=True)
                np.savez(stored, **samples)  # type: ignore[arg-type]
        if given.free:
            free = free_scores(given.robot, seed, given.free).tolist()
        else:
            free = []
        gait = gait_of(given.robot, seed)
        results.append(
            {"gait": gait, "contacts": judged(given.robot, seed, samples), "free": free}
        )
    if given.json:
        given.json.write_text(json.dumps(results) + "\n", "utf-8")
    print_detection(results, given.picture)
    print_errors(results, load_robot(given.robot).geometry.pitch)


def print_detection(results: list[dict[str, Any]], picture: bool) -> None:
    """Print detected contacts and false alarms over the threshold, and draw them."""
    scores = np.array([row[3] for r in results for row in r["contacts"]])
    hours = sum(len(r["free"]) for r in results) * TICK_S / 3600
    print(
        f"{len(results)} robots, {len(scores)} contacts, {hours:.2f} h of free crawling"
    )
    levels = np.linspace(2.5, 15.0, 51)
    free = [np.array(r["free"]) for r in results]
    false = [
        sum(alarms(row, level) for row in free) / max(hours, 1e-9) for level in levels
    ]
    found = [100 * (scores > level).mean() for level in levels], false
    lines = [
        [f"{t:g}", *(f"{np.interp(t, levels, row):.1f}" for row in found)]
        for t in THRESHOLDS
    ]
    print(table(["threshold", "detected, %", "false alarms per hour"], lines))
    print(
        "largest score without contact"
        f" {max(max(r['free'], default=0) for r in results):.2f}, smallest of a contact"
        f" {scores.min():.2f}"
    )
    if picture:
        figure = Figure(figsize=(6.4, 3.2), layout="constrained")
        curve, both = figure.subplots(1, 2)
        curve.plot(found[1], found[0], "o-", ms=3)
        curve.set(
            xlabel="false alarms per hour",
            ylabel="detected contacts, %",
            xscale="symlog",
            ylim=(0, 103),
        )
        both.semilogy(
            levels, np.maximum(found[1], 0.1 / hours), label="false alarms per hour"
        )
        both.semilogy(levels, found[0], label="detected contacts, %")
        both.axvline(THRESHOLD, color="0.6", lw=1)
        both.set(xlabel="threshold of the score")
        both.legend(fontsize="small")
        figure.savefig(IMAGE, dpi=120)


def print_errors(results: list[dict[str, Any]], pitch: float) -> None:
    """Print the errors of force and place, and the coverage of the intervals."""
    rows = np.array([row for r in results for row in r["contacts"]])
    gaits = [
        (f"{r['gait'][0]:g} Hz", r["gait"][2]) for r in results for _ in r["contacts"]
    ]
    force = rows[:, 0]
    place = rows[:, 1] / pitch
    error = np.abs(rows[:, 4] / force - 1)
    off = np.abs(rows[:, 5] / pitch - place)
    groups = [("all", np.ones(len(rows), dtype=bool))]
    groups += [
        (f"{a} to {a + 1} segments from the head", (place >= a) & (place < a + 1))
        for a in range(int(place.max()) + 1)
    ]
    for names in zip(*gaits, strict=True):
        groups += [(name, np.array(names) == name) for name in sorted(set(names))]
    lines = []
    for name, chosen in groups:
        fractions = [
            (rows[:, 3] > THRESHOLD)[chosen].mean(),
            (off <= 1)[chosen].mean(),
            ((rows[:, 6] <= force) & (force <= rows[:, 7]))[chosen].mean(),
            ((rows[:, 8] <= rows[:, 1]) & (rows[:, 1] <= rows[:, 9]))[chosen].mean(),
        ]
        width = np.nanmedian(((rows[:, 7] - rows[:, 6]) / np.abs(force))[chosen])
        medians = np.nanmedian(error[chosen]), np.nanmedian(off[chosen])
        lines.append(
            [
                name,
                str(chosen.sum()),
                f"{100 * fractions[0]:.0f}",
                f"{100 * medians[0]:.0f}",
                f"{medians[1]:.2f}",
                *(f"{100 * value:.0f}" for value in fractions[1:]),
                f"{width:.2f}",
            ]
        )
    heads = [
        "contacts",
        "number",
        "detected, %",
        "median force error, %",
        "median place error, segments",
        "within one segment, %",
        f"force in {COVERAGE:.0%} interval",
        "place in interval",
        "width of the force interval over the force",
    ]
    print(table(heads, lines))


if __name__ == "__main__":
    main()
