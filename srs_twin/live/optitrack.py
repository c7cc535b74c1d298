"""Motion capture over UDP: `NatNetLink` receives what OptiTrack streams, `NatNetServer` stands in for it."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from abc import abstractmethod
from collections.abc import Iterable, Mapping

import numpy as np

from srs_twin.errors import InputError
from srs_twin.live import natnet
from srs_twin.live.links import LOOPBACK, Link, clock, resolved
from srs_twin.live.messages import POSES, BadMessageError, Message

_ASKS_EVERY_S = 1.0
_LISTENS_S = 0.1


class _UdpLink(Link):
    """A thread that listens on a socket."""

    def __init__(self, sockets: Iterable[socket.socket]) -> None:
        super().__init__()
        self._sockets, self._over = list(sockets), threading.Event()
        for each in self._sockets:
            each.settimeout(_LISTENS_S)
        self._threads = [threading.Thread(target=self._listen, args=(s,), daemon=True) for s in self._sockets]

    def _start(self) -> None:
        # A first answer may add a thread while the others are started.
        for each in tuple(self._threads):
            each.start()

    def _listen(self, own: socket.socket) -> None:
        while not self._over.is_set():
            self._idle()
            try:
                packet, sender = own.recvfrom(65_536)
            except TimeoutError:
                continue
            except OSError:
                self.counts["unreachable"] += 1
                time.sleep(_LISTENS_S)
                continue
            arrived = clock()
            try:
                kind, content = natnet.opened(packet)
                self._packet(kind, content, sender, arrived)
            except BadMessageError as error:
                self._refuse(error)

    def _idle(self) -> None:
        """Do what is due."""

    @abstractmethod
    def _packet(self, kind: int, content: bytes, sender: tuple[str, int], arrived: float) -> None:
        """Take a packet."""

    def close(self) -> None:
        """See `Link.close`."""
        self._over.set()
        for each in self._threads:
            each.join(timeout=2 * _LISTENS_S + 1)
        for own in self._sockets:
            own.close()


class NatNetLink(_UdpLink):
    """Bodies that a motion capture system sees, as messages of kind `POSES`.

    Attributes:
        version: of the server's frames; None before its first answer.
        names: of its bodies.
    """

    def __init__(
        self, host: str = LOOPBACK, port: int = natnet.COMMAND_PORT, *, local: str = LOOPBACK, up: str = "y"
    ) -> None:
        """Ask a server for its frames, now and until it answers.

        Args:
            host: of the server.
            port: its command port.
            local: address of ours on which frames arrive.
            up: axis that is up in the frames, "y" or "z".

        Raises:
            InputError: the server's name is unknown, or we have no such address.
        """
        # Packets name their sender by its number.
        host, local = resolved(host), resolved(local)
        own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            own.bind((local, 0))
        except OSError as error:
            own.close()
            raise InputError(f"frames cannot arrive at {local}: {error}") from error
        super().__init__([own])
        self.version: natnet.Version | None = None
        self.names: dict[int, str] = {}
        self._server, self._local, self._up = (host, port), local, up
        self._asked, self._last, self._number = 0.0, -1.0, -1
        self._start()

    def _idle(self) -> None:
        now = clock()
        if now - self._asked < _ASKS_EVERY_S:
            return
        self._asked = now
        silent = self.version is None or now - self._last > 2 * _ASKS_EVERY_S
        content = natnet.CONNECT, b"Ping\0"
        asked = [content] if silent else [(natnet.KEEPALIVE, b"\0")]
        if self.version is not None and not self.names:
            asked.append((natnet.REQUEST_MODELDEF, b""))
        for kind, text in asked:
            with contextlib.suppress(OSError):
                self._sockets[0].sendto(natnet.closed(kind, text), self._server)

    def _packet(self, kind: int, content: bytes, sender: tuple[str, int], arrived: float) -> None:
        if sender[0] != self._server[0]:
            raise BadMessageError("a packet from elsewhere")
        if kind == natnet.SERVER_INFO:
            self.version, group = natnet.read_server(content)
            if group is not None and len(self._sockets) == 1:
                try:
                    self._join(*group)
                except OSError as error:
                    raise BadMessageError(f"group {group[0]} cannot be joined") from error
            self._asked = 0.0
        elif self.version is None:
            raise BadMessageError("a packet before the server said its version")
        elif kind == natnet.MODELDEF:
            self.names = natnet.read_models(content, self.version)
        elif kind == natnet.FRAME:
            frame = natnet.read_frame(content, self.version)
            self._last = arrived
            if self._number >= 0 and frame.number > self._number + 1:
                self.counts["frames lost"] += frame.number - self._number - 1
            self._number = frame.number
            seen = {key: each for key, each in frame.bodies.items() if each.tracked}
            values = [natnet.turned(each, self._up) for each in seen.values()]
            names = tuple(self.names.get(key, str(key)) for key in seen)
            self._take(Message(POSES, "natnet", frame.time, arrived, np.array(values).reshape(-1, 4), names))

    def _join(self, group: str, port: int) -> None:
        """Listen to a multicast group as well."""
        own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        own.bind((group, port))
        member = socket.inet_aton(group) + socket.inet_aton(self._local)
        own.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        own.settimeout(_LISTENS_S)
        self._sockets.append(own)
        self._threads.append(threading.Thread(target=self._listen, args=(own,), daemon=True))
        self._threads[-1].start()


class NatNetServer(_UdpLink):
    """A stand-in for a motion capture system: sends frames to whoever asks.

    Attributes:
        port: its command port.
    """

    def __init__(
        self, names: Mapping[int, str], *, host: str = LOOPBACK, port: int = 0,
        version: natnet.Version = (4, 1), group: str | None = None, data_port: int = natnet.DATA_PORT,
    ) -> None:  # fmt: skip
        """Listen.

        Args:
            names: of the bodies, by id.
            host: address of ours.
            port: command port; 0: one that is free.
            version: of the frames.
            group: to which frames are multicast; None: to each who asked.
            data_port: of the group.

        Raises:
            InputError: the address is taken, or none of ours.
        """
        own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            own.bind((host, port))
        except (OSError, UnicodeError, OverflowError) as error:
            own.close()
            raise InputError(f"{host}:{port} cannot be listened on: {error}") from error
        super().__init__([own])
        self.port: int = own.getsockname()[1]
        self._names, self._version, self._group = dict(names), version, group
        self._data_port, self._clients, self._number = data_port, dict[tuple[str, int], float](), 0
        if group is not None:
            own.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(host))
            own.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, struct.pack("b", 0))
        self._start()

    def send(self, time: float, bodies: Mapping[int, natnet.RigidBody]) -> None:
        """Send a frame (time of our clock, s)."""
        packet = natnet.write_frame(natnet.Frame(self._number, time, bodies), self._version)
        self._number += 1
        now = clock()
        alive = [each for each, heard in list(self._clients.items()) if now - heard < 10 * _ASKS_EVERY_S]
        to = [(self._group, self._data_port)] if self._group else alive
        for each in to:
            with contextlib.suppress(OSError):
                self._sockets[0].sendto(packet, each)

    def _packet(self, kind: int, content: bytes, sender: tuple[str, int], arrived: float) -> None:
        self._clients[sender] = arrived
        answers = {
            natnet.CONNECT: natnet.write_server(self._version, group=self._group, port=self._data_port),
            natnet.REQUEST_MODELDEF: natnet.write_models(self._names, self._version),
            natnet.REQUEST: natnet.closed(natnet.UNRECOGNIZED),
        }
        if kind in answers:
            self._sockets[0].sendto(answers[kind], sender)
        elif kind != natnet.KEEPALIVE:
            raise BadMessageError(f"a packet of kind {kind}")
