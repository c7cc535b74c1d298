"""Session of a live twin in real time.

In each tick, the session passes the received messages to the live twin and can send a
command to the robot.
"""

from __future__ import annotations

import itertools
import json
import math
import sys
import time
import warnings
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from pydantic_core import from_json

from srs_twin.errors import InputError, SessionWarning
from srs_twin.io.file_sets import replace_files
from srs_twin.io.files import create_numbered_file, display_path
from srs_twin.io.saved_state import SavedState
from srs_twin.live.clocks import AGREEMENT_S
from srs_twin.live.estimate import Estimate, Prediction
from srs_twin.live.fault_hypotheses import START_S
from srs_twin.live.journal import Journal
from srs_twin.live.links import Link, MqttLink
from srs_twin.live.messages import (
    BENDS,
    COMMAND,
    CONTROL,
    POSES,
    PRESSURES,
    STATUS,
    STOP,
    VALVES,
    Message,
    strict_json,
)
from srs_twin.live.shadow import LOST_AFTER_S, Shadow
from srs_twin.live.steering import TOO_SLOW, EstimateSteering
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory

TICK_S = 0.02
"""Interval between updates of the live twin, s."""
STATE = "state.npz"
SUMMARY = "shadow.json"
ESTIMATE = "estimate.parquet"
KEPT = (SUMMARY, ESTIMATE, STATE)
"""Files in the output folder that the next session replaces.

Journals and recordings are kept, because their names are numbered.
"""
_MOST_ROWS = 1_000_000


def estimate_row(time: float, e: Estimate) -> np.ndarray:
    """Return an estimate and its time (s) as a row of `estimates_over_time`."""
    return np.concatenate(
        [[time], e.pose, e.pose_sd, e.bend, e.bend_sd, [bool(e.lost)]]
    )


def estimates_over_time(rows: Iterable[np.ndarray], spec: RobotSpec) -> Trajectory:
    """Return the time series of estimates with standard deviations."""
    segments = range(1, spec.segments + 1)
    units = {"com_x_sd": "m", "com_y_sd": "m", "heading_sd": "rad"}
    names = ["time", "com_x", "com_y", "heading", *units]
    names += [f"{name}_{j}" for name in ("bend", "bend_sd") for j in segments]
    units |= {f"bend_sd_{j}": "rad" for j in segments}
    columns = dict(zip([*names, "lost"], np.stack([*rows], axis=1), strict=True))
    return Trajectory(columns, units, metadata={"robot": spec.name})


def summary(
    shadow: Shadow, links: Sequence[Link], e: Estimate | None
) -> dict[str, object]:
    """Return message counts, clock offsets and an estimate as JSON values."""
    counts: Counter[str] = Counter()
    for link in links:
        # The counts are copied, because another thread changes them.
        counts.update(dict(link.counts))
    dropped: Counter[str] = Counter()
    for (_, kind, what), count in shadow.buffer.counts.items():
        if what != "taken":
            dropped[f"{kind} {what}"] += count
    clocks = {
        sender: {
            "offset_s": clock.offset,
            "jitter_s": clock.jitter,
            "jumps": clock.jumps,
            "age_uncertainty_s": clock.uncertainty,
        }
        for sender, clock in shadow.buffer.clocks.items()
    }
    found: dict[str, object] = {
        "robot": shadow.spec.name,
        "messages": dict(counts),
        "dropped": dict(dropped),
        "clocks": clocks,
    }
    if e is not None:
        found["estimate"] = {
            "lost": e.lost,
            "pose": e.pose.tolist(),
            "pose_sd": e.pose_sd.tolist(),
            "bend_rad": e.bend.tolist(),
            "bend_sd_rad": e.bend_sd.tolist(),
            "off": dict(e.off),
            "parameters": {
                name: {"value": known.value.tolist(), "sd": known.sd.tolist()}
                for name, known in e.parameters.items()
            },
        }
    return found


def write_results(
    folder: Path, found: Mapping[str, object], estimates: Trajectory | None
) -> None:
    """Write the summary and the time series of estimates to a folder."""
    with replace_files(folder, (SUMMARY, ESTIMATE)) as fresh:
        if estimates is not None:
            estimates.to_parquet(fresh / ESTIMATE)
        (fresh / SUMMARY).write_text(
            json.dumps(found, indent=1, allow_nan=False) + "\n", "utf-8"
        )


def _quantiles_ms(durations: Collection[float]) -> dict[str, float | None]:
    median = p99 = None
    if durations:
        median, p99 = np.quantile(np.array(durations) * 1e3, [0.5, 0.99]).tolist()
    return {"median": median, "p99": p99}


INTERVALS_S = {"predict": 0.5, "view": 0.12, "flush": 0.5, "save": 5.0, "watch": 1.0}
"""Interval at which each periodic task is repeated, s."""
_MOST_OVERRUNS = 0.5
"""Fraction of slow ticks above which a warning is issued."""
_WATCHED_TICKS = 50
"""Number of recent ticks among which slow ticks are counted."""
_WORK_S = 0.05
"""Maximum time for processing messages in each tick, s.

The remaining messages wait for the next tick, so that even a slow machine sends
commands and obeys control words.
"""
STALE_S = 0.2
"""Age of an estimate above which the chambers of a steered robot are vented, s."""
TOO_SLOW_S = 1.0
"""Age of an estimate above which the steering ends, s."""
JOURNALS = "journal-{}.mcap"
RECORDINGS = "recording-{}.rrd"
_RESTART_S = 1.0
"""Delay behind real time above which missed ticks are skipped, s."""
_KEPT = 1_000_000
"""Maximum number of ticks whose durations are kept."""
_MOST_PROBLEMS = 100
_GOODBYE_S = 1.0
"""Maximum time to wait until the last message has been sent, s."""
_WARM_UP_S = 0.6
"""Duration of the artificial messages in `warm_up`, s."""
_STROKE_S = 0.16
"""Half the period of the commands in `warm_up`, s."""

View = Callable[[Estimate, Prediction | None], None]
Keys = Callable[[], Iterable[str]]


def warm_up(spec: RobotSpec) -> None:
    """Load and compile all code that a live twin needs.

    Without this call, the first messages of the robot would wait for the compiler.
    """
    shadow = Shadow(spec, members=8)
    n = spec.segments
    rows = np.outer(-spec.geometry.pitch * np.arange(n + 1), [1.0, 0.0, 0.0, 0.0])
    names = tuple(f"connector_{i}" for i in range(1, n + 2))
    for k in range(round(_WARM_UP_S / TICK_S)):
        now = k * TICK_S
        valves = np.full((n, 2), 1.0 if now % (2 * _STROKE_S) < _STROKE_S else -1.0)
        values = {
            COMMAND: valves,
            VALVES: valves,
            BENDS: np.zeros(n),
            PRESSURES: np.zeros((n, 2)),
        }
        messages = [
            Message(kind, "robot", now, now, value) for kind, value in values.items()
        ]
        messages.append(Message(POSES, "cameras", now, now, rows, names))
        shadow.update(now, messages)
    shadow.predict()


def _restore(shadow: Shadow, path: Path) -> bool:
    if not path.exists():
        return False
    try:
        shadow.restore(SavedState.read(path))
    except InputError as error:
        raise InputError(
            f"{error}; give another folder with --out, or remove {display_path(path)}"
        ) from error
    return True


class Session:
    """Session that runs a live twin in real time.

    Attributes:
        estimate: latest estimate, or None before the first measurement.
        faults: time of the first detection of each fault, counted from the start of the
            session, s, keyed by part and fault.
        problems: descriptions of problems that did not end the session.
        ticks: durations of the ticks, s.
        lag: maximum age of an estimate at the time when its command is sent, s.
        latency: times between the arrival of bend readings and the estimates that use
            them, s. Empty for replayed journals.
        resumed: whether the state of an earlier session was restored from the output
            folder.
    """

    def __init__(
        self,
        shadow: Shadow,
        links: Sequence[Link],
        *,
        out: Path | None = None,
        steering: EstimateSteering | None = None,
        commands: MqttLink | None = None,
        views: Iterable[View] = (),
        keys: Keys = tuple,
    ) -> None:
        """Prepare a session, and restore the state of an earlier session if it exists.

        Args:
            shadow: live twin that has not processed any messages.
            links: sources of messages.
            out: output folder for the journal and the results, or None to write no
                files.
            steering: steering that computes the commands, or None to send no commands.
            commands: link for sending commands, contact estimates and the final status,
                or None to send nothing and ignore control words.
            views: functions that are called with the latest estimate and prediction
                about eight times per second.
            keys: function that returns the control words typed since its last call.

        Raises:
            InputError: the output folder cannot be written, or contains the state of
                another robot.
        """
        self.shadow = shadow
        self._links = list(links)
        self._out = out
        self._steering = steering
        self._commands = commands
        self._views = list(views)
        self._keys = keys
        self._journal: Journal | None = None
        self.resumed = False
        if out is not None:
            self.resumed = _restore(shadow, out / STATE)
            self._journal = Journal(create_numbered_file(out, JOURNALS))
        self.estimate: Estimate | None = None
        self.faults: dict[tuple[str, str], float] = {}
        self.problems: list[str] = []
        self.ticks = deque[float](maxlen=_KEPT)
        self.latency = deque[float](maxlen=_KEPT)
        self.lag = 0.0
        self.view_s = 0.0
        self._rows = deque[np.ndarray](maxlen=_MOST_ROWS)
        self._prediction: Prediction | None = None
        self._start = 0.0
        self._stopped = False
        self._slow = False
        self._next_times = dict.fromkeys(INTERVALS_S, math.inf)
        self._skipped = 0.0
        self._behind = 0.0
        self._uncertain: set[str] = set()
        # Two threads are used, so that a slow task such as planning does not delay the
        # predictions.
        self._pool = ThreadPoolExecutor(2)
        self._predicting: Future[Prediction] | None = None
        self._saving: Future[None] | None = None
        self._summary: dict[str, object] = {}

    def run(
        self, duration: float = math.inf, stop: Callable[[], bool] = lambda: False
    ) -> dict[str, object]:
        """Run the session and return its summary.

        The session ends after a stop request, at the end of a replayed journal, or at
        the end of the steering. A steered robot is then vented and the files are
        written, even after an error.

        Args:
            duration: maximum duration, s.
            stop: function that is called in each tick and returns whether to end the
                session.
        """
        self._start = time.monotonic()
        try:
            self._loop(duration, stop)
        finally:
            self._end()
        return self._summary

    def _loop(self, duration: float, stop: Callable[[], bool]) -> None:
        clock = self._links[0].clock
        start = self._start
        done = 0
        if self._steering is not None:
            self._steering.follower.submit = self._pool.submit
        while (
            not stop()
            and (tick := time.monotonic()) - self._start < duration
            and not self._over()
        ):
            self._tick(clock(), tick - self._start)
            self._report_connections()
            self._collect()
            self._submit(tick)
            if self.estimate is not None and self._is_due("view", tick):
                self._show(self.estimate)
            self.ticks.append(time.monotonic() - tick)
            done += 1
            if self._is_due("watch", tick):
                self._watch()
                self._report_senders()
            left = start + done * TICK_S - time.monotonic()
            if left > 0:
                time.sleep(left)
            elif left < -_RESTART_S:
                start = time.monotonic() - done * TICK_S

    def _is_due(self, work: str, now: float) -> bool:
        """Return whether periodic work is due at a time (s), and restart its timer.

        The timer starts at the first call.
        """
        is_due = now >= self._next_times[work]
        if is_due or math.isinf(self._next_times[work]):
            self._next_times[work] = now + INTERVALS_S[work]
        return is_due

    def _submit(self, now: float) -> None:
        # No predictions are computed while the machine is too slow for all messages.
        can_predict = (
            self.estimate is not None and self._predicting is None and not self._behind
        )
        if can_predict and self._is_due("predict", now):
            self._predicting = self._pool.submit(self.shadow.prediction_task())
        if self._journal is not None and self._is_due("flush", now):
            self._journal.flush()
        if self._out is None or self._saving is not None:
            return
        is_first = not self.ticks
        if self._is_due("save", now) or is_first:
            # This thread copies the state, and another thread writes the file.
            save = self.shadow.save().write
            self._saving = self._pool.submit(save, self._out / STATE)

    def _watch(self) -> None:
        skipped = self.shadow.skipped - self._skipped
        self._skipped = self.shadow.skipped
        self._behind = self._behind + skipped if skipped else 0.0
        if skipped:
            self._report(
                "this machine is too slow for all messages, so some are skipped, and"
                " the position is unknown until the next motion capture frame"
            )
        durations = list(itertools.islice(reversed(self.ticks), _WATCHED_TICKS))
        slow = float(np.mean(np.array(durations) > TICK_S)) > _MOST_OVERRUNS
        if slow and self._commands is not None and not self._slow:
            self._slow = True
            self._report(
                "this machine is too slow: ticks take"
                f" {1e3 * np.median(durations):.0f} ms instead of {1e3 * TICK_S:.0f},"
                f" so estimates are up to {self.lag:.2f} s old"
            )
        if (
            self._steering is not None
            and self._steering.begun
            and self._behind > TOO_SLOW_S
        ):
            self._steering.give_up(TOO_SLOW)

    def _report_connections(self) -> None:
        for link in self._links:
            if change := link.connection_change():
                self._report(change)

    def _report_senders(self) -> None:
        if self.shadow.interruptions:
            self._report(
                f"interruption {self.shadow.interruptions}: the robot restarted, or"
                f" sent nothing for more than {LOST_AFTER_S:g} s; no faults are"
                f" detected in the next {START_S:g} s"
            )
        for sender, clock in self.shadow.buffer.clocks.items():
            if clock.uncertainty > AGREEMENT_S and sender not in self._uncertain:
                self._uncertain.add(sender)
                self._report(
                    f"{sender}: its clock was set back, or its messages take longer"
                    " than before, so the age of its messages is uncertain by"
                    f" {clock.uncertainty:.1f} s"
                )

    def _show(self, estimate: Estimate) -> None:
        before = time.monotonic()
        for view in self._views:
            view(estimate, self._prediction)
        self.view_s += time.monotonic() - before

    def _over(self) -> bool:
        steered = self._steering is not None and self._steering.finished
        played = all(link.over for link in self._links) and not self.shadow.waits
        return self._stopped or steered or played

    def _collect(self) -> None:
        predicting = self._predicting
        if predicting is not None and predicting.done():
            self._predicting = None
            if not predicting.cancelled():
                self._adopt(predicting)
        saving = self._saving
        if saving is not None and saving.done():
            self._saving = None
            error = None if saving.cancelled() else saving.exception()
            if isinstance(error, InputError):
                self._report(str(error))
            elif error is not None:
                self._report(f"{STATE}: {error!r}")
        if self._journal is not None and self._journal.trouble:
            self._report(self._journal.trouble)

    def _adopt(self, predicting: Future[Prediction]) -> None:
        if (error := predicting.exception()) is not None:
            self._report(f"a forecast failed ({error!r})")
            return
        calibration = self.shadow.prediction_calibration
        self._prediction = calibration.inflate(predicting.result())

    def _report(self, problem: str) -> None:
        if problem not in self.problems and len(self.problems) < _MOST_PROBLEMS:
            self.problems.append(problem)
            warnings.warn(problem, SessionWarning, stacklevel=2)

    def _tick(self, now: float, since: float) -> None:
        if math.isnan(now):
            return
        messages = self._receive()
        if self._commands is not None:  # Control words in journals are ignored.
            sent = [message.names[0] for message in messages if message.kind == CONTROL]
            for word in [*self._keys(), *sent]:
                self._obey(word)
        self._record(messages)
        if self._stopped:
            return
        # All messages of a replayed journal are processed, even if the playback is
        # faster than the machine.
        work_s = math.inf if self._commands is None else _WORK_S
        estimate = self.shadow.update(now, messages, work_s=work_s)
        self.estimate = estimate
        if estimate is not None:
            for fault in estimate.faults:
                self.faults.setdefault((fault.part, fault.name), since)
            self._rows.append(estimate_row(since, estimate))
        if self._commands is not None:
            hold = self.shadow.buffer.hold
            # The latency includes the time for which the buffer holds a message.
            self.latency.extend(
                now - message.arrived + hold
                for message in messages
                if message.kind == BENDS
            )
            self._send(self._commands, now)

    def _receive(self) -> list[Message]:
        return [message for link in self._links for message in link.received()]

    def _record(self, messages: Iterable[Message]) -> None:
        if self._journal is not None:
            for message in messages:
                self._journal.write(message)

    def _send(self, link: MqttLink, now: float) -> None:
        contact = self.shadow.contact.estimate
        if contact is not None:
            link.send_contact(contact)
        steering = self._steering
        command = None
        if steering is not None:
            command = steering.step(self.estimate, self.shadow)
        lag = self._links[0].clock() - now
        self.lag = max(self.lag, lag)
        if steering is None or command is None:
            return
        if lag > TOO_SLOW_S and steering.begun:
            steering.give_up(TOO_SLOW)
        # A command that is based on an old estimate could steer the robot into an
        # obstacle.
        link.send(COMMAND, steering.vented() if lag > STALE_S else command)

    def _obey(self, word: str) -> None:
        if word == STOP:
            self._stopped = True
            self._vent()
        elif self._steering is not None:
            self._steering.control(word)

    def _vent(self) -> None:
        if self._commands is not None and self._steering is not None:
            self._commands.send(COMMAND, self._steering.vented())

    def _end(self) -> None:
        seconds = time.monotonic() - self._start
        error = sys.exception()
        with ExitStack() as steps:
            steps.callback(self._write)
            steps.callback(self._close_journal)
            # The summary is created before the journal is closed, so that every message
            # counted in the summary is also in the journal.
            steps.callback(self._summarise, seconds, error)
            steps.callback(self._pool.shutdown, cancel_futures=True)
            steps.callback(self._say_goodbye, error)
            steps.callback(self._vent)

    def _say_goodbye(self, error: BaseException | None) -> None:
        if self._commands is not None and self._steering is not None:
            text = "stopped"
            if error is not None:
                text += f": {type(error).__name__}"
            self._commands.send(STATUS, text, wait_s=_GOODBYE_S)

    def _close_journal(self) -> None:
        if self._journal is not None:
            self._record(self._receive())
            self._journal.close()

    def _summarise(self, seconds: float, error: BaseException | None) -> None:
        document = summary(self.shadow, self._links, self.estimate) | {
            "seconds": seconds,
            "resumed": self.resumed,
            "error": None if error is None else f"{type(error).__name__}: {error}",
            "problems": [],
            "faults": [
                {"part": part, "fault": fault, "time_s": time_s}
                for (part, fault), time_s in self.faults.items()
            ],
            "tick_ms": _quantiles_ms(self.ticks),
            "latency_ms": _quantiles_ms(self.latency),
            "overruns": sum(tick > TICK_S for tick in self.ticks),
            "lag_s": self.lag,
            "skipped_s": self.shadow.skipped,
            "view_fraction": self.view_s / max(seconds, 1e-9),
        }
        if self._steering is not None:
            document["following"] = self._steering.summary()
        self._summary = from_json(strict_json(document))

    def _write(self) -> None:
        self._collect()
        self._summary["problems"] = self.problems
        if self._out is not None:
            estimates = None
            if self._rows:
                estimates = estimates_over_time(self._rows, self.shadow.spec)
            write_results(self._out, self._summary, estimates)
