"""Links to message sources such as an MQTT broker, and control words from the terminal.

Each link receives messages in its own thread and records their arrival times. Invalid
messages are counted and discarded.
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
from typing import TYPE_CHECKING, Any, Self, TextIO

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
    from paho.mqtt.reasoncodes import ReasonCode

LOOPBACK = "127.0.0.1"
_MOST_WAITING = 100_000
_MOST_REASONS = 200
"""Maximum number of separately counted reasons for refusing messages.

Without this limit, malicious messages could exhaust the memory.
"""


def clock() -> float:
    """Return the time of the local monotonic clock, s."""
    return time.monotonic()


class Link(ABC):
    """Abstract base class of message sources.

    Attributes:
        counts: number of received messages, keyed by message kind. Refused messages are
            counted under the key "bad: REASON", and losses of the connection under the
            key "disconnected".
        connected: whether the connection to the broker exists. Other sources count as
            connected.
    """

    def __init__(self) -> None:
        self.connected = True
        self._was_connected = True
        self.counts: Counter[str] = Counter()
        self._queue: queue.Queue[Message] = queue.Queue(_MOST_WAITING)

    def received(self) -> list[Message]:
        """Return the messages that have arrived since the last call."""
        messages = []
        with suppress(queue.Empty):
            while True:
                messages.append(self._queue.get_nowait())
        return messages

    @property
    def over(self) -> bool:
        """Whether the source has ended and `received` has returned all messages."""
        return self.counts["over"] > 0 and self._queue.empty()

    def connection_change(self) -> str:
        """Return a message if the connection was lost or restored since the last call."""
        connected = self.connected  # The thread of the link may change the attribute.
        if connected == self._was_connected:
            return ""
        self._was_connected = connected
        return f"the connection to the broker is {'back' if connected else 'lost'}"

    def clock(self) -> float:
        """Return the current time (s) on the clock that stamps arriving messages."""
        return clock()

    def _take(self, message: Message) -> None:
        self.counts[message.kind] += 1
        try:
            self._queue.put_nowait(message)
        except queue.Full:
            self.counts["nobody asked"] += 1

    def _refuse(self, error: Exception) -> None:
        reason = type(error).__name__
        if isinstance(error, BadMessageError):
            reason = str(error)[:80]
        name = f"bad: {reason}"
        if name not in self.counts and len(self.counts) >= _MOST_REASONS:
            name = "bad: for other reasons"
        self.counts[name] += 1

    @abstractmethod
    def close(self) -> None:
        """Close the connection and end the thread."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


_LONGEST_HOST = 253
_LABEL = re.compile(r"[^\W_]([\w-]{0,61}[^\W_])?")


def address(given: str, port: int) -> tuple[str, int]:
    """Split a network address into its host and port.

    Args:
        given: address in the form ``HOST`` or ``HOST:PORT``, where HOST is a name or an
            IPv4 address.
        port: default port number.

    Raises:
        InputError: the text is not a valid address.
    """
    host, colon, number = given.partition(":")
    if not _is_host(host) or (
        colon and not (re.fullmatch("[0-9]{1,5}", number) and 0 < int(number) < 65536)
    ):
        raise InputError(
            f"{given[:80]!r} is not an address; give HOST or HOST:PORT, for example"
            f" {LOOPBACK}:{port}, where HOST is a name or an IPv4 address and PORT is"
            " between 1 and 65535"
        )
    return host, int(number or port)


def _is_host(name: str) -> bool:
    try:
        encoded = name.encode("idna")
    except UnicodeError:
        return False
    labels = name.removesuffix(".").split(".")
    return len(encoded) <= _LONGEST_HOST and all(
        _LABEL.fullmatch(label) for label in labels
    )


def resolved(host: str) -> str:
    """Return the IPv4 address of a host.

    Raises:
        InputError: the host cannot be found.
    """
    try:
        return socket.gethostbyname(host)
    except (OSError, UnicodeError) as error:
        raise InputError(f"the host {host[:80]!r} cannot be found") from error


PORT = 1883
_ANSWER_S = 5.0
"""Maximum time to wait for the first answer of the broker, s."""
LOST = "lost"
"""Status that the broker publishes when a connection breaks (MQTT last will)."""


@dataclass(frozen=True)
class BrokerAccess:
    """Address and login of an MQTT broker.

    Attributes:
        host: host name or IPv4 address.
        port: port number.
        user: user name, or None for an anonymous login.
        password: password of the user, or None if the broker requires no password.
        ca: PEM file with the CA certificate of the broker, or None to connect without
            TLS.
    """

    host: str = LOOPBACK
    port: int = PORT
    user: str | None = None
    password: str | None = None
    ca: Path | None = None


class MqttLink(Link):
    """Link to the topics of one robot on an MQTT broker.

    The link reconnects automatically after a lost connection.
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
        """Connect to a broker and subscribe to the topics of a robot.

        Args:
            robot: name of the robot in the MQTT topics.
            segments: number of segments of the robot.
            broker: address and login of the broker.
            kinds: message kinds to which the link subscribes.
            speaks: name of the robot for which the broker publishes the status `LOST`
                if this connection breaks, or None to publish no status.
            chambers: number of chambers per segment of a spatial robot, or 0 for a
                planar robot.

        Raises:
            InputError: paho-mqtt is not installed, no broker answers, or the broker
                refuses the connection.
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
        # An invalid host name raises ValueError.
        except (OSError, ValueError) as error:
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
        """Send a message.

        The message is discarded if the link is not connected to the broker.

        Args:
            kind: kind of the message, one of `KINDS`.
            values: content of the message, as described in `encode`.
            at: time stamp on the local clock, s. If None, the current time is used.
            wait_s: maximum time to wait until the message has been sent, s.
        """
        time = clock() if at is None else at
        sent = self._client.publish(
            topic(self._robot, kind), encode(kind, time, values)
        )
        if wait_s:
            # `wait_for_publish` raises RuntimeError without a connection, and
            # ValueError if the queue is full.
            with suppress(RuntimeError, ValueError):
                sent.wait_for_publish(wait_s)

    def send_contact(self, contact: ContactEstimate) -> None:
        """Send a contact estimate, stamped with the current time."""
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
        reason: ReasonCode,
        _properties: object,
    ) -> None:
        self.connected = not reason.is_failure
        self._why = str(reason)
        if self.connected:
            self.counts["connected"] += 1
            # Without TCP_NODELAY, a small message would wait up to 40 ms for the
            # acknowledgement of the previous message.
            with suppress(OSError, AttributeError):
                client.socket().setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._topics:
                client.subscribe([(name, 0) for name in self._topics])
        self._answered.set()

    def _on_disconnect(self, *_: object) -> None:
        self.counts["disconnected"] += self.connected
        self.connected = False

    def _on_message(
        self, _client: object, _data: object, message: mqtt.MQTTMessage
    ) -> None:
        arrived = clock()
        try:
            kind = self._topics.get(message.topic, "")
            if message.retain and kind != STATUS:
                raise BadMessageError("an old message that the broker retained")
            self._take(self._decode(kind, message.payload, arrived=arrived))
        except Exception as error:  # An exception would end the client's thread.
            self._refuse(error)


def _trust(client: mqtt.Client, ca: Path) -> None:
    place = require_file(
        ca, suffix=".pem"
    )  # Pipes are rejected, because opening a pipe would block.
    try:
        client.tls_set(str(place))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{display_path(ca)}: this is not a certificate in PEM format; --ca needs"
            " the certificate of the authority that signed the broker's certificate"
        ) from error


KEYS = {"p": PAUSE, "g": GO, "v": VENT, "s": STOP}


@contextmanager
def typed_words(terminal: TextIO | None = None) -> Iterator[Callable[[], list[str]]]:
    """Yield a function that returns the control words typed since its last call.

    The user types a control word by pressing a key of `KEYS` without Enter. No keys are
    read if the process runs in the background or has no terminal.
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
        with suppress(OSError):
            typed = os.read(handle, 1024)
        keys = typed.decode("ascii", "replace").lower()
        return [KEYS[key] for key in keys if key in KEYS]

    try:
        yield words
    finally:
        with suppress(termios.error):
            termios.tcsetattr(handle, termios.TCSADRAIN, before)


def _in_foreground(handle: int) -> bool:
    try:
        return os.tcgetpgrp(handle) == os.getpgrp()
    except OSError:  # `handle` is not the controlling terminal.
        return True
