"""Session: a shadow beside a robot in real time: messages in; estimates, commands and a journal out."""

from __future__ import annotations

import json
import math
import sys
import time
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from srs_twin.errors import InputError, SessionWarning
from srs_twin.io.file_sets import replace_files
from srs_twin.io.files import create_numbered_file, display_path
from srs_twin.io.saved_state import SavedState
from srs_twin.live.helm import TOO_SLOW, Helm
from srs_twin.live.journal import Journal
from srs_twin.live.links import Link
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
)
from srs_twin.live.mqtt import MqttLink
from srs_twin.live.prediction import Prediction
from srs_twin.live.shadow import Estimate, Shadow
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory

TICK_S = 0.02
PREDICTS_S = 0.5
STALE_S = 0.2
"""Age of an estimate from which the robot is vented instead of steered: so long a command holds."""
TOO_SLOW_S = 1.0
"""Age of an estimate that ends the steering."""
_WATCHED_S, _MOST_OVERRUNS = 1.0, 0.5
"""The session warns when this share of the ticks of so many seconds took longer than `TICK_S`."""
FLUSHES_S, SAVES_S = 1.0, 5.0
STATE = "state.npz"
SUMMARY, ESTIMATE = "shadow.json", "estimate.parquet"
KEPT = (SUMMARY, ESTIMATE, STATE)
"""Files in the session's folder that the next session replaces; journals and recordings are numbered."""
JOURNALS, RECORDINGS = "journal-{}.mcap", "recording-{}.rrd"
_KEPT = 1_000_000
_MOST_PROBLEMS = 100
_GOODBYE_S = 1.0
"""Longest wait for the broker to take the last message."""

View = Callable[[Estimate, Prediction | None], None]
Keys = Callable[[], Iterable[str]]
_WARM_S, _STROKE_S = 0.6, 0.16


def warm_up(spec: RobotSpec) -> None:
    """Have all compiled or loaded that a shadow of a robot computes with, before somebody waits for it."""
    shadow, n = Shadow(spec, members=8), spec.segments
    rows = np.outer(-spec.geometry.pitch * np.arange(n + 1), [1.0, 0.0, 0.0, 0.0])
    names = tuple(f"connector_{i}" for i in range(1, n + 2))
    for k in range(round(_WARM_S / TICK_S)):
        valves = np.full((n, 2), 1.0 if k * TICK_S % (2 * _STROKE_S) < _STROKE_S else -1.0)
        values = {COMMAND: valves, VALVES: valves, BENDS: np.zeros(n), PRESSURES: np.zeros((n, 2))}
        told = [Message(kind, "robot", k * TICK_S, k * TICK_S, each) for kind, each in values.items()]
        shadow.take(k * TICK_S, [*told, Message(POSES, "cameras", k * TICK_S, k * TICK_S, rows, names)])
    shadow.predict()


class Session:
    """One shadow and whoever it listens and talks to.

    Attributes:
        shadow: the twin of the robot.
        estimate: the last one; None before the robot's first message.
        faults: (part, fault) → when it was first named, s from the beginning.
        problems: what the session went on without, such as a file that cannot be written.
        ticks: how long each took, s.
        lag: largest age of an estimate when its tick ended, s.
        latency: from a reading's arrival to an estimate with it, s.
    """

    def __init__(
        self, shadow: Shadow, links: Sequence[Link], *, out: Path | None = None, helm: Helm | None = None,
        commands: MqttLink | None = None, views: Iterable[View] = (), keys: Keys = tuple,
    ) -> None:  # fmt: skip
        """Restore what an earlier session in the folder has learnt.

        Args:
            shadow: a new one.
            links: sources of messages.
            out: folder of journal and results; None: none are kept.
            helm: steers the robot; None: the session only listens.
            commands: link on which commands are sent, and control messages are obeyed.
            views: are shown estimates and predictions, ten times a second.
            keys: returns the control words that were typed since the last call, of `WORDS`.

        Raises:
            InputError: the folder cannot be written, or holds the state of another robot.
        """
        self.shadow, self._links, self._out, self._helm = shadow, list(links), out, helm
        self._commands, self._views, self._keys = commands, list(views), keys
        self._journal: Journal | None = None
        self.resumed = False
        if out is not None:
            if (out / STATE).exists():
                try:
                    shadow.restore(SavedState.read(out / STATE))
                except InputError as error:
                    raise InputError(
                        f"{error}; another --out keeps them apart, or remove {display_path(out / STATE)}"
                    ) from error
                self.resumed = True
            self._journal = Journal(create_numbered_file(out, JOURNALS))
        self.estimate: Estimate | None = None
        self.faults: dict[tuple[str, str], float] = {}
        self.problems: list[str] = []
        self.ticks, self.latency = deque[float](maxlen=_KEPT), deque[float](maxlen=_KEPT)
        self.lag = 0.0
        self._rows: list[np.ndarray] = []
        self._prediction: Prediction | None = None
        self._shown, self._first, self._stopped, self._slow = 0.0, 0.0, False, False
        self._pool = ThreadPoolExecutor(2)
        self._forecast: Future[Prediction] | None = None
        self._saving: Future[None] | None = None
        self._found: dict[str, Any] = {}

    def run(self, duration: float = math.inf, stop: Callable[[], bool] = lambda: False) -> dict[str, Any]:
        """Run until the session is stopped, a recording is over, or the helm has arrived; return the summary.

        However the run ends, a robot that was steered is vented and the files are written.
        """
        self._first = time.monotonic()
        try:
            self._live(duration, stop)
        finally:
            self._end()
        return self._found

    def _live(self, duration: float, stop: Callable[[], bool]) -> None:
        clock, begun, done = self._links[0].clock, self._first, 0
        if self._helm is not None:
            self._helm.follower.submit = self._pool.submit
        while not stop() and (tick := time.monotonic()) - self._first < duration and not self._over():
            self._tick(clock(), tick - self._first)
            self._collect()
            known = self.estimate is not None
            if known and self._forecast is None and done % round(PREDICTS_S / TICK_S) == 0:
                self._forecast = self._pool.submit(self.shadow.outlook())
            if self._journal is not None and done % round(FLUSHES_S / TICK_S) == 0:
                self._journal.flush()
            if self._out is not None and self._saving is None and done % round(SAVES_S / TICK_S) == 0:
                self._saving = self._pool.submit(self.shadow.save().write, self._out / STATE)
            if known and done % 6 == 0:
                self._show()
            self.ticks.append(time.monotonic() - tick)
            done += 1
            if done % round(_WATCHED_S / TICK_S) == 0:
                self._watch()
            left = begun + done * TICK_S - time.monotonic()
            if left > 0:
                time.sleep(left)
            elif left < -1.0:
                begun = time.monotonic() - done * TICK_S  # missed ticks are not made up for

    def _watch(self) -> None:
        """Warn if the machine is too slow: ticks that take longer than `TICK_S` delay all that follow."""
        if self._commands is None or self._slow:
            return
        took = np.array([self.ticks[-k] for k in range(1, round(_WATCHED_S / TICK_S) + 1)])
        if (took > TICK_S).mean() > _MOST_OVERRUNS:
            self._slow = True
            self._report(
                f"falling behind: ticks take {1e3 * np.median(took):.0f} ms instead of {1e3 * TICK_S:.0f}; "
                f"estimates are up to {self.lag:.2f} s old"
            )

    def _show(self) -> None:
        assert self.estimate is not None
        before = time.monotonic()
        for view in self._views:
            view(self.estimate, self._prediction)
        self._shown += time.monotonic() - before

    def _over(self) -> bool:
        steered = self._helm is not None and self._helm.finished
        return self._stopped or steered or all(link.counts["over"] for link in self._links)

    def _collect(self) -> None:
        """Take the results of other threads, and report their errors and the journal's."""
        if self._forecast is not None and self._forecast.done():
            if not self._forecast.cancelled() and (failed := self._forecast.exception()) is not None:
                self._report(f"a forecast failed: {failed!r}")
            elif not self._forecast.cancelled():
                self._prediction = self.shadow.hindsight.corrected(self._forecast.result())
            self._forecast = None
        if self._saving is not None and self._saving.done():
            if not self._saving.cancelled() and (error := self._saving.exception()) is not None:
                self._report(str(error) if isinstance(error, InputError) else f"{STATE}: {error!r}")
            self._saving = None
        if self._journal is not None and self._journal.trouble:
            self._report(self._journal.trouble)

    def _report(self, problem: str) -> None:
        """Warn of a problem, once, and keep it for the summary."""
        if problem not in self.problems and len(self.problems) < _MOST_PROBLEMS:
            self.problems.append(problem)
            warnings.warn(problem, SessionWarning, stacklevel=2)

    def _tick(self, now: float, since: float) -> None:
        """Take the messages that have come, and send a command."""
        messages = [message for link in self._links for message in link.received()]
        if self._commands is not None:  # a journal's control messages are history
            for word in [*self._keys(), *(each.names[0] for each in messages if each.kind == CONTROL)]:
                self._obey(word)
        if math.isnan(now):
            return
        if self._journal is not None:
            for message in messages:
                self._journal.write(message)
        self.estimate = found = self.shadow.take(now, messages)
        self.latency.extend(
            now - each.arrived + self.shadow.inbox.hold for each in messages if each.kind == BENDS
        )
        if found is not None:
            for part, fault, _ in found.faults:
                self.faults.setdefault((part, fault), since)
            self._rows.append(
                np.concatenate(
                    [[since], found.pose, found.pose_sd, found.bend, found.bend_sd, [bool(found.lost)]]
                )
            )
            del self._rows[:-_KEPT]
        if self._commands is None:
            return  # a journal waits
        command = None if self._helm is None or self._stopped else self._helm.step(found, self.shadow)
        lag = self._links[0].clock() - now
        self.lag = max(self.lag, lag)
        if self._helm is not None and command is not None:
            if lag > TOO_SLOW_S and self._helm.begun:
                self._helm.give_up(TOO_SLOW)
            self._commands.send(COMMAND, self._helm.vented() if lag > STALE_S else command)

    def _obey(self, word: str) -> None:
        """Obey a control word, of `WORDS`."""
        if word == STOP:
            self._stopped = True
            self._vent()
        elif self._helm is not None:
            self._helm.hold(word)

    def _vent(self) -> None:
        """Vent the robot if it is steered."""
        if self._commands is not None and self._helm is not None:
            self._commands.send(COMMAND, self._helm.vented())

    def _end(self) -> None:
        """Vent the robot, say so, and write the files; every step has its turn, also after one that fails."""
        seconds, error = time.monotonic() - self._first, sys.exception()
        with ExitStack() as steps:  # the last one comes first
            steps.callback(self._write)
            steps.callback(self._close_journal)
            # Before the journal is closed, which then has every message that the summary counts.
            steps.callback(self._summarise, seconds, error)
            steps.callback(self._pool.shutdown, cancel_futures=True)
            steps.callback(self._say_goodbye, error)
            steps.callback(self._vent)

    def _say_goodbye(self, error: BaseException | None) -> None:
        if self._commands is not None and self._helm is not None:
            text = "stopped" if error is None else f"stopped: {type(error).__name__}"
            self._commands.send(STATUS, text, wait_s=_GOODBYE_S)

    def _close_journal(self) -> None:
        if self._journal is not None:
            for message in (each for link in self._links for each in link.received()):
                self._journal.write(message)
            self._journal.close()

    def _summarise(self, seconds: float, error: BaseException | None) -> None:
        self._found = _finite(self._told(seconds, error))

    def _write(self) -> None:
        """Write the summary and the estimates."""
        self._collect()
        self._found["problems"] = self.problems
        if self._out is not None:
            with replace_files(self._out, (SUMMARY, ESTIMATE)) as fresh:
                if self._rows:
                    self._trajectory().to_parquet(fresh / ESTIMATE)
                (fresh / SUMMARY).write_text(json.dumps(self._found, indent=1) + "\n", "utf-8")

    def _trajectory(self) -> Trajectory:
        """Return estimates and their standard deviations over time."""
        table, n = np.array(self._rows), self.shadow.spec.segments
        names = [
            "time", "com_x", "com_y", "heading", "com_x_sd", "com_y_sd", "heading_sd",
            *(f"bend_{j}" for j in range(1, n + 1)), *(f"bend_sd_{j}" for j in range(1, n + 1)), "lost",
        ]  # fmt: skip
        units = {"com_x_sd": "m", "com_y_sd": "m"} | {
            name: "rad" for name in names if "heading_sd" in name or "bend_sd" in name
        }
        return Trajectory(
            dict(zip(names, table.T, strict=True)), units, metadata={"robot": self.shadow.spec.name}
        )

    def _told(self, seconds: float, error: BaseException | None) -> dict[str, Any]:
        counts: Counter[str] = Counter()
        for link in self._links:
            counts.update(dict(link.counts))  # a copy: its thread goes on counting
        dropped: Counter[str] = Counter()
        for (_, kind, what), count in self.shadow.inbox.counts.items():
            if what != "taken":
                dropped[f"{kind} {what}"] += count
        clocks = {
            who: {"offset_s": clock.offset, "jitter_s": clock.jitter}
            for who, clock in self.shadow.inbox.clocks.items()
        }
        found: dict[str, Any] = {
            "robot": self.shadow.spec.name, "seconds": seconds, "resumed": self.resumed,
            "error": None if error is None else f"{type(error).__name__}: {error}", "problems": [],
            "faults": [{"part": p, "fault": f, "time_s": at} for (p, f), at in self.faults.items()],
            "tick_ms": _quantiles(self.ticks), "latency_ms": _quantiles(self.latency),
            "overruns": int(sum(tick > TICK_S for tick in self.ticks)), "lag_s": self.lag,
            "view_share": self._shown / max(seconds, 1e-9),
            "messages": dict(counts), "dropped": dict(dropped), "clocks": clocks,
        }  # fmt: skip
        if self.estimate is not None:
            e = self.estimate
            found["estimate"] = {
                "lost": e.lost, "pose": e.pose.tolist(), "pose_sd": e.pose_sd.tolist(),
                "bend_rad": e.bend.tolist(), "bend_sd_rad": e.bend_sd.tolist(), "off": dict(e.off),
                "parameters": {
                    name: {"value": v.tolist(), "sd": s.tolist()} for name, (v, s) in e.parameters.items()
                },
            }  # fmt: skip
        if self._helm is not None:
            found["following"] = self._helm.told()
        return found


def _finite(value: Any) -> Any:
    """Return JSON values with null for every number that is not finite."""
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _quantiles(values: Iterable[float]) -> Mapping[str, float | None]:
    found = np.array(list(values)) * 1e3
    if not len(found):
        return {"median": None, "p99": None}
    return {"median": float(np.median(found)), "p99": float(np.quantile(found, 0.99))}
