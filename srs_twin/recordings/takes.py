"""Takes: recordings with the logs of their valves, as what fits and replays ask for.

The log of ``walk.csv`` is ``walk.valves.csv`` beside it, unless another is named.
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
from srs_twin.recordings.recording import LONGEST_GAP, Recording, read_motion
from srs_twin.recordings.recording_map import NO_MAP, RecordingMap
from srs_twin.recordings.signals.clock import join
from srs_twin.recordings.signals.logs import is_bend_log, read_bends, read_valves
from srs_twin.recordings.signals.valve_log import ValveLog
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory

_LOG = ".valves.csv"
_WITH_LOGS = (".mcap", ".bag", ".db3")
NO_MARKERS = "bends alone do not tell where a robot crawled; markers are wanted"
_LEAST_OPENINGS = 4
_EVEN = 0.05  # of a period: by how much openings may come early or late
_CARRIER = 0.07  # s: openings nearer to each other are those of a carrier
_STILL = 1e-9  # s


@dataclass(frozen=True)
class RecordingReader:
    """Reads recordings and their logs, with settings for all of them.

    Attributes:
        up: axis of the file that points up, one of `floor.UPS`.
        layout: of the markers, one of `body.LAYOUTS`.
        head: name of the column of the marker at the head; None: the end towards which the robot crawls.
        map: which marker or column is what.
        longest_gap_s: longest gap that is filled, s.
        offset_s: what to add to the log's times, s; None: estimated.
        gait_frequency_hz: Hz; None: as the valves repeat themselves.
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
            path: of the file.
            spec: the robot on it.
            frequency: of the gait where none was given, Hz.
        """
        given: dict[str, Any] = {"up": self.up, "layout": self.layout, "head": self.head, "map": self.map}
        return read_motion(path, spec, **given, **self._stretch(frequency))

    def body(self, path: str, spec: RobotSpec, frequency: float | None = None) -> Recording:
        """Read what was measured of the body: a captured motion, or a log of its bends; as `motion`."""
        if is_bend_log(path, self.map):
            return read_bends(path, spec, map=self.map, **self._stretch(frequency))
        return self.motion(path, spec, frequency)

    def _stretch(self, frequency: float | None) -> dict[str, Any]:
        given = self.gait_frequency_hz
        frequency = frequency if given is None else given
        return {"longest_gap_s": self.longest_gap_s, "gait_frequency_hz": frequency}

    def joined(self, body: Recording, log: ValveLog, spec: RobotSpec, *, one_file: bool) -> Recording:
        """Put what was measured and a log on one clock, which they share where both are columns of one file.

        Raises:
            InputError: as `join`.
        """
        offset = 0.0 if one_file and self.offset_s is None else self.offset_s
        return join(body, log, spec, offset=offset)

    def take(self, path: str, valves: str, spec: RobotSpec) -> Recording:
        """Read what was measured and its log, and put both on one clock.

        Raises:
            InputError: as `body`, `read_valves` and `joined`.
        """
        try:
            log = read_valves(valves, spec, self.map)
        except InputError:
            self.body(path, spec)  # what is wrong with the recording is said first: the log is named after it
            raise
        return self.joined(self.body(path, spec, repeats(log)), log, spec, one_file=path == valves)


def logs_of(takes: Sequence[str], given: Sequence[str]) -> list[str]:
    """Return the log of each take.

    Args:
        takes: paths of motions.
        given: their logs in the same order; none: those that lie beside them.

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
    """Return the log beside a take, or the take where it may hold its own."""
    if not take.name:
        return str(take)  # the current folder, which is no recording
    beside = take.with_name(take.stem + _LOG)
    own = take.suffix.lower() in _WITH_LOGS or take.is_dir()
    return str(take if own and not os.path.lexists(beside) else beside)


def repeats(log: ValveLog) -> float | None:
    """Return the frequency at which all chambers open evenly, Hz; None where they do not.

    The first opening is left out: a gait may begin with a part of a period. Openings of a carrier, which come
    sooner than any gait's, count as one.
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
    """Say whether of a measured body the bends alone are known."""
    return bool(trajectory.metadata.get("bends_only"))


def pressures(recording: Recording) -> tuple[np.ndarray, np.ndarray] | None:
    """Return recorded pressures, None where valves were recorded.

    Returns:
        Times from the recording's first sample on (rows,), s, and gauge pressures (rows, segments, 2), Pa.
    """
    log = recording.valves
    if log is None or log.kind == "valve":
        return None
    time, values = log.breakpoints()
    return time - recording.trajectory.time[0], values


def commands(recording: Recording, name: str) -> Schedule:
    """Return the valves from the recording's first sample on; all venting where pressures were recorded.

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
    return schedule.part(begin, schedule.span)


def starts_at_rest(recording: Recording) -> bool:
    """Say whether chambers are empty as a recording begins, as those of a plant are."""
    log = recording.valves
    if log is None:
        return True
    before = log.values[log.time <= recording.trajectory.time[0] + _STILL]
    return bool((before == -1).all() if log.kind == "valve" else (np.abs(before) < 1e3).all())


def start_pose(recording: Recording) -> Pose:
    """Return where the body lies as the recording begins: its mean until air comes."""
    trajectory, log = recording.trajectory, recording.valves
    moves = trajectory.time[0]
    if log is not None:
        busy = (log.values > (0 if log.kind == "valve" else 1e3)).any(axis=(1, 2))
        moves = log.time[np.argmax(busy)] if busy.any() else trajectory.time[-1]
    still = trajectory.time <= max(moves, trajectory.time[0]) + _STILL
    x, y = trajectory.com[still].mean(axis=0)
    return float(x), float(y), float(trajectory["heading"][still].mean())
