r"""SenderClock and ReorderBuffer: clocks of the senders, and messages in the order of their times.

For a message sent at time s of the sender's clock and received at time a of ours, a − s is the offset of the
clocks plus the transport delay, which is not negative. The minimum over the last seconds is the estimated
offset; the excess of a message over it is its jitter. Quartz clocks drift by about 5·10⁻⁵, half a millisecond
in ten seconds.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections import Counter, deque

import numpy as np

from srs_twin.live.messages import BENDS, COMMAND, VALVES, Message

WINDOW_S = 10.0
"""Interval over which the offset is estimated."""
STEP_S = 1.0
"""Change of the offset above which the clock was set or its sender restarted."""
KEPT = 5000
"""Largest number of messages in the window."""
MOST_HOLD_S = 0.1
"""Longest time for which messages are held, s."""
_IN_TIME = 0.97
"""Share of the messages that must arrive within the holding time."""
_HOLD_UPDATES = 25
"""Number of calls after which the holding time is adapted."""
_RANKS = {COMMAND: 0, VALVES: 0, BENDS: 1}
"""Processing order of messages with equal times: commands, bends, then measurements that depend on bends."""


class SenderClock:
    """The clock of one sender.

    Attributes:
        offset: our clock minus the sender's clock, including the minimum delay, s.
        jumps: number of times that the sender's clock was set.
    """

    def __init__(self) -> None:
        """Create a clock without any messages."""
        self.offset, self.jumps = math.nan, 0
        self._seen: deque[tuple[float, float]] = deque(maxlen=KEPT)
        # Candidates for the minimum in the window, the smallest first.
        self._least: deque[tuple[float, float]] = deque()

    def update(self, sent: float, arrived: float) -> float:
        """Add the times of a message (s); return its sending time on our clock, s."""
        delay = arrived - sent
        if self._seen and abs(delay - self.offset) > STEP_S:
            self._seen.clear()
            self._least.clear()
            self.jumps += 1
        self._seen.append((arrived, delay))
        while self._seen[0][0] < arrived - WINDOW_S:
            self._seen.popleft()
        while self._least and self._least[-1][1] >= delay:
            self._least.pop()
        self._least.append((arrived, delay))
        while self._least[0][0] < self._seen[0][0]:
            self._least.popleft()
        # The smallest delay in the window is closest to the true offset, as transport only adds delay.
        self.offset = self._least[0][1]
        return sent + self.offset

    def delay_quantile(self, share: float) -> float:
        """Return a quantile of the jitter, s."""
        return float(np.quantile(self._excess(), share)) if self._seen else 0.0

    @property
    def jitter(self) -> float:
        """RMS of the excess delay, s."""
        return float(np.sqrt(np.mean(self._excess() ** 2))) if self._seen else math.nan

    def _excess(self) -> np.ndarray:
        return np.array([delay for _, delay in self._seen]) - self.offset


class ReorderBuffer:
    """Buffer that sorts the messages of all senders by their sending times on our clock.

    Attributes:
        clocks: clocks by sender; the sender of commands and the robot have different clocks.
        hold: time for which messages are held, s; it grows with the jitter up to `MOST_HOLD_S`.
        counts: number of messages by source, kind and result: "taken", "duplicate", "late" after a newer one
            was used, or "off its clock", with a time that differs from the clock by more than `STEP_S`.
    """

    def __init__(self, hold_s: float = 0.03) -> None:
        """Create a buffer that holds messages for a time (s)."""
        self.clocks: dict[str, SenderClock] = {}
        self.counts: Counter[tuple[str, str, str]] = Counter()
        self.hold, self._least, self._handed = hold_s, hold_s, -math.inf
        self._calls = 0
        self._waiting: list[tuple[float, int, int, Message]] = []
        self._number = itertools.count()
        self._known: dict[tuple[str, str], deque[float]] = {}
        self._odd: dict[str, float] = {}

    def push(self, message: Message) -> None:
        """Add a message."""
        known = self._known.setdefault((message.source, message.kind), deque(maxlen=200))
        if message.sent in known:
            self.counts[message.source, message.kind, "duplicate"] += 1
            return
        # A broker may deliver a message more than once.
        known.append(message.sent)
        sender = f"{message.source}, {message.kind}" if message.kind == COMMAND else message.source
        clock = self.clocks.setdefault(sender, SenderClock())
        if not self._plausible(sender, clock, message):
            self.counts[message.source, message.kind, "off its clock"] += 1
            return
        time = clock.update(message.sent, message.arrived)
        if time < self._handed:
            self.counts[message.source, message.kind, "late"] += 1
            return
        self.counts[message.source, message.kind, "taken"] += 1
        heapq.heappush(self._waiting, (time, _RANKS.get(message.kind, 2), next(self._number), message))

    def waiting(self, kind: str) -> list[tuple[float, Message]]:
        """Return the held messages of a kind with their times on our clock (s), unordered."""
        return [(time, message) for time, _, _, message in self._waiting if message.kind == kind]

    def _plausible(self, sender: str, clock: SenderClock, message: Message) -> bool:
        """Return whether the time of a message agrees with the clock, or with the message before it.

        One message with a wrong time must not change the clock; two successive ones that agree do.
        """
        delay, odd = message.arrived - message.sent, self._odd.pop(sender, math.nan)
        if math.isnan(clock.offset) or abs(delay - clock.offset) <= STEP_S or abs(delay - odd) <= STEP_S:
            return True
        self._odd[sender] = delay
        return False

    def pop_until(self, now: float) -> list[tuple[float, Message]]:
        """Return the messages that are due at `now` (our clock, s), with their times on our clock."""
        self._calls += 1
        if self._calls % _HOLD_UPDATES == 0 and self.clocks:
            longest = max(clock.delay_quantile(_IN_TIME) for clock in self.clocks.values())
            self.hold = min(max(self._least, longest), max(self._least, MOST_HOLD_S))
        until, due = now - self.hold, []
        while self._waiting and self._waiting[0][0] <= until:
            time, _, _, message = heapq.heappop(self._waiting)
            due.append((time, message))
        self._handed = max(self._handed, until)
        return due
