"""Journals of live messages in the MCAP format, and their playback."""

from __future__ import annotations

import itertools
import json
import math
import mmap
import struct
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO

import numpy as np

from srs_twin.errors import InputError, WriteError, format_names
from srs_twin.io.files import display_path, require_file
from srs_twin.live.links import Link, clock
from srs_twin.live.messages import (
    CONTROL,
    LATEST_S,
    POSES,
    PREFIX,
    STATUS,
    BadMessageError,
    Message,
    decode,
    encode,
    strict_json,
    topic,
)
from srs_twin.live.natnet import is_place
from srs_twin.recordings.formats.bags import MCAP_MAGIC, stream_messages
from srs_twin.recordings.formats.topics import BagMessage

LONGEST_GAP_S = 60.0
"""Longest pause that playback reproduces, s. Longer pauses are skipped."""
_NOT_IN_ORDER = "a record is earlier than the record before it"
_FULL_S = 0.01
"""Interval between checks for free space in a full message queue, s."""
_MOST_HEAD = 100_000
"""Maximum number of messages to read in search of the robot's first message."""


class Journal:
    """MCAP file to which messages are written as JSON.

    The file remains readable if the process is killed. After a write error, all further
    messages are discarded without an exception.

    Attributes:
        trouble: description of the write error that ended the journal, or an empty
            string if all messages were written.
    """

    def __init__(self, path: Path) -> None:
        """Create the file and its folder.

        Raises:
            InputError: the package mcap is not installed.
            WriteError: the file cannot be written.
        """
        try:
            from mcap.writer import CompressionType, Writer
        except ImportError as error:
            raise InputError(
                "journals need the package mcap; install it with: pip install"
                " 'srs-twin[live]'"
            ) from error
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb")
        except OSError as error:
            raise WriteError(
                f"{display_path(path)}: the file cannot be written ({error.strerror})"
            ) from error
        # Without chunks, a killed process loses only the messages that were written
        # after the last `flush`.
        self._writer = Writer(
            self._file, use_chunking=False, compression=CompressionType.NONE
        )
        self._writer.start(profile="", library="srs_twin")
        self._path = path
        self.trouble = ""
        self._channels: dict[tuple[str, str], int] = {}
        self._schema = self._writer.register_schema(
            name="srs_twin.Message", encoding="jsonschema", data=b'{"type": "object"}'
        )

    def write(self, message: Message) -> None:
        """Add a message."""
        self._attempt(lambda: self._write(message))

    def flush(self) -> None:
        """Write buffered messages to the file."""
        self._attempt(self._file.flush)

    def close(self) -> None:
        """Write the end of the MCAP file and close the file."""
        self._attempt(self._writer.finish)
        self._attempt(self._file.close)

    def _attempt(self, step: Callable[[], object]) -> None:
        if self.trouble:
            return
        try:
            step()
        except (OSError, OverflowError, ValueError, struct.error) as error:
            reason = f"{type(error).__name__}: {error}"
            if isinstance(error, OSError):
                reason = str(error.strerror)
            self.trouble = (
                f"{display_path(self._path)}: the journal ends early, because it"
                f" cannot be written ({reason})"
            )

    def _write(self, message: Message) -> None:
        key = message.source, message.kind
        if key not in self._channels:
            # Each combination of source and kind has its own channel, so that other
            # tools can plot each channel separately.
            self._channels[key] = self._writer.register_channel(
                topic=topic(message.source, message.kind),
                message_encoding="json",
                schema_id=self._schema,
            )
        if message.kind == POSES:
            poses = message.values.tolist()
            data = strict_json(
                {"t": message.sent, "names": message.names, "poses": poses}
            )
        elif message.kind in (STATUS, CONTROL):
            data = encode(message.kind, message.sent, message.names[0])
        else:
            data = encode(message.kind, message.sent, message.values)
        self._writer.add_message(
            channel_id=self._channels[key],
            data=data,
            log_time=_nanoseconds(message.arrived),
            publish_time=_nanoseconds(message.sent),
        )

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _nanoseconds(time: float) -> int:
    return round(min(max(time, 0.0), LATEST_S) * 1e9)


def journal_messages(
    path: Path,
    robot: str,
    segments: int,
    refuse: Callable[[BadMessageError], None] | None = None,
    others: set[str] | None = None,
) -> Iterator[Message]:
    """Yield the messages of a robot and of motion capture in the order of the file.

    Reading stops at the first damaged record. Each invalid message is reported to
    `refuse`, and the names of other robots in the journal are added to `others`.

    Raises:
        InputError: the file does not exist or is not an MCAP file.
    """
    skip = refuse or (lambda _: None)
    with opened_journal(path) as file:
        # The file is memory-mapped, because a long journal may not fit into memory.
        whole = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        for topic, log_time, data in _records(whole, skip):
            try:
                message = _message(topic.name, log_time, bytes(data), robot, segments)
            except BadMessageError as error:
                skip(error)
                continue
            if message is not None:
                yield message
            elif others is not None:
                others.add(topic.name.split("/")[1])


def _records(
    whole: memoryview, skip: Callable[[BadMessageError], None]
) -> Iterator[BagMessage]:
    try:
        yield from stream_messages(whole)
    except Exception as error:  # A damaged file can raise any exception.
        skip(
            BadMessageError(
                f"the rest of the file is damaged or missing: {type(error).__name__}"
            )
        )


def opened_journal(path: Path) -> IO[bytes]:
    """Open a journal for reading.

    Raises:
        InputError: the file does not exist or is not an MCAP file.
    """
    try:
        file = require_file(path, suffix=".mcap").open("rb")
        if file.read(len(MCAP_MAGIC)) == MCAP_MAGIC:
            file.seek(0)
            return file
    except OSError as error:
        raise InputError(
            f"{display_path(path)}: the file cannot be read ({error.strerror})"
        ) from error
    file.close()
    raise InputError(f"{display_path(path)}: this is not an MCAP file")


def _message(
    topic: str, log_time: int, data: bytes, robot: str, segments: int
) -> Message | None:
    arrived = log_time / 1e9
    try:
        prefix, source, kind = topic.split("/", 2)
        if prefix != PREFIX:
            raise ValueError("the topic belongs to another program")
        if kind == POSES:
            said = json.loads(data)
            poses = np.array(said["poses"], dtype=float).reshape(-1, 4)
            sent = float(said["t"])
            names = tuple(map(str, said["names"]))
            places = all(map(is_place, np.nan_to_num(poses, nan=0.0)))
            if len(names) != len(poses) or not abs(sent) <= LATEST_S or not places:
                raise ValueError("the lists of names and poses do not match")
            return Message(kind, source, sent, arrived, poses, names)
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        raise BadMessageError(
            f"the message is not in the srs-twin format: {type(error).__name__}"
        ) from None
    if source != robot:
        return None
    return decode(kind, data, source=source, arrived=arrived, segments=segments)


def in_order(
    messages: Iterable[Message], refuse: Callable[[BadMessageError], None]
) -> Iterator[Message]:
    """Yield the messages with plausible arrival times, and refuse the other messages.

    A message is plausible if it arrives within `LONGEST_GAP_S` of the previous message.
    After a longer pause, a message is plausible only if the next message arrives within
    `LONGEST_GAP_S` of it.
    """
    last = -math.inf
    odd: Message | None = None
    for message in messages:
        if odd is not None:
            confirmed = abs(message.arrived - odd.arrived) <= LONGEST_GAP_S
            if confirmed and odd.arrived > last:
                yield odd
                last = odd.arrived
            else:
                refuse(BadMessageError(_NOT_IN_ORDER))
            odd = None
        if abs(message.arrived - last) <= LONGEST_GAP_S:
            last = message.arrived
            yield message
        else:
            odd = message
    if odd is not None and math.isinf(last):
        yield odd
    elif odd is not None:
        refuse(BadMessageError(_NOT_IN_ORDER))


class McapLink(Link):
    """Link that replays the messages of a journal at a chosen speed."""

    def __init__(
        self, path: Path, robot: str, segments: int, *, speed: float = 1.0
    ) -> None:
        """Start the playback.

        Args:
            path: MCAP file written by `Journal`.
            robot: name of the robot.
            segments: number of segments of the robot.
            speed: playback speed as a multiple of real time. At infinite speed, all
                messages are replayed without waiting.

        Raises:
            InputError: the file does not exist, is not an MCAP file, or contains no
                message of the robot.
        """
        super().__init__()
        self._speed = speed
        self._over = threading.Event()
        self._messages = self._of_the_robot(path, robot, segments)
        self._first = self._begun = math.nan
        self._next = math.inf
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()

    def clock(self) -> float:
        """Return the current time of the playback (s), or NaN before the first message.

        The returned time never exceeds the arrival time of the next message.
        """
        return min(self._first + (clock() - self._begun) * self._speed, self._next)

    def _of_the_robot(self, path: Path, robot: str, segments: int) -> Iterator[Message]:
        others: set[str] = set()
        messages = in_order(
            journal_messages(path, robot, segments, self._refuse, others), self._refuse
        )
        head: list[Message] = []
        for message in messages:
            head.append(message)
            if message.source == robot or len(head) >= _MOST_HEAD:
                break
        if head and (head[-1].source == robot or not others):
            return itertools.chain(head, messages)
        bad = [
            f"{count} × {what.removeprefix('bad: ')}"
            for what, count in self.counts.items()
        ]
        found = f"no messages of '{robot}'" if others or bad else "no messages at all"
        if others:
            names = format_names(sorted(others))
            found += f", but messages of {names} (choose one with --name)"
        if bad:
            found += f"; unreadable messages: {', '.join(bad[:3])}"
        raise InputError(f"{display_path(path)}: the journal has {found}")

    def _play(self) -> None:
        try:
            for message in self._messages:
                self._next = message.arrived
                played = (clock() - self._begun) * self._speed
                ahead = message.arrived - self._first - played
                # The condition also holds for the first message, where `ahead` is NaN.
                if not ahead <= LONGEST_GAP_S:
                    self._first = message.arrived
                    self._begun = clock()
                elif ahead > 0 and self._over.wait(ahead / self._speed):
                    return
                while self._queue.full():
                    if self._over.wait(_FULL_S):
                        return
                self._take(message)
        except Exception as error:
            self._refuse(error)
        finally:
            self._next = math.inf
            self.counts["over"] += 1

    def close(self) -> None:
        """See `Link.close`."""
        self._over.set()
        self._thread.join()
