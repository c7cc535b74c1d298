"""ROS 1 bag (V2.0): messages in file order. The index is not used, so truncated bags can be read."""

from __future__ import annotations

from collections.abc import Iterator

from srs_twin.recordings.csv_table import RecordedFile
from srs_twin.recordings.formats.topics import (
    CutError,
    Message,
    Topic,
    check_unpacked,
    unpacked,
)

NAME = "ROS 1 bag"
_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _CHUNK, _CONNECTION = b"\2", b"\5", b"\7"


def recognizes(start: RecordedFile) -> bool:
    """Return whether a file starts with the magic line of a bag."""
    return start.data.startswith(_MAGIC)


def messages(file: RecordedFile) -> Iterator[Message]:
    """Yield the messages of a bag in file order.

    Raises:
        InputError: the unpacked chunks are larger than allowed.
        ChunkError: the bag is damaged; a `CutError` if it ends in a record.
    """
    data, connections = memoryview(file.data)[len(_MAGIC) :], dict[str, Topic]()
    sizes = (_number(fields["size"]) for fields, _ in _records(data) if fields["op"] == _CHUNK)
    check_unpacked(file, sizes)
    for outer, packed in _records(data):
        inside = iter([(outer, packed)])
        if outer["op"] == _CHUNK:
            compression = outer["compression"].decode().replace("none", "")
            inside = _records(memoryview(unpacked(packed, compression, _number(outer["size"]))))
        for fields, content in inside:
            if fields["op"] == _CONNECTION:
                name, kind = fields["topic"].decode("utf-8", "replace"), _fields(content)["type"].decode()
                connections[fields["conn"].hex()] = Topic(name, kind, "ros1")
            elif fields["op"] == _MESSAGE:
                time = _number(fields["time"][:4]) * 10**9 + _number(fields["time"][4:])
                yield Message(connections[fields["conn"].hex()], time, content)


def _records(data: memoryview) -> Iterator[tuple[dict[str, bytes], memoryview]]:
    """Yield the header fields and the content of successive records."""
    blocks = _blocks(data)
    for header in blocks:
        content = next(blocks, None)
        if content is None:
            raise CutError("the file ends in a record")
        yield _fields(header), content


def _fields(header: memoryview) -> dict[str, bytes]:
    """Return the fields NAME=VALUE of a header."""
    pairs = (bytes(field).partition(b"=") for field in _blocks(header))
    return {name.decode("utf-8", "replace"): value for name, _, value in pairs}


def _blocks(data: memoryview) -> Iterator[memoryview]:
    """Yield blocks that are preceded by their lengths."""
    while data:
        end = 4 + _number(data[:4])
        if end > len(data):
            raise CutError("the file ends in a record")
        yield data[4:end]
        data = data[end:]


def _number(data: bytes | memoryview) -> int:
    return int.from_bytes(data, "little")
