"""ROS 2 bag in SQLite (.db3, or the folder that holds it): the messages of a file, in its order."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing

from srs_twin.recordings.csv_table import RecordedFile
from srs_twin.recordings.formats.topics import ChunkError, Message, Topic, unpacked

NAME = "ROS 2 bag"
_MAGIC = b"SQLite format 3\0"
_JOURNALS = slice(18, 20)  # bytes of the header that ask for a journal beside the file, which memory has not
_ZSTD = b"\x28\xb5\x2f\xfd"


def recognizes(start: RecordedFile) -> bool:
    """Say whether a file is a database of SQLite."""
    return start.data.startswith(_MAGIC)


def messages(file: RecordedFile) -> Iterator[Message]:
    """Yield the messages of a bag in its order.

    Raises:
        InputError: a database without the tables of a bag.
        ChunkError: its tables hold more than the file.
    """
    data = bytearray(file.data)
    data[_JOURNALS] = b"\1\1"
    with closing(sqlite3.connect(":memory:")) as base:
        base.deserialize(bytes(data))
        # No value is longer than the file, and all together are not: columns may be computed.
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, len(data))
        tables = base.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0")
        if not {"topics", "messages"} <= {name for (name,) in tables}:
            raise file.error("a database of SQLite that is no ROS 2 bag (no tables topics and messages)")
        rows = base.execute("SELECT id, name, type, serialization_format FROM topics LIMIT 20000")
        known, left = {number: Topic(*map(str, row)) for number, *row in rows}, len(data)
        for number, time, content in base.execute("SELECT topic_id, timestamp, data FROM messages"):
            left -= len(content)
            if left < 0:
                raise ChunkError("more data than the file has")
            if content.startswith(_ZSTD):
                content = unpacked(content, "zstd", None)
            yield Message(known[number], int(time), memoryview(content))
