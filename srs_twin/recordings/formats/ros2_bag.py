"""ROS 2 bag in SQLite (.db3, or the folder that contains it): messages in file order."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing

from srs_twin.recordings.csv_table import RecordedFile
from srs_twin.recordings.formats.topics import ChunkError, Message, Topic, unpacked

NAME = "ROS 2 bag"
_MAGIC = b"SQLite format 3\0"
_JOURNALS = slice(18, 20)
"""Bytes of the header that request a write-ahead log, which a database in memory cannot have."""
_ZSTD = b"\x28\xb5\x2f\xfd"


def recognizes(start: RecordedFile) -> bool:
    """Return whether a file is an SQLite database."""
    return start.data.startswith(_MAGIC)


def messages(file: RecordedFile) -> Iterator[Message]:
    """Yield the messages of a bag in file order.

    Raises:
        InputError: the database does not have the tables of a bag.
        ChunkError: its tables contain more data than the file.
    """
    data = bytearray(file.data)
    data[_JOURNALS] = b"\1\1"
    with closing(sqlite3.connect(":memory:")) as base:
        base.deserialize(bytes(data))
        # Columns of a manipulated database may be computed, so that they are larger than the file.
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, len(data))
        tables = base.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0")
        if not {"topics", "messages"} <= {name for (name,) in tables}:
            raise file.error(
                "the SQLite database is not a ROS 2 bag (it lacks the tables topics and messages)"
            )
        rows = base.execute("SELECT id, name, type, serialization_format FROM topics LIMIT 20000")
        known, remaining = {number: Topic(*map(str, row)) for number, *row in rows}, len(data)
        for number, time, content in base.execute("SELECT topic_id, timestamp, data FROM messages"):
            remaining -= len(content)
            if remaining < 0:
                raise ChunkError("the tables contain more data than the file")
            if content.startswith(_ZSTD):
                content = unpacked(content, "zstd", None)
            yield Message(known[number], int(time), memoryview(content))
