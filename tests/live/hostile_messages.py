"""Seeded messages and packets of which none may be taken for a robot's or a motion capture system's."""

from __future__ import annotations

import json
import math
import struct
from random import Random
from typing import Any

import natnet_packets as packets

from srs_twin.live import natnet
from srs_twin.live.messages import BENDS, CONTROL, KINDS, STATUS

VERSION = (4, 1)


def valid(kind: str, segments: int, time: float) -> dict[str, Any]:
    """Return a message that would be taken."""
    if kind == BENDS:
        return {"t": time, "rad": [0.0] * segments}
    if kind in (STATUS, CONTROL):
        return {"t": time, "text": "pause"}
    return {"t": time, "plus": [0] * segments, "minus": [0] * segments}


def not_json(draw: Random, text: bytes) -> bytes:
    """Return bytes that no JSON parser takes."""
    return draw.choice(
        [
            b"",
            b"\x00" + draw.randbytes(draw.randrange(300)),
            text[: draw.randrange(1, len(text))],
            text + b"}",
            b"[" * draw.randrange(1, 60_000),
            b"\xff\xfe" + text,
            text.replace(b'"t"', b"t"),
            b'{"t": 0x10}',
            text.replace(b":", b"=", 1),
        ]
    )


def no_object(draw: Random) -> bytes:
    """Return JSON that is no object."""
    return json.dumps(
        draw.choice(
            [
                None,
                True,
                "stop it",
                [],
                [{"t": 1}],
                10**400,
            ]
        )
    ).encode()


def wrong_value(draw: Random) -> Any:
    """Return a value that is not a number within the bounds of any key."""
    return draw.choice(
        [
            math.nan,
            math.inf,
            1e300,
            "1",
            [0.0],
            {"t": 1},
            True,
            1e11,
        ]
    )


def message(draw: Random, segments: int) -> tuple[str, bytes, bool]:
    """Return a kind, a payload and whether the broker had retained it."""
    kind = draw.choice(KINDS)
    said = valid(kind, segments, draw.uniform(0.0, 1e4))
    text = json.dumps(said).encode()
    how = draw.randrange(8)
    if how == 0:
        return kind, not_json(draw, text), False
    if how == 1:
        return kind, no_object(draw), False
    if how == 2 and kind != STATUS:
        return kind, text, True
    if how == 3:
        return kind, text + b" " * 65_536, False
    if how == 4:
        del said["t"]
    elif how == 5 or kind in (STATUS, CONTROL):
        said["t"] = wrong_value(draw)
    else:
        key = draw.choice([each for each in said if each != "t"])
        values = [0.0] * segments
        values[draw.randrange(segments)] = wrong_value(draw)
        other = [
            [0.0] * (segments + draw.choice([-1, 1, 1000])),
            wrong_value(draw),
            None,
            values,
        ]
        said[key] = draw.choice(other)
    return kind, json.dumps(said).encode(), False


def frame(draw: Random, time: float = 1.0) -> bytes:
    """Return a frame that would be taken."""
    bodies = {
        k: natnet.RigidBody((draw.random(), draw.random(), draw.random()))
        for k in range(1, 4)
    }
    return packets.write_frame(
        natnet.Frame(draw.randrange(1000), time, bodies), VERSION
    )


def packet(draw: Random, server: tuple[str, int]) -> tuple[bytes, tuple[str, int]]:
    """Return a packet and its sender."""
    elsewhere = "10.9.8.7", server[1]
    restarted = server[0], server[1] % 65_535 + 1
    answers = [packets.write_server((3, 0)), packets.write_models({1: "a"}, VERSION)]
    _, content = natnet.opened(frame(draw))
    counts = struct.pack("<i", draw.choice([-1, -(2**31), 2**31 - 1, 20_000]))
    counts += draw.randbytes(200)
    unused = [
        natnet.Packet.REQUEST,
        natnet.Packet.RESPONSE,
        natnet.Packet.UNRECOGNIZED,
        8,
        42,
        65_535,
    ]
    from_server = [
        draw.randbytes(draw.randrange(4)),
        struct.pack("<HH", 7, 65_000) + draw.randbytes(draw.randrange(500)),
        natnet.closed(
            natnet.Packet.FRAME, content[: draw.randrange(len(content) // 2)]
        ),
        frame(draw, draw.choice([math.nan, math.inf, 1e11, -1e300])),
        packets.write_server(draw.choice([(1, 9), (2, 5), (5, 0), (255, 255)])),
        packets.write_server(
            VERSION,
            group=draw.choice(["10.0.0.1", "0.0.0.0", "255.255.255.255", "192.0.2.7"]),
            port=draw.choice([1511, 1600]),
        ),
        natnet.closed(natnet.Packet.FRAME, content[:4] + counts),
        natnet.closed(natnet.Packet.MODELDEF, counts),
        natnet.closed(draw.choice(unused), draw.randbytes(draw.randrange(100))),
    ]
    from_others = [
        (frame(draw), elsewhere),
        (draw.choice(answers), draw.choice([elsewhere, restarted])),
    ]
    return draw.choice([*from_others, *((each, server) for each in from_server)])
