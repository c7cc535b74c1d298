"""Link to an OptiTrack motion capture system over UDP, and an emulated server."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from abc import abstractmethod
from collections import Counter
from collections.abc import Mapping

import numpy as np

from srs_twin.errors import InputError, check_choice
from srs_twin.live import natnet
from srs_twin.live.links import LOOPBACK, Link, clock, resolved
from srs_twin.live.messages import POSES, BadMessageError, Message

_ASKS_EVERY_S = 1.0
_ASKS_NAMES_EVERY_S = 10.0
"""Interval between requests for the names of rigid bodies, s.

The names are requested repeatedly, because the server does not report changed names.
"""
_WINDOW = 1000
"""Minimum jump in frame numbers that indicates a restart of the server."""
_LISTENS_S = 0.1


class _UdpLink(Link):
    """Link that listens to each of its UDP sockets in a separate thread."""

    def __init__(self, own: socket.socket) -> None:
        super().__init__()
        self._sockets = [own]
        self._over = threading.Event()
        self._threads: list[threading.Thread] = []

    def _start(self) -> None:
        """Start to listen to the newest socket."""
        own = self._sockets[-1]
        own.settimeout(_LISTENS_S)
        thread = threading.Thread(target=self._listen, args=(own,), daemon=True)
        self._threads.append(thread)
        thread.start()

    def _listen(self, own: socket.socket) -> None:
        while not self._over.is_set():
            self._idle()
            try:
                packet, sender = own.recvfrom(65_536)
            except TimeoutError:
                continue
            except OSError:
                if own not in self._sockets:
                    return
                self.counts["unreachable"] += 1
                time.sleep(_LISTENS_S)
                continue
            self._arrived(packet, sender)

    def _arrived(self, packet: bytes, sender: tuple[str, int]) -> None:
        arrived = clock()
        try:
            kind, content = natnet.opened(packet)
            self._packet(kind, content, sender, arrived)
        except Exception as error:  # An exception would end this thread.
            self._refuse(error)

    def _idle(self) -> None:
        """Send due requests before the link waits for the next packet."""

    @abstractmethod
    def _packet(
        self, kind: int, content: bytes, sender: tuple[str, int], arrived: float
    ) -> None:
        """Process a packet that arrived at a given time on the local clock (s)."""

    def close(self) -> None:
        """See `Link.close`."""
        self._over.set()
        for thread in self._threads:
            thread.join(timeout=2 * _LISTENS_S + 1)
        for own in self._sockets:
            own.close()


class FrameNumbers:
    """Counter of lost, reordered and repeated motion capture frames."""

    def __init__(self) -> None:
        self._newest: int | None = None
        self._missing: set[int] = set()

    def count(self, number: int, counts: Counter[str]) -> None:
        """Update `counts` with the number of a received frame.

        A late frame is no longer counted as lost.
        """
        newest = self._newest
        if newest is None or not -_WINDOW < number - newest < _WINDOW:
            self._newest = number
            self._missing = set()
        elif number > newest:
            if number > newest + 1:
                counts["frames lost"] += number - newest - 1
            self._missing.update(range(newest + 1, number))
            self._newest = number
            self._missing = {
                missing for missing in self._missing if missing > number - _WINDOW
            }
        elif number in self._missing:
            self._missing.remove(number)
            counts["frames lost"] -= 1
            counts["frames reordered"] += 1
        else:
            counts["frames repeated"] += 1


class NatNetLink(_UdpLink):
    """Link that receives frames from a motion capture system.

    The poses of the tracked bodies in each frame become a message of kind `POSES`.

    Attributes:
        version: NatNet version of the server, or None until the server has answered.
        names: names of the rigid bodies, keyed by id.
    """

    def __init__(
        self,
        host: str = LOOPBACK,
        port: int = natnet.COMMAND_PORT,
        *,
        local: str = LOOPBACK,
        up: str = "y",
    ) -> None:
        """Start requesting frames from a server.

        Args:
            host: name or address of the server.
            port: command port of the server.
            local: address of this machine to which the server sends frames.
            up: upward axis of the motion capture system, "y" or "z".

        Raises:
            InputError: the host of the server is unknown, `local` is not an address
                of this machine, or the axis is unknown.
        """
        check_choice("up", up, ("y", "z"))
        # The host name is resolved, because packets contain the numeric address of
        # their sender.
        host = resolved(host)
        local = resolved(local)
        own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            own.bind((local, 0))
        except OSError as error:
            own.close()
            raise InputError(
                f"motion capture frames cannot be received at {local} ({error}); give"
                " an address of this machine with --local"
            ) from error
        super().__init__(own)
        self.version: natnet.Version | None = None
        self.names: dict[int, str] = {}
        self._server = (host, port)
        self._local = local
        self._up = up
        self._asked = 0.0
        self._asked_names = 0.0
        self._last = -1.0
        self._unknown = False
        self._numbers = FrameNumbers()
        self._group: natnet.Group | None = None
        self._start()

    def _idle(self) -> None:
        now = clock()
        if now - self._asked < _ASKS_EVERY_S:
            return
        self._asked = now
        silent = self.version is None or now - self._last > 2 * _ASKS_EVERY_S
        # A restarted server does not know its clients, so the link connects again.
        if silent:
            self._ask(natnet.Packet.CONNECT, b"Ping\0")
        else:
            self._ask(natnet.Packet.KEEPALIVE, b"\0")
        is_due = now - self._asked_names > _ASKS_NAMES_EVERY_S
        if self.version is not None and (not self.names or self._unknown or is_due):
            self._asked_names = now
            self._ask(natnet.Packet.REQUEST_MODELDEF)

    def _ask(self, kind: natnet.Packet, content: bytes = b"") -> None:
        with contextlib.suppress(OSError):
            self._sockets[0].sendto(natnet.closed(kind, content), self._server)

    def _packet(
        self, kind: int, content: bytes, sender: tuple[str, int], arrived: float
    ) -> None:
        # The server sends frames and answers from different ports.
        expected = self._server
        if kind == natnet.Packet.FRAME:
            expected = (self._server[0], sender[1])
        if sender != expected:
            raise BadMessageError("the packet came from an unexpected address")
        if kind == natnet.Packet.SERVER_INFO:
            self._meet(natnet.read_server(content))
        elif self.version is None:
            raise BadMessageError(
                "the packet arrived before the version of the server was known"
            )
        elif kind == natnet.Packet.MODELDEF:
            self.names = natnet.read_models(content, self.version)
            self._unknown = False
        elif kind == natnet.Packet.FRAME:
            frame = natnet.read_frame(content, self.version)
            self._last = arrived
            self._count(frame)
            self._take(self._message(frame, arrived))
        else:
            raise BadMessageError("packets of this kind are not used")

    def _meet(self, server: natnet.Server) -> None:
        if self.version is None:
            self._asked = 0.0
        self.version = server.version
        if server.group is not None and server.group != self._group:
            try:
                self._join(server.group)
            except (OSError, OverflowError) as error:
                raise BadMessageError(
                    "the multicast group of the server cannot be joined"
                ) from error

    def _message(self, frame: natnet.Frame, arrived: float) -> Message:
        seen = {key: body for key, body in frame.bodies.items() if body.tracked}
        poses = [natnet.rotate(body, self._up) for body in seen.values()]
        values = np.array(poses).reshape(-1, 4)
        names = tuple(self.names.get(key, str(key)) for key in seen)
        return Message(POSES, "natnet", frame.time, arrived, values, names)

    def _count(self, frame: natnet.Frame) -> None:
        self._unknown |= (
            bool(self.names) and not frame.bodies.keys() <= self.names.keys()
        )
        self._numbers.count(frame.number, self.counts)
        useless = sum(
            natnet.unit_quaternion(body.turn) is None or not natnet.is_place(body.place)
            for body in frame.bodies.values()
        )
        if useless:
            self.counts["bodies without a usable pose"] += useless

    def _join(self, group: natnet.Group) -> None:
        own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            # Other programs on this machine may listen to the same multicast group.
            own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            own.bind(group)
            member = socket.inet_aton(group.address) + socket.inet_aton(self._local)
            own.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        except (OSError, OverflowError):
            own.close()
            raise
        for earlier in self._sockets[1:]:
            self._sockets.remove(earlier)
            earlier.close()
        self._group = group
        self._sockets.append(own)
        self._start()


class NatNetServer(_UdpLink):
    """Emulated motion capture server that sends frames to its clients."""

    def __init__(
        self, names: Mapping[int, str], *, host: str = LOOPBACK, port: int = 0
    ) -> None:
        """Open the command port and wait for clients.

        Args:
            names: names of the rigid bodies, keyed by id.
            host: address of this machine on which the server listens.
            port: command port, or 0 for any free port.

        Raises:
            InputError: the address is in use or does not belong to this machine.
        """
        own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            own.bind((host, port))
        except (OSError, UnicodeError, OverflowError) as error:
            own.close()
            raise InputError(
                f"the address {host}:{port} cannot be used for NatNet: {error}"
            ) from error
        super().__init__(own)
        self.port: int = own.getsockname()[1]
        self._names = dict(names)
        self._number = 0
        self._clients = dict[tuple[str, int], float]()
        self._start()

    def send(self, time: float, bodies: Mapping[int, natnet.RigidBody]) -> None:
        """Send a frame with its time on the local clock (s) to all active clients."""
        packet = natnet.write_frame(natnet.Frame(self._number, time, bodies))
        now = clock()
        self._number += 1
        for client, heard in list(self._clients.items()):
            if now - heard < 10 * _ASKS_EVERY_S:
                with contextlib.suppress(OSError):
                    self._sockets[0].sendto(packet, client)

    def _packet(
        self, kind: int, content: bytes, sender: tuple[str, int], arrived: float
    ) -> None:
        self._clients[sender] = arrived
        answers: dict[int, bytes] = {
            natnet.Packet.CONNECT: natnet.write_server(),
            natnet.Packet.REQUEST_MODELDEF: natnet.write_models(self._names),
            natnet.Packet.REQUEST: natnet.closed(natnet.Packet.UNRECOGNIZED),
        }
        if kind in answers:
            self._sockets[0].sendto(answers[kind], sender)
        elif kind != natnet.Packet.KEEPALIVE:
            raise BadMessageError(f"packets of kind {kind} are not used")
