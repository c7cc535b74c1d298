"""Topics: poses, points and signals of the messages of bags (ROS 1, ROS 2, JSON), whatever holds them.

A container (`mcap`, `ros1_bag`, `ros2_bag`) yields its messages, each with its topic and log time. Those of
ROS are decoded by the library `rosbags`, by its own definitions of the kinds that are known here; those in
the file are not looked at. Chunks are judged by the sizes that they declare, before they are unpacked.
Repeated bytes unpack to ten thousand times their size; no recording does.
"""

from __future__ import annotations

import json
import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, lru_cache, partial
from importlib import import_module
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.files import escape_unprintable
from srs_twin.recordings.csv_table import MAX_BYTES, MAX_COLUMNS, MAX_VALUES, RecordedFile
from srs_twin.recordings.formats.base import decoding, marker_table
from srs_twin.recordings.marker_table import MarkerTable

_SINCE_1970 = 10**17  # ns: earlier log times are of a clock of their own
_OTHER_CLOCK = 1e6  # s
_APART = 1.0  # s from the log's clock: stamps farther away may be another clock's
_MOST_UNPACKED = 4 * MAX_BYTES
_LEAST_ALLOWED = 16 << 20  # bytes, unpacked, of the smallest file
_MOST_RATIO = 32  # valve states in JSON, which repeat themselves, reach 20
_MOST_MESSAGES = 1 << 23  # an hour of twenty topics at 100 Hz
_UNPACKERS = {"lz4": ("lz4.frame", "LZ4Frame"), "zstd": ("backports.zstd", "Zstd"), "bz2": ("bz2", "BZ2")}
"""Compression → module, and name of its class before "Decompressor"."""


class ChunkError(ValueError):
    """A chunk or record that is damaged or too large."""


class CutError(ChunkError):
    """A file that ends in a record."""


class Topic(NamedTuple):
    """Name of a topic, kind of its messages ("geometry_msgs/Pose") and encoding ("cdr", "ros1", "json")."""

    name: str
    kind: str
    encoding: str


class Message(NamedTuple):
    """A message that is not decoded; its log time in ns."""

    topic: Topic
    log_time: int
    data: memoryview


Messages = Callable[[RecordedFile], Iterator[Message]]
"""Yields the messages of a container."""


def check_unpacked(file: RecordedFile, sizes: Iterable[int]) -> None:
    """Refuse a file by the sizes to which its chunks say that they unpack.

    Raises:
        InputError: their sum is beyond the bound.
    """
    allowed, total = min(_MOST_UNPACKED, _LEAST_ALLOWED + _MOST_RATIO * len(file.data)), 0
    with suppress(CutError):  # what follows is not read
        for size in sizes:
            total += size
    if total > allowed:
        raise file.error(
            f"its chunks unpack to {total / (1 << 20):.0f} MB; of a file of {len(file.data) / 1000:.0f} kB "
            f"at most {allowed >> 20} MB are read (record fewer topics, or a shorter take)"
        )


def unpacked(data: memoryview | bytes, how: str, size: int | None) -> bytes | memoryview:
    """Return unpacked data, of no more bytes than they say; None: a message.

    Raises:
        ChunkError: there are fewer, they are damaged, or too many.
    """
    most = MAX_BYTES if size is None else size
    if most > MAX_BYTES or how not in ("", *_UNPACKERS):
        raise ChunkError(f"a chunk of {size} bytes, compression '{how}'; at most {MAX_BYTES} are read")
    if how:
        module, name = _UNPACKERS[how]
        data = getattr(import_module(module), f"{name}Decompressor")().decompress(data, max_length=most)
    if size is not None and len(data) != size:
        raise ChunkError("a chunk is shorter than it says")
    return data


@dataclass(frozen=True)
class RecordedTopics:
    """Topics of a file, on one clock that begins at its first message.

    Attributes:
        name: of the file, as messages show it.
        sha256: of the file.
        origin_ns: log time of the first message, ns; 0 s of all times here.
        markers: positions and rotations of bodies and points; None where no topic has any.
        signals: (time, values) by name, each of shape (samples,), s and as recorded: ``/joy.axes[0]``,
            ``/joints.NAME.position``, ``/topic.data[2]``, ``/topic.fluid_pressure`` (Pa),
            ``/topic.dotted.path`` of JSON.
        notes: what was skipped or is odd, in words.
    """

    name: str
    sha256: str
    origin_ns: int
    markers: MarkerTable | None
    signals: dict[str, tuple[np.ndarray, np.ndarray]]
    notes: tuple[str, ...]


def read_markers(file: RecordedFile, kind: str, messages: Messages) -> MarkerTable:
    """Read the topics with positions.

    Raises:
        InputError: as `read`, or no topic has positions.
    """
    found = read(file, kind, messages, signals=False)
    if found.markers is None:
        wanted = "geometry_msgs/PoseStamped, PoseArray, PointStamped, tf2_msgs/TFMessage, … are wanted"
        there = "".join(f"; {note}" for note in found.notes[:3])
        raise InputError(f"{found.name}: no topic with positions; {wanted}{there}")
    return found.markers


def read(file: RecordedFile, kind: str, messages: Messages, *, signals: bool = True) -> RecordedTopics:
    """Read poses, points and signals.

    Times are header stamps where messages have them, else log times. Frames are the messages of the body
    that has most; of other bodies the nearest message within half a frame counts.

    Args:
        file: that holds the messages.
        kind: name of its format.
        messages: of the format.
        signals: whether to read the topics without positions.

    Raises:
        InputError: damaged, too large, or the libraries are not installed.
    """
    topics = _Topics(file, kind, signals)
    with decoding(file, kind):
        try:
            for message in messages(file):
                topics.add(message)
        except CutError:
            if not topics.messages:
                raise
            topics.notes.append("the file is cut: read up to there")
        return topics.result()


_Numbers = tuple[float, ...]
_Series = dict[str, "array[float]"]
"""Label → rows of time (ns from the first message on) and one or seven numbers, one after another."""


@dataclass
class _Topics:
    """What has been read of a file up to now."""

    file: RecordedFile
    kind: str
    with_signals: bool = True
    origin: int = 0
    signals: _Series = field(default_factory=dict)
    bodies: dict[str, _Series] = field(default_factory=dict)  # by topic
    parents: dict[str, str] = field(default_factory=dict)  # label of a transform → frame that it starts from
    skipped: Counter[str] = field(default_factory=Counter)  # messages
    messages: int = 0
    numbers: int = 0
    apart: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add(self, message: Message) -> None:
        """Take in one message."""
        self.messages += 1
        if self.messages > _MOST_MESSAGES:
            raise self.file.error(f"over {_MOST_MESSAGES} messages; record fewer topics, or a shorter take")
        if self.messages == 1:
            self.origin = message.log_time
        topic, kind, decode = _decoder(message.topic)
        if decode is None:
            self.skipped[f"{topic} ({kind})"] += 1
        elif kind in _BODIES:
            for label, stamped, pose in _BODIES[kind](topic, decode(bytes(message.data))):
                if label != topic and hasattr(stamped, "child_frame_id"):
                    label = escape_unprintable(label[:200])
                    self.parents[label] = stamped.header.frame_id
                self._append(self.bodies.setdefault(topic, {}), label, stamped, message, _numbers(pose))
        elif self.with_signals:
            said = decode(bytes(message.data))
            for name, value in _joints(said) if kind.endswith("JointState") else _leaves("", said):
                self._append(self.signals, f"{topic}{escape_unprintable(name)}", said, message, (value,))

    def _append(self, series: _Series, label: str, said: Any, message: Message, values: _Numbers) -> None:
        """Add a row, at the stamp of its header or else at its log time."""
        stamp, time = getattr(getattr(said, "header", None), "stamp", None), message.log_time
        whole, part = getattr(stamp, "sec", None), getattr(stamp, "nanosec", None)
        if isinstance(whole, int) and isinstance(part, int) and (whole or part):
            time = whole * 10**9 + part
            self.apart.setdefault(escape_unprintable(message.topic.name), abs(time - message.log_time) / 1e9)
        series.setdefault(label, array("d")).extend((time - self.origin, *values))
        self.numbers += 1 + len(values)
        if self.numbers > MAX_VALUES or len(series) > MAX_COLUMNS:
            raise self.file.error(f"at most {MAX_VALUES} numbers of {MAX_COLUMNS} signals are read")

    def result(self) -> RecordedTopics:
        """Return all topics on one clock."""
        self.notes += [f"topic {topic} skipped: {count} messages" for topic, count in self.skipped.items()]
        apart = {topic: seconds for topic, seconds in self.apart.items() if seconds > _APART}
        self.notes += [
            f"stamps of {topic} lie {each:.3g} s from the log's clock" for topic, each in apart.items()
        ]
        signals = {name: (rows[:, 0], rows[:, 1]) for name, rows in _sorted(self.signals, 2).items()}
        markers = self._markers() if self.bodies else None
        return RecordedTopics(
            self.file.name, self.file.sha256, self.origin, markers, signals, tuple(self.notes)
        )

    def _markers(self) -> MarkerTable:
        bodies = {topic: _sorted(series, 8) for topic, series in self.bodies.items()}
        series = {(topic, label): rows for topic, each in bodies.items() for label, rows in each.items()}
        main = max(series, key=lambda key: len(series[key]))
        time = np.unique(series[main][:, 0])
        half = 0.5 * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        # Where the body that has most messages was not seen, others of its topic may have been.
        seen = np.unique(np.concatenate([rows[:, 0] for rows in bodies[main[0]].values()]))
        time = np.sort(np.append(time, seen[np.abs(time[_nearest(time, seen)] - seen) > half]))
        if len(time) * len(series) * 7 > MAX_VALUES:
            raise self.file.error(f"{len(time)} frames of {len(series)} bodies; at most {MAX_VALUES} numbers")
        poses = np.full((len(time), len(series), 7), np.nan)
        for k, ((topic, _), rows) in enumerate(series.items()):
            nearest = _nearest(rows[:, 0], time)
            near = (np.abs(rows[nearest, 0] - time) <= half) | topic.endswith("tf_static")
            poses[near, k] = rows[nearest[near], 1:]
        often = Counter(label for _, label in series)
        names = [label if often[label] == 1 else f"{topic}:{label}" for topic, label in series]
        moved = _compose(poses, names, self.parents)
        notes = [f"{len(moved)} transforms start from another body: composed"] if moved else []
        roots = sorted(set(self.parents.values()) - set(names))
        notes += [f"bodies are in different frames: {', '.join(roots[:5])}"] if len(roots) > 1 else []
        turns = np.where(_turned(poses)[..., None], poses[..., 3:], np.nan)
        rotations = None if np.isnan(turns).all() else turns
        epoch: int | None = self.origin if self.origin > _SINCE_1970 else None
        if abs(time[0]) > _OTHER_CLOCK:  # stamps of a simulated clock
            time, epoch = time - time[0], None
        notes = [*self.notes, *map(escape_unprintable, notes)]
        return marker_table(
            self.file, self.kind, time, poses[..., :3], names, notes, rotations=rotations, epoch_ns=epoch
        )


def _sorted(series: _Series, width: int) -> dict[str, np.ndarray]:
    """Return the rows of each label in the order of time, s."""
    tables = {label: np.array(flat).reshape(-1, width) for label, flat in series.items()}
    scale = np.array([1e-9, *[1.0] * (width - 1)])
    return {label: rows[np.argsort(rows[:, 0], kind="stable")] * scale for label, rows in tables.items()}


def _nearest(own: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Return the index of the own time nearest to each time."""
    return np.rint(np.interp(time, own, np.arange(len(own)))).astype(int)


def _turned(poses: np.ndarray) -> np.ndarray:
    """Say of which poses the quaternion is one."""
    return np.asarray(np.abs(np.linalg.norm(poses[..., 3:], axis=-1) - 1) < 0.5)


def _compose(poses: np.ndarray, names: list[str], parents: Mapping[str, str]) -> list[str]:
    """Turn transforms that start from another body into poses where that one's starts; return their names."""
    from scipy.spatial.transform import Rotation

    place, moved = {name: k for k, name in enumerate(names)}, dict[str, None]()
    for name in names:
        chain = [name]
        while chain[-1] not in moved and parents.get(chain[-1]) in place and len(chain) <= len(names):
            chain.append(parents[chain[-1]])
        for inner, outer in zip(chain[-2::-1], chain[::-1], strict=False):
            moved[inner] = None
            child, base = poses[:, place[inner]], poses[:, place[outer]]
            known = _turned(child) & _turned(base)
            turn = Rotation.from_quat(base[known, 3:])
            child[known, :3] = base[known, :3] + turn.apply(child[known, :3])
            child[known, 3:] = (turn * Rotation.from_quat(child[known, 3:])).as_quat()
            child[~known] = np.nan
    return list(moved)


_SIGNALS = re.compile(
    r"std_msgs/(Bool|(Float|U?Int)\d+(MultiArray)?)|sensor_msgs/(Joy|JointState|FluidPressure)"
)
_ABOUT = ("header", "layout")  # parts of a message that hold no signals
_BODIES: dict[str, Callable[[str, Any], list[tuple[str, Any, Any]]]] = {
    "geometry_msgs/PoseStamped": lambda topic, said: [(topic, said, said.pose)],
    "geometry_msgs/PoseWithCovarianceStamped": lambda topic, said: [(topic, said, said.pose.pose)],
    "nav_msgs/Odometry": lambda topic, said: [(topic, said, said.pose.pose)],
    "nav_msgs/Path": lambda topic, said: [(topic, said, each.pose) for each in said.poses[-1:]],
    "geometry_msgs/Pose": lambda topic, said: [(topic, said, said)],
    "geometry_msgs/PoseArray": lambda topic, said: [
        (f"{topic}_{k}", said, pose) for k, pose in enumerate(said.poses, start=1)
    ],
    "geometry_msgs/PointStamped": lambda topic, said: [(topic, said, said.point)],
    "geometry_msgs/Point": lambda topic, said: [(topic, said, said)],
    "geometry_msgs/TransformStamped": lambda topic, said: [
        (said.child_frame_id or topic, said, said.transform)
    ],
    "tf2_msgs/TFMessage": lambda topic, said: [
        (each.child_frame_id or topic, each, each.transform) for each in said.transforms
    ],
}
"""Kind of messages with positions → topic and message → label, what has the stamp, and what the pose."""


@lru_cache(1000)
def _decoder(topic: Topic) -> tuple[str, str, Callable[[bytes], Any] | None]:
    """Return name and kind of a topic, and what decodes its messages; None where that is not known."""
    kind = (
        escape_unprintable(topic.kind[:80])
        .replace("/msg/", "/")
        .replace("tf/tfMessage", "tf2_msgs/TFMessage")
    )
    decode: Callable[[bytes], Any] | None = None
    if topic.encoding == "json":
        decode = partial(json.loads, object_hook=lambda each: SimpleNamespace(**each))
    elif topic.encoding in ("cdr", "ros1") and (kind in _BODIES or _SIGNALS.fullmatch(kind)):
        store = _definitions(topic.encoding)
        decode = partial(
            store.deserialize_cdr if topic.encoding == "cdr" else store.deserialize_ros1,
            typename=kind.replace("/", "/msg/"),
        )
    return escape_unprintable(topic.name[:200]), kind, decode


@cache
def _definitions(encoding: str) -> Any:
    """Return the kinds of messages of ROS; files' own definitions would be compiled, and are not trusted."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE if encoding == "cdr" else Stores.ROS1_NOETIC)
    transforms = "geometry_msgs/TransformStamped[] transforms"
    store.register(get_types_from_msg(transforms, "tf2_msgs/msg/TFMessage"))
    return store


def _numbers(pose: Any) -> _Numbers:
    """Return x, y, z and the quaternion x, y, z, w of a pose, transform or point; NaN where there is none."""
    at = getattr(pose, "position", None) or getattr(pose, "translation", pose)
    turn = getattr(pose, "orientation", None) or getattr(pose, "rotation", None)
    return (at.x, at.y, at.z, *((turn.x, turn.y, turn.z, turn.w) if turn is not None else (np.nan,) * 4))


def _joints(said: Any) -> Iterator[tuple[str, float]]:
    """Yield (name below the topic, number) of the state of joints."""
    for quantity in ("position", "velocity", "effort"):
        for joint, value in zip(said.name, getattr(said, quantity), strict=False):
            yield f".{joint}.{quantity}", float(value)


def _leaves(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """Yield all numbers inside lists and objects, by dotted path."""
    if isinstance(value, int | float | np.number):
        yield name, float(value)
    elif isinstance(value, list | np.ndarray):
        for k, inner in enumerate(value):
            yield from _leaves(f"{name}[{k}]", inner)
    elif hasattr(value, "__dict__"):
        for key, inner in vars(value).items():
            yield from _leaves(f"{name}.{key}", inner) if key not in _ABOUT else ()
