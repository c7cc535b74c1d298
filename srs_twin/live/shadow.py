"""Live twin that estimates the state of a robot and detects its faults.

Messages are sorted by sending time (`clocks.ReorderBuffer`). Each measurement updates
an ensemble filter (`ensemble`) and a fault detector (`fault_detector`). The ensemble
filter simulates the most likely valve faults and leaks, and ignores the readings of
bend sensors that are probably faulty.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from time import monotonic

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.provenance import short_digest
from srs_twin.io.saved_state import SavedState, Stateful, check_kind
from srs_twin.live.clocks import ReorderBuffer, TimedMessage
from srs_twin.live.commands import KEPT_S, SLOT_S, CommandHistory, CommandPeriod
from srs_twin.live.ensemble import EnsembleFilter
from srs_twin.live.estimate import (
    DetectedFault,
    Estimate,
    IntervalCalibration,
    LiveContact,
    Prediction,
    PredictionCalibration,
)
from srs_twin.live.fault_detector import FaultDetector
from srs_twin.live.fault_hypotheses import (
    CHAMBERS,
    LEAK_RATES,
    LOW_SUPPLY_PRESSURE,
    SENSORS,
    ChamberBehaviour,
    SensorBehaviour,
    valve_duty,
)
from srs_twin.live.member_dynamics import STEP_S, ValveInput
from srs_twin.live.messages import (
    BENDS,
    COMMAND,
    POSES,
    PRESSURES,
    SUPPLY,
    VALVES,
    Message,
)
from srs_twin.live.uncertain import Estimates
from srs_twin.robot.geometry import measured_bend
from srs_twin.robot.spec import RobotSpec

TRANSPORT_DELAY_S = 0.002
"""Assumed minimum transport delay of messages, s."""
LOST_AFTER_S = 1.0
"""Time without a message after which the state of the robot is unknown, s."""
LARGEST_SD_M = 0.05
"""Standard deviation above which the position of the robot is unknown, m."""
MISSING_FRAMES = 8
"""Number of successive frames without a body after which the body counts as lost."""
HORIZON_S = 1.0
"""Horizon of predictions, s."""
MOST_BEHIND_S = 0.3
"""Age of the oldest waiting message above which all waiting messages are skipped, s."""
_PREDICTION_STEP_S = 0.1
"""Interval between the predicted poses, s."""
_PREDICTION_MEMBERS = 16
_SUBSLOTS = 2
"""Number of prediction steps per command slot."""
_EXTRAPOLATE_AFTER_S = 0.05
"""Time without a message after which the filters are advanced to the current time, s.
"""
_LEAST_STEP_S = 5e-4
"""Minimum time step of the filters, s."""
_LEAST_INTERVAL_S = 0.018
"""Minimum interval between used measurements from the same sender, s.

More than 50 measurements per second provide little additional information.
"""
_PRESENT_STEP_S = 0.005
"""Time step of the prediction from the last message to the current time, s."""
_KINDS = (COMMAND, VALVES, BENDS, PRESSURES, POSES, SUPPLY)
_MEASURED = (BENDS, PRESSURES, POSES, SUPPLY)


class Shadow:
    """Live twin of one robot, as described in the module docstring.

    Attributes:
        ensemble: ensemble filter for the pose, bends and pressures.
        faults: fault detector.
        command_period: detector for periodic commands.
        contact: estimator of the contact force.
        prediction_calibration: calibration of the prediction intervals with the errors
            of earlier predictions.
        buffer: buffer that sorts messages by sending time.
        time: time on the local clock to which the filters have advanced, s, or NaN
            before the first measurement.
        skipped: total time for which messages were skipped because the machine was too
            slow, s.
        interruptions: number of times that the robot restarted or sent no message for
            more than `LOST_AFTER_S`.
    """

    def __init__(
        self,
        spec: RobotSpec,
        *,
        supply_pa: float | None = None,
        members: int = 32,
        seed: int = 0,
        frames: Mapping[str, int] | None = None,
    ) -> None:
        """Initialise the live twin with the nominal values of a robot.

        Args:
            spec: robot specification.
            supply_pa: nominal gauge supply pressure, Pa, or None to use the pressure in
                `spec`.
            members: number of ensemble members.
            seed: random seed.
            frames: connector number of each motion capture body, counted from 1 at the
                head and keyed by body name. If None, the bodies must be named
                "connector_1", "connector_2" and so on.

        Raises:
            InputError: the robot is spatial.
        """
        spec.require_planar("the live twin")
        n = spec.segments
        self.spec = spec
        self._supply = spec.supply.nominal if supply_pa is None else supply_pa
        self.ensemble = EnsembleFilter(spec, members=members, seed=seed)
        self.faults = FaultDetector(spec, supply_pa=self._supply)
        self.ensemble.set_modules(self.faults.modules())
        self.buffer = ReorderBuffer()
        self.time = math.nan
        self._frames = frames or {f"connector_{i}": i for i in range(1, n + 2)}
        self._due: deque[TimedMessage] = deque()
        self.skipped = 0.0
        self.interruptions = 0
        self._commands = CommandHistory(n)
        self._heard = dict.fromkeys(_KINDS, -math.inf)
        self._used: dict[str, float] = {}
        self._missing = np.zeros(n + 1, dtype=int)
        self._lost_markers = np.zeros(n + 1, dtype=bool)
        self._innovation: dict[str, float] = {}
        self.command_period = CommandPeriod()
        self.contact = LiveContact(spec)
        self.prediction_calibration = PredictionCalibration()
        self._intervals = IntervalCalibration((n, 2, 1))

    def update(
        self, now: float, messages: Iterable[Message], *, work_s: float = math.inf
    ) -> Estimate | None:
        """Process new messages, and estimate the current state.

        Args:
            now: current time on the local clock, s.
            messages: messages that have arrived since the last call.
            work_s: maximum time for processing messages, s. The remaining messages wait
                for the next call, but are skipped if they become older than
                `MOST_BEHIND_S`.

        Returns:
            Estimate for the time `now`, or None before the first measurement.
        """
        if not self.receive(now, messages, work_s=work_s):
            return None
        estimate = self._estimate(now)
        self.prediction_calibration.observe(now, estimate.pose)
        return estimate

    def receive(
        self, now: float, messages: Iterable[Message], *, work_s: float = math.inf
    ) -> bool:
        """Process new messages as in `update`, but do not compute an estimate.

        Returns:
            Whether any measurement has been processed so far.
        """
        for message in messages:
            if message.kind in _KINDS:
                self.buffer.push(message)
        due = self.buffer.pop_until(now)
        self._due.extend(timed for timed in due if self._needed(timed.message))
        deadline = monotonic() + work_s
        while self._due and monotonic() < deadline:
            # Messages with equal times are processed together, because the result
            # depends on the order of the corrections.
            at = self._due[0].time
            simultaneous = []
            while self._due and self._due[0].time == at:
                simultaneous.append(self._due.popleft().message)
            self._use(at, simultaneous)
        if self._due and now - self._due[0].time > MOST_BEHIND_S:
            self._skip_due()
        # The filters lag behind the current time by the holding time of the buffer,
        # because earlier messages may still arrive.
        elif now - self.buffer.hold - self.time > _EXTRAPOLATE_AFTER_S:
            self._advance(now - self.buffer.hold)
        return not math.isnan(self.time)

    @property
    def waits(self) -> bool:
        """Whether any received message is waiting to be processed."""
        return self.buffer.waits or bool(self._due)

    def predict(self) -> Prediction:
        """Predict the path over the next second from the current commands."""
        return self.prediction_calibration.inflate(self.prediction_task()())

    def prediction_task(self) -> Callable[[], Prediction]:
        """Return a function that another thread can call to compute a prediction."""
        # All inputs are copied here, because the filters change while another thread
        # computes the prediction.
        per_step = round(_PREDICTION_STEP_S / SLOT_S)
        slots = round(HORIZON_S / SLOT_S)
        commands = self.command_period.commands(slots)
        fine = np.repeat(commands, _SUBSLOTS, axis=0)
        inputs = list(map(self._valve_input, np.split(fine, slots // per_step)))
        times = self.time + _PREDICTION_STEP_S * np.arange(1, len(inputs) + 1)
        begun = self.time
        heading = float(self.ensemble.mean("heading")[0])
        ensemble = self.ensemble.copy(_PREDICTION_MEMBERS)

        def run() -> Prediction:
            poses = ensemble.forecast(inputs, _PREDICTION_STEP_S)
            sd = poses.std(axis=1, ddof=1)
            return Prediction(begun, heading, times, poses.mean(axis=1), sd)

        return run

    def save(self) -> SavedState:
        """Return the learnt values and the detected faults for `restore`."""
        # The pose is not saved, because the robot may be moved before the state is
        # restored.
        parts = {name: part.state_dict() for name, part in self._saved_parts().items()}
        return SavedState(self._identity(), {"gone": self._lost_markers} | parts)

    def restore(self, state: SavedState) -> None:
        """Restore the learnt values and the detected faults.

        Raises:
            InputError: the state belongs to another robot, or is incomplete.
        """
        state.check("shadow", self._identity())
        parts = self._saved_parts()
        for name, present in (parts | {"gone": self._lost_markers}).items():
            check_kind(name, state.content.get(name), present)
        for name, part in parts.items():
            part.load_state_dict(state.content[name])
        self._lost_markers = np.array(state.content["gone"])

    def _saved_parts(self) -> dict[str, Stateful]:
        return {"connection": self.ensemble.odometry.connection, "bank": self.faults}

    def _identity(self) -> dict[str, object]:
        return {
            "shadow": short_digest(self.spec),
            "supply_pa": self._supply,
            "learns": [*self._saved_parts()],
            "products": len(self.ensemble.odometry.connection.weights),
        }

    def _skip_due(self) -> None:
        newest = self._due[-1].time
        for at, message in self._due:
            if message.kind in (COMMAND, VALVES) and at > newest - KEPT_S:
                self._commands.add(at, message)
        self._due.clear()
        if math.isnan(self.time):
            return
        gap = min(newest - self.time, LOST_AFTER_S)
        self.skipped += newest - self.time
        # The valves may have switched during the skipped time.
        self.faults.inflate(np.ones((self.spec.segments, 2)), gap)
        self.ensemble.placed = False
        self.time = newest

    def _needed(self, message: Message) -> bool:
        if message.kind not in _MEASURED:
            return True
        interval = message.sent - self._used.get(message.source, -math.inf)
        if 0 < interval < _LEAST_INTERVAL_S:
            return False
        self._used[message.source] = message.sent
        if message.kind != POSES and abs(interval) > LOST_AFTER_S:
            # After a restart or a long silence of the robot, the pressures are unknown.
            self.faults.restart()
            self.interruptions += math.isfinite(interval)
        return True

    def _use(self, time: float, messages: Sequence[Message]) -> None:
        for message in messages:
            if message.kind in (COMMAND, VALVES):
                lost = self._commands.add(time, message)
                if lost is not None:
                    gap = min(lost.interval, LOST_AFTER_S)
                    self.faults.inflate(lost.change, gap)
        self.contact.update(messages, self.command_period)
        measured = [message for message in messages if message.kind in _MEASURED]
        if not measured:
            return
        if math.isnan(self.time):
            self.time = time
        self._advance(time)
        for message in measured:
            self._update_faults(time, message)
        self.ensemble.set_modules(self.faults.modules())
        # The fault detector must process bends before pressures, but the ensemble is
        # most accurate if the bends are processed last.
        for message in reversed(measured):
            self._correct_ensemble(message)
        self.ensemble.apply_odometry()
        kinds = {message.kind for message in measured}
        # Only motion capture frames contain information about the position and heading.
        bends_corrected = not kinds.isdisjoint((BENDS, PRESSURES))
        corrected = [bends_corrected, POSES in kinds, POSES in kinds]
        self._intervals.update(time, _state(self.ensemble), corrected)

    def _update_faults(self, time: float, message: Message) -> None:
        if message.kind == POSES:
            self._use_frame(message)
        elif message.kind == BENDS:
            self.faults.update(message.values)
        elif message.kind == SUPPLY:
            self.faults.update_supply(float(message.values))
        else:
            dt = min(time - self._heard[PRESSURES], 1.0)
            self.faults.update(pressures=message.values, dt=dt)
        self._heard[message.kind] = time

    def _correct_ensemble(self, message: Message) -> None:
        if message.kind == PRESSURES:
            innovation = self.ensemble.update_pressures(message.values)
        elif message.kind == BENDS:
            bends = self.faults.corrected(message.values).value
            working = SENSORS[self.faults.most_likely()] == SensorBehaviour.READS
            readings = np.where(working, bends, np.nan)
            innovation = self.ensemble.update_bends(readings)
        else:
            return
        self._note_innovation(message.kind, innovation)

    def _use_frame(self, message: Message) -> None:
        poses = np.full((self.spec.segments + 1, 3), np.nan)
        for name, row in zip(message.names, message.values, strict=True):
            if name in self._frames:
                poses[self._frames[name] - 1] = row[[0, 1, 3]]
        seen = ~np.isnan(poses[:, :2]).any(axis=1)
        if not seen.any():
            return
        self._missing = np.where(seen, 0, self._missing + 1)
        self._lost_markers = ~seen & (
            self._lost_markers | (self._missing >= MISSING_FRAMES)
        )
        bends = measured_bend(poses[:-1, 2], poses[1:, 2])
        self.faults.update(
            markers=bends, heading_noise_scale=self.ensemble.heading_noise_scale
        )
        self._note_innovation(POSES, self.ensemble.update_poses(poses))

    def _note_innovation(self, kind: str, innovation: np.ndarray) -> None:
        if not np.isnan(innovation).all():
            self._innovation[kind] = float(np.sqrt(np.nanmean(innovation**2)))

    def _advance(self, time: float) -> None:
        if time - self.time < _LEAST_STEP_S:
            return
        if time - self.time > LOST_AFTER_S:
            # The motion during a long pause is unknown, so the position is initialised
            # again with the next motion capture frame.
            self.ensemble.placed = False
            self.time = time - LOST_AFTER_S
        slots = math.ceil((time - self.time) / SLOT_S - 1e-6)
        begun = self.time
        dt = (time - self.time) / slots
        steps = math.ceil(dt / STEP_S - 1e-6)
        for k in range(1, slots + 1):
            duties = self._commands.at(
                self.time + (np.arange(steps) + 0.5) * dt / steps
            )
            self.command_period.add(self.time + dt / 2, duties[0])
            self.faults.predict(duties.mean(axis=0), dt)
            self.ensemble.predict(self._valve_input(duties), dt)
            self.time = begun + k * dt
        self._commands.forget(self.time - KEPT_S)

    def _present(self, now: float) -> EnsembleFilter:
        dt = min(now - self.time, LOST_AFTER_S)
        if dt < _LEAST_STEP_S:
            return self.ensemble
        steps = math.ceil(dt / _PRESENT_STEP_S - 1e-6)
        times = now - dt + (np.arange(steps) + 0.5) * dt / steps
        duties = self._commands.at(times, self.buffer.waiting(COMMAND))
        # Only a copy of the filter is advanced, because messages for this time may
        # still arrive.
        present = self.ensemble.copy(_PREDICTION_MEMBERS)
        present.predict(self._valve_input(duties), dt, _PRESENT_STEP_S)
        present.apply_odometry()
        return present

    def _valve_input(self, duties: np.ndarray) -> ValveInput:
        likely = self.faults.most_likely()
        chambers = CHAMBERS[likely]
        leak = np.where(
            chambers == ChamberBehaviour.LEAKS, LEAK_RATES[likely][:, None], 0.0
        )
        supply = np.full(len(likely), self.faults.supply.pressure)
        return ValveInput(valve_duty(duties, chambers), supply, leak)

    def detected(self) -> Iterator[DetectedFault]:
        """Yield the detected faults."""
        sound = self.faults.probability[:, 0]
        for number, name in self.faults.detected_faults.items():
            if number:
                probability = float(1 - sound[number - 1])
                yield DetectedFault(f"segment {number}", name, probability)
            else:
                yield DetectedFault("supply", LOW_SUPPLY_PRESSURE, 1.0)
        for i in np.flatnonzero(self._lost_markers):
            yield DetectedFault(f"connector {i + 1}", "lost_marker", 1.0)

    def _lost(self, now: float, placed: bool, pose_sd: np.ndarray) -> str:
        if now - self._heard[BENDS] > LOST_AFTER_S:
            return "no message from the robot"
        if not placed:
            return "motion capture has not seen the robot"
        if math.hypot(*pose_sd[:2]) > LARGEST_SD_M:
            return "the position is too uncertain"
        return ""

    def _estimate(self, now: float) -> Estimate:
        ensemble = self._present(now)
        state = _state(ensemble)
        self._intervals.predict(now, state)
        n = self.spec.segments
        bend = state.value[:n]
        pose = state.value[n:]
        sd = self._intervals.calibrated(state.sd)
        pose_sd = sd[n:]
        # The ensemble does not represent constant errors of sensors and transport
        # delays, so their variances are added.
        sensor_sd = self.faults.corrected(bend).sd
        delay_sd = TRANSPORT_DELAY_S * ensemble.mean("motion")[3:]
        x, y, turn = ensemble.odometry.twist
        c = math.cos(pose[2])
        s = math.sin(pose[2])
        return Estimate(
            time=now,
            bend=bend,
            bend_sd=np.sqrt(sd[:n] ** 2 + sensor_sd**2 + delay_sd**2),
            pose=pose,
            pose_sd=pose_sd,
            velocity=np.array([c * x - s * y, s * x + c * y, turn]),
            connectors=ensemble.poses().mean(axis=0),
            parameters=self.faults.parameters(),
            faults=tuple(self.detected()),
            off=dict(self._innovation),
            lost=self._lost(now, ensemble.placed, pose_sd),
        )


def _state(ensemble: EnsembleFilter) -> Estimates:
    names = "bend", "x", "y", "heading"
    return Estimates(
        np.concatenate([ensemble.mean(name) for name in names]),
        np.concatenate([ensemble.sd(name) for name in names]),
    )


def frames_of(pairs: Sequence[str], connectors: int) -> dict[str, int]:
    """Parse texts of the form ``BODY=CONNECTOR`` into connector numbers by body name.

    Raises:
        InputError: a pair is malformed, a connector is unknown, or a body or a
            connector is used twice.
    """
    frames: dict[str, int] = {}
    for pair in pairs:
        name, _, number = pair.rpartition("=")
        if not name or not number.isdigit() or not 1 <= int(number) <= connectors:
            raise InputError(
                f"--body {pair!r} is not allowed; write BODY=CONNECTOR with a"
                f" connector between 1 and {connectors}, for example head=1"
            )
        if name in frames or int(number) in frames.values():
            raise InputError(
                f"the body or the connector of {pair!r} is used twice; give each body a"
                " connector of its own"
            )
        frames[name] = int(number)
    return frames
