"""Commands and their age: which valve states hold now.

A command carries `t`, the controller's clock. The two clocks are not synchronised, so
the age of a command is measured against the quickest message of the last ten seconds:

    offset = min over the last 10 s of (arrival - t),    age = arrival - t - offset.

A command holds until its age is 0.2 s. A link that stalls delivers old commands in a
burst when it recovers. Their `t` rises while their arrival does not, so they are
detected:

- As long as the offset is known, by their age.
- After a second without a command in time, the offset is forgotten. It counts as known
  again after 0.3 s and ten messages in which it fell by at most 20 ms. While a link
  delivers old commands, it falls with every one.

A delay that stays the same cannot be observed: it is part of the offset. The same holds
for old commands that arrive at 0.93 to 1.07 times the rate at which they were sent.
"""

import json

HOLD_MS = 200  # as docs/live.md says of robots
FORGET_MS = (
    1000  # also the largest step of the controller's clock that is taken for jitter
)
SETTLE_MS = 300
SETTLED_WITHIN_MS = 20  # one tick of a controller
SETTLE_MESSAGES = 10  # two bursts of a stalled link are not steady
_WINDOW_S = 10  # clocks of quartz drift by 0.5 ms in this time
_LATEST_MS = 10**15  # srs_twin accepts times up to 10^12 s.
_NUMBER = b"0123456789+-.eE"
_LONGEST_NUMBER = 40


def decode(payload, segments):
    """Return the time (ms, integer) and the fill shares of the + and - valves (0 vents, 1 fills).

    The states -1 and 1 and duties from 0 to 1 have the same form: max(0, value) is the
    share of the carrier's period in which the valve fills.

    Args:
        payload: JSON of the message, bytes.
        segments: number of segments of the robot.

    Raises:
        ValueError: the payload is no command for this robot.
    """
    try:
        document = json.loads(payload)
    except (ValueError, TypeError, OverflowError, MemoryError, RuntimeError):
        raise ValueError("no JSON") from None
    if not isinstance(document, dict):
        raise ValueError("no JSON object")
    time = _number(document.get("t"), 1e12)
    sent = _milliseconds(payload)
    # A text such as {"a": {"t": 5}, "t": 6} has two candidates; JSON says which one
    # counts.
    if abs(time - sent / 1000) > 1e-5 * abs(time) + 2e-3:
        raise ValueError("t is ambiguous")
    return (
        sent,
        _shares(document.get("plus"), segments),
        _shares(document.get("minus"), segments),
    )


def _number(value, largest):
    if (
        type(value) not in (int, float) or not -largest <= value <= largest
    ):  # also refuses NaN
        raise ValueError("a number is needed")
    return value


def _shares(values, segments):
    if not isinstance(values, list) or len(values) != segments:
        raise ValueError("one number per segment is needed")
    return [max(0, _number(value, 1)) for value in values]


def _milliseconds(payload):
    """Return `t` in ms from its digits: a single-precision float of a long uptime has errors of seconds."""
    start = payload.find(b'"t"')
    text = payload[start + 3 : start + 3 + 2 * _LONGEST_NUMBER].lstrip(b" \t\r\n:")
    end = 0
    while end < len(text) and text[end] in _NUMBER:
        end += 1
    if start < 0 or not 0 < end <= _LONGEST_NUMBER:
        raise ValueError("t is needed")
    mantissa, _, exponent = text[:end].decode().lower().partition("e")
    whole, _, fraction = mantissa.partition(".")
    scale = int(exponent or "0") - len(fraction) + 3
    if abs(scale) > _LONGEST_NUMBER:
        raise ValueError("t is out of range")
    digits = int(whole + fraction)
    sent = digits * 10**scale if scale >= 0 else digits // 10**-scale
    if abs(sent) > _LATEST_MS:
        raise ValueError("t is out of range")
    return sent


class SenderClock:
    """Offset between the controller's clock and ours.

    Attributes:
        offset: ours less the controller's plus the least delay, ms; None while there is
            no message.
        settled: whether the offset counts as known.
    """

    def __init__(self):
        """Know nothing."""
        self.forget()

    def forget(self):
        """Drop what was measured."""
        self.offset = None
        self.settled = False
        self._least = {}  # least difference of each second
        self._first = (
            None  # (time, difference) of the message since which the offset is steady
        )
        self._steady = 0  # messages since

    def age(self, sent, now):
        """Take a message's times (ms) and return the message's age, ms."""
        apart = now - sent
        second = now // 1000
        if self._first is None or apart < self._first[1] - SETTLED_WITHIN_MS:
            self._first = (now, apart)
            self._steady = 0
        self._steady += 1
        if now - self._first[0] >= SETTLE_MS and self._steady >= SETTLE_MESSAGES:
            self.settled = True
        for old in [each for each in self._least if each <= second - _WINDOW_S]:
            del self._least[old]
        self._least[second] = min(apart, self._least.get(second, apart))
        self.offset = min(self._least.values())
        return apart - self.offset


class Commands:
    """The newest command, as long as it holds.

    Attributes:
        refused: number of payloads that were no commands.
        stale: number of commands that were too old, or not newer than the one before.
    """

    def __init__(self, segments):
        """Hold no command.

        Args:
            segments: number of segments of the robot.
        """
        self.refused = self.stale = 0
        self._segments = segments
        self._clock = SenderClock()
        self._newest = None  # ms, the controller's clock
        self._in_time = self._expires = 0  # ms, ours
        self._vented = [0] * segments
        self._plus = self._minus = self._vented

    def take(self, payload, now):
        """Take a message; return whether it was a command and newer than those before.

        Args:
            payload: as it arrived, bytes.
            now: time of its arrival, ms.
        """
        try:
            sent, plus, minus = decode(payload, self._segments)
        except ValueError:
            self.refused += 1
            return False
        offset = self._clock.offset
        ahead = (
            offset is not None and now - sent < offset - FORGET_MS
        )  # the controller's clock was set
        if ahead or now - self._in_time > FORGET_MS:
            self._clock.forget()
            self._newest = None
        if self._newest is not None and sent <= self._newest:
            self.stale += 1
            return False
        self._newest = sent
        age = self._clock.age(sent, now)
        if age >= HOLD_MS:
            self.stale += 1
            return True
        self._in_time = now
        if self._clock.settled:
            self._plus = plus
            self._minus = minus
            self._expires = now + HOLD_MS - age
        return True

    def valves(self, now):
        """Return the fill shares of the + and of the - valves that hold at a time (ms)."""
        if now >= self._expires:
            return self._vented, self._vented
        return self._plus, self._minus
