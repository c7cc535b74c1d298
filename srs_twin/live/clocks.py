r"""Clocks of senders on our own: what is measured of offset and jitter, and messages in order of time.

A message that was sent at s on the sender's clock and arrives at a on ours has come by d = a − s, the clocks'
offset and its delay. Delays are never below 0, so the offset is the least d of the last seconds, and what
others have more is jitter. Clocks of quartz drift by some 50 millionths: half a millisecond in ten seconds.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections import Counter, deque

import numpy as np

from srs_twin.live.messages import BENDS, COMMAND, VALVES, Message

WINDOW_S = 10.0
STEP_S = 1.0
"""A clock that jumps by more was set, or its sender began anew."""
KEPT = 5000
MOST_HOLD_S = 0.1
_IN_TIME, _EVERY = 0.97, 25
_RANKS = {COMMAND: 0, VALVES: 0, BENDS: 1}
"""Of messages that were sent at once: what moved the robot, how it is bent, what depends on that."""


class SenderClock:
    """The clock of one sender.

    Attributes:
        offset: ours less the sender's, with the least delay, s.
        jumps: how often it was set.
    """

    def __init__(self) -> None:
        """Know nothing yet."""
        self.offset, self.jumps = math.nan, 0
        self._seen: deque[tuple[float, float]] = deque(maxlen=KEPT)
        # Those after which none was quicker, the quickest first.
        self._least: deque[tuple[float, float]] = deque()

    def take(self, sent: float, arrived: float) -> float:
        """Take a message's times and return when it was sent on our clock, s."""
        apart = arrived - sent
        if self._seen and abs(apart - self.offset) > STEP_S:
            self._seen.clear()
            self._least.clear()
            self.jumps += 1
        self._seen.append((arrived, apart))
        while self._seen[0][0] < arrived - WINDOW_S:
            self._seen.popleft()
        while self._least and self._least[-1][1] >= apart:
            self._least.pop()
        self._least.append((arrived, apart))
        while self._least[0][0] < self._seen[0][0]:
            self._least.popleft()
        self.offset = self._least[0][1]
        return sent + self.offset

    def late(self, share: float) -> float:
        """Return what a share of the messages is late by at most, s."""
        late = np.array([each for _, each in self._seen]) - self.offset
        return float(np.quantile(late, share)) if len(late) else 0.0

    @property
    def jitter(self) -> float:
        """RMS of what messages are late by, s."""
        late = np.array([each for _, each in self._seen]) - self.offset
        return float(np.sqrt(np.mean(late**2))) if len(late) else math.nan


class Inbox:
    """Messages of all senders in order of when they were sent, on our clock.

    Attributes:
        clocks: of each sender: whoever commands a robot has another one than the robot.
        hold: how long messages wait, s: longer where they come later than that, up to `MOST_HOLD_S`.
        counts: (source, kind, what) → how many: "taken", "duplicate", "late" ones that came when later ones
            had been handed out, "off its clock" whose time lies more than `STEP_S` beside the sender's clock.
    """

    def __init__(self, hold_s: float = 0.03) -> None:
        """Wait for so long (s) for messages that come in disorder."""
        self.clocks: dict[str, SenderClock] = {}
        self.counts: Counter[tuple[str, str, str]] = Counter()
        self.hold, self._least, self._handed = hold_s, hold_s, -math.inf
        self._takes = 0
        self._waiting: list[tuple[float, int, int, Message]] = []
        self._number = itertools.count()
        self._known: dict[tuple[str, str], deque[float]] = {}
        self._odd: dict[str, float] = {}

    def put(self, message: Message) -> None:
        """Take a message, in whatever order."""
        known = self._known.setdefault((message.source, message.kind), deque(maxlen=200))
        if message.sent in known:
            self.counts[message.source, message.kind, "duplicate"] += 1
            return
        known.append(message.sent)
        sender = f"{message.source}, {message.kind}" if message.kind == COMMAND else message.source
        clock = self.clocks.setdefault(sender, SenderClock())
        if not self._plausible(sender, clock, message):
            self.counts[message.source, message.kind, "off its clock"] += 1
            return
        time = clock.take(message.sent, message.arrived)
        if time < self._handed:
            self.counts[message.source, message.kind, "late"] += 1
            return
        self.counts[message.source, message.kind, "taken"] += 1
        heapq.heappush(self._waiting, (time, _RANKS.get(message.kind, 2), next(self._number), message))

    def waiting(self, kind: str) -> list[tuple[float, Message]]:
        """Return the messages of a kind that wait, with their times on our clock, in any order."""
        return [(time, message) for time, _, _, message in self._waiting if message.kind == kind]

    def _plausible(self, sender: str, clock: SenderClock, message: Message) -> bool:
        """Return whether a message's time fits the clock that was measured, or confirms that it was set.

        One message with a wrong time must not move the clock of all others; two in a row that agree do.
        """
        apart, odd = message.arrived - message.sent, self._odd.pop(sender, math.nan)
        if math.isnan(clock.offset) or abs(apart - clock.offset) <= STEP_S or abs(apart - odd) <= STEP_S:
            return True
        self._odd[sender] = apart
        return False

    def take(self, now: float) -> list[tuple[float, Message]]:
        """Return what was sent until a little before now (our clock, s), with its time on our clock."""
        self._takes += 1
        if self._takes % _EVERY == 0 and self.clocks:
            late = max(clock.late(_IN_TIME) for clock in self.clocks.values())
            self.hold = min(max(self._least, late), max(self._least, MOST_HOLD_S))
        until, found = now - self.hold, []
        while self._waiting and self._waiting[0][0] <= until:
            time, _, _, message = heapq.heappop(self._waiting)
            found.append((time, message))
        self._handed = max(self._handed, until)
        return found
