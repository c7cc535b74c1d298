"""MCAP messages (ROS 2, Foxglove, and ROS 1 as written by `mcap convert`), within size limits."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

from srs_twin.recordings.csv_table import RecordedFile
from srs_twin.recordings.formats.topics import (
    ChunkError,
    CutError,
    Message,
    Topic,
    check_unpacked,
    unpacked,
)

NAME = "MCAP"
MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x03, 0x04, 0x05, 0x06
_HEAD = struct.Struct("<BQ")
"""Header of a record: kind and length."""
_MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Header of a message: channel, sequence, log time, publish time."""
_CHUNK_HEAD = struct.Struct("<QQQI")
"""Header of a chunk: first and last time, unpacked size and its checksum."""


def recognizes(start: RecordedFile) -> bool:
    """Return whether a file starts with the magic bytes of MCAP."""
    return start.data.startswith(MAGIC)


def messages(file: RecordedFile) -> Iterator[Message]:
    """Yield the messages of a file in its order.

    Raises:
        InputError: the unpacked chunks are larger than allowed.
        ChunkError: the file is damaged; a `CutError` if its end is missing.
    """
    data = memoryview(file.data)
    chunks = (content for kind, content in _records(data[len(MAGIC) :]) if kind == _CHUNK)
    check_unpacked(file, (_CHUNK_HEAD.unpack_from(chunk)[2] for chunk in chunks))
    return stream_messages(data)


def stream_messages(data: memoryview) -> Iterator[Message]:
    """Yield the messages of a file as `messages` does, but without a limit of the unpacked size."""
    kinds: dict[int, str] = {}
    channels: dict[int, Topic] = {}
    for outer, packed in _records(data[len(MAGIC) :]):
        for kind, content in _records(_unpacked(packed)) if outer == _CHUNK else [(outer, packed)]:
            if kind == _MESSAGE:
                number, _, log_time, _ = _MESSAGE_HEAD.unpack_from(content)
                yield Message(channels[number], log_time, content[_MESSAGE_HEAD.size :])
            elif kind == _SCHEMA:
                kinds[int.from_bytes(content[:2], "little")] = _text(content, 2)[0]
            elif kind == _CHANNEL:
                number, schema = struct.unpack_from("<HH", content)
                name, place = _text(content, 4)
                encoding, _ = _text(content, place)
                channels[number] = Topic(name, kinds.get(schema) or encoding, encoding)


def _records(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield kind and content of successive records."""
    while data and data != MAGIC:
        if len(data) < _HEAD.size:
            raise CutError("the file ends in a record")
        kind, length = _HEAD.unpack_from(data)
        content, data = data[_HEAD.size : _HEAD.size + length], data[_HEAD.size + length :]
        if len(content) < length:
            raise CutError("the file ends in a record")
        yield kind, content


def _unpacked(chunk: memoryview) -> memoryview:
    """Return the records of a chunk."""
    _, _, size, checksum = _CHUNK_HEAD.unpack_from(chunk)
    compression, end = _text(chunk, _CHUNK_HEAD.size)
    data = unpacked(chunk[end + 8 :], compression, size)
    if checksum and zlib.crc32(data) != checksum:
        raise ChunkError("the checksum of a chunk is wrong")
    return memoryview(data)


def _text(content: memoryview, place: int) -> tuple[str, int]:
    """Return a string, and the position after it."""
    end = place + 4 + int.from_bytes(content[place : place + 4], "little")
    if end > len(content):
        raise ChunkError("a string is longer than its record")
    return str(content[place + 4 : end], "utf-8", "replace"), end
