"""Journal: everything that came in and went out, as MCAP; `McapLink` plays it at any speed."""

from __future__ import annotations

import contextlib
import json
import math
import mmap
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.files import existing, shown
from srs_twin.live.links import Link, clock
from srs_twin.live.messages import POSES, STATUS, BadMessageError, Message, decode, encode, topic
from srs_twin.recordings.formats.mcap import MAGIC, stream_messages


class Journal:
    """Everything that came in and went out, as MCAP with JSON; readable up to where a process was killed."""

    def __init__(self, path: Path) -> None:
        """Begin a file.

        Raises:
            InputError: it cannot be written, or mcap is not installed.
        """
        try:
            from mcap.writer import CompressionType, Writer
        except ImportError as error:
            raise InputError("journals need mcap: pip install 'srs-twin[live]'") from error
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb")
        except OSError as error:
            raise InputError(f"{shown(path)}: cannot be written: {error.strerror}") from error
        # Small chunks: what a kill takes with it is a second or so.
        self._writer = Writer(self._file, chunk_size=16_384, compression=CompressionType.NONE)
        self._writer.start(profile="", library="srs_twin")
        self._channels: dict[tuple[str, str], int] = {}
        self._schema = self._writer.register_schema(
            name="srs_twin.Message", encoding="jsonschema", data=b'{"type": "object"}'
        )

    def write(self, message: Message) -> None:
        """Add a message."""
        key = message.source, message.kind
        if key not in self._channels:
            self._channels[key] = self._writer.register_channel(
                topic=topic(message.source, message.kind), message_encoding="json", schema_id=self._schema
            )
        text = message.names[0] if message.kind == STATUS and message.names else message.values
        data = _poses(message) if message.kind == POSES else encode(message.kind, message.sent, text)
        self._writer.add_message(
            channel_id=self._channels[key], data=data, log_time=round(message.arrived * 1e9),
            publish_time=max(round(message.sent * 1e9), 0),
        )  # fmt: skip

    def flush(self) -> None:
        """Bring what is written so far to the disk."""
        self._file.flush()

    def close(self) -> None:
        """End the file."""
        self._writer.finish()
        self._file.close()

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _poses(message: Message) -> bytes:
    rows = [[None if np.isnan(each) else each for each in row] for row in message.values.tolist()]
    return json.dumps({"t": message.sent, "names": message.names, "poses": rows}).encode()


def journal_messages(
    path: Path, robot: str, segments: int, refuse: Callable[[BadMessageError], None] | None = None
) -> Iterator[Message]:
    """Yield what a journal holds of a robot and of motion capture, as it arrived; what is cut off ends it.

    Args:
        path: of the journal.
        robot: whose messages.
        segments: of the robot.
        refuse: called with the error of each record that is no message of ours; None: they are skipped.

    Raises:
        InputError: no such file, or no MCAP.
    """
    # Exception: a damaged file raises errors of many kinds.
    with opened_journal(path) as file, contextlib.suppress(Exception):
        whole = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        for topic, log_time, data in stream_messages(whole):
            try:
                message = _message(topic.name, log_time, bytes(data), robot, segments)
            except BadMessageError as error:
                if refuse is not None:
                    refuse(error)
                continue
            if message is not None:
                yield message


def opened_journal(path: Path) -> IO[bytes]:
    """Return a journal, opened for reading.

    Raises:
        InputError: no such file, or no MCAP.
    """
    try:
        file = existing(path, suffix=".mcap").open("rb")
        if file.read(len(MAGIC)) == MAGIC:
            file.seek(0)
            return file
    except OSError as error:
        raise InputError(f"{shown(path)}: cannot be read ({error.strerror})") from error
    file.close()
    raise InputError(f"{shown(path)}: not an MCAP file")


def _message(topic: str, log_time: int, data: bytes, robot: str, segments: int) -> Message | None:
    """Return the message of a record; None where it is another robot's.

    Raises:
        BadMessageError: it is no message of ours.
    """
    arrived = log_time / 1e9
    try:
        _, source, kind = topic.split("/", 2)
        if kind == POSES:
            said = json.loads(data)
            poses, sent = np.array(said["poses"], dtype=float).reshape(-1, 4), float(said["t"])
            names = tuple(map(str, said["names"]))
            if len(names) != len(poses) or not math.isfinite(sent):
                raise ValueError("its numbers do not fit together")
            return Message(kind, source, sent, arrived, poses, names)
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise BadMessageError(f"no message of ours: {type(error).__name__}") from None
    if source != robot:
        return None
    return decode(kind, data, source=source, arrived=arrived, segments=segments)


class McapLink(Link):
    """A journal, played at any speed as if it came in now."""

    def __init__(self, path: Path, robot: str, segments: int, *, speed: float = 1.0) -> None:
        """Begin to play.

        Args:
            path: what `Journal` wrote.
            robot: whose messages.
            segments: of the robot.
            speed: how many times as fast as recorded; infinite: all at once.

        Raises:
            InputError: no such file, or mcap is not installed.
        """
        super().__init__()
        self._speed, self._over = speed, threading.Event()
        opened_journal(path).close()  # now, while an error can still be raised: the thread reads it
        self._messages = journal_messages(path, robot, segments, self._refuse)
        self._first = self._begun = math.nan
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()

    def clock(self) -> float:
        """Return when in the recording it is now, s; NaN before the first message."""
        return self._first + (clock() - self._begun) * self._speed

    def _play(self) -> None:
        for message in self._messages:
            if math.isnan(self._first):
                self._first, self._begun = message.arrived, clock()
            wait = (message.arrived - self.clock()) / self._speed
            if wait > 0 and self._over.wait(wait):
                return
            self._take(message)
        self.counts["over"] += 1

    def close(self) -> None:
        """See `Link.close`."""
        self._over.set()
        self._thread.join()
