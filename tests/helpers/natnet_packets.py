"""NatNet packets of a server, in all versions that the link reads; the package writes version 4.1 only."""

from __future__ import annotations

import struct
from collections.abc import Mapping

from srs_twin.live.natnet import Frame, Packet, Version, closed


def write_server(
    version: Version, *, group: str | None = None, port: int = 1511
) -> bytes:
    """Return a server's answer to `Packet.CONNECT`."""
    content = (
        b"srs_twin".ljust(256, b"\0") + bytes([1, 0, 0, 0]) + bytes([*version, 0, 0])
    )
    if version >= (3, 0):
        octets = map(int, (group or "0.0.0.0").split("."))
        content += struct.pack("<QH?4B", 10**9, port, group is not None, *octets)
    return closed(Packet.SERVER_INFO, content)


def write_models(names: Mapping[int, str], version: Version) -> bytes:
    """Return the descriptions of rigid bodies without markers."""
    content = struct.pack("<i", len(names))
    for number, name in names.items():
        turn = struct.pack("<4f", 0, 0, 0, 1) if version >= (4, 2) else b""
        markers = struct.pack("<i", 0) if version >= (3, 0) else b""
        body = (
            name.encode()
            + b"\0"
            + struct.pack("<ii3f", number, -1, 0, 0, 0)
            + turn
            + markers
        )
        size = struct.pack("<i", len(body)) if version >= (4, 1) else b""
        content += struct.pack("<i", 1) + size + body
    return closed(Packet.MODELDEF, content)


def write_frame(frame: Frame, version: Version) -> bytes:
    """Return the packet of a frame."""

    def listed(parts: list[bytes]) -> bytes:
        content = b"".join(parts)
        size = struct.pack("<i", len(content)) if version >= (4, 1) else b""
        return struct.pack("<i", len(parts)) + size + content

    none = listed([])
    bodies = [
        struct.pack("<i7f", key, *body.place, *body.turn)
        + (struct.pack("<i", 0) if version < (3, 0) else b"")
        + struct.pack("<fH", body.error, int(body.tracked))
        for key, body in frame.bodies.items()
    ]
    content = struct.pack("<i", frame.number) + none + none + listed(bodies) + none
    # Assets, labelled markers, force plates and devices.
    content += none * (
        1 + (version >= (4, 1)) + (version >= (2, 9)) + (version >= (2, 11))
    )
    content += struct.pack("<II", 0, 0) + struct.pack(
        "<d" if version >= (2, 7) else "<f", frame.time
    )
    if version >= (3, 0):
        content += struct.pack("<3Q", 0, 0, 0)
    if version >= (4, 1):
        content += struct.pack("<II", 0, 0)
    return closed(Packet.FRAME, content + struct.pack("<Hi", 0, 0))
