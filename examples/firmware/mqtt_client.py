"""MQTT 3.1.1 client that never waits for the network.

The common client of MicroPython, `umqtt.simple`, waits in `connect`, in writes to a
stalled link and within half a message. The valves would hold their state for as long.
This client does what is possible at once and returns. It knows one subscription and
messages without acknowledgement (QoS 0), and no encryption.
"""

import errno
import select
import socket

KEEPALIVE_S = (
    3  # The broker publishes the will after 1.5 times as long without a message.
)
LARGEST_BYTES = 2048  # Longer messages are skipped.
_PING_MS = 1000
_SILENT_MS = (
    3000  # Largest time without an answer of the broker; then the client reconnects.
)
_RETRY_MS = 1000
_READS = 16  # per call of `poll`
_CHUNK = bytearray(1024)
_LARGEST_WAITING = 4096  # bytes to send; messages beyond are dropped
_CONNECT = 0x10
_CONNACK = 0x20
_PUBLISH = 0x30
_SUBSCRIBE = 0x82
_PING = 0xC0
_DISCONNECT = 0xE0
_CLOSED, _CONNECTING, _GREETED, _READY = range(4)
_IPPROTO_TCP, _TCP_NODELAY = (
    6,
    1,
)  # MicroPython's socket module does not name them everywhere.


def _text(content):
    return len(content).to_bytes(2, "big") + content


def _packet(kind, body):
    head = bytearray([kind])
    rest = len(body)
    while rest > 127:
        head.append(rest & 127 | 128)
        rest >>= 7
    head.append(rest)
    return bytes(head) + body


class MqttClient:
    """Connection to a broker that is established again whenever it breaks off.

    Attributes:
        connections: number of times that the broker has accepted us.
        dropped: number of messages that were not sent, because the link was down or
            slow.
    """

    def __init__(self, address, name, subscription, will, user=b"", password=b""):
        """Connect at the first `poll`.

        Args:
            address: (IPv4 address, port) of the broker; looking up a name would wait.
            name: our name at the broker, bytes; a new connection of this name ends the
                old one.
            subscription: topic to hear, bytes.
            will: (topic, payload) that the broker publishes if the connection breaks
                off, bytes.
            user: name of the user, bytes; empty for none.
            password: password of that user, bytes.
        """
        self.connections = self.dropped = 0
        self._address = address
        flags = 0x06 | (0xC0 if user else 0)  # clean session, will
        self._greeting = _packet(
            _CONNECT,
            _text(b"MQTT")
            + bytes([4, flags])
            + KEEPALIVE_S.to_bytes(2, "big")
            + _text(name)
            + _text(will[0])
            + _text(will[1])
            + (_text(user) + _text(password) if user else b""),
        )
        self._subscribing = _packet(_SUBSCRIBE, b"\0\1" + _text(subscription) + b"\0")
        self._socket = None
        self._retry = 0
        self._reset(0)

    def _reset(self, now):
        self._state = _CLOSED
        self._in = b""
        self._out = b""
        self._skip = 0
        self._heard = self._pinged = now

    def poll(self, now):
        """Receive, send and reconnect as far as possible at once.

        Args:
            now: time, ms.

        Returns:
            The payloads that have arrived, the newest last.
        """
        try:
            if self._socket is None:
                if now >= self._retry:
                    self._open(now)
                return []
            if now - self._heard > _SILENT_MS:
                raise OSError(errno.ETIMEDOUT)
            if self._state == _CONNECTING and not self._connected():
                return []
            found = self._receive(now)
            if self._state == _READY and now - self._pinged >= _PING_MS:
                self._pinged = now
                self._out += _packet(_PING, b"")
            self._send()
        except OSError:
            self._close(now)
            return []
        return found

    def publish(self, topic, payload):
        """Send a message with the next `poll` or `flush`, or drop it where the link is down or slow."""
        packet = _packet(_PUBLISH, _text(topic) + payload)
        if self._state != _READY or len(self._out) + len(packet) > _LARGEST_WAITING:
            self.dropped += 1
        else:
            self._out += packet

    def flush(self, now):
        """Send what is waiting as far as possible at once."""
        try:
            self._send()
        except OSError:
            self._close(now)

    def disconnect(self, now):
        """Send what is waiting, if possible at once, and take leave: the broker publishes no will."""
        if self._state == _READY:
            self._out += _packet(_DISCONNECT, b"")
            self.flush(now)
        self._close(now)

    def _open(self, now):
        self._reset(now)
        self._retry = now + _RETRY_MS
        self._socket = socket.socket()
        self._socket.setblocking(False)
        try:
            self._socket.setsockopt(_IPPROTO_TCP, _TCP_NODELAY, 1)
        except OSError:
            pass  # Small messages then wait for the acknowledgement of the one before.
        self._state = _CONNECTING
        self._poller = select.poll()
        try:
            self._socket.connect(
                socket.getaddrinfo(self._address[0], self._address[1])[0][-1]
            )
        except OSError as error:
            if error.errno != errno.EINPROGRESS:
                raise
        self._poller.register(self._socket, select.POLLIN | select.POLLOUT)

    def _connected(self):
        for event in self._poller.poll(0):
            if event[1] & (select.POLLERR | select.POLLHUP):
                raise OSError(errno.ECONNREFUSED)
            if event[1] & select.POLLOUT:
                self._state = _GREETED
                self._out = self._greeting
                return True
        return False

    def _close(self, now):
        if self._socket is not None:
            self._socket.close()
        self._socket = None
        self._reset(now)
        self._retry = now + _RETRY_MS

    def _send(self):
        while self._out and self._state >= _GREETED:
            try:
                sent = self._socket.send(self._out)
            except OSError as error:
                if error.errno == errno.EAGAIN:
                    return
                raise
            self._out = self._out[sent:]

    def _receive(self, now):
        found = []
        for _ in range(_READS):
            count = self._socket.readinto(_CHUNK)
            if count is None:  # nothing more at present
                break
            if count == 0:
                raise OSError(errno.ECONNRESET)
            self._heard = now
            skipped = min(self._skip, count)
            self._skip -= skipped
            self._in += bytes(memoryview(_CHUNK)[skipped:count])
            self._split(found)
        return found

    def _split(self, found):
        """Take whole packets off the bytes that have arrived."""
        while len(self._in) >= 2:
            length = shift = 0
            for at in range(1, min(5, len(self._in))):
                length |= (self._in[at] & 127) << shift
                shift += 7
                if self._in[at] < 128:
                    break
            else:
                if len(self._in) >= 5:
                    raise OSError(errno.EINVAL)
                return
            start = at + 1
            end = at + 1 + length
            if length > LARGEST_BYTES:
                self._skip = max(0, end - len(self._in))
                self._in = self._in[end:]
                continue
            if len(self._in) < end:
                return
            self._handle(self._in[0], self._in[start:end], found)
            self._in = self._in[end:]

    def _handle(self, kind, body, found):
        if kind & 0xF0 == _PUBLISH and len(body) >= 2:
            found.append(body[2 + (body[0] << 8 | body[1]) :])
        elif kind == _CONNACK:
            if len(body) != 2 or body[1] != 0:
                raise OSError(errno.EACCES)
            self._state = _READY
            self.connections += 1
            self._out += self._subscribing
