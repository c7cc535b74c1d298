"""Emulated robots and their shadows in simulated time, with lost and late messages.

Modules spread by 10 %, chambers of compressible flow, 0.02 rad of noise. Of the
messages 5 % are lost, the rest late by up to 20 ms; motion capture has 30 frames per
second.
"""

from __future__ import annotations

import copy
import hashlib
import heapq
import os
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from srs_twin import Gait, RobotSpec, load_robot, load_scenario
from srs_twin.live.commands import SILENT_S
from srs_twin.live.emulator import EmulatedRobot, Simulation
from srs_twin.live.estimate import Estimate, Prediction
from srs_twin.live.messages import (
    BENDS,
    COMMAND,
    POSES,
    PRESSURES,
    SUPPLY,
    VALVES,
    Message,
)
from srs_twin.live.shadow import Shadow
from srs_twin.live.steering import EstimateSteering
from srs_twin.plants.twin.snake import TwinSnake

NOISE_RAD = 0.02
OFFSETS = (0.0, 0.15, -0.15)
TURNS_S = 5.0
TAKES_S = 0.02
"""Interval between updates of the shadow, as in a session, s."""
DROOPS_S = 6.0
"""Time at which the supply changes (droop or outage), s."""
DROOPS_BEFORE_FAULT_S = 3.0
"""The same in a run with a fault, s."""
WANDER = 0.84, (8.0, 25.0)
"""Lowest pressure of a wandering supply as a share of the nominal one, and range of its periods, s."""
OUTAGE = 0.4, 4.0
"""Pressure during an outage as a share of the nominal one, and its duration, s."""
HOLDS_S, GOES_S, STANDS_S = 1.5, 4.0, 3.0
"""Duration of a held bend, of walking and of standing in stop and go, s."""
SENSOR_GAIN, SENSOR_OFFSET_RAD, SENSOR_DRIFT = 0.05, 0.04, 3e-4
"""Standard deviations of a poor bend sensor: gain, offset (rad) and drift (rad/s)."""
CACHE = os.environ.get("SRS_LIVE_RECORDINGS")
"""Folder of recordings that are simulated once; none without."""

ROBOTS: Mapping[str, Mapping[str, Any]] = {
    "": {},
    "softer": {"bending": {"stiffness_nm_per_rad": 0.7 * 0.88}},
    "smoother": {"friction": {"mu_t": 0.7 * 0.043, "mu_n": 0.7 * 0.57}},
    "slow chamber": {"modules": {"tau_fill": [[1, 1], [2, 1], [1, 1], [1, 1]]}},
    "unequal": {"modules": {"gain_spread": 0.25, "tau_spread": 0.15}},
}
"""Generation 4 that differs from its file: name → changes."""
SUPPLIES = ("droop:0.97", "droop:0.95", "droop:0.90", "droop:0.85", "wander")


@dataclass(frozen=True)
class Run:
    """One robot, walking.

    Attributes:
        seed: seed of modules, noise and message losses.
        seconds: of it.
        fault: as `srs-twin emulate` takes it; empty: none.
        robot: name.
        frequency: of its gait, Hz.
        pressures: whether it publishes pressures.
        valves: whether it publishes valve states.
        cameras_s: for how long motion capture sees it.
        loss: share of messages that are lost.
        jitter_s: largest delay of a message, s.
        camera_hz: frame rate of motion capture, Hz.
        pneumatics: its chambers.
        tau_spread: of their time constants.
        gain_spread: of the modules' gains.
        supply_kpa: of its supply; None: the robot's nominal one.
        supply: "droop:SHARE" or "outage" from `changes_s` on, "wander", or empty:
            constant.
        variant: one of `ROBOTS`.
        motion: "walk", "stand", "stop and go" or "hold".
        poor_sensors: whether bend sensors have a gain, an offset and a drift.
        rate_hz: messages of the robot in a second.
        publishes_supply: whether the robot publishes its supply pressure.
        changes_s: time at which the supply changes (droop or outage), s.
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
    supply: str = ""
    variant: str = ""
    motion: str = "walk"
    poor_sensors: bool = False
    rate_hz: float = 50.0
    publishes_supply: bool = False
    changes_s: float = DROOPS_S

    @property
    def tick(self) -> float:
        """Tick of the robot, s."""
        return min(0.02, 1 / self.rate_hz)

    def supply_fraction(self, time: float) -> float:
        """Return the pressure of the supply as a share of the nominal one."""
        if self.supply.startswith("droop"):
            return (
                float(self.supply.partition(":")[2]) if time >= self.changes_s else 1.0
            )
        if self.supply == "outage":
            return OUTAGE[0] if 0 <= time - self.changes_s < OUTAGE[1] else 1.0
        if self.supply == "wander":
            low, (shortest, longest) = WANDER
            phase, where = np.random.default_rng((self.seed, 7)).random(2)
            period = shortest + where * (longest - shortest)
            return float(
                low
                + (1 - low) * (0.5 + 0.5 * np.cos(2 * np.pi * (time / period + phase)))
            )
        return 1.0

    def emulated(
        self,
        noise_rad: float = NOISE_RAD,
        fault: bool = True,
        start: tuple[float, float, float] = (0, 0, 0),
    ) -> EmulatedRobot:
        """Return the robot."""
        faults = [self.fault] if fault and self.fault else []
        changes = dict(ROBOTS[self.variant])
        changes["modules"] = {"tau_spread": self.tau_spread} | changes.get(
            "modules", {}
        )
        return EmulatedRobot(
            self.robot,
            Simulation(
                gain_spread=self.gain_spread,
                tick=self.tick,
                pneumatics=self.pneumatics,
                supply_kpa=self.supply_kpa,
                changes=changes,
            ),
            seed=self.seed,
            faults=faults,
            noise_rad=noise_rad,
            start=start,
        )

    def commands(self, robot: EmulatedRobot) -> Iterator[np.ndarray]:
        """Yield the valve states of each tick: a gait that crawls straight, left, right."""
        gait = Gait(self.frequency)
        tick = robot.tick
        segments = robot.segments
        gait.reset(robot.twin.spec, tick)
        rng = np.random.default_rng((self.seed, 8))
        held = np.full((segments, 2), -1.0)
        vented = held.copy()
        for k in range(round(self.seconds / tick)):
            time = k * tick
            if k % round(TURNS_S / tick) == 0:
                gait.offset = OFFSETS[k // round(TURNS_S / tick) % len(OFFSETS)]
            if self.motion == "stand" or (
                self.motion == "stop and go" and time % (GOES_S + STANDS_S) >= GOES_S
            ):
                yield vented
            elif self.motion == "hold":
                if k % round(HOLDS_S / tick) == 0:
                    side = rng.integers(0, 3, segments)
                    held = np.stack(
                        [np.where(side == each, 1.0, -1.0) for each in (0, 1)], axis=1
                    )
                yield held
            else:
                valves = gait.valves_at(time)
                yield valves if valves.ndim == 2 else valves[-1]

    def step(self, robot: EmulatedRobot, command: np.ndarray | None) -> None:
        """Have a robot obey a command for a tick."""
        if self.supply:
            robot.regulate(self.supply_fraction(float(robot.state.time)))
        robot.step(command)


@dataclass(frozen=True)
class Recording:
    """Messages of a run as they arrived, and the truth.

    Attributes:
        run: conditions.
        updates: time of an update of the shadow (s), and the messages that arrived
            since the one before.
        truth: time (s), bends (rad), centre of mass (m), heading (rad), shape (ticks,
            segments + 4).
        spec: the robot as it was.
        supply_pa: nominal pressure of its supply, gauge, Pa.
    """

    run: Run
    updates: list[tuple[float, list[Message]]]
    truth: np.ndarray
    spec: RobotSpec
    supply_pa: float


@dataclass(frozen=True)
class Moment:
    """Estimate at one update of a run."""

    time: float
    estimate: Estimate | None
    shadow: Shadow


class Wire:
    """Channel between robot, camera, commander and shadow, whose clocks differ: loss and jitter."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._rng = np.random.default_rng((run.seed, 5))
        self._count = 0
        self._waiting: list[tuple[float, int, Message]] = []
        self._frame_due = self._due = 0.0
        draws = np.random.default_rng((run.seed, 6)).normal(
            size=(3, load_robot(run.robot).segments)
        )
        self._poor = draws * run.poor_sensors

    def send(
        self,
        kind: str,
        source: str,
        time: float,
        values: np.ndarray,
        names: tuple[str, ...] = (),
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
        bends = robot.bends()
        if time > self._due - 1e-6:
            self._due = max(self._due + 1 / run.rate_hz, time)
            gain, offset, drift = self._poor
            bends = bends * (1 + SENSOR_GAIN * gain) + SENSOR_OFFSET_RAD * offset
            self.send(BENDS, run.robot, time, bends + SENSOR_DRIFT * drift * time)
            if run.valves:
                self.send(VALVES, run.robot, time, robot.valves)
            if run.pressures:
                self.send(PRESSURES, run.robot, time, robot.state.pressure)
            if run.publishes_supply:
                self.send(SUPPLY, run.robot, time, np.array(robot.supply_now_pa))
        if time <= run.cameras_s and time >= self._frame_due:
            self._frame_due = max(
                self._frame_due + 1 / run.camera_hz, time - robot.tick
            )
            seen = {f"connector_{i}": b for i, b in robot.bodies().items() if b.tracked}
            rows = [
                [
                    b.place[0],
                    -b.place[2],
                    b.place[1],
                    2 * np.arctan2(b.turn[1], b.turn[3]),
                ]
                for b in seen.values()
            ]
            self.send(POSES, "natnet", time, np.array(rows).reshape(-1, 4), tuple(seen))

    def arrived(self, time: float) -> list[Message]:
        """Return the messages that have arrived."""
        found = []
        while self._waiting and self._waiting[0][0] <= time:
            found.append(heapq.heappop(self._waiting)[2])
        return found


def recorded(run: Run) -> Recording:
    """Return a run's messages and truth."""
    return cached(run, lambda: _record(run))


def _record(run: Run) -> Recording:
    robot = run.emulated()
    truth: list[np.ndarray] = []
    commands = list(run.commands(robot))
    updates = _updates(run, robot, Wire(run), commands, 0, len(commands), truth=truth)
    return Recording(run, updates, np.array(truth), robot.twin.spec, robot.supply_pa)


def _updates(
    run: Run,
    robot: EmulatedRobot,
    wire: Wire,
    commands: Sequence[np.ndarray],
    first: int,
    last: int,
    readings: list[np.ndarray] | None = None,
    truth: list[np.ndarray] | None = None,
) -> list[tuple[float, list[Message]]]:
    """Run a robot for some ticks; return the messages that arrive, and fill noiseless readings and truth."""
    updates = []
    every = round(TAKES_S / robot.tick)
    frozen = np.full(robot.segments, np.nan)
    for k in range(first, last):
        begun = k * robot.tick
        time = (k + 1) * robot.tick
        wire.send(COMMAND, run.robot, begun - 0.01, commands[k])
        run.step(robot, commands[k])
        wire.tell(robot, time)
        state = robot.state
        if readings is not None:
            kept = robot._rng, robot._noise, robot._frozen
            robot._rng = np.random.default_rng(0)
            robot._noise = 0.0
            robot._frozen = frozen
            readings.append(robot.bends())
            robot._rng, robot._noise, robot._frozen = kept
        if truth is not None:
            truth.append(
                np.array([time, *state.bend, *state.com, float(state.heading)])
            )
        if (k + 1) % every == 0:
            updates.append((time, wire.arrived(time)))
    return updates


def shadowed(run: Run, **shadow: Any) -> Iterator[Moment]:
    """Yield the moments of a run."""
    recording = recorded(run)
    twin = Shadow(load_robot(run.robot), seed=run.seed, **shadow)
    for time, messages in recording.updates:
        yield Moment(time, twin.update(time, messages), twin)


def steered(order: tuple[Run, str]) -> dict[str, Any]:
    """Steer a robot by its shadow along the path of a scenario; return the ending and the contacts."""
    run, name = order
    scenario = load_scenario(name)
    robot = run.emulated(start=scenario.pose)
    wire = Wire(run)
    twin = Shadow(load_robot(run.robot), seed=run.seed, supply_pa=robot.supply_pa)
    steering = EstimateSteering(scenario, twin, robot.tick)
    command = None
    heard = -1.0
    time = 0.0
    clearance = np.inf
    faults: dict[str, float] = {}
    while time < run.seconds and not steering.finished:
        state = robot.step(command if time - heard <= SILENT_S else None)
        time += robot.tick
        wire.tell(robot, time)
        messages = wire.arrived(time)
        for message in messages:
            if message.kind == COMMAND:
                command = message.values
                heard = time
        found = twin.update(time, messages)
        for part, what, _ in found.faults if found else ():
            faults.setdefault(f"{part}: {what}", round(time, 2))
        told = steering.step(found, twin)
        if told is not None:
            wire.send(COMMAND, run.robot, time, told)
        for obstacle in scenario.world.obstacles:
            off = (
                np.hypot(*(state.position - [obstacle.x, obstacle.y]).T).min()
                - obstacle.radius
            )
            clearance = min(clearance, float(off) - robot.twin.spec.geometry.width / 2)
    return {
        "seed": run.seed,
        "fault": run.fault,
        **steering.summary(),
        "clearance_m": clearance,
        "faults": faults,
        "time_s": time,
        "pose": [*robot.state.com.tolist(), float(robot.state.heading)],
    }


def followed_estimate(run: Run, **shadow: Any) -> dict[str, Any]:
    """Return estimates, predictions and true values of a run, one row per update.

    `estimate` is for the time of the update, `filtered` for that of the newest message
    that was used.
    """
    rows: list[np.ndarray] = []
    filtered: list[np.ndarray] = []
    predictions: list[Prediction] = []
    recording = recorded(run)
    for moment in shadowed(run, **shadow):
        found = moment.estimate
        if found is not None:
            filtered.append(
                np.array([moment.shadow.time, *moment.shadow.ensemble.mean("bend")])
            )
            rows.append(
                np.array(
                    [
                        found.time,
                        *found.bend,
                        *found.pose,
                        *found.bend_sd,
                        *found.pose_sd,
                    ]
                )
            )
            if round(moment.time * 50) % 25 == 0:
                predictions.append(moment.shadow.predict())
    spec = recording.spec
    known = found.parameters if found else {}
    return {
        "estimate": np.array(rows),
        "filtered": np.array(filtered),
        "truth": recording.truth,
        "predictions": predictions,
        "gain": spec.modules.array("gain"),
        **{f"known_{name}": np.stack(pair) for name, pair in known.items()},
    }


BREAKS_S = 5.0
AFTER_S = 4.0
FREQUENCIES_HZ = (1.5, 1.0, 0.75)
NAMES = {
    "stuck_valve:{j}{side}=open": "stuck_valve {side}=open",
    "stuck_valve:{j}{side}=closed": "stuck_valve {side}=closed",
    "leak:{j}{side}=slow": "leak {side}",
    "leak:{j}{side}=fast": "leak {side}",
    "dead_sensor:{j}=silent": "dead_sensor",
    "dead_sensor:{j}=frozen": "dead_sensor frozen",
    "drifting_sensor:{j}=up": "drifting_sensor",
    "low_supply_pressure=half": "low_supply_pressure",
    "low_supply_pressure=empty": "low_supply_pressure",
    "lost_marker:{j}": "lost_marker",
}
"""Fault → the name that it should get."""


def parts(kind: str, seed: int, segments: int = 4) -> tuple[str, str, str]:
    """Return a fault of a part drawn by a seed, the part as a shadow calls it, and the name to be given."""
    rng = np.random.default_rng((seed, 9))
    marker = kind.startswith("lost_marker")
    j = int(rng.integers(1, segments + 1 + marker))
    side = "+-"[rng.integers(2)]
    part = f"connector {j}" if marker else f"segment {j}" if "{j}" in kind else "supply"
    return kind.format(j=j, side=side), part, NAMES[kind].format(side=side)


CONDITIONS: Mapping[str, Mapping[str, Any]] = {
    "nominal": {},
    "no pressures": {"pressures": False},
    **{each: {"supply": each} for each in SUPPLIES},
    "measured supply, wander": {"supply": "wander", "publishes_supply": True},
    "30 % softer": {"variant": "softer"},
    "friction 30 % lower": {"variant": "smoother"},
    "one slow chamber": {"variant": "slow chamber"},
    "unequal segments": {"variant": "unequal"},
    "0.3 Hz": {"frequency": 0.3},
    "3 Hz": {"frequency": 3.0},
    "stop and go": {"motion": "stop and go"},
    "held bends": {"motion": "hold"},
    "standing": {"motion": "stand"},
    "poor sensors": {"poor_sensors": True},
}
"""Name → how the run differs from generation 4 walking at 1.5, 1 or 0.75 Hz by turns.
"""


def conditioned(condition: str, seed: int, seconds: float, **more: Any) -> Run:
    """Return a run under some conditions."""
    return Run(
        seed,
        seconds,
        **(
            {"frequency": FREQUENCIES_HZ[seed % 3]} | dict(CONDITIONS[condition]) | more
        ),
    )


def cached(key: Any, make: Callable[[], Any]) -> Any:
    """Return the result of `make`, from the folder `CACHE` if it was computed before."""
    if not CACHE:
        return make()
    file = Path(CACHE) / f"{hashlib.sha256(repr(key).encode()).hexdigest()[:20]}.pickle"
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(f".{os.getpid()}")
        part.write_bytes(pickle.dumps(make()))
        part.replace(file)
    return pickle.loads(file.read_bytes())


@dataclass(frozen=True)
class Breakage:
    """Messages after a fault.

    Attributes:
        run: conditions.
        updates: as of a `Recording`, from the fault on.
        observable: time from which noiseless readings (or frames) differ from a sound
            robot's by 3 σ, s.
    """

    run: Run
    updates: list[tuple[float, list[Message]]]
    observable: float


def breakages(
    condition: str, seed: int, kinds: Sequence[str]
) -> tuple[Recording, list[tuple[str, Breakage]]]:
    """Return a sound robot's recording up to the fault, and what follows each kind of fault."""
    run = conditioned(
        condition, seed, BREAKS_S + AFTER_S, changes_s=DROOPS_BEFORE_FAULT_S
    )
    robot = run.emulated()
    wire = Wire(run)
    commands = list(run.commands(robot))
    first = round(BREAKS_S / robot.tick)
    updates = _updates(run, robot, wire, commands, 0, first)
    saved = robot.twin.save()
    state = robot.state
    hidden = copy.deepcopy((wire, robot._rng))
    sound: list[np.ndarray] = []
    _updates(run, robot, wire, commands, first, len(commands), sound)
    found = []
    for kind in kinds:
        broken = replace(run, fault=f"{parts(kind, seed)[0]}@{BREAKS_S}")
        sick = broken.emulated()
        assert isinstance(sick.twin, TwinSnake)
        stuck = sick.twin.pneumatics.stuck
        sick.twin.restore(saved)
        sick.twin.pneumatics.stuck = stuck
        sick.state = state
        channel, sick._rng = copy.deepcopy(hidden)
        readings: list[np.ndarray] = []
        after = _updates(
            broken, sick, channel, commands, first, len(commands), readings
        )
        off = (
            np.abs(np.nan_to_num(np.subtract(readings, sound), nan=9.0)).max(axis=1)
            >= 3 * NOISE_RAD
        )
        since = BREAKS_S + (int(off.argmax()) + 1) * robot.tick if off.any() else np.inf
        found.append(
            (
                kind,
                Breakage(broken, after, BREAKS_S if "lost_marker" in kind else since),
            )
        )
    return Recording(run, updates, np.empty(0), robot.twin.spec, robot.supply_pa), found


def unchanged(shadow: Shadow) -> None:
    """Leave a shadow as it is."""


def isolated(
    order: tuple[int, str, Sequence[str]], prepare: Callable[[Shadow], None] = unchanged
) -> list[dict[str, Any]]:
    """Inject several faults into a robot; return whether its shadow named each one correctly and in time."""
    seed, condition, kinds = order
    sound, found = cached(("faults", *order), lambda: breakages(condition, seed, kinds))
    twin = Shadow(load_robot(sound.run.robot), seed=seed, members=8)
    prepare(twin)
    early: dict[str, tuple[str, float]] = {}
    for time, messages in sound.updates:
        _note_faults(early, twin, time, messages)
    rows = []
    for kind, breakage in found:
        _, part, name = parts(kind, seed)
        named = dict(early)
        shadow = copy.deepcopy(twin)
        for time, messages in breakage.updates:
            _note_faults(named, shadow, time, messages)
        what, at = named.pop(part, ("", np.inf))
        among = name in what.split(" or ")
        since = breakage.observable
        rows.append(
            {
                "fault": kind,
                "seed": seed,
                "condition": condition,
                "named": what,
                "at": at,
                "observable": since,
                "right": what == name,
                "among": among,
                "in_time": among and at <= since + 1 / breakage.run.frequency,
                "others": list(named.items()),
            }
        )
    return rows


def _note_faults(
    named: dict[str, tuple[str, float]],
    shadow: Shadow,
    time: float,
    messages: Sequence[Message],
) -> None:
    if shadow.receive(time, messages):
        for where, what, _ in shadow.detected():
            named.setdefault(where, (what, time))


def alarms(
    order: tuple[int, float, str], prepare: Callable[[Shadow], None] = unchanged
) -> list[str]:
    """Return the false alarms of a healthy robot in a number of seconds; each one is reset."""
    seed, seconds, condition = order
    recording = recorded(conditioned(condition, seed, seconds))
    found = []
    twin = Shadow(load_robot(recording.run.robot), seed=seed, members=8)
    prepare(twin)
    for time, messages in recording.updates:
        twin.receive(time, messages)
        for number, name in list(twin.faults.detected_faults.items()):
            found.append(f"{number}: {name} at {time:.1f} s")
            twin.faults.clear_fault(number)
    return found
