"""Reader and writer for NatNet packets, which motion capture systems send over UDP.

The reader supports NatNet 2.6 to 4.2 and extracts only rigid bodies. The writer is used
by the emulator and supports NatNet 4.1. Positions (m) refer to the coordinate frame of
the Motive software. The function `rotate` converts them to a frame whose z axis points
upwards.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from srs_twin.live.messages import LATEST_S, BadMessageError

COMMAND_PORT = 1510
_DATA_PORT = 1511
VERSIONS = (
    (2, 6),
    (2, 7),
    (2, 9),
    (2, 10),
    (2, 11),
    (3, 0),
    (3, 1),
    (4, 0),
    (4, 1),
    (4, 2),
)
"""NatNet versions that the reader supports."""
_MOST = 10_000
"""Maximum number of entries in each list of a packet."""
_TRACKED = 0x01
_NAME = 256
_FURTHEST_M = 1000.0
"""Maximum absolute value of a plausible coordinate, m."""
_LENGTH_TOLERANCE = 0.1
"""Maximum difference between 1 and the norm of a valid quaternion."""

Version = tuple[int, int]
_WRITTEN: Version = (4, 1)
"""NatNet version that the writer uses."""


class Packet(IntEnum):
    """Kind of a NatNet packet."""

    CONNECT = 0
    SERVER_INFO = 1
    REQUEST = 2
    RESPONSE = 3
    REQUEST_MODELDEF = 4
    MODELDEF = 5
    FRAME = 7
    KEEPALIVE = 10
    UNRECOGNIZED = 100


@dataclass(frozen=True)
class RigidBody:
    """Pose of a rigid body in one motion capture frame.

    Attributes:
        place: position x, y, z in Motive's coordinate frame, m.
        turn: orientation as a quaternion with components x, y, z, w.
        error: mean residual of the body's markers, m.
        tracked: whether the body was tracked in this frame and has a valid pose.
    """

    place: tuple[float, ...]
    turn: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
    error: float = 0.0
    tracked: bool = True


@dataclass(frozen=True)
class Frame:
    """Single frame of motion capture data.

    Attributes:
        number: frame number assigned by the sender.
        time: time stamp on the sender's clock, s.
        bodies: rigid bodies, keyed by id.
    """

    number: int
    time: float
    bodies: Mapping[int, RigidBody] = field(default_factory=dict)


class Group(NamedTuple):
    """Address and port of a multicast group."""

    address: str
    port: int


class Server(NamedTuple):
    """NatNet version and multicast group of a motion capture server."""

    version: Version
    group: Group | None = None


class _Reader:
    def __init__(self, data: bytes) -> None:
        self._data = memoryview(data)
        self.at = 0

    def read(self, form: str) -> tuple[Any, ...]:
        try:
            values = struct.unpack_from("<" + form, self._data, self.at)
        except struct.error:
            raise BadMessageError("the packet ends too early") from None
        self.at += struct.calcsize("<" + form)
        return values

    def count(self) -> int:
        (count,) = self.read("i")
        if not 0 <= count <= _MOST:
            raise BadMessageError(
                f"the packet states a list length of {count}; 0 to {_MOST} are allowed"
            )
        return int(count)

    def listed(self, version: Version) -> tuple[int, int | None]:
        """Read the length of a list and, from NatNet 4.1 on, its end position."""
        count = self.count()
        if version < (4, 1):
            return count, None
        return count, self.end()

    def end(self) -> int:
        """Read the size of a list in bytes, and return the end position of the list."""
        (size,) = self.read("i")
        if not 0 <= size <= len(self._data) - self.at:
            raise BadMessageError("a list is longer than the packet")
        return self.at + int(size)

    def text(self) -> str:
        # The length of a name is limited, so that a damaged packet is not read as one
        # long name.
        rest = bytes(self._data[self.at : self.at + _NAME + 1])
        end = rest.find(b"\0")
        if end < 0:
            raise BadMessageError("a name in the packet is not terminated")
        self.at += end + 1
        return rest[:end].decode("utf-8", "replace")


def opened(packet: bytes) -> tuple[int, bytes]:
    """Split a packet into its kind and content.

    Raises:
        BadMessageError: the packet is invalid or incomplete.
    """
    if len(packet) < 4:
        raise BadMessageError("the packet has fewer than 4 bytes")
    kind, size = struct.unpack_from("<HH", packet)
    if len(packet) - 4 < size:
        raise BadMessageError("the packet is shorter than its header states")
    return kind, packet[4 : 4 + size]


def closed(kind: int, content: bytes = b"") -> bytes:
    """Build a packet from its kind and content."""
    return struct.pack("<HH", kind, len(content)) + content


def read_server(content: bytes) -> Server:
    """Read the NatNet version and multicast group of a server from its answer.

    Raises:
        BadMessageError: the content is invalid, or the version is not supported.
    """
    packet = _Reader(content)
    packet.at = _NAME + 4
    major, minor, _, _ = packet.read("4B")
    version = (major, minor)
    if not VERSIONS[0] <= version < (VERSIONS[-1][0] + 1, 0):
        first = ".".join(map(str, VERSIONS[0]))
        last = ".".join(map(str, VERSIONS[-1]))
        raise BadMessageError(
            f"the NatNet version is not supported; it must be between {first} and"
            f" {last}"
        )
    # Servers before NatNet 3.0 do not state their multicast group.
    if version < (3, 0) or len(content) - packet.at < 15:
        return Server(version)
    _, port, multicast, *group = packet.read("QH?4B")
    if not multicast:
        return Server(version)
    return Server(version, Group(".".join(map(str, group)), int(port)))


def write_server() -> bytes:
    """Build the answer of a unicast server to `Packet.CONNECT`."""
    name = b"srs_twin".ljust(_NAME, b"\0")
    versions = bytes([1, 0, 0, 0, *_WRITTEN, 0, 0])
    connection = struct.pack("<QH?4B", 10**9, _DATA_PORT, False, 0, 0, 0, 0)
    return closed(Packet.SERVER_INFO, name + versions + connection)


_MARKER_SET = 0
_RIGID_BODY = 1


def read_models(content: bytes, version: Version) -> dict[int, str]:
    """Read the names of the rigid bodies, keyed by id.

    Before NatNet 4.1, packets do not state the length of a description. Reading then
    ends at the first description of an unknown type.

    Raises:
        BadMessageError: the content is invalid.
    """
    packet = _Reader(content)
    names = dict[int, str]()
    for _ in range(packet.count()):
        (kind,) = packet.read("i")
        end = packet.end() if version >= (4, 1) else None
        if kind == _MARKER_SET:
            packet.text()
            for _ in range(packet.count()):
                packet.text()
        elif kind == _RIGID_BODY:
            number, name = _model(packet, version)
            names[number] = name
        elif end is None:
            break
        if end is not None:
            packet.at = end
    return names


def _model(packet: _Reader, version: Version) -> tuple[int, str]:
    name = packet.text()
    number, *_ = packet.read("ii3f4f" if version >= (4, 2) else "ii3f")
    if version >= (3, 0):
        count = packet.count()
        packet.read("3f" * count + "i" * count)
        if version >= (4, 0):
            for _ in range(count):
                packet.text()
    return number, name


def write_models(names: Mapping[int, str]) -> bytes:
    """Build a packet that describes rigid bodies without markers, given their names."""
    content = struct.pack("<i", len(names))
    for number, name in names.items():
        body = name.encode() + b"\0" + struct.pack("<ii3fi", number, -1, 0, 0, 0, 0)
        content += struct.pack("<ii", _RIGID_BODY, len(body)) + body
    return closed(Packet.MODELDEF, content)


def read_frame(content: bytes, version: Version) -> Frame:
    """Read a frame from the content of a packet.

    Raises:
        BadMessageError: the content is invalid.
    """
    packet = _Reader(content)
    (number,) = packet.read("i")
    _skip(packet, version, _marker_set)
    _skip(packet, version, _place)  # unlabelled markers
    count, end = packet.listed(version)
    bodies = dict(_body(packet, version) for _ in range(count))
    if end is not None:
        packet.at = end
    for read_one, since in _AFTER_BODIES:
        if version >= since:
            _skip(packet, version, read_one)
    # The time code is skipped, because the frame also contains a time stamp.
    packet.read("II")
    (time,) = packet.read("d" if version >= (2, 7) else "f")
    if not abs(time) <= LATEST_S:
        raise BadMessageError(
            f"the time of the frame is not a number of at most {LATEST_S:g} s"
        )
    return Frame(number, time, bodies)


def _skip(
    packet: _Reader, version: Version, read_one: Callable[[_Reader, Version], object]
) -> None:
    count, end = packet.listed(version)
    if end is None:
        for _ in range(count):
            read_one(packet, version)
    else:
        packet.at = end


def _marker_set(packet: _Reader, version: Version) -> None:
    packet.text()
    for _ in range(packet.count()):
        packet.read("3f")


def _place(packet: _Reader, version: Version) -> None:
    packet.read("3f")


def _body(packet: _Reader, version: Version) -> tuple[int, RigidBody]:
    number, *rest = packet.read("i7f")
    if version < (3, 0):
        count = packet.count()
        packet.read("3f" * count + "i" * count + "f" * count)
    error, params = packet.read("fH")
    place = tuple(rest[:3])
    turn = tuple(rest[3:])
    # The tracking flag alone is not sufficient, because some senders mark a body as
    # tracked although its orientation is invalid.
    has_pose = is_place(place) and unit_quaternion(turn) is not None
    tracked = has_pose and bool(params & _TRACKED)
    return number, RigidBody(place, turn, error, tracked)


def _skeleton(packet: _Reader, version: Version) -> None:
    packet.read("i")
    for _ in range(packet.count()):
        _body(packet, version)


def _asset(packet: _Reader, version: Version) -> None:
    # Asset lists exist only from NatNet 4.1 on, where all lists state their length.
    raise BadMessageError("the list of assets does not state its length")


def _labelled(packet: _Reader, version: Version) -> None:
    packet.read("i4fHf" if version >= (3, 0) else "i4fH")


def _channels(packet: _Reader, version: Version) -> None:
    packet.read("i")
    for _ in range(packet.count()):
        packet.read("f" * packet.count())


_AFTER_BODIES: Sequence[tuple[Callable[[_Reader, Version], object], Version]] = (
    (_skeleton, (2, 6)),
    (_asset, (4, 1)),
    (_labelled, (2, 6)),
    (_channels, (2, 9)),  # force plates
    (_channels, (2, 11)),  # devices
)
"""Readers of the lists that follow the rigid bodies.

Each reader is paired with the first NatNet version that contains the list.
"""


def write_frame(frame: Frame) -> bytes:
    """Build a packet that contains a frame."""

    def listed(*entries: bytes) -> bytes:
        content = b"".join(entries)
        return struct.pack("<ii", len(entries), len(content)) + content

    bodies = (
        struct.pack(
            "<i7ffH", key, *body.place, *body.turn, body.error, _TRACKED * body.tracked
        )
        for key, body in frame.bodies.items()
    )
    # Empty lists of marker sets and unlabelled markers precede the bodies. Empty lists
    # of skeletons, assets, labelled markers, force plates and devices follow them.
    lists = 2 * listed() + listed(*bodies) + 5 * listed()
    end = struct.pack("<IId3QIIHi", 0, 0, frame.time, *7 * [0])
    return closed(Packet.FRAME, struct.pack("<i", frame.number) + lists + end)


def is_place(place: Sequence[float]) -> bool:
    """Return whether all coordinates of a position (m) are finite and plausible."""
    return all(abs(coordinate) <= _FURTHEST_M for coordinate in place)


def unit_quaternion(turn: Sequence[float]) -> tuple[float, ...] | None:
    """Normalise a quaternion, or return None if the quaternion is invalid.

    A quaternion is invalid if its norm differs from 1 by more than 0.1. Some senders
    use NaN or zeros for an unknown orientation.
    """
    length = math.hypot(*turn)
    if not abs(length - 1) <= _LENGTH_TOLERANCE:
        return None
    return tuple(component / length for component in turn)


def rotate(body: RigidBody, up: str) -> np.ndarray:
    """Return the position x, y, z (m) and the heading (rad) of a body.

    The z axis of the returned position points upwards. The heading is the direction of
    the body's x axis. If the orientation is unknown, all values are NaN.

    Args:
        body: rigid body in Motive's coordinate frame.
        up: upward axis of Motive's coordinate frame, "y" or "z".
    """
    turn = unit_quaternion(body.turn)
    if turn is None:
        return np.full(4, math.nan)
    x, y, z = body.place
    i, j, k, w = turn
    forward = 1 - 2 * (j * j + k * k)
    if up == "y":
        return np.array([x, -z, y, math.atan2(-2 * (i * k - j * w), forward)])
    return np.array([x, y, z, math.atan2(2 * (i * j + k * w), forward)])
