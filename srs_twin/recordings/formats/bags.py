"""Readers for message bags in the formats MCAP, ROS 1 and ROS 2."""

from __future__ import annotations

import sqlite3
import struct
import zlib
from collections.abc import Iterator
from contextlib import closing
from enum import IntEnum
from typing import final

from srs_twin.recordings.formats.topics import (
    Bag,
    BagMessage,
    ChunkError,
    CutError,
    Topic,
    check_unpacked,
    unpacked,
)
from srs_twin.recordings.recorded_file import RecordedFile

MCAP_MAGIC = b"\x89MCAP0\r\n"


class _McapRecord(IntEnum):
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06


_RECORD_HEAD = struct.Struct("<BQ")
"""Record header with the kind and the length of the record."""

_MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Message header with channel, sequence number, log time and publish time."""

_CHUNK_HEAD = struct.Struct("<QQQI")
"""Chunk header with first time, last time, unpacked size and checksum."""


@final
class Mcap(Bag):
    """MCAP file with messages in the encodings cdr (ROS 2), ros1 (ROS 1) and json."""

    name = "MCAP"
    suffix = ".mcap"

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether a file starts with the magic bytes of MCAP."""
        return start.data.startswith(MCAP_MAGIC)

    def messages(self, file: RecordedFile) -> Iterator[BagMessage]:
        """Yield the messages in the order of the file."""
        data = memoryview(file.data)
        chunks = (
            content
            for kind, content in _mcap_records(data[len(MCAP_MAGIC) :])
            if kind == _McapRecord.CHUNK
        )
        check_unpacked(file, (_CHUNK_HEAD.unpack_from(chunk)[2] for chunk in chunks))
        return stream_messages(data)


def stream_messages(data: memoryview) -> Iterator[BagMessage]:
    """Yield the messages of an MCAP file, without a limit on the unpacked size."""
    kinds: dict[int, str] = {}
    channels: dict[int, Topic] = {}
    for outer, packed in _mcap_records(data[len(MCAP_MAGIC) :]):
        for kind, content in (
            _mcap_records(_unpacked_chunk(packed))
            if outer == _McapRecord.CHUNK
            else [(outer, packed)]
        ):
            if kind == _McapRecord.MESSAGE:
                number, _, log_time, _ = _MESSAGE_HEAD.unpack_from(content)
                yield BagMessage(
                    channels[number], log_time, content[_MESSAGE_HEAD.size :]
                )
            elif kind == _McapRecord.SCHEMA:
                kinds[_number(content[:2])] = _text(content, 2)[0]
            elif kind == _McapRecord.CHANNEL:
                number, schema = struct.unpack_from("<HH", content)
                name, place = _text(content, 4)
                encoding, _ = _text(content, place)
                channels[number] = Topic(name, kinds.get(schema) or encoding, encoding)


def _mcap_records(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    while data and data != MCAP_MAGIC:
        if len(data) < _RECORD_HEAD.size:
            raise CutError("the file ends in the middle of a record")
        kind, length = _RECORD_HEAD.unpack_from(data)
        end = _RECORD_HEAD.size + length
        content = data[_RECORD_HEAD.size : end]
        data = data[end:]
        if len(content) < length:
            raise CutError("the file ends in the middle of a record")
        yield kind, content


def _unpacked_chunk(chunk: memoryview) -> memoryview:
    _, _, size, checksum = _CHUNK_HEAD.unpack_from(chunk)
    compression, end = _text(chunk, _CHUNK_HEAD.size)
    data = unpacked(chunk[end + 8 :], compression, size)
    if checksum and zlib.crc32(data) != checksum:
        raise ChunkError("the checksum of a chunk is wrong")
    return memoryview(data)


def _text(content: memoryview, place: int) -> tuple[str, int]:
    end = place + 4 + _number(content[place : place + 4])
    if end > len(content):
        raise ChunkError("a string is longer than its record")
    return str(content[place + 4 : end], "utf-8", "replace"), end


_ROS1_MAGIC = b"#ROSBAG V2.0\n"
# Values of the field `op` in a record header.
_ROS1_MESSAGE = b"\2"
_ROS1_CHUNK = b"\5"
_ROS1_CONNECTION = b"\7"


@final
class Ros1Bag(Bag):
    """ROS 1 bag (version 2.0).

    The index is ignored, so that truncated bags can be read.
    """

    name = "ROS 1 bag"
    suffix = ".bag"

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether a file starts with the first line of a ROS 1 bag."""
        return start.data.startswith(_ROS1_MAGIC)

    def messages(self, file: RecordedFile) -> Iterator[BagMessage]:
        """Yield the messages in the order of the bag."""
        data = memoryview(file.data)[len(_ROS1_MAGIC) :]
        connections = dict[str, Topic]()
        sizes = (
            _number(fields["size"])
            for fields, _ in _ros1_records(data)
            if fields["op"] == _ROS1_CHUNK
        )
        check_unpacked(file, sizes)
        for outer, packed in _ros1_records(data):
            inside = iter([(outer, packed)])
            if outer["op"] == _ROS1_CHUNK:
                compression = outer["compression"].decode().replace("none", "")
                inside = _ros1_records(
                    memoryview(unpacked(packed, compression, _number(outer["size"])))
                )
            for fields, content in inside:
                if fields["op"] == _ROS1_CONNECTION:
                    name = fields["topic"].decode("utf-8", "replace")
                    kind = _fields(content)["type"].decode()
                    connections[fields["conn"].hex()] = Topic(name, kind, "ros1")
                elif fields["op"] == _ROS1_MESSAGE:
                    time = _number(fields["time"][:4]) * 10**9 + _number(
                        fields["time"][4:]
                    )
                    yield BagMessage(connections[fields["conn"].hex()], time, content)


def _ros1_records(data: memoryview) -> Iterator[tuple[dict[str, bytes], memoryview]]:
    while data:
        header = _block(data)
        if not len(header):
            data = memoryview(bytes(data).lstrip(b"\0"))
            continue
        content = _block(data[4 + len(header) :])
        yield _fields(header), content
        data = data[8 + len(header) + len(content) :]


def _fields(header: memoryview) -> dict[str, bytes]:
    pairs = (bytes(field).partition(b"=") for field in _blocks(header))
    return {name.decode("utf-8", "replace"): value for name, _, value in pairs}


def _blocks(data: memoryview) -> Iterator[memoryview]:
    while data:
        block = _block(data)
        yield block
        data = data[4 + len(block) :]


def _block(data: memoryview) -> memoryview:
    end = 4 + _number(data[:4])
    if end > len(data):
        raise CutError("the file ends in the middle of a record")
    return data[4:end]


def _number(data: bytes | memoryview) -> int:
    return int.from_bytes(data, "little")


_SQLITE_MAGIC = b"SQLite format 3\0"
_JOURNALS = slice(18, 20)
"""Header bytes for a write-ahead log, which in-memory databases do not support."""

_ZSTD = b"\x28\xb5\x2f\xfd"


@final
class Ros2Bag(Bag):
    """ROS 2 bag in an SQLite database (.db3)."""

    name = "ROS 2 bag"
    suffix = ".db3"

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether a file is an SQLite database."""
        return start.data.startswith(_SQLITE_MAGIC)

    def messages(self, file: RecordedFile) -> Iterator[BagMessage]:
        """Yield the messages in the order of the bag."""
        data = bytearray(file.data)
        data[_JOURNALS] = b"\1\1"
        with closing(sqlite3.connect(":memory:")) as base:
            base.deserialize(bytes(data))
            # In a manipulated database, a computed column may be larger than the file.
            base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, len(data))
            tables = base.execute(
                "SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0"
            )
            if not {"topics", "messages"} <= {name for (name,) in tables}:
                raise file.error(
                    "the SQLite database is not a ROS 2 bag; it lacks the tables"
                    " `topics` and `messages`"
                )
            rows = base.execute(
                "SELECT id, name, type, serialization_format FROM topics LIMIT 20000"
            )
            known = {number: Topic(*map(str, row)) for number, *row in rows}
            remaining = len(data)
            for number, time, content in base.execute(
                "SELECT topic_id, timestamp, data FROM messages"
            ):
                remaining -= len(content)
                if remaining < 0:
                    raise ChunkError("the tables contain more data than the file")
                packed = content.startswith(_ZSTD)
                plain = unpacked(content, "zstd", None) if packed else content
                yield BagMessage(known[number], int(time), memoryview(plain))
