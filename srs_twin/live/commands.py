"""Valve duty cycles as a function of time, and detection of periodic commands."""

from __future__ import annotations

import bisect
import math
from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from srs_twin.live.messages import COMMAND, Message

DELAY_S = 0.01
"""Delay between sending a command and its effect, s (half a tick of the robot)."""
REPORTED_S = 0.02
"""Default time from the start of a valve state to its report, s (one robot tick)."""
SILENT_S = 0.2
"""Age of the last command above which the robot vents all chambers, s."""
KEPT_S = 1.0
"""Time for which past commands are stored, s."""
_LEAST_INTERVAL_S = 1e-3
"""Minimum interval between reports from different ticks, s."""
_GAP_FACTOR = 1.5
"""Multiple of the median command interval above which commands count as lost."""


def are_states(values: np.ndarray) -> bool:
    """Return whether a command contains valve states (−1 or 1) instead of duties."""
    return bool((np.abs(values) == 1.0).all())


def duty(values: np.ndarray) -> np.ndarray:
    """Convert valve states or duties to duties between 0 and 1."""
    if are_states(values):
        return np.asarray((values + 1) / 2)
    return np.asarray(np.clip(values, 0.0, 1.0))


class LostCommands(NamedTuple):
    """Change of the valve duties that was noticed late because commands were lost.

    Attributes:
        change: absolute change of each duty, shape (segments, 2).
        interval: time since the previous command, within which the duties changed, s.
    """

    change: np.ndarray
    interval: float


class CommandHistory:
    """Valve duties as a piecewise constant function of time.

    Initially, all chambers vent.
    """

    def __init__(self, segments: int) -> None:
        self._times = deque([-math.inf])
        self._duties = deque([np.zeros((segments, 2))])
        self._carrier = False
        self._reported = -math.inf
        self._report_s = REPORTED_S

    def add(self, time: float, message: Message) -> LostCommands | None:
        """Add a command or a report of valve states that was sent at a time (s).

        Returns:
            Effect of lost commands, or None if no loss was detected.
        """
        if message.kind == COMMAND:
            self._carrier = not are_states(message.values)
            start = time + DELAY_S
        elif self._carrier:
            # The duty of a pulse-width modulated valve cannot be determined from a
            # single valve state.
            return None
        else:
            # The shortest interval between reports is the robot's tick, because longer
            # intervals are due to lost reports.
            if _LEAST_INTERVAL_S < message.sent - self._reported < self._report_s:
                self._report_s = message.sent - self._reported
            self._reported = message.sent
            start = time - self._report_s
        new = duty(message.values)
        k = bisect.bisect(self._times, start)
        gap = start - self._times[k - 1]
        change = np.abs(new - self._duties[k - 1])
        usual = np.median(np.diff(self._times)) if len(self._times) > 2 else math.inf
        self._times.insert(k, start)
        self._duties.insert(k, new)
        if gap > _GAP_FACTOR * usual:
            return LostCommands(change, gap)
        return None

    def forget(self, before: float) -> None:
        """Remove the duties that ended before a time (s)."""
        while len(self._times) > 2 and self._times[1] < before:
            self._times.popleft()
            self._duties.popleft()

    def at(
        self, times: np.ndarray, waiting: Iterable[tuple[float, Message]] = ()
    ) -> np.ndarray:
        """Return the valve duties at given times, shape (times, segments, 2).

        Args:
            times: ascending times, shape (times,), s.
            waiting: sending times (s) and messages of commands that have not been added
                to the history yet.
        """
        starts = list(self._times)
        duties = list(self._duties)
        for time, message in waiting:
            k = bisect.bisect(starts, time + DELAY_S)
            starts.insert(k, time + DELAY_S)
            duties.insert(k, duty(message.values))
        rows = np.searchsorted(starts, times, side="right") - 1
        silent = times - np.asarray(starts)[rows] > SILENT_S
        return np.where(silent[:, None, None], 0.0, np.array(duties)[rows])


SLOT_S = 0.02
"""Duration of a time slot in which the commands are sampled, s."""
_KEPT = 250
"""Number of stored time slots."""
_LAGS = range(10, 126)
"""Possible periods of the commands, in time slots."""
_SAME = 0.1
"""Mean absolute difference between duties below which commands count as equal."""


class CommandPeriod:
    """Detector of periodic commands, which are sampled in time slots."""

    def __init__(self) -> None:
        self._slot = -1
        self._duties: deque[np.ndarray] = deque(maxlen=_KEPT)

    def add(self, time: float, duty: np.ndarray) -> None:
        """Store the valve duties for the time slot that contains a time (s)."""
        slot = math.floor(time / SLOT_S)
        if slot > self._slot + 1:  # A gap would change the lags of earlier commands.
            self._duties.clear()
        if slot > self._slot:
            self._duties.append(duty)
            self._slot = slot

    def commands(self, slots: int) -> np.ndarray:
        """Predict the duties in the next time slots, shape (slots, segments, 2).

        If the commands are periodic, the last period is repeated. Otherwise, the last
        command is held.
        """
        lag = self.period() or 1
        return np.array(self._duties)[-lag:][np.arange(slots) % lag]

    def period(self) -> int:
        """Return the period in time slots, or 0 if the commands are not periodic."""
        if not self._duties:
            return 0
        past = np.array(self._duties)
        recent = past[-_LAGS[-1] // 2 :]
        if not np.ptp(recent, axis=0).any():
            return 0
        least = _SAME
        period = 0
        for lag in _LAGS:
            before = past[-len(recent) - lag : -lag]
            if len(before) < len(recent):
                break
            difference = float(np.abs(recent - before).mean())
            if difference < least:
                least = difference
                period = lag
        return period
