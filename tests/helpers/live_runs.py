"""A robot and its shadow in simulated time: the stand-in of `srs-twin emulate`, what its messages suffer.

Modules spread by 10 %, chambers of compressible flow, 0.02 rad of noise. Of the messages 5 % are lost, the
rest late by up to 20 ms; motion capture has 30 frames a second.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from srs_twin import Gait, load_robot, load_scenario
from srs_twin.live.emulator import SILENT_S, EmulatedRobot
from srs_twin.live.helm import Helm
from srs_twin.live.messages import BENDS, COMMAND, POSES, PRESSURES, VALVES, Message
from srs_twin.live.shadow import Estimate, Prediction, Shadow

NOISE_RAD = 0.02
OFFSETS = (0.0, 0.15, -0.15)
TURNS_S = 5.0


@dataclass(frozen=True)
class Run:
    """One robot, walking.

    Attributes:
        seed: of modules, noise and what messages suffer.
        seconds: of it.
        fault: as `srs-twin emulate` takes it; empty: none.
        robot: name.
        frequency: of its gait, Hz.
        pressures: whether it tells them.
        valves: whether it tells what it did with them.
        cameras_s: for how long motion capture sees it.
        loss: share of messages that are lost.
        jitter_s: by how much each is late at most.
        camera_hz: frames a second.
        pneumatics: its chambers.
        tau_spread: of their time constants.
        gain_spread: of the modules' gains.
        supply_kpa: of its supply; None: the robot's nominal one.
    """

    seed: int
    seconds: float
    fault: str = ""
    robot: str = "gen4"
    frequency: float = 1.5
    pressures: bool = True
    valves: bool = True
    cameras_s: float = np.inf
    loss: float = 0.05
    jitter_s: float = 0.02
    camera_hz: float = 30.0
    pneumatics: str = "orifice"
    tau_spread: float = 0.0
    gain_spread: float = 0.1
    supply_kpa: float | None = None

    def emulated(
        self, noise_rad: float = NOISE_RAD, fault: bool = True, start: tuple[float, float, float] = (0, 0, 0)
    ) -> EmulatedRobot:
        """Return the robot."""
        faults = [self.fault] if fault and self.fault else []
        return EmulatedRobot(
            self.robot, seed=self.seed, faults=faults, noise_rad=noise_rad, tau_spread=self.tau_spread,
            pneumatics=self.pneumatics, gain_spread=self.gain_spread, supply_kpa=self.supply_kpa, start=start,
        )  # fmt: skip

    def commands(self, robot: EmulatedRobot) -> Iterator[np.ndarray]:
        """Yield the states of its valves, tick by tick: a gait that goes straight, left, right."""
        gait = Gait(self.frequency)
        gait.reset(robot.twin.spec, robot.tick)
        turn = round(TURNS_S / robot.tick)
        for k in range(round(self.seconds / robot.tick)):
            if k % turn == 0:
                gait.offset = OFFSETS[k // turn % len(OFFSETS)]
            valves = gait.valves_at(k * robot.tick)
            yield valves if valves.ndim == 2 else valves[-1]


@dataclass(frozen=True)
class Moment:
    """What is, and what is known of it, at one tick of a run."""

    time: float
    robot: EmulatedRobot
    estimate: Estimate | None
    shadow: Shadow


class Wire:
    """What messages suffer between robot, camera, commander and shadow, whose clocks differ."""

    def __init__(self, run: Run) -> None:
        self._run, self._rng, self._count = run, np.random.default_rng((run.seed, 5)), 0
        self._waiting: list[tuple[float, int, Message]] = []
        self._frame_due = 0.0

    def send(
        self, kind: str, source: str, time: float, values: np.ndarray, names: tuple[str, ...] = ()
    ) -> None:
        """Send a message."""
        self._count += 1
        if self._rng.random() >= self._run.loss:
            arrived = time + 0.001 + self._rng.random() * self._run.jitter_s
            clock = {COMMAND: 700.0, POSES: -3.0}.get(kind, 40.0)
            message = Message(kind, source, time + clock, arrived, values, names)
            heapq.heappush(self._waiting, (arrived, self._count, message))

    def tell(self, robot: EmulatedRobot, time: float) -> None:
        """Send what a robot and the camera tell."""
        run = self._run
        self.send(BENDS, run.robot, time, robot.bends())
        if run.valves:
            self.send(VALVES, run.robot, time, robot.valves)
        if run.pressures:
            self.send(PRESSURES, run.robot, time, robot.state.pressure)
        if time <= run.cameras_s and time >= self._frame_due:
            self._frame_due = max(self._frame_due + 1 / run.camera_hz, time - robot.tick)
            seen = {f"connector_{i}": b for i, b in robot.bodies().items() if b.tracked}
            rows = [
                [b.place[0], -b.place[2], b.place[1], 2 * np.arctan2(b.turn[1], b.turn[3])]
                for b in seen.values()
            ]
            self.send(POSES, "natnet", time, np.array(rows).reshape(-1, 4), tuple(seen))

    def arrived(self, time: float) -> list[Message]:
        """Return what has arrived."""
        found = []
        while self._waiting and self._waiting[0][0] <= time:
            found.append(heapq.heappop(self._waiting)[2])
        return found


def shadowed(run: Run, **shadow: Any) -> Iterator[Moment]:
    """Yield the moments of a run."""
    robot, wire = run.emulated(), Wire(run)
    twin = Shadow(load_robot(run.robot), seed=run.seed, **shadow)
    for k, command in enumerate(run.commands(robot)):
        begun, time = k * robot.tick, (k + 1) * robot.tick
        wire.send(COMMAND, run.robot, begun - 0.01, command)
        robot.step(command)
        wire.tell(robot, time)
        yield Moment(time, robot, twin.take(time, wire.arrived(time)), twin)


def steered(order: tuple[Run, str]) -> dict[str, Any]:
    """Let a shadow steer a robot along a scenario's way, and say how it ended and what it touched."""
    run, name = order
    scenario = load_scenario(name)
    robot, wire = run.emulated(start=scenario.pose), Wire(run)
    twin = Shadow(load_robot(run.robot), seed=run.seed, supply_pa=robot.supply_pa)
    helm = Helm(scenario, twin, robot.tick)
    command, heard, time, clearance = None, -1.0, 0.0, np.inf
    faults: dict[str, float] = {}
    while time < run.seconds and not helm.finished:
        state = robot.step(command if time - heard <= SILENT_S else None)
        time += robot.tick
        wire.tell(robot, time)
        messages = wire.arrived(time)
        for message in messages:
            if message.kind == COMMAND:
                command, heard = message.values, time
        found = twin.take(time, messages)
        for part, what, _ in found.faults if found else ():
            faults.setdefault(f"{part}: {what}", round(time, 2))
        told = helm.step(found, twin)
        if told is not None:
            wire.send(COMMAND, run.robot, time, told)
        for obstacle in scenario.world.obstacles:
            off = np.hypot(*(state.position - [obstacle.x, obstacle.y]).T).min() - obstacle.radius
            clearance = min(clearance, float(off) - robot.twin.spec.geometry.width / 2)
    return {
        "seed": run.seed, "fault": run.fault, **helm.told(), "clearance_m": clearance, "faults": faults,
        "pose": [*robot.state.com.tolist(), float(robot.state.heading)], "time_s": time,
    }  # fmt: skip


def followed_estimate(run: Run, **shadow: Any) -> dict[str, Any]:
    """Return what was estimated, predicted and true, a row a tick; estimates are of `hold` before."""
    rows: list[np.ndarray] = []
    truths: list[np.ndarray] = []
    predictions: list[Prediction] = []
    for moment in shadowed(run, **shadow):
        state, found = moment.robot.state, moment.estimate
        truths.append(np.array([moment.time, *state.bend, *state.com, float(state.heading)]))
        if found is not None:
            rows.append(
                np.array([moment.shadow.time, *found.bend, *found.pose, *found.bend_sd, *found.pose_sd])
            )
            if round(moment.time * 50) % 25 == 0:
                predictions.append(moment.shadow.predict())
    spec = moment.robot.twin.spec
    return {
        "estimate": np.array(rows), "truth": np.array(truths),
        "predictions": predictions,
        "gain": spec.modules.array("gain"), "tau_fill": spec.modules.array("tau_fill").mean(axis=1),
        "tau_vent": spec.modules.array("tau_vent").mean(axis=1),
        **{f"known_{name}": np.stack(pair) for name, pair in found.parameters.items()},
    }  # fmt: skip


BREAKS_S, AFTER_S = 5.0, 4.0
FREQUENCIES_HZ = (1.5, 1.0, 0.75)
NAMES = {
    "stuck_valve:{j}{side}=open": "stuck_valve {side}=open",
    "stuck_valve:{j}{side}=closed": "stuck_valve {side}=closed",
    "leak:{j}{side}=slow": "leak {side}",
    "leak:{j}{side}=fast": "leak {side}",
    "dead_sensor:{j}=silent": "dead_sensor",
    "dead_sensor:{j}=frozen": "dead_sensor frozen",
    "drifting_sensor:{j}=up": "drifting_sensor",
    "starved=half": "starved",
    "starved=empty": "starved",
    "lost_marker:{j}": "lost_marker",
}
"""Fault → the name that it should get."""


def parts(kind: str, seed: int, segments: int = 4) -> tuple[str, str, str]:
    """Return a fault of a part drawn by a seed, the part as a shadow calls it, and the name to be given."""
    rng = np.random.default_rng((seed, 9))
    marker = kind.startswith("lost_marker")
    j, side = int(rng.integers(1, segments + 1 + marker)), "+-"[rng.integers(2)]
    part = f"connector {j}" if marker else f"segment {j}" if "{j}" in kind else "supply"
    return kind.format(j=j, side=side), part, NAMES[kind].format(side=side)


def observable(run: Run) -> float:
    """Return from when on noiseless readings (or frames) differ from a healthy robot's by 3 σ, s."""
    if "lost_marker" in run.fault:
        return BREAKS_S
    sound = run.emulated(noise_rad=0.0, fault=False)
    sick: EmulatedRobot | None = None
    for k, command in enumerate(run.commands(sound)):
        now = k * sound.tick
        if sick is None and now > BREAKS_S - 2 * sound.tick:  # until then both are the same
            sick = run.emulated(noise_rad=0.0)
            stuck = sick.twin.pneumatics.stuck
            sick.twin.restore(sound.twin.save())
            sick.twin.pneumatics.stuck = stuck
        sound.step(command)
        if sick is not None:
            sick.step(command)
            if np.abs(np.nan_to_num(sick.bends() - sound.bends(), nan=9.0)).max() >= 3 * NOISE_RAD:
                return now + sound.tick
    return np.inf


def isolated(order: tuple[str, int, bool]) -> dict[str, Any]:
    """Let a robot break, and say whether its shadow named the fault rightly and in time."""
    kind, seed, pressures = order
    fault, part, name = parts(kind, seed)
    run = Run(
        seed, BREAKS_S + AFTER_S, fault=f"{fault}@{BREAKS_S}", pressures=pressures,
        frequency=FREQUENCIES_HZ[seed % 3],
    )  # fmt: skip
    named: dict[str, tuple[str, float]] = {}
    for moment in shadowed(run, members=8):
        for where, what, _ in moment.estimate.faults if moment.estimate else ():
            named.setdefault(where, (what, moment.time))
    found, at = named.pop(part, ("", np.inf))
    since = observable(run)
    return {
        "fault": kind, "seed": seed, "pressures": pressures, "named": found, "at": at, "observable": since,
        "right": found == name, "among": name in found.split(" or "),
        "in_time": name in found.split(" or ") and at <= since + 1 / run.frequency,
        "others": list(named.values()),
    }  # fmt: skip


def alarms(order: tuple[int, float, bool]) -> list[str]:
    """Return what a healthy robot was accused of in so many seconds; it is then taken for whole."""
    seed, seconds, pressures = order
    found = []
    run = Run(seed, seconds, pressures=pressures, frequency=FREQUENCIES_HZ[seed % 3])
    for moment in shadowed(run, members=8):
        for number, name in list(moment.shadow.bank.named.items()):
            found.append(f"{number}: {name}")
            moment.shadow.bank.forget(number)
    return found
