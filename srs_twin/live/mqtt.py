"""MqttLink: connection to a robot's topics at an MQTT broker."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.files import display_path, require_file
from srs_twin.live.links import LOOPBACK, Link, clock
from srs_twin.live.messages import KINDS, STATUS, BadMessageError, decode, encode, topic

PORT = 1883
LOST = "lost"
"""Status that the broker publishes when a connection is lost."""


class MqttLink(Link):
    """Connection to the topics of one robot at a broker.

    Attributes:
        connected: whether the connection to the broker is up.
    """

    def __init__(
        self, robot: str, segments: int, host: str = LOOPBACK, port: int = PORT, *,
        kinds: Iterable[str] = KINDS, user: str | None = None, password: str | None = None,
        ca: Path | None = None, wait_s: float = 5.0, speaks: str | None = None,
    ) -> None:  # fmt: skip
        """Connect and subscribe.

        Args:
            robot: name of the robot.
            segments: number of segments of the robot.
            host: host of the broker.
            port: port of the broker.
            kinds: kinds of messages to receive.
            user: user name; None: no authentication.
            password: password of the user.
            ca: CA certificate of the broker; it enables TLS.
            wait_s: longest wait for the first answer of the broker, s.
            speaks: robot whose `status` becomes `LOST` if this connection is lost; None: no status.

        Raises:
            InputError: paho-mqtt is not installed, or the broker does not answer or refuses the user.
        """
        super().__init__()
        try:
            from paho.mqtt import client as mqtt
        except ImportError as error:
            raise InputError("MQTT needs paho-mqtt: pip install 'srs-twin[live]'") from error
        self._robot, self._segments, self._topics = robot, segments, {topic(robot, k): k for k in kinds}
        self.connected, self._answered, self._why = False, threading.Event(), ""
        self._client = client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        client.on_connect, client.on_disconnect = self._on_connect, self._on_disconnect
        client.on_message = self._on_message
        client.reconnect_delay_set(1, 2)
        if user is not None:
            client.username_pw_set(user, password)
        if ca is not None:
            _trust(client, ca)
        if speaks is not None:
            client.will_set(topic(speaks, STATUS), encode(STATUS, 0.0, LOST))
        try:
            client.connect(host, port, keepalive=5)
        except (OSError, ValueError) as error:  # ValueError: a name that no host can have
            raise InputError(f"no broker answers at {host}:{port}: {error}") from error
        client.loop_start()
        if not self._answered.wait(wait_s) or not self.connected:
            self.close()
            raise InputError(f"the broker at {host}:{port} does not admit us: {self._why or 'no answer'}")

    def send(
        self, kind: str, values: np.ndarray | str, *, at: float | None = None, wait_s: float = 0.0
    ) -> None:
        """Send a message; without a connection it is dropped.

        Args:
            kind: one of `KINDS`.
            values: as in `encode`.
            at: time on our clock, s; default now.
            wait_s: longest wait until the message is sent, s.
        """
        time = clock() if at is None else at
        sent = self._client.publish(topic(self._robot, kind), encode(kind, time, values))
        if wait_s:
            with contextlib.suppress(RuntimeError, ValueError):  # not connected, or the queue is full
                sent.wait_for_publish(wait_s)

    def close(self) -> None:
        """See `Link.close`."""
        self._client.disconnect()
        self._client.loop_stop()

    def _on_connect(self, client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        self.connected, self._why = not reason.is_failure, str(reason)
        if self.connected:
            self.counts["connected"] += 1
            # Without this, a small message waits up to 40 ms for the acknowledgement of the previous one.
            with contextlib.suppress(OSError, AttributeError):  # a connection that is gone again
                client.socket().setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._topics:
                client.subscribe([(topic, 0) for topic in self._topics])
        self._answered.set()

    def _on_disconnect(self, *_: Any) -> None:
        self.connected = False

    def _on_message(self, _client: Any, _data: Any, message: Any) -> None:
        arrived = clock()
        try:
            kind = self._topics.get(message.topic, "")
            if message.retain and kind != STATUS:
                raise BadMessageError("retained by the broker from earlier")
            self._take(
                decode(kind, message.payload, source=self._robot, arrived=arrived, segments=self._segments)
            )
        except Exception as error:  # the edge of the client's thread: no message may end it
            self._refuse(error)


def _trust(client: Any, ca: Path) -> None:
    """Enable TLS; accept only brokers whose certificate is signed by this authority.

    Raises:
        InputError: the file is not a certificate in PEM format.
    """
    place = require_file(ca, suffix=".pem")  # else a pipe would be waited for
    try:
        client.tls_set(str(place))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{display_path(ca)}: not a certificate in PEM form; --ca needs that of the authority that "
            "signed the broker's"
        ) from error
