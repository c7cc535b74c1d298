"""Shadow: a robot's state beside the running robot, with its uncertainty, what comes next, what has failed.

Messages in order of time (`clocks.Inbox`) move an ensemble (`ensemble`) and a bank of fault hypotheses
(`faults`) to the time of each and correct them. What the bank has named, the ensemble takes for granted: a
chamber that always fills does so in it as well, and readings of a broken sensor are no longer taken. Nothing
here knows of wires or of the time of day: `take` is told what time it is.
"""

from __future__ import annotations

import bisect
import itertools
import math
import operator
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.saved_state import SavedState, Stateful, short_digest
from srs_twin.live.clocks import Inbox
from srs_twin.live.ensemble import STEP_S, Air, Ensemble
from srs_twin.live.faults import FILLS, HYPOTHESES, LEAKS, READS, STARVED, VENTS, FaultBank
from srs_twin.live.messages import BENDS, COMMAND, POSES, PRESSURES, VALVES, Message
from srs_twin.live.prediction import SLOT_S, Hindsight, Prediction, Rhythm
from srs_twin.plants.base import SnakeState
from srs_twin.robot.spec import RobotSpec

DELAY_S = 0.01
"""How much later than it was sent a command is taken to be obeyed: half a tick of the robot."""
REPORTED_S = 0.02
"""For how long valves have been as a robot says that they are: its tick."""
UNTOLD_S = 0.002
"""What a message takes at the least, which no clock tells; estimated, of stand-ins."""
SILENT_S = 0.2
"""A robot without commands vents after so long."""
LOST_AFTER_S = 1.0
"""Without a robot's message for so long nothing is known of it."""
LARGEST_SD_M = 0.05
"""Where the robot is known less well than this, it is lost."""
MISSING_FRAMES = 8
"""A body that so many frames in a row do not have is lost, while others are seen."""
_TAKEN = (COMMAND, VALVES, BENDS, PRESSURES, POSES)
HORIZON_S, _STEP_S, _AHEAD, _FINER = 1.0, 0.1, 16, 2
"""How far predictions reach, at which times (s), how many members make them, in how many parts of a slot."""
_WAITS_S, _NOTHING_S = 0.1, 5e-4
"""After how long without a message the robot is guessed, and what is too short a time to go on for."""
_HISTORY_S = 5.0
_LEARNS = ["modules", "connection", "bank"]


@dataclass(frozen=True)
class Estimate:
    """What is known of a robot at a moment.

    Attributes:
        time: our clock, s.
        bend: of each segment, rad.
        bend_sd: of that.
        pose: x, y (m) of the centre of mass, mean heading (rad).
        pose_sd: of that.
        velocity: of the centre of mass, world frame, m/s, and yaw rate, rad/s.
        connectors: x, y (m), heading (rad) of each, shape (connectors, 3).
        parameters: name → (values, standard deviations): gain of each chamber, bias (rad), time constants of
            filling and venting of each module, stiffness and μ_t as multiples of the file's.
        faults: what was named: (part, fault, probability); part is a segment, "supply" or a connector.
        off: RMS of what the last measurements of each kind were off by, in standard deviations.
        lost: why the robot is lost; empty: it is not.
    """

    time: float
    bend: np.ndarray
    bend_sd: np.ndarray
    pose: np.ndarray
    pose_sd: np.ndarray
    velocity: np.ndarray
    connectors: np.ndarray
    parameters: Mapping[str, tuple[np.ndarray, np.ndarray]]
    faults: tuple[tuple[str, str, float], ...]
    off: Mapping[str, float]
    lost: str

    def state(self, time: float, pressure: np.ndarray) -> SnakeState:
        """Return it as a controller takes states, at a time of its own (s)."""
        n = len(self.connectors)
        return SnakeState(
            time=np.float64(time), com=self.pose[:2], com_velocity=self.velocity[:2], heading=self.pose[2],
            position=self.connectors[:, :2], theta=self.connectors[:, 2], bend=self.bend,
            bend_rate=np.zeros_like(self.bend), pressure=pressure,
            valves=np.zeros_like(pressure, dtype=np.int8),
            sensed=self.bend, contact_force=np.zeros((n, 2)), obstacle_force=np.zeros((n, 2)),
            torque=np.zeros_like(self.bend), work=np.float64(0.0), internal_loss=np.float64(0.0),
            air=np.float64(0.0), qpos=np.empty(0),
        )  # fmt: skip


class Shadow:
    """The twin of one running robot (module docstring).

    Attributes:
        spec: the robot, as its file has it.
        ensemble: what moves beside it.
        bank: what may have failed.
        rhythm: of the commands.
        hindsight: what predictions were off by.
        inbox: messages that wait for others that were sent before them.
        time: until when it has come, our clock, s; NaN before the first message.
    """

    def __init__(
        self, spec: RobotSpec, *, supply_pa: float | None = None, members: int = 32, seed: int = 0,
        hold_s: float = 0.03, frames: Mapping[str, int] | None = None,
    ) -> None:  # fmt: skip
        """Know nothing of the robot but its file.

        Args:
            spec: the robot.
            supply_pa: gauge; default the robot's nominal one.
            members: of the ensemble.
            seed: of its draws.
            hold_s: how long a message waits for others that were sent earlier, s.
            frames: body of the motion capture → connector, from 1; default "connector_1" and so on.
        """
        n = spec.segments
        self.spec, self._supply = spec, spec.supply.nominal if supply_pa is None else supply_pa
        self.ensemble = Ensemble(spec, members=members, seed=seed)
        self.bank = FaultBank(spec, supply_pa=self._supply)
        self.inbox, self.time = Inbox(hold_s), math.nan
        self._frames = frames or {f"connector_{i}": i for i in range(1, n + 2)}
        closed = np.zeros((n, 2))
        # When commands took effect, and what share of the time valves fill from then on.
        self._times, self._opens = deque([-math.inf]), deque([closed])
        self._duties = False
        self._heard = {kind: -math.inf for kind in _TAKEN}
        self._missing = np.zeros(n + 1, dtype=int)
        self._gone = np.zeros(n + 1, dtype=bool)
        self._off: dict[str, float] = {}
        self.rhythm = Rhythm()
        self.hindsight = Hindsight(self.rhythm)

    def take(self, now: float, messages: Iterable[Message]) -> Estimate | None:
        """Take what has arrived until now (our clock, s).

        Returns:
            What is known now; None before the first message of the robot.
        """
        for message in messages:
            if message.kind in _TAKEN:
                self.inbox.put(message)
        for time, together in itertools.groupby(self.inbox.take(now), key=operator.itemgetter(0)):
            self._take(time, [message for _, message in together])
        if math.isnan(self.time):
            return None
        # What the next message will correct is not guessed before.
        if now - self.inbox.hold - self.time > _WAITS_S:
            self._advance(now - self.inbox.hold)
            self.ensemble.roll()
        found = self._estimate(now)
        self.hindsight.see(self.time, found.pose)
        return found

    def predict(self) -> Prediction:
        """Return where the robot goes in the next second if commands go on as they do."""
        return self.hindsight.corrected(self.outlook()())

    def outlook(self) -> Callable[[], Prediction]:
        """Return what computes a prediction, on any thread; `hindsight` is to correct it."""
        each, slots = round(_STEP_S / SLOT_S), round(HORIZON_S / SLOT_S)
        commands = self.rhythm.commands(slots)
        fine = np.repeat(commands, _FINER, axis=0)
        airs = [self._air(part) for part in np.split(fine, slots // each)]
        times = self.time + _STEP_S * np.arange(1, len(airs) + 1)
        begun, heading = self.time, float(self.ensemble.mean("heading")[0])
        goes = self.ensemble.ahead(_AHEAD)

        def run() -> Prediction:
            found = goes(airs, _STEP_S)
            return Prediction(begun, heading, commands, times, found.mean(axis=1), found.std(axis=1, ddof=1))

        return run

    def save(self) -> SavedState:
        """Return what was learnt of the robot, for `restore` after an interruption; not where it is."""
        content = {"gone": self._gone} | {
            name: part.state_dict() for name, part in zip(_LEARNS, self._parts(), strict=True)
        }
        return SavedState(self._identity(), content)

    def restore(self, state: SavedState) -> None:
        """Go on with what was learnt.

        Raises:
            InputError: a state of another robot.
        """
        state.check("shadow", self._identity())
        for name, part in zip(_LEARNS, self._parts(), strict=True):
            part.load_state_dict(state.content[name])
        self._gone = np.array(state.content["gone"])

    def _parts(self) -> tuple[Stateful, ...]:
        return self.ensemble.modules, self.ensemble.connection, self.bank

    def _identity(self) -> dict[str, Any]:
        rows = len(self.ensemble.connection.weights)
        return {
            "shadow": short_digest(self.spec), "supply_pa": self._supply, "learns": _LEARNS, "products": rows,
        }  # fmt: skip

    def _take(self, time: float, messages: Sequence[Message]) -> None:
        """Take what was told of one time on our clock."""
        measured = []
        for message in messages:
            if message.kind in (COMMAND, VALVES):
                self._command(time, message)
            else:
                measured.append(message)
        if not measured:
            return
        if math.isnan(self.time):
            self.time = time
        self._advance(time)
        for message in measured:
            kind, values = message.kind, message.values
            if kind == POSES:
                self._see(message)
            elif kind == BENDS:
                self.bank.read(values)
            else:
                self.bank.read(pressures=values, span=min(time - self._heard[PRESSURES], 1.0))
            self._heard[kind] = time
        # Balances take pressures where they know bends; members know these best where they come last.
        for message in reversed(measured):
            if message.kind == PRESSURES:
                self._note(PRESSURES, self.ensemble.read_pressures(message.values))
            elif message.kind == BENDS:
                reads = np.where(self._reads(), message.values, np.nan)
                self._note(BENDS, self.ensemble.read_bends(reads))
        self.ensemble.roll()

    def _command(self, time: float, message: Message) -> None:
        """Take what valves were told, or what a robot says that they were: either message may be lost."""
        states = np.isin(message.values, (-1.0, 1.0)).all()
        if message.kind == COMMAND:
            self._duties = not states
        elif self._duties:  # of a carrier's duty a moment tells nothing
            return
        at = time + DELAY_S if message.kind == COMMAND else time - REPORTED_S
        opens = (message.values + 1) / 2 if states else np.clip(message.values, 0.0, 1.0)
        k = bisect.bisect(self._times, at)
        gap = at - self._times[k - 1]
        # What was lost may have switched valves before this does.
        if len(self._times) > 2 and gap > 1.5 * np.median(np.diff(self._times)):
            self.bank.doubt(np.abs(opens - self._opens[k - 1]), min(gap, LOST_AFTER_S))
        self._times.insert(k, at)
        self._opens.insert(k, opens)

    def _see(self, message: Message) -> None:
        """Take a frame of motion capture."""
        poses = np.full((self.spec.segments + 1, 3), np.nan)
        for name, row in zip(message.names, message.values, strict=True):
            if name in self._frames:
                poses[self._frames[name] - 1] = row[[0, 1, 3]]
        seen = ~np.isnan(poses[:, :2]).any(axis=1)
        if not seen.any():
            return
        self._missing = np.where(seen, 0, self._missing + 1)
        self._gone = ~seen & (self._gone | (self._missing >= MISSING_FRAMES))
        bends = -np.diff(poses[:, 2])
        bends = np.remainder(bends + np.pi, 2 * np.pi) - np.pi
        self.bank.read(markers=bends, rough=self.ensemble.rough)
        self._note(POSES, self.ensemble.read_poses(poses))

    def _note(self, kind: str, off: np.ndarray) -> None:
        if not np.isnan(off).all():
            self._off[kind] = float(np.sqrt(np.nanmean(off**2)))

    def _advance(self, time: float) -> None:
        """Go on to a time."""
        if time - self.time < _NOTHING_S:
            return
        if time - self.time > LOST_AFTER_S:  # what happened meanwhile nobody knows
            self.ensemble.placed = False
            self.time = time - LOST_AFTER_S
        parts = math.ceil((time - self.time) / SLOT_S - 1e-6)
        begun, span = self.time, (time - self.time) / parts
        steps = math.ceil(span / STEP_S - 1e-6)
        for k in range(1, parts + 1):
            opens = self._commanded(self.time + (np.arange(steps) + 0.5) * span / steps)
            self.rhythm.take(self.time + span / 2, opens[0])
            self.bank.advance(opens.mean(axis=0), span)
            self.ensemble.advance(self._air(opens), span)
            self.time = begun + k * span
        while len(self._times) > 2 and self._times[1] < self.time - _HISTORY_S:
            self._times.popleft()
            self._opens.popleft()

    def _commanded(self, times: np.ndarray) -> np.ndarray:
        """Return for what share of the time valves were told to fill, shape (times, segments, 2)."""
        known, found = list(self._times), []
        for time in times.tolist():
            k = bisect.bisect(known, time) - 1
            silent = time - known[k] > SILENT_S
            found.append(np.zeros_like(self._opens[k]) if silent else self._opens[k])
        return np.array(found)

    def _air(self, opens: np.ndarray) -> Air:
        """Return what the chambers get, as far as it is known what has failed."""
        likely = [HYPOTHESES[m] for m in self.bank.likely()]
        does = np.array([[each.plus, each.minus] for each in likely])
        opens = np.where(does == FILLS, 1.0, np.where(does == VENTS, 0.0, opens))
        leak = np.where(does == LEAKS, [[each.leak] for each in likely], 0.0)
        return Air(opens, self._supply * np.array([each.weak for each in likely]), leak)

    def _reads(self) -> np.ndarray:
        """Say whose sensor is taken for whole."""
        return np.array([HYPOTHESES[m].sensor == READS for m in self.bank.likely()])

    def _faults(self) -> Iterable[tuple[str, str, float]]:
        sound = self.bank.probability[:, 0]
        for number, name in self.bank.named.items():
            yield (
                (f"segment {number}", name, float(1 - sound[number - 1]))
                if number
                else ("supply", STARVED, 1.0)
            )
        for i in np.flatnonzero(self._gone):
            yield f"connector {i + 1}", "lost_marker", 1.0

    def _lost(self, now: float, pose_sd: np.ndarray) -> str:
        if now - self._heard[BENDS] > LOST_AFTER_S:
            return "the robot says nothing"
        if not self.ensemble.placed:
            return "nobody has seen where it is"
        if math.hypot(*pose_sd[:2]) > LARGEST_SD_M:
            return "it is not known well enough where it is"
        return ""

    def _estimate(self, now: float) -> Estimate:
        e = self.ensemble
        pose, pose_sd = (np.concatenate([f(name) for name in ("x", "y", "heading")]) for f in (e.mean, e.sd))
        (x, y, turn), (c, s) = e.twist, (math.cos(pose[2]), math.sin(pose[2]))
        velocity = np.array([c * x - s * y, s * x + c * y, turn])
        bend_sd = np.hypot(e.sd("bend"), UNTOLD_S * e.mean("motion")[3:])
        off = dict(self._off)
        return Estimate(
            now, e.mean("bend"), bend_sd, pose, pose_sd, velocity, e.poses().mean(axis=0),
            e.parameters(),
            tuple(self._faults()), off, self._lost(now, pose_sd),
        )  # fmt: skip


def frames_of(given: Sequence[str], connectors: int) -> dict[str, int]:
    """Return body → connector of ``BODY=CONNECTOR`` pairs.

    Raises:
        InputError: no such pair, or no such connector.
    """
    found = {}
    for each in given:
        name, _, number = each.rpartition("=")
        if not name or not number.isdigit() or not 1 <= int(number) <= connectors:
            raise InputError(
                f"{each!r} names no body; BODY=CONNECTOR does, with a connector from 1 to {connectors}"
            )
        found[name] = int(number)
    return found
