"""MCAP: the messages of a file, within bounds (ROS 2, Foxglove, and ROS 1 as `mcap convert` writes it)."""

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
_HEAD = struct.Struct("<BQ")  # of a record: its kind and length
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_CHUNK_HEAD = struct.Struct("<QQQI")  # first and last time, size when unpacked, its checksum


def recognizes(start: RecordedFile) -> bool:
    """Say whether a file starts with MCAP's magic bytes."""
    return start.data.startswith(MAGIC)


def messages(file: RecordedFile) -> Iterator[Message]:
    """Yield the messages of a file in its order.

    Raises:
        InputError: its chunks unpack to more than is read.
        ChunkError: it is damaged; a `CutError` where it has no end.
    """
    data = memoryview(file.data)
    chunks = (content for kind, content in _records(data[len(MAGIC) :]) if kind == _CHUNK)
    check_unpacked(file, (_CHUNK_HEAD.unpack_from(chunk)[2] for chunk in chunks))
    return stream_messages(data)


def stream_messages(data: memoryview) -> Iterator[Message]:
    """Yield the messages of a file in its order, however much its chunks unpack to; as `messages`."""
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
    """Yield kind and content of records that follow each other."""
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
    how, place = _text(chunk, _CHUNK_HEAD.size)
    data = unpacked(chunk[place + 8 :], how, size)
    if checksum and zlib.crc32(data) != checksum:
        raise ChunkError("the checksum of a chunk is wrong")
    return memoryview(data)


def _text(content: memoryview, place: int) -> tuple[str, int]:
    """Return a text, and where it ends."""
    end = place + 4 + int.from_bytes(content[place : place + 4], "little")
    if end > len(content):
        raise ChunkError("a text is longer than its record")
    return str(content[place + 4 : end], "utf-8", "replace"), end
