"""Recordings with the logs of their valves, for fits and replays.

The default log of ``walk.csv`` is ``walk.valves.csv`` in the same folder.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from srs_twin.errors import InputError
from srs_twin.plants.base import Pose
from srs_twin.pneumatics import Schedule
from srs_twin.recordings.formats import BAG_SUFFIXES
from srs_twin.recordings.recording import LONGEST_GAP, Recording, read_motion
from srs_twin.recordings.recording_map import NO_MAP, RecordingMap
from srs_twin.recordings.signals.clock import join
from srs_twin.recordings.signals.logs import is_bend_log, read_bends, read_valves
from srs_twin.recordings.signals.valve_log import ValveLog
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory

_LOG = ".valves.csv"
NO_MARKERS = "bends alone do not tell where a robot crawled; markers are wanted"
_LEAST_OPENINGS = 4
_EVEN = 0.05  # largest deviation of an opening from a periodic one, in periods
_CARRIER = 0.07  # s: shortest interval between two openings of a gait; those of a carrier are shorter
_STILL = 1e-9  # s


@dataclass(frozen=True)
class RecordingReader:
    """Reader of recordings and their logs, with common settings.

    Attributes:
        up: axis of the file that points up, one of `floor.UPS`.
        layout: marker layout, one of `body.LAYOUTS`.
        head: name of the column of the marker at the head; None: the end towards which the robot crawls.
        map: recording map: quantities of markers and columns.
        longest_gap_s: longest gap that is filled, s.
        offset_s: clock offset added to the times of the log, s; None: estimated.
        gait_frequency_hz: gait frequency, Hz; None: the frequency of the valve pattern.
    """

    up: str = "auto"
    layout: str = "auto"
    head: str | None = None
    map: RecordingMap = NO_MAP
    longest_gap_s: float = LONGEST_GAP
    offset_s: float | None = None
    gait_frequency_hz: float | None = None

    def motion(self, path: str, spec: RobotSpec, frequency: float | None = None) -> Recording:
        """Read a captured motion; see `read_motion`.

        Args:
            path: recording.
            spec: the robot.
            frequency: gait frequency if the reader has none, Hz.
        """
        given: dict[str, Any] = {"up": self.up, "layout": self.layout, "head": self.head, "map": self.map}
        return read_motion(path, spec, **given, **self._signal_settings(frequency))

    def body(self, path: str, spec: RobotSpec, frequency: float | None = None) -> Recording:
        """Read the measured motion of the body, from markers or a bend log; as `motion`."""
        if is_bend_log(path, self.map):
            return read_bends(path, spec, map=self.map, **self._signal_settings(frequency))
        return self.motion(path, spec, frequency)

    def _signal_settings(self, frequency: float | None) -> dict[str, Any]:
        given = self.gait_frequency_hz
        frequency = frequency if given is None else given
        return {"longest_gap_s": self.longest_gap_s, "gait_frequency_hz": frequency}

    def joined(self, body: Recording, log: ValveLog, spec: RobotSpec, *, one_file: bool) -> Recording:
        """Join a motion with a log on one clock; columns of the same file already share it.

        Raises:
            InputError: as `join`.
        """
        offset = 0.0 if one_file and self.offset_s is None else self.offset_s
        return join(body, log, spec, offset=offset)

    def take(self, path: str, valves: str, spec: RobotSpec) -> Recording:
        """Read a recording and its log, and synchronise their clocks.

        Raises:
            InputError: as `body`, `read_valves` and `joined`.
        """
        try:
            log = read_valves(valves, spec, self.map)
        except InputError:
            self.body(path, spec)  # read first, so its errors come first: the default log is named after it
            raise
        return self.joined(self.body(path, spec, repeats(log)), log, spec, one_file=path == valves)


def logs_of(takes: Sequence[str], given: Sequence[str]) -> list[str]:
    """Return the log of each take.

    Args:
        takes: paths of motions.
        given: their logs in the same order; empty for the default logs.

    Raises:
        InputError: more or fewer logs than takes.
    """
    if not given:
        return [_log_of(Path(take)) for take in takes]
    if len(given) != len(takes):
        wanted = f"give one for each, in their order ({', '.join(takes)})"
        otherwise = f"or none where each lies beside its recording as NAME{_LOG}"
        raise InputError(f"{len(given)} logs of valves for {len(takes)} recordings; {wanted}, {otherwise}")
    return list(given)


def _log_of(take: Path) -> str:
    """Return the default log of a recording, or the recording if it may contain its own log."""
    if not take.name:
        return str(take)  # the current folder, which is not a recording
    beside = take.with_name(take.stem + _LOG)
    own = take.suffix.lower() in BAG_SUFFIXES or take.is_dir()
    return str(take if own and not os.path.lexists(beside) else beside)


def repeats(log: ValveLog) -> float | None:
    """Return the frequency at which all chambers open periodically, Hz; None if they do not.

    The first opening is ignored, because a gait may begin within a period. Successive openings of a carrier,
    which are shorter than those of any gait, count as one.
    """
    if log.kind != "valve":
        return None
    opened = (log.values[1:] == 1) & (log.values[:-1] != 1)
    periods = []
    for column in opened.reshape(len(opened), -1).T:
        times = log.time[1:][column]
        times = times[np.append(True, np.diff(times) > _CARRIER)[: len(times)]][1:]
        if len(times) < _LEAST_OPENINGS:
            return None
        gaps = np.diff(times)
        period = float(gaps.mean())
        if np.abs(gaps - period).max() > _EVEN * period:
            return None
        periods.append(period)
    period = float(np.mean(periods))
    return 1 / period if np.ptp(periods) <= _EVEN * period else None


def only_bends(trajectory: Trajectory) -> bool:
    """Return whether a recording contains only bends."""
    return bool(trajectory.metadata.get("bends_only"))


def pressures(recording: Recording) -> tuple[np.ndarray, np.ndarray] | None:
    """Return recorded pressures; None if valve states were recorded.

    Returns:
        Times from the recording's first sample on (rows,), s, and gauge pressures (rows, segments, 2), Pa.
    """
    log = recording.valves
    if log is None or log.kind == "valve":
        return None
    time, values = log.breakpoints()
    return time - recording.trajectory.time[0], values


def commands(recording: Recording, name: str) -> Schedule:
    """Return the valve states from the first sample on; all vent if pressures were recorded.

    Raises:
        InputError: there is no log.
    """
    log = recording.valves
    if log is None:
        raise InputError(f"{name}: no log of valves or pressures; join one with the recording")
    if log.kind != "valve":
        vented = np.full((1, *log.values.shape[1:]), -1, dtype=np.int8)
        time = recording.trajectory.time
        return Schedule(float(time[-1] - time[0]), np.zeros(1), vented)
    schedule = log.schedule()
    begin = min(max(float(recording.trajectory.time[0] - log.time[0]), 0.0), schedule.span - _STILL)
    return schedule.slice(begin, schedule.span)


def starts_at_rest(recording: Recording) -> bool:
    """Return whether the chambers are empty at the start of a recording, like those of a plant."""
    log = recording.valves
    if log is None:
        return True
    before = log.values[log.time <= recording.trajectory.time[0] + _STILL]
    return bool((before == -1).all() if log.kind == "valve" else (np.abs(before) < 1e3).all())


def start_pose(recording: Recording) -> Pose:
    """Return the initial pose of the body: its mean until the first valve opens."""
    trajectory, log = recording.trajectory, recording.valves
    moves = trajectory.time[0]
    if log is not None:
        busy = (log.values > (0 if log.kind == "valve" else 1e3)).any(axis=(1, 2))
        moves = log.time[np.argmax(busy)] if busy.any() else trajectory.time[-1]
    still = trajectory.time <= max(moves, trajectory.time[0]) + _STILL
    x, y = trajectory.com[still].mean(axis=0)
    return float(x), float(y), float(trajectory["heading"][still].mean())
