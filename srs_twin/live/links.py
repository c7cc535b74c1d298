"""Links: where messages come from and go to; what brokers, motion capture and journals have in common.

Every link receives on a thread of its own, which writes down when each message arrived, and hands over what
has come when asked (`received`). It connects where it is told to and nowhere else, goes on trying when the
other side is gone, and counts what it could not read.
"""

from __future__ import annotations

import contextlib
import queue
import time
from abc import ABC, abstractmethod
from collections import Counter
from typing import Any

from srs_twin.errors import InputError
from srs_twin.live.messages import BadMessageError, Message

LOOPBACK = "127.0.0.1"
_MOST_WAITING = 100_000


def clock() -> float:
    """Return our clock, s: it is never set."""
    return time.monotonic()


class Link(ABC):
    """Where messages come from.

    Attributes:
        counts: what → how many, "bad: why" among them.
    """

    def __init__(self) -> None:
        """Receive nothing yet."""
        self.counts: Counter[str] = Counter()
        self._queue: queue.Queue[Message] = queue.Queue(_MOST_WAITING)

    def received(self) -> list[Message]:
        """Return what has arrived since the last call."""
        found = []
        with contextlib.suppress(queue.Empty):
            while True:
                found.append(self._queue.get_nowait())
        return found

    def clock(self) -> float:
        """Return the clock by which messages arrive, s."""
        return clock()

    def _take(self, message: Message) -> None:
        self.counts[message.kind] += 1
        try:
            self._queue.put_nowait(message)
        except queue.Full:
            self.counts["nobody asked"] += 1

    def _refuse(self, error: BadMessageError) -> None:
        self.counts[f"bad: {str(error)[:80]}"] += 1

    @abstractmethod
    def close(self) -> None:
        """End the connection and the thread."""

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def address(given: str, port: int) -> tuple[str, int]:
    """Return host and port of ``HOST`` or ``HOST:PORT``.

    Raises:
        InputError: no such thing.
    """
    host, _, number = given.partition(":")
    if not host or (number and not (number.isdigit() and 0 < int(number) < 65536)):
        raise InputError(f"{given!r} is no address; HOST or HOST:PORT is, such as {LOOPBACK}:{port}")
    return host, int(number or port)
