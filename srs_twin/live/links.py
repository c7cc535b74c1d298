"""Link: base of the connections to brokers, motion capture and journals.

Each link receives in its own thread, which records the time of arrival; `received` returns the messages since
its last call. A link connects to the given address only, reconnects after a loss, and counts the messages
that it could not read.
"""

from __future__ import annotations

import contextlib
import queue
import re
import socket
import time
from abc import ABC, abstractmethod
from collections import Counter
from typing import Any

from srs_twin.errors import InputError
from srs_twin.live.messages import BadMessageError, Message

LOOPBACK = "127.0.0.1"
_MOST_WAITING = 100_000
_MOST_REASONS = 200
"""Number of distinct reasons that are counted; a limit, so that hostile messages cannot fill the memory."""


def clock() -> float:
    """Return our monotonic clock, s."""
    return time.monotonic()


class Link(ABC):
    """Source of messages.

    Attributes:
        counts: number of messages by kind; refused ones are counted as "bad: REASON".
    """

    def __init__(self) -> None:
        """Create a link without messages."""
        self.counts: Counter[str] = Counter()
        self._queue: queue.Queue[Message] = queue.Queue(_MOST_WAITING)

    def received(self) -> list[Message]:
        """Return the messages since the last call."""
        messages = []
        with contextlib.suppress(queue.Empty):
            while True:
                messages.append(self._queue.get_nowait())
        return messages

    def clock(self) -> float:
        """Return the time on the clock of the arrival times, s."""
        return clock()

    def _take(self, message: Message) -> None:
        self.counts[message.kind] += 1
        try:
            self._queue.put_nowait(message)
        except queue.Full:
            self.counts["nobody asked"] += 1

    def _refuse(self, error: Exception) -> None:
        """Count a refused message by its reason; for unexpected errors the reason is the error's name."""
        reason = str(error)[:80] if isinstance(error, BadMessageError) else type(error).__name__
        name = f"bad: {reason}"
        if name not in self.counts and len(self.counts) >= _MOST_REASONS:
            name = "bad: for other reasons"
        self.counts[name] += 1

    @abstractmethod
    def close(self) -> None:
        """End the connection and the thread."""

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


_LONGEST_HOST = 253
_LABEL = re.compile(r"[^\W_]([\w-]{0,61}[^\W_])?")


def address(given: str, port: int) -> tuple[str, int]:
    """Return host and port of ``HOST`` or ``HOST:PORT``; HOST is a name or an IPv4 address.

    Raises:
        InputError: the text has another form.
    """
    host, colon, number = given.partition(":")
    if not _is_host(host) or (colon and not (re.fullmatch("[0-9]{1,5}", number) and 0 < int(number) < 65536)):
        raise InputError(
            f"{given[:80]!r} is no address; HOST or HOST:PORT is, such as {LOOPBACK}:{port}: a name or an "
            "IPv4 address, and a port from 1 to 65535"
        )
    return host, int(number or port)


def _is_host(name: str) -> bool:
    """Return whether a text is a valid host name: labels of letters, digits and hyphens with dots between."""
    try:
        encoded = name.encode("idna")  # as sockets do
    except UnicodeError:
        return False
    labels = name.removesuffix(".").split(".")
    return len(encoded) <= _LONGEST_HOST and all(_LABEL.fullmatch(label) for label in labels)


def resolved(host: str) -> str:
    """Return the IPv4 address of a host.

    Raises:
        InputError: no host has this name.
    """
    try:
        return socket.gethostbyname(host)
    except (OSError, UnicodeError) as error:
        raise InputError(f"{host[:80]!r}: no host of this name is known") from error
