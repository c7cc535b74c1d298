"""Links: connections to brokers, motion capture and journals; MqttLink; keys of the terminal.

Each link receives in its own thread, which records the time of arrival; `received`
returns the messages since its last call. A link connects to the given address only,
reconnects after a loss, and counts the messages that it could not read.
"""

from __future__ import annotations

import os
import queue
import re
import select
import socket
import sys
import termios
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.files import display_path, require_file
from srs_twin.live.contact_observer import ContactEstimate
from srs_twin.live.messages import (
    CONTACT,
    GO,
    KINDS,
    PAUSE,
    STATUS,
    STOP,
    VENT,
    BadMessageError,
    Message,
    decode,
    encode,
    encode_contact,
    topic,
)

if TYPE_CHECKING:
    from paho.mqtt import client as mqtt

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
        with suppress(queue.Empty):
            while True:
                messages.append(self._queue.get_nowait())
        return messages

    @property
    def over(self) -> bool:
        """Whether a journal has ended, and all of its messages were received."""
        return self.counts["over"] > 0 and self._queue.empty()

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
        reason = type(error).__name__
        if isinstance(error, BadMessageError):
            reason = str(error)[:80]
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
    if not _is_host(host) or (
        colon and not (re.fullmatch("[0-9]{1,5}", number) and 0 < int(number) < 65536)
    ):
        raise InputError(
            f"{given[:80]!r} is not an address; give HOST or HOST:PORT, such as"
            f" {LOOPBACK}:{port}, with a name or an IPv4 address as HOST and a PORT"
            " from 1 to 65535"
        )
    return host, int(number or port)


def _is_host(name: str) -> bool:
    """Return whether a text is a valid host name: labels of letters, digits and hyphens with dots between."""
    try:
        encoded = name.encode("idna")  # as sockets do
    except UnicodeError:
        return False
    labels = name.removesuffix(".").split(".")
    return len(encoded) <= _LONGEST_HOST and all(
        _LABEL.fullmatch(label) for label in labels
    )


def resolved(host: str) -> str:
    """Return the IPv4 address of a host.

    Raises:
        InputError: no host has this name.
    """
    try:
        return socket.gethostbyname(host)
    except (OSError, UnicodeError) as error:
        raise InputError(f"the host {host[:80]!r} cannot be found") from error


PORT = 1883
"""Usual port of a broker."""
_ANSWER_S = 5.0
"""Longest wait for the first answer of the broker, s."""
LOST = "lost"
"""Status that the broker publishes when a connection breaks."""


@dataclass(frozen=True)
class BrokerAccess:
    """Access to an MQTT broker: its address and a login.

    Attributes:
        host: name or IPv4 address.
        port: port.
        user: user name; None: without.
        password: password of that user.
        ca: file with the CA certificate of the broker; it enables TLS.
    """

    host: str = LOOPBACK
    port: int = PORT
    user: str | None = None
    password: str | None = None
    ca: Path | None = None


class MqttLink(Link):
    """One robot's topics at a broker.

    Attributes:
        connected: whether the broker answers now.
    """

    def __init__(
        self,
        robot: str,
        segments: int,
        broker: BrokerAccess = BrokerAccess(),
        *,
        kinds: Iterable[str] = KINDS,
        speaks: str | None = None,
        chambers: int = 0,
    ) -> None:
        """Connect and subscribe.

        Args:
            robot: whose topics.
            segments: of the robot.
            broker: address and login.
            kinds: of messages to receive.
            speaks: robot whose `status` becomes `LOST` if this connection breaks; None:
                no status.
            chambers: number of chambers per segment of a spatial robot; 0: the robot is
                planar.

        Raises:
            InputError: paho-mqtt is not installed, or no broker answers or admits us.
        """
        super().__init__()
        try:
            from paho.mqtt import client as mqtt
            from paho.mqtt.enums import CallbackAPIVersion
        except ImportError as error:
            raise InputError(
                "MQTT needs paho-mqtt; install it with: pip install 'srs-twin[live]'"
            ) from error
        self._robot = robot
        self._topics = {topic(robot, kind): kind for kind in kinds}
        self._decode = partial(
            decode, source=robot, segments=segments, chambers=chambers
        )
        self.connected = False
        self._answered = threading.Event()
        self._why = ""
        self._client = client = mqtt.Client(CallbackAPIVersion.VERSION2)
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        client.on_message = self._on_message
        client.reconnect_delay_set(1, 2)
        if broker.user is not None:
            client.username_pw_set(broker.user, broker.password)
        if broker.ca is not None:
            _trust(client, broker.ca)
        if speaks is not None:
            client.will_set(topic(speaks, STATUS), encode(STATUS, 0.0, LOST))
        place = f"{broker.host}:{broker.port}"
        try:
            client.connect(broker.host, broker.port, keepalive=5)
        except (OSError, ValueError) as error:  # ValueError: no host can have the name
            raise InputError(f"no broker answers at {place}: {error}") from error
        client.loop_start()
        if not self._answered.wait(_ANSWER_S) or not self.connected:
            self.close()
            raise InputError(
                f"the broker at {place} refuses the connection:"
                f" {self._why or 'no answer'}"
            )

    def send(
        self,
        kind: str,
        values: np.ndarray | str,
        *,
        at: float | None = None,
        wait_s: float = 0.0,
    ) -> None:
        """Send a message; nothing is kept for a broker that is away.

        Args:
            kind: one of `KINDS`.
            values: as `encode` takes them.
            at: of our clock, s; default now.
            wait_s: longest time to wait until it has left, s.
        """
        time = clock() if at is None else at
        sent = self._client.publish(
            topic(self._robot, kind), encode(kind, time, values)
        )
        if wait_s:
            # RuntimeError: not connected; ValueError: the queue is full.
            with suppress(RuntimeError, ValueError):
                sent.wait_for_publish(wait_s)

    def send_contact(self, contact: ContactEstimate) -> None:
        """Send a contact estimate."""
        self._client.publish(
            topic(self._robot, CONTACT), encode_contact(clock(), contact)
        )

    def close(self) -> None:
        """See `Link.close`."""
        self._client.disconnect()
        self._client.loop_stop()

    def _on_connect(
        self,
        client: Any,
        _data: object,
        _flags: object,
        reason: Any,
        _properties: object,
    ) -> None:
        self.connected = not reason.is_failure
        self._why = str(reason)
        if self.connected:
            self.counts["connected"] += 1
            # Else small messages wait for the acknowledgement of the one before, up to
            # 40 ms.
            with suppress(OSError, AttributeError):  # a connection that is gone again
                client.socket().setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._topics:
                client.subscribe([(name, 0) for name in self._topics])
        self._answered.set()

    def _on_disconnect(self, *_: object) -> None:
        self.connected = False

    def _on_message(self, _client: object, _data: object, message: Any) -> None:
        arrived = clock()
        try:
            kind = self._topics.get(message.topic, "")
            if message.retain and kind != STATUS:
                raise BadMessageError("an old message that the broker retained")
            self._take(self._decode(kind, message.payload, arrived=arrived))
        except Exception as error:  # no message may end the client's thread
            self._refuse(error)


def _trust(client: mqtt.Client, ca: Path) -> None:
    """Encrypt a client's connection; trust a broker whose certificate this authority has signed.

    Raises:
        InputError: the file is no certificate in PEM form.
    """
    place = require_file(ca, suffix=".pem")  # else a pipe would be waited for
    try:
        client.tls_set(str(place))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{display_path(ca)}: this is not a certificate in PEM form; --ca needs the"
            " certificate of the authority that signed the broker's certificate"
        ) from error


KEYS = {"p": PAUSE, "g": GO, "v": VENT, "s": STOP}


@contextmanager
def typed_words(terminal: TextIO | None = None) -> Iterator[Callable[[], list[str]]]:
    """Yield a function that returns the control words typed since its last call, of `WORDS`.

    Lines need no Enter meanwhile, and the terminal is restored afterwards. Without a
    terminal, and in the background, no key is read.

    Args:
        terminal: default standard input.
    """
    stream = sys.stdin if terminal is None else terminal
    if stream is None or stream.closed or not stream.isatty():
        yield list
        return
    handle = stream.fileno()
    if not _in_foreground(handle):
        yield list
        return
    before = termios.tcgetattr(handle)
    tty.setcbreak(handle)

    def words() -> list[str]:
        if not _in_foreground(handle) or not select.select([handle], [], [], 0)[0]:
            return []
        typed = b""
        with suppress(OSError):  # the terminal was closed
            typed = os.read(handle, 1024)
        keys = typed.decode("ascii", "replace").lower()
        return [KEYS[key] for key in keys if key in KEYS]

    try:
        yield words
    finally:
        with suppress(termios.error):
            termios.tcsetattr(handle, termios.TCSADRAIN, before)


def _in_foreground(handle: int) -> bool:
    """Return whether the process may read from its terminal; in the background reading would stop it."""
    try:
        return os.tcgetpgrp(handle) == os.getpgrp()
    except OSError:  # not the controlling terminal
        return True
