"""CommandHistory: duties of the valves over time, from commands and from reports of the robot."""

from __future__ import annotations

import bisect
import math
from collections import deque
from collections.abc import Iterable, Sequence

import numpy as np

from srs_twin.live.messages import COMMAND, VALVES, Message

DELAY_S = 0.01
"""Delay from sending a command to its effect: half a tick of the robot."""
REPORTED_S = 0.02
"""Time before a report during which the valves had the reported states: one tick of the robot."""
SILENT_S = 0.2
"""Age of a command above which the robot vents."""
KEPT_S = 1.0
"""Time for which commands are kept."""
_LEAST_INTERVAL_S = 1e-3
"""Interval between reports below which they belong to one transmission."""
_GAP_FACTOR = 1.5
"""Ratio of an interval between commands to the usual interval above which commands were lost."""


def duty(message: Message) -> np.ndarray:
    """Return the fraction of time in which each valve fills, from valve states or duties."""
    if np.isin(message.values, (-1.0, 1.0)).all():
        return np.asarray((message.values + 1) / 2)
    return np.clip(message.values, 0.0, 1.0)


class CommandHistory:
    """Duties of the valves over time; each holds until the next one, and initially all chambers vent."""

    def __init__(self, segments: int) -> None:
        """Create an empty history."""
        self._times, self._duties = deque([-math.inf]), deque([np.zeros((segments, 2))])
        self._carrier = False
        self._reported, self._report_s = -math.inf, REPORTED_S

    def add(self, time: float, message: Message) -> tuple[np.ndarray, float] | None:
        """Add a command, or the valve states that the robot reports; either message may be lost.

        Returns:
            Change of the duty, shape (segments, 2), and the interval in which it happened (s), if commands
            before this one were lost; otherwise None.
        """
        if message.kind == COMMAND:
            self._carrier = not np.isin(message.values, (-1.0, 1.0)).all()
        elif self._carrier:  # the states at one time do not determine the duty of a carrier
            return None
        if message.kind == VALVES:
            # The shortest interval between reports is the robot's tick; longer ones are due to losses.
            if _LEAST_INTERVAL_S < message.sent - self._reported < self._report_s:
                self._report_s = message.sent - self._reported
            self._reported = message.sent
        start = time + DELAY_S if message.kind == COMMAND else time - self._report_s
        new = duty(message)
        k = bisect.bisect(self._times, start)
        gap, change = start - self._times[k - 1], np.abs(new - self._duties[k - 1])
        lost = len(self._times) > 2 and gap > _GAP_FACTOR * np.median(np.diff(self._times))
        self._times.insert(k, start)
        self._duties.insert(k, new)
        return (change, gap) if lost else None

    def forget(self, before: float) -> None:
        """Remove duties that ended before a time (s)."""
        while len(self._times) > 2 and self._times[1] < before:
            self._times.popleft()
            self._duties.popleft()

    def at(self, times: np.ndarray, waiting: Iterable[tuple[float, Message]] = ()) -> np.ndarray:
        """Return the duties at given times.

        Args:
            times: ascending, s.
            waiting: further commands with their times, s.

        Returns:
            Shape (times, segments, 2).
        """
        starts, duties = list(self._times), list(self._duties)
        for time, message in waiting:
            k = bisect.bisect(starts, time + DELAY_S)
            starts.insert(k, time + DELAY_S)
            duties.insert(k, duty(message))
        return _sampled(times, starts, duties)


def _sampled(times: np.ndarray, starts: Sequence[float], duties: Sequence[np.ndarray]) -> np.ndarray:
    rows = np.searchsorted(starts, times, side="right") - 1
    silent = times - np.asarray(starts)[rows] > SILENT_S
    return np.where(silent[:, None, None], 0.0, np.array([duties[k] for k in rows]))
