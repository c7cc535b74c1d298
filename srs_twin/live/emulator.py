"""Simulated robot with the communication interfaces of a real robot.

The MuJoCo simulation has random module properties, and faults begin at given times. The
emulated robot receives commands from an MQTT broker and publishes bends, pressures and
valve states in real time. A NatNet server sends the poses of the connectors. Like the
firmware of a real robot, the emulated robot vents all chambers 0.2 s after the last
command.
"""

from __future__ import annotations

import heapq
import itertools
import math
import re
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from srs_twin.control.pwm import PulseWidthModulator
from srs_twin.errors import InputError, SessionWarning, UnknownNameError
from srs_twin.live.commands import SILENT_S, are_states, duty
from srs_twin.live.links import MqttLink, clock
from srs_twin.live.messages import BENDS, COMMAND, PRESSURES, STATUS, SUPPLY, VALVES
from srs_twin.live.natnet import RigidBody
from srs_twin.live.optitrack import NatNetServer
from srs_twin.plants.base import SnakeState, SpatialState
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.pneumatics.orifice import OrificePneumatics
from srs_twin.pneumatics.valves import StuckValve
from srs_twin.robot.file import load_robot_file
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.scenario import Scenario

CARRIER_HZ = 60.0
"""Carrier frequency of the pulse-width modulated valves, Hz."""
_LATE_S = 1.0
"""Delay behind real time above which the emulator no longer catches up, s."""
_SIDES = {"+": 0, "-": 1}
_FAULT = re.compile(r"(\w+)(?::(\d+)([+-])?)?(?:=(\w+))?@([\d.]+)")
_FORM = "KIND[:NUMBER[+|-]][=HOW]@SECONDS, such as stuck_valve:2+=closed@5"


class FaultKind(NamedTuple):
    """Kind of fault with possible variants.

    Attributes:
        part: kind of robot part that has the fault, for example "segment", or an empty
            string if the fault affects the whole robot.
        variants: severity or type of each variant, keyed by name. The first variant is
            the default. For a leak, the value is the rate of pressure loss in 1/s.
    """

    part: str
    variants: dict[str, float]


KINDS = {
    "stuck_valve": FaultKind("chamber", {"open": 1, "closed": -1}),
    "leak": FaultKind("chamber", {"slow": 2, "fast": 8}),
    "dead_sensor": FaultKind("segment", {"silent": 1, "frozen": 0}),
    "drifting_sensor": FaultKind("segment", {"up": 1, "down": -1}),
    "low_supply_pressure": FaultKind("", {"half": 0.5, "empty": 0.1}),
    "lost_marker": FaultKind("connector", {"gone": 1}),
}
_EXAMPLES = {"chamber": ":2+@5", "segment": ":2@5", "connector": ":2@5", "": "@5"}
"""Example of the location and start time of a fault for each kind of robot part."""

_DRIFT_RAD_PER_S = 0.1
_CAMERA_NOISE_M = 0.0003
"""Standard deviation of the noise in motion capture coordinates, m."""
_MARKER_DISTANCE_M = 0.02
"""Distance between a marker and the centre of the connector, m."""
_HEIGHT_M = 0.02
"""Height of the connectors of a planar robot, m."""


@dataclass(frozen=True)
class Fault:
    """Fault that begins at a given time.

    Attributes:
        number: number of the segment or connector, counted from 1 at the head, or 0 if
            the fault affects the whole robot.
        side: side of a faulty chamber, 0 for + and 1 for −.
        how: value of the variant from `KINDS`.
        since: time from the start of the emulation to the start of the fault, s.
    """

    kind: str
    number: int
    side: int
    how: float
    since: float

    @classmethod
    def parse(cls, text: str, segments: int) -> Fault:
        """Parse a fault such as ``stuck_valve:2+@5``.

        Raises:
            InputError: the text is malformed, or the named part does not exist.
            UnknownNameError: the kind or the variant is unknown.
        """
        match = _FAULT.fullmatch(text)
        if match is None:
            raise InputError(f"{text!r} is not a valid fault; write it as {_FORM}")
        kind, number, side, how, since = match.groups()
        if kind not in KINDS:
            raise UnknownNameError("fault", kind, KINDS)
        part, variants = KINDS[kind]
        how = how or next(iter(variants))
        if how not in variants:
            raise UnknownNameError(f"variant of {kind}", how, variants)
        is_complete = bool(number) == bool(part)
        if not is_complete or bool(side) != (part == "chamber"):
            needed = f"affects one {part}" if part else "affects the whole robot"
            raise InputError(
                f"{text!r}: the fault {kind} {needed}; write it as"
                f" {kind}{_EXAMPLES[part]}"
            )
        most = segments + (part == "connector")
        if number and not 1 <= int(number) <= most:
            numbered = part.replace("chamber", "segment")
            raise InputError(
                f"{text!r}: {numbered} {number} does not exist; the robot has {most}"
                f" {numbered}s"
            )
        return cls(
            kind,
            number=int(number or 0),
            side=_SIDES.get(side, 0),
            how=variants[how],
            since=float(since),
        )


@dataclass(frozen=True)
class Simulation:
    """Simulation settings of an emulated robot.

    Attributes:
        gain_spread: relative standard deviation of the bending gains of the modules.
        tick: control period of the robot, s.
        pneumatics: pneumatic model, "orifice" or "lag". The default is "lag" for
            spatial robots, which do not support "orifice", and "orifice" for planar
            robots.
        supply_kpa: gauge supply pressure, kPa, or None for the nominal pressure.
        changes: changed fields of the robot file, in the format of the `robot` section
            of a scenario.
    """

    gain_spread: float = 0.1
    tick: float = 0.02
    pneumatics: str | None = None
    supply_kpa: float | None = None
    changes: Mapping[str, Any] = field(default_factory=dict)

    def scenario(self, robot: str, seed: int) -> Scenario:
        """Build a scenario for a robot, which is given by a name or a file path.

        Raises:
            InputError: the robot does not exist, or a setting is invalid.
        """
        pneumatics = self.pneumatics
        if pneumatics is None:
            is_spatial = load_robot_file(robot).is_spatial
            pneumatics = "lag" if is_spatial else "orifice"
        modules = {"gain_spread": self.gain_spread} | self.changes.get("modules", {})
        document: dict[str, object] = {
            "robot": {"base": robot, **self.changes, "modules": modules},
            "duration_s": 1.0,
            "seed": seed,
            "controller": {"kind": "gait", "frequency_hz": 1.0},
            "pneumatics": {"kind": pneumatics},
            "plants": {"twin": {"tick_s": self.tick}},
        }
        if self.supply_kpa is not None:
            document["supply"] = {"pressure_kpa": self.supply_kpa}
        return parse_scenario(document, name="emulate")


class EmulatedRobot:
    """Simulated robot that advances in ticks, independently of real time and network.

    Attributes:
        supply_pa: nominal gauge supply pressure, Pa.
        supply_now_pa: current gauge supply pressure, Pa.
        valves: commanded valve states at the end of the last tick, shape (segments,
            chambers).
        spatial_chambers: number of chambers per segment of a spatial robot, or 0 for a
            planar robot.
    """

    def __init__(
        self,
        robot: str,
        simulation: Simulation = Simulation(),
        *,
        seed: int = 0,
        faults: Sequence[str] = (),
        noise_rad: float = 0.02,
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Build the simulation.

        Args:
            robot: name of a shipped robot, or path of a robot file.
            simulation: settings of the simulation.
            seed: random seed of the module properties and the sensor noise.
            faults: faults in the format of `Fault.parse`.
            noise_rad: standard deviation of the bend sensor noise, rad.
            start: initial position x, y (m) and initial heading (rad).

        Raises:
            InputError: the robot does not exist, or a fault is invalid.
        """
        scenario = simulation.scenario(robot, seed)
        self.twin = scenario.build_plant("twin")
        assert isinstance(self.twin, TwinSnake)
        self._air = self.twin.pneumatics
        spec = self.twin.spec
        self.segments = spec.segments
        self.tick = simulation.tick
        self.spatial_chambers = spec.chambers if spec.is_spatial else 0
        self._rng = np.random.default_rng((seed, 0xE0))
        self._noise = noise_rad
        self.supply_pa = self.supply_now_pa = scenario.supply_pa
        self._fraction = self._left = 1.0
        self.faults = tuple(Fault.parse(fault, spec.segments) for fault in faults)
        self._inject_faults()
        self._pulses = PulseWidthModulator(
            CARRIER_HZ,
            self.tick,
            spec.segments,
            aligned=True,
            allow_long_ticks=True,
            scale=spec.scale,
            chambers=spec.chambers,
        )
        self.valves = np.full((spec.segments, spec.chambers), -1, dtype=np.int8)
        self.state = self.twin.reset(pose=start, seed=seed)
        self._frozen = np.full(self.state.bend.shape, np.nan)

    def _inject_faults(self) -> None:
        kinds = {fault.kind for fault in self.faults}
        if "stuck_valve" in kinds:
            self.twin.spec.require_planar(
                "fault stuck_valve, which names a + or − chamber,"
            )
        if "leak" in kinds and not isinstance(self._air, OrificePneumatics):
            raise InputError(
                "a leak can be simulated only with compressible flow; use pneumatics"
                " 'orifice'"
            )
        self._air.stuck = tuple(
            StuckValve(fault.number, fault.side, int(fault.how), fault.since)
            for fault in self.faults
            if fault.kind == "stuck_valve"
        )
        self._pending = [
            fault
            for fault in self.faults
            if fault.kind in ("leak", "low_supply_pressure")
        ]

    def step(self, command: np.ndarray | None) -> SnakeState:
        """Advance by one tick with valve states or duties.

        If the command is None, all chambers vent.
        """
        now = float(self.state.time)
        for fault in [fault for fault in self._pending if fault.since <= now + 1e-9]:
            self._pending.remove(fault)
            if isinstance(self._air, OrificePneumatics) and fault.kind == "leak":
                self._air.leak(fault.number, fault.side, fault.how)
            else:
                self._left = fault.how
                self.regulate(self._fraction)
        wanted = np.full(self.valves.shape, -1.0)
        if command is not None:
            wanted = np.asarray(command, dtype=float)
        # The carrier also advances during commands with valve states, so that the
        # carrier phase does not depend on the type of earlier commands.
        obeyed = self._pulses.step(duty(wanted))
        if are_states(wanted):
            obeyed = wanted.astype(np.int8)
        self.valves = obeyed[-1] if obeyed.ndim == 3 else obeyed
        self.state = self.twin.step(obeyed)
        return self.state

    def regulate(self, fraction: float) -> None:
        """Set the supply pressure to a fraction of the nominal pressure.

        A fault of the supply reduces the resulting pressure.
        """
        self._fraction = fraction
        self.supply_now_pa = fraction * self._left * self.supply_pa
        self._air.set_supply_pressure(self.supply_now_pa)

    def bends(self) -> np.ndarray:
        """Return the bend readings (rad), with NaN for missing readings."""
        time = float(self.state.time)
        readings = self.state.bend + self._noise * self._rng.normal(
            size=self.state.bend.shape
        )
        for fault in self.faults:
            if fault.since > time:
                continue
            j = fault.number - 1
            if fault.kind == "dead_sensor":
                self._frozen[j] = np.where(
                    np.isnan(self._frozen[j]), readings[j], self._frozen[j]
                )
                readings[j] = math.nan if fault.how else self._frozen[j]
            elif fault.kind == "drifting_sensor":
                readings[j] += fault.how * _DRIFT_RAD_PER_S * (time - fault.since)
        return np.asarray(readings)

    def bodies(self) -> dict[int, RigidBody]:
        """Return the rigid bodies measured by motion capture.

        The keys are connector numbers from 1 at the head. The y axis points upwards.
        """
        time = float(self.state.time)
        bodies = {}
        lost = {
            fault.number
            for fault in self.faults
            if fault.kind == "lost_marker" and fault.since <= time
        }
        noise = _CAMERA_NOISE_M * self._rng.normal(size=(len(self.state.position), 3))
        for i, (x, y) in enumerate(self.state.position):
            dx, dy, dz = noise[i].tolist()
            # The y axis of Motive points upwards, so the y axis of the simulation
            # corresponds to the −z axis of Motive.
            if isinstance(self.state, SpatialState):
                height = float(self.state.height[i]) + dz
                w, a, b, c = map(float, self.state.orientation[i])
                turn = (a, c, -b, w)
            else:
                height = _HEIGHT_M
                half = (
                    float(self.state.connector_heading[i]) + dz / _MARKER_DISTANCE_M
                ) / 2
                turn = (0.0, math.sin(half), 0.0, math.cos(half))
            place = (float(x) + dx, height, -(float(y) + dy))
            bodies[i + 1] = RigidBody(place, turn, tracked=i + 1 not in lost)
        return bodies


_GOODBYE_S = 1.0
"""Maximum time to wait for the broker to accept the final status message, s."""
_LETS_GO_S = 0.001
"""Time for which the thread of the MQTT client can run after each tick, s.

During a tick, compiled kernels hold the interpreter lock.
"""
_POLL_S = 0.002
"""Maximum interval between checks whether a queued message is due, s."""


class _DelayedCall(NamedTuple):
    due: float
    number: int
    call: partial[None]


class Transport:
    """Queue of outgoing messages that simulates message loss and random delay."""

    def __init__(self, loss: float = 0.0, jitter: float = 0.0, seed: int = 0) -> None:
        """Create a queue with a loss probability and a maximum delay `jitter` (s)."""
        self._loss = loss
        self._jitter = jitter
        self._rng = np.random.default_rng((seed, 0xA1))
        self._waiting: list[_DelayedCall] = []
        self._number = itertools.count()

    def add(
        self, due: float, send: Callable[..., None], *values: object, **named: object
    ) -> None:
        """Schedule a call of `send` at a local time (s) with random loss and delay."""
        if self._rng.random() >= self._loss:
            delayed = due + self._rng.random() * self._jitter
            call = partial(send, *values, **named)
            entry = _DelayedCall(delayed, next(self._number), call)
            heapq.heappush(self._waiting, entry)

    def send_until(self, due: float) -> None:
        """Wait until a local time (s) while sending the messages that become due."""
        while True:
            while self._waiting and self._waiting[0].due <= clock():
                heapq.heappop(self._waiting).call()
            left = due - clock()
            if left <= 0:
                return
            if self._waiting:
                left = min(left, _POLL_S)
            time.sleep(left)


def emulate(
    robot: EmulatedRobot,
    link: MqttLink,
    capture: NatNetServer | None,
    *,
    transport: Transport | None = None,
    duration: float = math.inf,
    stop: Callable[[], bool] = lambda: False,
    publishes_supply: bool = False,
) -> dict[str, float]:
    """Run an emulated robot in real time.

    Args:
        robot: emulated robot.
        link: MQTT link that receives commands and publishes measurements.
        capture: motion capture server, or None if motion capture is not emulated.
        transport: queue that simulates message loss and delay, or None if messages arrive
            at once.
        duration: duration of the run, s.
        stop: function that is called once per tick and returns whether to end the run.
        publishes_supply: whether the supply pressure is also published.

    Returns:
        Number of ticks (``ticks``), number of ticks that ended more than one tick
        behind real time (``late``), and number of times that the connection to the
        broker was lost (``disconnected``).
    """
    transport = transport or Transport()
    begun = clock()
    tick = robot.tick
    done = 0
    late = 0
    command = None
    heard = -math.inf
    link.send(STATUS, "running")
    try:
        while done * tick < duration and not stop():
            if change := link.connection_change():
                text = f"{done * tick:.1f} s: {change}"
                warnings.warn(text, SessionWarning, stacklevel=2)
            for message in link.received():
                if message.kind == COMMAND:
                    command = message.values
                    heard = message.arrived
            state = robot.step(command if clock() - heard <= SILENT_S else None)
            done += 1
            due = begun + done * tick
            messages = {
                BENDS: robot.bends(),
                PRESSURES: state.pressure,
                VALVES: robot.valves,
            }
            if publishes_supply:
                messages[SUPPLY] = np.array(robot.supply_now_pa)
            for kind, values in messages.items():
                transport.add(due, link.send, kind, values, at=due)
            if capture is not None:
                transport.add(due, capture.send, due, robot.bodies())
            late += clock() > due + tick
            if clock() - due > _LATE_S:
                begun = clock() - done * tick
            transport.send_until(due)
            time.sleep(_LETS_GO_S)
    finally:
        link.send(STATUS, "stopped", wait_s=_GOODBYE_S)
    return {
        "ticks": done,
        "late": late,
        "disconnected": link.counts["disconnected"],
    }
