"""Messages of an MCAP file, within bounds.

Chunks are judged by the sizes that they declare, before they are unpacked. Repeated bytes unpack to ten
thousand times their size; no recording does.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import IO, TYPE_CHECKING, Any, NamedTuple

from srs_twin.recordings.csv_table import MAX_BYTES, RecordedFile

if TYPE_CHECKING:
    from mcap.records import Channel, Schema

_MOST_UNPACKED = 4 * MAX_BYTES
_LEAST_ALLOWED = 16 << 20  # bytes, unpacked, of the smallest file
_MOST_RATIO = 32  # valve states in JSON, which repeat themselves, reach 20
_MOST_MESSAGES = 1 << 23  # an hour of twenty topics at 100 Hz
_HEAD = struct.Struct("<BQ")  # of a record: its kind and length
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_MAGIC_BYTES = 8
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x03, 0x04, 0x05, 0x06


class ChunkError(ValueError):
    """A chunk that is damaged or too large."""


class RawMessage(NamedTuple):
    """A message that is not decoded; its log time in ns."""

    channel_id: int
    log_time: int
    data: memoryview


def messages(file: RecordedFile) -> Iterator[tuple[Schema | None, Channel, RawMessage]]:
    """Yield the messages of a file in its order, each with its schema and channel.

    Raises:
        InputError: it holds, or unpacks to, more than is read.
        Exception: any error of the library on a damaged file.
    """
    from mcap.records import Schema

    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    count = 0
    _check_declared(file)
    for record in records(BytesIO(file.data)):
        if isinstance(record, RawMessage):
            count += 1
            if count > _MOST_MESSAGES:
                raise file.error(f"over {_MOST_MESSAGES} messages; record fewer topics, or a shorter take")
            channel = channels[record.channel_id]
            yield schemas.get(channel.schema_id), channel, record
        else:
            (schemas if isinstance(record, Schema) else channels)[record.id] = record


def _check_declared(file: RecordedFile) -> None:
    """Refuse a file by the sizes that its chunks declare.

    Raises:
        InputError: their sum is beyond the bound.
    """
    allowed = min(_MOST_UNPACKED, _LEAST_ALLOWED + _MOST_RATIO * len(file.data))
    place, total = _MAGIC_BYTES, 0
    while place + _HEAD.size <= len(file.data):
        kind, length = _HEAD.unpack_from(file.data, place)
        place += _HEAD.size
        if kind == _CHUNK and place + 24 <= len(file.data):
            total += int.from_bytes(file.data[place + 16 : place + 24], "little")
        place += length
    if total > allowed:
        raise file.error(
            f"its chunks unpack to {total / (1 << 20):.0f} MB; of a file of {len(file.data) / 1000:.0f} kB "
            f"at most {allowed >> 20} MB are read (record fewer topics, or a shorter take)"
        )


def records(stream: IO[bytes]) -> Iterator[Schema | Channel | RawMessage]:
    """Yield the schemas, channels and messages of an MCAP stream, in chunks and outside.

    Raises:
        ChunkError: a chunk is larger than `MAX_BYTES`, or damaged.
        Exception: any other error of the library on a damaged stream.
    """
    from mcap.records import Channel, Chunk, Message, Schema
    from mcap.stream_reader import StreamReader

    whole = StreamReader(stream, emit_chunks=True, validate_crcs=True, record_size_limit=MAX_BYTES)
    for record in whole.records:
        if isinstance(record, Chunk):
            yield from _inside(memoryview(_unpacked(record)))
        elif isinstance(record, Message):
            yield RawMessage(record.channel_id, record.log_time, memoryview(record.data))
        elif isinstance(record, Schema | Channel):
            yield record


def _inside(chunk: memoryview) -> Iterator[Schema | Channel | RawMessage]:
    """Yield the records in an unpacked chunk."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import Channel, Schema

    place = 0
    while place < len(chunk):
        kind, length = _HEAD.unpack_from(chunk, place)
        place += _HEAD.size
        if place + length > len(chunk):
            raise ChunkError("a record is longer than its chunk")
        content = chunk[place : place + length]
        if kind == _MESSAGE:
            channel, _, log_time, _ = _MESSAGE_HEAD.unpack_from(content)
            yield RawMessage(channel, log_time, content[_MESSAGE_HEAD.size :])
        elif kind == _SCHEMA:
            yield Schema.read(ReadDataStream(BytesIO(content)))
        elif kind == _CHANNEL:
            yield Channel.read(ReadDataStream(BytesIO(content)))
        place += length


def _unpacked(chunk: Any) -> bytes:
    """Return the records of a chunk, of no more bytes than it says.

    Raises:
        ChunkError: there are fewer, they are damaged, or the chunk is too large.
    """
    if chunk.uncompressed_size > MAX_BYTES:
        raise ChunkError(f"a chunk of {chunk.uncompressed_size} bytes; at most {MAX_BYTES} are read")
    data: bytes = chunk.data
    if chunk.compression == "zstd":
        import zstandard

        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            data = stream.read(chunk.uncompressed_size)
    elif chunk.compression == "lz4":
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=chunk.uncompressed_size)
    elif chunk.compression:
        raise ChunkError(f"compression '{chunk.compression}' is not known")
    if len(data) != chunk.uncompressed_size:
        raise ChunkError("a chunk is shorter than it says")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ChunkError("the checksum of a chunk is wrong")
    return data
