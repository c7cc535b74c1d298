r"""Estimates of clock offsets, and a buffer that sorts messages by sending time.

A message is sent at the time s on the sender's clock and received at the time a on the
local clock. The difference a − s is the offset between the two clocks plus the
transport delay, which cannot be negative. The offset is therefore estimated as the
minimum of a − s over the last ten seconds. The jitter of a message is a − s minus the
estimated offset. In ten seconds, quartz clocks drift by about half a millisecond, which
corresponds to a relative drift of 5·10⁻⁵.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections import Counter, deque
from typing import NamedTuple

import numpy as np

from srs_twin.live.messages import BENDS, COMMAND, VALVES, Message

WINDOW_S = 10.0
"""Duration of the interval over which the clock offset is estimated, s."""
STEP_S = 1.0
"""Difference between delay and offset above which a time stamp is implausible, s.

An implausible time stamp is used only after other messages have confirmed it.
"""
AGREEMENT_S = 0.05
"""Maximum difference between delay and offset in a message that confirms the offset, s.
"""
CONFIRMING = 3
"""Number of successive messages that confirm a new clock offset."""
CONFIRMING_S = 0.4
"""Time without a confirming message after which the clock offset may increase, s."""
MOST_DELAY_S = 15.0
"""Maximum increase of the clock offset that may be due to slower transport, s."""
KEPT = 5000
"""Maximum number of messages from which the clock offset is estimated."""
MOST_HOLD_S = 0.1
"""Maximum time for which the buffer holds a message, s."""
_IN_TIME = 0.97
"""Fraction of the messages that must arrive within the holding time."""
_HOLD_UPDATES = 25
"""Number of `pop_until` calls between two adaptations of the holding time."""
_RANKS = {COMMAND: 0, VALVES: 0, BENDS: 1}
"""Rank of each message kind in the order of messages with equal sending times.

Other kinds come last, because some of these measurements depend on the bends.
"""


class _Arrival(NamedTuple):
    time: float
    delay: float


class SenderClock:
    """Estimator of the clock offset of one sender.

    A message confirms the offset if the delay of the message differs from the offset by
    at most `AGREEMENT_S`. The offset decreases after `CONFIRMING` successive messages
    with lower delays, and increases if no message has confirmed it for `CONFIRMING_S`.
    An increase may be due either to slower transport or to a sender's clock that was
    set back. Increases of less than `MOST_DELAY_S` are therefore added to
    `uncertainty`, and later decreases are subtracted.

    Attributes:
        offset: local clock minus the sender's clock, including the minimum transport
            delay, s.
        jumps: number of changes of the offset by more than `AGREEMENT_S`.
        uncertainty: uncertainty in the age of messages due to offset changes, s.
    """

    def __init__(self) -> None:
        self.offset = math.nan
        self.jumps = 0
        self.uncertainty = 0.0
        self._agreed = -math.inf
        self._seen: deque[_Arrival] = deque(maxlen=KEPT)
        self._least: deque[_Arrival] = deque()
        self._early: deque[_Arrival] = deque(maxlen=CONFIRMING)
        self._late: deque[_Arrival] = deque(maxlen=KEPT)

    def update(self, sent: float, arrived: float) -> float | None:
        """Update the offset with the sending and arrival times (s) of a message.

        Returns:
            Sending time on the local clock, s, or None if the delay differs from the
            offset by more than `STEP_S`.
        """
        delay = arrived - sent
        arrival = _Arrival(arrived, delay)
        excess = delay - self.offset
        if math.isnan(excess):
            self._agreed = arrived
            self._accept(arrival)
        elif excess < -AGREEMENT_S:
            self._early.append(arrival)
            self._follow(self._early, confirmed=len(self._early) == CONFIRMING)
        else:
            self._early.clear()
            if excess <= AGREEMENT_S:
                self._late.clear()
                self._agreed = arrived
            else:
                self._late.append(arrival)
                silent = arrived - self._agreed >= CONFIRMING_S
                self._follow(
                    self._late, confirmed=silent and len(self._late) >= CONFIRMING
                )
            if excess <= STEP_S:
                self._accept(arrival)
        if abs(delay - self.offset) > STEP_S:
            return None
        # A wrong time stamp must not cause a sending time after the arrival.
        return min(sent + self.offset, arrived)

    def _follow(self, arrivals: deque[_Arrival], *, confirmed: bool) -> None:
        delays = [arrival.delay for arrival in arrivals]
        lowest = min(delays)
        agreeing = [delay for delay in delays if delay - lowest <= STEP_S]
        if not confirmed or len(agreeing) < CONFIRMING:
            return
        step = lowest - self.offset
        if step < MOST_DELAY_S:
            self.uncertainty = max(0.0, self.uncertainty + step)
        self.jumps += 1
        self._seen.clear()
        self._least.clear()
        for arrival in arrivals:
            self._accept(arrival)
        self._early.clear()
        self._late.clear()
        self._agreed = self._seen[-1].time

    def _accept(self, arrival: _Arrival) -> None:
        self._seen.append(arrival)
        while self._seen[0].time < arrival.time - WINDOW_S:
            self._seen.popleft()
        while self._least and self._least[-1].delay >= arrival.delay:
            self._least.pop()
        self._least.append(arrival)
        while self._least[0].time < self._seen[0].time:
            self._least.popleft()
        self.offset = self._least[0].delay

    def delay_quantile(self, fraction: float) -> float:
        """Return the jitter (s) that a given fraction of messages do not exceed."""
        if self._seen:
            return float(np.quantile(self._excess(), fraction))
        return 0.0

    @property
    def jitter(self) -> float:
        """RMS jitter of the messages, s."""
        if self._seen:
            return float(np.sqrt(np.mean(self._excess() ** 2)))
        return math.nan

    def _excess(self) -> np.ndarray:
        return np.array([arrival.delay for arrival in self._seen]) - self.offset


class TimedMessage(NamedTuple):
    """Message with its sending time on the local clock, s."""

    time: float
    message: Message


class _Held(NamedTuple):
    time: float
    rank: int
    number: int
    message: Message


class ReorderBuffer:
    """Buffer that sorts messages from all senders by sending time on the local clock.

    Attributes:
        clocks: clock estimator of each sender. The sender of commands is the
            controller, whose clock differs from the robot's clock.
        hold: holding time of messages, which increases with the jitter from its initial
            value up to `MOST_HOLD_S`, s.
        counts: number of messages per source, kind and result, which is "taken",
            "duplicate", "late" or "off its clock". A message is late if `pop_until` has
            already passed its sending time, and off its clock if its time stamp is
            implausible.
    """

    def __init__(self, hold_s: float = 0.03) -> None:
        self.clocks: dict[str, SenderClock] = {}
        self.counts: Counter[tuple[str, str, str]] = Counter()
        self.hold = hold_s
        self._least = hold_s
        self._handed = -math.inf
        self._calls = 0
        self._waiting: list[_Held] = []
        self._number = itertools.count()
        self._known: dict[tuple[str, str], deque[float]] = {}

    def push(self, message: Message) -> None:
        """Add a message."""
        sender = message.source
        if message.kind == COMMAND:
            sender = f"{message.source}, {message.kind}"
        clock = self.clocks.setdefault(sender, SenderClock())
        jumps = clock.jumps
        time = clock.update(message.sent, message.arrived)
        if clock.jumps > jumps:
            # After the sender's clock has been set back, two different messages may
            # have equal time stamps.
            self._known = {
                key: sent
                for key, sent in self._known.items()
                if key[0] != message.source
            }
        key = message.source, message.kind
        known = self._known.setdefault(key, deque(maxlen=200))
        if message.sent in known:  # A broker may deliver a message more than once.
            self.counts[*key, "duplicate"] += 1
            return
        known.append(message.sent)
        if time is None:
            self.counts[*key, "off its clock"] += 1
            return
        if time < self._handed:
            self.counts[*key, "late"] += 1
            return
        self.counts[*key, "taken"] += 1
        rank = _RANKS.get(message.kind, 2)
        heapq.heappush(self._waiting, _Held(time, rank, next(self._number), message))

    @property
    def waits(self) -> bool:
        """Whether the buffer holds any message."""
        return bool(self._waiting)

    def waiting(self, kind: str) -> list[TimedMessage]:
        """Return the held messages of one kind in no particular order."""
        return [
            TimedMessage(held.time, held.message)
            for held in self._waiting
            if held.message.kind == kind
        ]

    def pop_until(self, now: float) -> list[TimedMessage]:
        """Return the messages whose holding time has ended at the time `now` (s)."""
        self._calls += 1
        if self._calls % _HOLD_UPDATES == 0 and self.clocks:
            longest = max(
                clock.delay_quantile(_IN_TIME) for clock in self.clocks.values()
            )
            self.hold = max(self._least, min(longest, MOST_HOLD_S))
        until = now - self.hold
        due = []
        while self._waiting and self._waiting[0].time <= until:
            held = heapq.heappop(self._waiting)
            due.append(TimedMessage(held.time, held.message))
        self._handed = max(self._handed, until)
        return due
