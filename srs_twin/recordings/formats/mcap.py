"""MCAP: poses, points and signals of ROS 2 (CDR) and JSON topics, by the library `mcap`."""

from __future__ import annotations

import json
import os
import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr
from dataclasses import dataclass, field
from io import StringIO
from types import SimpleNamespace
from typing import Any

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.files import printable
from srs_twin.recordings.csv_table import MAX_COLUMNS, MAX_VALUES, RecordedFile, read_bytes
from srs_twin.recordings.formats.base import Start, Unstated, decoding
from srs_twin.recordings.formats.mcap_messages import RawMessage, messages
from srs_twin.recordings.marker_table import MarkerTable, plausible

NAME = "MCAP"
_APART = 1.0  # s from the log's clock: stamps farther away may be another clock's
_MAGIC = b"\x89MCAP0\r\n"


def recognizes(start: Start) -> bool:
    """Say whether a file starts with MCAP's magic bytes."""
    return start.raw.startswith(_MAGIC)


def read(path: str | os.PathLike[str], unstated: Unstated) -> MarkerTable:
    """Read the topics with positions.

    Raises:
        InputError: as `read_topics`, or no topic has positions.
    """
    topics = read_topics(path, signals=False)
    if topics.markers is None:
        wanted = "geometry_msgs/PoseStamped, PoseArray or PointStamped are wanted"
        there = "".join(f"; {note}" for note in topics.notes[:3])
        raise InputError(f"{topics.name}: no topic with positions; {wanted}{there}")
    return topics.markers


@dataclass(frozen=True)
class McapTopics:
    """What an MCAP file holds, on one clock that begins at its first message.

    Attributes:
        name: of the file, as messages show it.
        sha256: of the file.
        origin_ns: log time of the first message, ns; 0 s of all times here.
        markers: positions and rotations of bodies and points; None where no topic has any.
        signals: (time, values) by name, each of shape (samples,), s and as recorded: ``/joy.axes[0]``,
            ``/joints.NAME.position``, ``/topic.data[2]``, ``/topic.dotted.path`` of JSON.
        notes: what was skipped or is odd, in words.
    """

    name: str
    sha256: str
    origin_ns: int
    markers: MarkerTable | None
    signals: dict[str, tuple[np.ndarray, np.ndarray]]
    notes: tuple[str, ...]


def read_topics(path: str | os.PathLike[str], *, signals: bool = True) -> McapTopics:
    """Read poses, points and signals of ROS 2 (CDR) and JSON topics.

    Times are header stamps where messages have them, else log times. Frames are the messages of the marker
    topic that has most; of other topics the nearest message within half a frame counts.

    Args:
        path: of the file.
        signals: whether to read the topics without positions.

    Raises:
        InputError: damaged, too large, or the libraries are not installed.
    """
    file = read_bytes(path)
    topics = _Topics(file, signals)
    cut = not file.data.endswith(_MAGIC) or len(file.data) < 2 * len(_MAGIC)
    with decoding(file, NAME):
        try:
            for schema, channel, message in messages(file):
                topics.add(schema, channel, message)
        except (InputError, ModuleNotFoundError):
            raise
        except Exception:  # a file without its end holds half a record somewhere
            if not (cut and topics.messages):
                raise
            topics.notes.append("the file is cut: read up to there")
        return topics.result()


_Series = tuple["array[int]", "array[float]"]  # ns; one or seven numbers a sample


@dataclass
class _Topics:
    """What has been read of an MCAP file up to now."""

    file: RecordedFile
    with_signals: bool = True
    origin: int = 0
    signals: dict[str, _Series] = field(default_factory=dict)
    bodies: dict[str, dict[str, _Series]] = field(default_factory=dict)  # topic → label → poses
    skipped: Counter[int] = field(default_factory=Counter)  # channel → messages
    topics: dict[int, tuple[str, str, Callable[[bytes], Any] | None]] = field(default_factory=dict)
    messages: int = 0
    numbers: int = 0
    apart: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add(self, schema: Any, channel: Any, message: RawMessage) -> None:
        """Take in one message."""
        self.messages += 1
        self.origin = message.log_time if self.messages == 1 else min(self.origin, message.log_time)
        if channel.id not in self.topics:
            kind = schema.name.replace("/msg/", "/") if schema else channel.message_encoding
            self.topics[channel.id] = (
                kind,
                printable(channel.topic[:200]),
                self._decoder(kind, schema, channel),
            )
        kind, topic, decode = self.topics[channel.id]
        if decode is None:
            self.skipped[channel.id] += 1
            return
        if kind not in _BODIES and not self.with_signals:
            return
        said = decode(bytes(message.data))
        stamp = getattr(getattr(said, "header", None), "stamp", None)
        time, whole, part = message.log_time, getattr(stamp, "sec", None), getattr(stamp, "nanosec", None)
        if isinstance(whole, int) and isinstance(part, int) and (whole or part):
            time = whole * 10**9 + part
            self.apart.setdefault(topic, abs(time - message.log_time) / 1e9)
        if kind in _BODIES:
            for k, pose in enumerate(_BODIES[kind](said), start=1):
                label = topic if kind != "geometry_msgs/PoseArray" else f"{topic}_{k}"
                self._append(self.bodies.setdefault(topic, {}), label, time, _pose_numbers(pose))
        else:
            for name, value in _numbers(kind, said):
                self._append(self.signals, f"{topic}{printable(name)}", time, (float(value),))

    @staticmethod
    def _decoder(kind: str, schema: Any, channel: Any) -> Callable[[bytes], Any] | None:
        if channel.message_encoding == "json":
            return _json
        if kind in _BODIES or kind in _SIGNALS or _STD.fullmatch(kind):
            from mcap_ros2.decoder import DecoderFactory

            with redirect_stderr(StringIO()):  # prints lines of schemas that it cannot read
                return DecoderFactory().decoder_for(channel.message_encoding, schema)
        return None

    def _append(self, series: dict[str, _Series], name: str, time: int, values: tuple[float, ...]) -> None:
        times, numbers = series.setdefault(name, (array("q"), array("d")))
        times.append(time)
        numbers.extend(values)
        self.numbers += 1 + len(values)
        if self.numbers > MAX_VALUES or len(series) > MAX_COLUMNS:
            raise self.file.error(f"at most {MAX_VALUES} numbers of {MAX_COLUMNS} signals are read")

    def result(self) -> McapTopics:
        """Return all topics on one clock."""
        skipped: Counter[str] = Counter()
        for channel, count in self.skipped.items():
            kind, topic, _ = self.topics[channel]
            skipped[f"{topic} ({printable(kind[:80])})"] += count
        self.notes += [f"topic {topic} skipped: {count} messages" for topic, count in skipped.items()]
        self.notes += [
            f"stamps of {topic} lie {apart:.3g} s from the log's clock"
            for topic, apart in self.apart.items()
            if apart > _APART
        ]
        signals = {}
        for name, (stamps, values) in self.signals.items():
            time, order = self._clock(stamps)
            signals[name] = (time, np.array(values)[order])
        markers = self._markers() if self.bodies else None
        return McapTopics(self.file.name, self.file.sha256, self.origin, markers, signals, tuple(self.notes))

    def _clock(self, stamps: array[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return ascending times, s, and the order that sorts samples by them."""
        whole = np.array(stamps, dtype=np.int64) - self.origin
        order = np.argsort(whole, kind="stable")
        return whole[order] / 1e9, order

    def _markers(self) -> MarkerTable:
        stamps = {
            topic: np.unique(np.concatenate([self._clock(each)[0] for each, _ in series.values()]))
            for topic, series in self.bodies.items()
        }
        main = max(stamps, key=lambda topic: len(stamps[topic]))
        time = stamps[main]
        half = 0.5 * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        labels = [(topic, label) for topic, series in self.bodies.items() for label in series]
        if len(time) * len(labels) * 7 > MAX_VALUES:
            raise self.file.error(f"{len(time)} frames of {len(labels)} bodies; at most {MAX_VALUES} numbers")
        poses = np.full((len(time), len(labels), 7), np.nan)
        for k, (topic, label) in enumerate(labels):
            own, order = self._clock(self.bodies[topic][label][0])
            after = np.searchsorted(own, time).clip(max=len(own) - 1)
            before = np.maximum(after - 1, 0)
            nearest = np.where(time - own[before] <= own[after] - time, before, after)
            near = np.abs(own[nearest] - time) <= (0.0 if topic == main else half)
            poses[near, k] = np.array(self.bodies[topic][label][1]).reshape(-1, 7)[order][nearest[near]]
        points, implausible = plausible(poses[..., :3])
        turned = np.linalg.norm(poses[..., 3:], axis=-1)
        valid = (turned > 0.5) & (turned < 2.0) & ~np.isnan(points[..., 0])
        rotations = np.where(valid[..., None], poses[..., 3:], np.nan) if valid.any() else None
        corrections, names = (*self.notes, *implausible), tuple(label for _, label in labels)
        return MarkerTable(
            self.file.name, self.file.sha256, NAME, time, points, names, corrections, rotations=rotations
        )


_STD = re.compile(r"std_msgs/(Bool|(Float|U?Int)\d+(MultiArray)?)")
_SIGNALS = ("sensor_msgs/Joy", "sensor_msgs/JointState")
_BODIES: dict[str, Callable[[Any], list[Any]]] = {
    "geometry_msgs/PoseStamped": lambda said: [said.pose],
    "geometry_msgs/Pose": lambda said: [said],
    "geometry_msgs/PoseArray": lambda said: said.poses,
    "geometry_msgs/PointStamped": lambda said: [SimpleNamespace(position=said.point)],
    "geometry_msgs/Point": lambda said: [SimpleNamespace(position=said)],
}


def _pose_numbers(pose: Any) -> tuple[float, ...]:
    """Return x, y, z and the quaternion x, y, z, w; NaN where a point has none."""
    at, turn = pose.position, getattr(pose, "orientation", None)
    return (at.x, at.y, at.z, *((turn.x, turn.y, turn.z, turn.w) if turn is not None else (np.nan,) * 4))


def _json(data: bytes) -> Any:
    """Return a JSON message; objects are namespaces, as decoded ROS messages are."""
    return json.loads(data, object_hook=lambda each: SimpleNamespace(**each))


def _numbers(kind: str, said: Any) -> Iterator[tuple[str, float]]:
    """Yield (name below the topic, number) of a message."""
    if kind == "sensor_msgs/JointState":
        for quantity in ("position", "velocity", "effort"):
            for joint, value in zip(said.name, getattr(said, quantity), strict=False):
                yield f".{joint}.{quantity}", value
    elif kind == "sensor_msgs/Joy":
        yield from _leaves(".axes", list(said.axes))
        yield from _leaves(".buttons", list(said.buttons))
    elif _STD.fullmatch(kind):
        yield from _leaves(".data", said.data if isinstance(said.data, int | float) else list(said.data))
    else:
        yield from _leaves("", said)


def _leaves(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """Yield all numbers inside lists and namespaces, by dotted path."""
    if isinstance(value, SimpleNamespace):
        for key, inner in vars(value).items():
            yield from _leaves(f"{name}.{key}", inner)
    elif isinstance(value, list):
        for k, inner in enumerate(value):
            yield from _leaves(f"{name}[{k}]", inner)
    elif isinstance(value, int | float):
        yield name, value
