"""Session: a shadow beside a robot in real time: messages in; estimates, commands and a journal out."""

from __future__ import annotations

import itertools
import json
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.file_sets import replaced
from srs_twin.io.files import shown
from srs_twin.live.helm import Helm
from srs_twin.live.journal import Journal
from srs_twin.live.links import Link
from srs_twin.live.messages import BENDS, COMMAND, POSES, PRESSURES, STATUS, VALVES, Message
from srs_twin.live.mqtt import MqttLink
from srs_twin.live.prediction import Prediction
from srs_twin.live.shadow import Estimate, Shadow
from srs_twin.memory import SavedState
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory

TICK_S = 0.02
PREDICTS_S = 0.5
FLUSHES_S, SAVES_S = 1.0, 5.0
STATE = "state.npz"
SUMMARY, ESTIMATE = "shadow.json", "estimate.parquet"
KEPT = (SUMMARY, ESTIMATE, STATE)
"""Files in the session's folder that the next session replaces; journals and recordings are numbered."""
_KEPT = 1_000_000

View = Callable[[Estimate, Prediction | None], None]
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
        ticks: how long each took, s.
        latency: from a reading's arrival to an estimate with it, s.
    """

    def __init__(
        self, shadow: Shadow, links: Sequence[Link], *, out: Path | None = None, helm: Helm | None = None,
        commands: MqttLink | None = None, views: Iterable[View] = (),
    ) -> None:  # fmt: skip
        """Take up what an earlier session in the folder has learnt.

        Args:
            shadow: that knows nothing yet.
            links: where messages come from.
            out: folder of journal and results; None: none are kept.
            helm: who steers the robot; None: nobody here.
            commands: where its commands go.
            views: who is shown estimates and predictions, ten times a second.

        Raises:
            InputError: the folder cannot be written, or holds the state of another robot.
        """
        self.shadow, self._links, self._out, self._helm = shadow, list(links), out, helm
        self._commands, self._views = commands, list(views)
        self._journal: Journal | None = None
        self.resumed = False
        if out is not None:
            numbers = itertools.count(1)
            self._journal = Journal(
                next(path for k in numbers if not (path := out / f"journal-{k}.mcap").exists())
            )
            if (out / STATE).exists():
                try:
                    shadow.restore(SavedState.read(out / STATE))
                except InputError as error:
                    raise InputError(
                        f"{error}; another --out keeps them apart, or remove {shown(out / STATE)}"
                    ) from error
                self.resumed = True
        self.estimate: Estimate | None = None
        self.faults: dict[tuple[str, str], float] = {}
        self.ticks, self.latency = deque[float](maxlen=_KEPT), deque[float](maxlen=_KEPT)
        self._rows: list[np.ndarray] = []
        self._prediction: Prediction | None = None
        self._shown = 0.0

    def run(self, duration: float = math.inf, stop: Callable[[], bool] = lambda: False) -> dict[str, Any]:
        """Live until told to stop, a recording is over, or the helm has arrived; return what came out."""
        clock = self._links[0].clock
        first = begun = time.monotonic()
        done = 0
        pending: Future[Prediction] | None = None
        with ThreadPoolExecutor(2) as pool:
            if self._helm is not None:
                self._helm.follower.submit = pool.submit
            while not stop() and (tick := time.monotonic()) - first < duration and not self._over():
                self._tick(clock(), tick - first)
                if pending is not None and pending.done():
                    self._prediction, pending = self.shadow.hindsight.corrected(pending.result()), None
                if pending is None and self.estimate is not None and done % round(PREDICTS_S / TICK_S) == 0:
                    pending = pool.submit(self.shadow.outlook())
                if self._journal is not None and done % round(FLUSHES_S / TICK_S) == 0:
                    self._journal.flush()
                if self._out is not None and done % round(SAVES_S / TICK_S) == 0:
                    pool.submit(self.shadow.save().write, self._out / STATE)
                if self._views and done % 6 == 0 and self.estimate is not None:
                    before = time.monotonic()
                    for view in self._views:
                        view(self.estimate, self._prediction)
                    self._shown += time.monotonic() - before
                self.ticks.append(time.monotonic() - tick)
                done += 1
                left = begun + done * TICK_S - time.monotonic()
                if left > 0:
                    time.sleep(left)
                elif left < -1.0:
                    begun = time.monotonic() - done * TICK_S  # what was missed is not made up for
        return self._end(time.monotonic() - first)

    def _over(self) -> bool:
        steered = self._helm is not None and self._helm.finished
        return steered or all(link.counts["over"] for link in self._links)

    def _tick(self, now: float, since: float) -> None:
        """Take what has come, and command."""
        if math.isnan(now):
            return
        messages = [message for link in self._links for message in link.received()]
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
        if self._helm is not None and self._commands is not None:
            command = self._helm.step(found, self.shadow)
            if command is not None:
                self._commands.send(COMMAND, command)

    def _end(self, seconds: float) -> dict[str, Any]:
        """Vent the robot if it was steered, write what came out, and return it."""
        if self._commands is not None and self._helm is not None:
            self._commands.send(COMMAND, self._helm.vented())
            self._commands.send(STATUS, "stopped")
        found = self._told(seconds)
        if self._journal is not None:
            for message in (each for link in self._links for each in link.received()):
                self._journal.write(message)
            self._journal.close()
        if self._out is not None:
            with replaced(self._out, (SUMMARY, ESTIMATE)) as fresh:
                if self._rows:
                    self._trajectory().to_parquet(fresh / ESTIMATE)
                (fresh / SUMMARY).write_text(json.dumps(found, indent=1, allow_nan=False) + "\n", "utf-8")
        return found

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

    def _told(self, seconds: float) -> dict[str, Any]:
        counts: Counter[str] = Counter()
        for link in self._links:
            counts.update(link.counts)
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
            "faults": [{"part": p, "fault": f, "time_s": at} for (p, f), at in self.faults.items()],
            "tick_ms": _quantiles(self.ticks), "latency_ms": _quantiles(self.latency),
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


def _quantiles(values: Iterable[float]) -> Mapping[str, float | None]:
    found = np.array(list(values)) * 1e3
    if not len(found):
        return {"median": None, "p99": None}
    return {"median": float(np.median(found)), "p99": float(np.quantile(found, 0.99))}
