"""Extraction of poses, points and signals from bag messages (ROS 1, ROS 2, JSON).

A container (see `bags`) yields messages with topics and log times. The library
`rosbags` decodes known ROS message types with its own definitions and ignores
definitions in the file. The declared chunk sizes are checked before unpacking, because
the contents of a malicious file may be ten thousand times as large as the file.
"""

from __future__ import annotations

import json
import re
import sys
from abc import abstractmethod
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from importlib import import_module
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from srs_twin.io.files import escape_unprintable
from srs_twin.recordings.formats.base import (
    Format,
    MarkerTable,
    Unstated,
    decoding,
    marker_table,
)
from srs_twin.recordings.recorded_file import (
    MAX_BYTES,
    MAX_COLUMNS,
    MAX_VALUES,
    RecordedFile,
)

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Decoded = Any
"""Decoded message, either a `rosbags` object or a namespace with JSON fields."""

_MIN_EPOCH_NS = 10**17
"""Minimum log time that is interpreted as Unix time, ns."""
_OTHER_CLOCK_S = 1e6
"""Minimum difference between stamp and log time due to a simulated clock, s."""
_NOTED_DIFFERENCE_S = 1.0
"""Difference between stamp and log time above which a note is added, s."""
_MAX_UNPACKED = 4 * MAX_BYTES
_MIN_ALLOWED = 16 << 20
"""Unpacked size that is allowed for a file of any size, bytes."""
_MAX_RATIO = 32
"""Maximum ratio of unpacked to packed size (repetitive JSON reaches 20)."""
_MAX_MESSAGES = 1 << 23
"""Maximum number of messages (one hour of twenty topics at 100 Hz)."""
if sys.version_info >= (3, 14):
    _ZSTD = "compression.zstd"
else:
    _ZSTD = "backports.zstd"
_UNPACKERS = {
    "lz4": ("lz4.frame", "LZ4Frame"),
    "zstd": (_ZSTD, "Zstd"),
    "bz2": ("bz2", "BZ2"),
}
"""Module and class name (without "Decompressor") for each compression."""


class ChunkError(ValueError):
    """Error for a chunk or record that is damaged or too large."""


class CutError(ChunkError):
    """Error for a truncated file, which ends inside a record."""


class Topic(NamedTuple):
    """Topic of a bag.

    Attributes:
        kind: message type, for example "geometry_msgs/Pose".
        encoding: message encoding, "cdr", "ros1" or "json".
    """

    name: str
    kind: str
    encoding: str


class BagMessage(NamedTuple):
    """Encoded message with its topic and log time (ns)."""

    topic: Topic
    log_time: int
    data: memoryview


def check_unpacked(file: RecordedFile, sizes: Iterable[int]) -> None:
    """Raise an error if the declared unpacked sizes of chunks exceed the limit."""
    allowed = min(_MAX_UNPACKED, _MIN_ALLOWED + _MAX_RATIO * len(file.data))
    total = 0
    with suppress(CutError):  # a truncated file is allowed
        for size in sizes:
            total += size
    if total > allowed:
        raise file.error(
            f"the unpacked size is {total / (1 << 20):.0f} MB, but at most"
            f" {allowed >> 20} MB are allowed for a file of"
            f" {len(file.data) / 1000:.0f} kB; record fewer topics, or for a shorter"
            " time"
        )


def unpacked(
    data: memoryview | bytes, compression: str, size: int | None
) -> bytes | memoryview:
    """Return decompressed data.

    `size` is the declared unpacked size in bytes, or None for a single message.

    Raises:
        ChunkError: the data are damaged, too large, or not of the declared size.
    """
    limit = MAX_BYTES if size is None else size
    if limit > MAX_BYTES or compression not in ("", *_UNPACKERS):
        raise ChunkError(
            f"a chunk of {size} bytes has the compression '{compression}'; at most"
            f" {MAX_BYTES} bytes and the compressions lz4, zstd and bz2 are allowed"
        )
    if compression:
        module, name = _UNPACKERS[compression]
        decompressor = getattr(import_module(module), f"{name}Decompressor")()
        data = decompressor.decompress(data, max_length=limit)
    if size is not None and len(data) != size:
        raise ChunkError("a chunk is shorter than declared")
    return data


@dataclass(frozen=True)
class RecordedTopics:
    """Topics of a file on a common clock that starts at the first message.

    Attributes:
        origin_ns: log time of the first message, ns.
        signals: times (s) and values of each signal, both of shape (samples,), keyed by
            name. Examples of names are ``/joy.axes[0]``, ``/joints.NAME.position``,
            ``/topic.fluid_pressure`` (Pa) and, for JSON, ``/topic.dotted.path``.
    """

    name: str
    sha256: str
    origin_ns: int
    markers: MarkerTable | None
    signals: dict[str, tuple[np.ndarray, np.ndarray]]
    notes: tuple[str, ...]


class Bag(Format):
    """Base class for message containers, including truncated containers."""

    binary = True
    suffix: ClassVar[str]

    @abstractmethod
    def messages(self, file: RecordedFile) -> Iterator[BagMessage]:
        """Yield the messages in the order of the file.

        Raises:
            InputError: the total size of the unpacked messages exceeds the limit.
            ChunkError: the file is damaged. A truncated file raises a `CutError`.
        """

    def read(self, file: RecordedFile, unstated: Unstated) -> MarkerTable:
        """Read the topics that contain positions."""
        recorded = self.read_topics(file, signals=False)
        if recorded.markers is None:
            types = (
                "geometry_msgs/PoseStamped, PoseArray, PointStamped,"
                " tf2_msgs/TFMessage, …"
            )
            notes = "".join(f"; {note}" for note in recorded.notes[:3])
            raise file.error(
                "the file has no topic with positions; such topics have the types"
                f" {types}{notes}"
            )
        return recorded.markers

    def read_topics(
        self, file: RecordedFile, *, signals: bool = True
    ) -> RecordedTopics:
        """Read poses and points, and also signals if `signals` is true.

        The time of a message is the stamp in its header, or the log time without such a
        stamp. The body with the most messages determines the frame times. The poses of
        other bodies are taken from the nearest message within half a frame period.

        Raises:
            InputError: the file is damaged or too large, or the libraries are not
                installed.
        """
        topics = _Topics(file, self.name, signals)
        with decoding(file, self.name):
            try:
                for message in self.messages(file):
                    topics.add(message)
            except CutError:
                if not topics.messages:
                    raise
                topics.notes.append("the file is cut off; it was read up to the cut")
            return topics.result()


_Numbers = tuple[float, ...]
_Series = dict[str, "array[float]"]
"""Rows with the time since the first message (ns) and one or seven numbers, keyed by
label."""


@dataclass
class _Topics:
    file: RecordedFile
    kind: str
    with_signals: bool = True
    origin: int = 0
    signals: _Series = field(default_factory=dict)
    bodies: dict[str, _Series] = field(default_factory=dict)  # keyed by topic
    parents: dict[str, str] = field(
        default_factory=dict
    )  # parent frame, keyed by transform label
    skipped: Counter[str] = field(default_factory=Counter)  # message counts
    messages: int = 0
    numbers: int = 0
    clock_differences: dict[str, float] = field(
        default_factory=dict
    )  # difference between stamp and log time, s, keyed by topic
    notes: list[str] = field(default_factory=list)

    def add(self, message: BagMessage) -> None:
        self.messages += 1
        if self.messages > _MAX_MESSAGES:
            raise self.file.error(
                f"the file has over {_MAX_MESSAGES} messages; record fewer topics, or"
                " for a shorter time"
            )
        if self.messages == 1:
            self.origin = message.log_time
        topic, kind, decode = _decoder(message.topic)
        if decode is None:
            self.skipped[f"{topic} ({kind})"] += 1
        elif kind in _BODIES:
            series = self.bodies.setdefault(topic, {})
            for label, stamped, pose in _BODIES[kind](
                topic, decode(bytes(message.data))
            ):
                name = label
                if label != topic and hasattr(stamped, "child_frame_id"):
                    name = escape_unprintable(label[:200])
                    self.parents[name] = stamped.header.frame_id
                self._append(series, name, stamped, message, _numbers(pose))
        elif self.with_signals:
            content = decode(bytes(message.data))
            leaves = _leaves("", content)
            if kind.endswith("JointState"):
                leaves = _joints(content)
            for path, value in leaves:
                name = f"{topic}{escape_unprintable(path)}"
                self._append(self.signals, name, content, message, (value,))

    def _append(
        self,
        series: _Series,
        label: str,
        content: object,
        message: BagMessage,
        values: _Numbers,
    ) -> None:
        stamp = getattr(getattr(content, "header", None), "stamp", None)
        time = message.log_time
        whole = getattr(stamp, "sec", None)
        part = getattr(stamp, "nanosec", None)
        if isinstance(whole, int) and isinstance(part, int) and (whole or part):
            time = whole * 10**9 + part
            difference = abs(time - message.log_time) / 1e9
            self.clock_differences.setdefault(
                escape_unprintable(message.topic.name), difference
            )
        series.setdefault(label, array("d")).extend((time - self.origin, *values))
        self.numbers += 1 + len(values)
        if self.numbers > MAX_VALUES or len(series) > MAX_COLUMNS:
            raise self.file.error(
                f"the file has too many values; at most {MAX_VALUES} numbers in"
                f" {MAX_COLUMNS} signals are allowed"
            )

    def result(self) -> RecordedTopics:
        self.notes += [
            f"the topic {topic} with {count} messages was skipped"
            for topic, count in self.skipped.items()
            if _DRAWING not in topic
        ]
        self.notes += [
            f"the time stamps of {topic} differ by {difference:.3g} s from the log"
            " times"
            for topic, difference in self.clock_differences.items()
            if difference > _NOTED_DIFFERENCE_S
        ]
        signals = {
            name: (rows[:, 0], rows[:, 1])
            for name, rows in _sorted(self.signals, 2).items()
        }
        markers = self._markers() if self.bodies else None
        return RecordedTopics(
            self.file.name,
            self.file.sha256,
            self.origin,
            markers,
            signals,
            tuple(self.notes),
        )

    def _markers(self) -> MarkerTable:
        bodies = {topic: _sorted(series, 8) for topic, series in self.bodies.items()}
        series = {
            (topic, label): rows
            for topic, labels in bodies.items()
            for label, rows in labels.items()
        }
        main_topic, main_label = max(series, key=lambda key: len(series[key]))
        frames = _frames(bodies[main_topic], main_label)
        if len(frames.time) * len(series) * 7 > MAX_VALUES:
            raise self.file.error(
                f"the file has {len(frames.time)} frames of {len(series)} bodies, but"
                f" at most {MAX_VALUES} numbers are allowed; record a shorter time or"
                " fewer bodies"
            )
        poses = np.full((len(frames.time), len(series), 7), np.nan)
        for k, ((topic, _), rows) in enumerate(series.items()):
            nearest = _nearest(rows[:, 0], frames.time)
            near = np.abs(rows[nearest, 0] - frames.time) <= frames.half_period
            near |= topic.endswith("tf_static")
            poses[near, k] = rows[nearest[near], 1:]
        names = _unique_names(series)
        notes = [*self.notes]
        if composed := _compose(poses, names, self.parents):
            notes.append(
                f"{len(composed)} transforms relative to another body were converted to"
                " the root frame"
            )
        roots = sorted(set(self.parents.values()) - set(names))
        if len(roots) > 1:
            listed = escape_unprintable(", ".join(roots[:5]))
            notes.append(f"the bodies are in different frames: {listed}")
        rotated = _has_rotation(poses)
        quaternions = np.where(rotated[..., None], poses[..., 3:], np.nan)
        # A simulated clock may start at any time, so its times are shifted to start at
        # 0.
        time = frames.time
        other_clock = abs(time[0]) > _OTHER_CLOCK_S
        if other_clock:
            time = time - time[0]
        table = marker_table(
            self.file,
            self.kind,
            time,
            poses[..., :3],
            names,
            notes,
            rotations=quaternions if rotated.any() else None,
        )
        if self.origin > _MIN_EPOCH_NS and not other_clock:
            return replace(table, epoch_ns=self.origin)
        return table


def _unique_names(bodies: Iterable[tuple[str, str]]) -> list[str]:
    bodies = list(bodies)
    counts = Counter(label for _, label in bodies)
    return [
        label if counts[label] == 1 else f"{topic}:{label}" for topic, label in bodies
    ]


class _Frames(NamedTuple):
    time: np.ndarray
    half_period: float


def _frames(bodies: Mapping[str, np.ndarray], main: str) -> _Frames:
    """Return the frames of `main` and the frames that contain only other bodies."""
    time = np.unique(bodies[main][:, 0])
    half = 0.5 * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    every = np.unique(np.concatenate([rows[:, 0] for rows in bodies.values()]))
    distance = np.abs(time[_nearest(time, every)] - every)
    return _Frames(np.sort(np.append(time, every[distance > half])), half)


def _sorted(series: _Series, width: int) -> dict[str, np.ndarray]:
    tables = {
        label: np.array(flat).reshape(-1, width) for label, flat in series.items()
    }
    scale = np.array([1e-9, *[1.0] * (width - 1)])
    return {
        label: rows[np.argsort(rows[:, 0], kind="stable")] * scale
        for label, rows in tables.items()
    }


def _nearest(own: np.ndarray, time: np.ndarray) -> np.ndarray:
    index: np.ndarray = np.rint(np.interp(time, own, np.arange(len(own)))).astype(int)
    return index


def _has_rotation(poses: np.ndarray) -> np.ndarray:
    return np.asarray(np.abs(np.linalg.norm(poses[..., 3:], axis=-1) - 1) < 0.5)


def _compose(
    poses: np.ndarray, names: list[str], parents: Mapping[str, str]
) -> list[str]:
    """Convert poses that are relative to another body to the root frame, in place."""
    from scipy.spatial.transform import Rotation

    index = {name: k for k, name in enumerate(names)}
    composed = dict[str, None]()
    for name in names:
        chain = [name]
        while (
            chain[-1] not in composed
            and parents.get(chain[-1]) in index
            and len(chain) <= len(names)
        ):
            chain.append(parents[chain[-1]])
        # Parents are converted before their children, so the pose of the parent is
        # already relative to the root frame.
        for inner, outer in zip(chain[-2::-1], chain[::-1], strict=False):
            composed[inner] = None
            child = poses[:, index[inner]]
            base = poses[:, index[outer]]
            known = _has_rotation(child) & _has_rotation(base)
            rotation = Rotation.from_quat(base[known, 3:])
            child[known, :3] = base[known, :3] + rotation.apply(child[known, :3])
            child[known, 3:] = (
                rotation * Rotation.from_quat(child[known, 3:])
            ).as_quat()
            child[~known] = np.nan
    return list(composed)


_SIGNALS = re.compile(
    r"std_msgs/(Bool|(Float|U?Int)\d+(MultiArray)?)|sensor_msgs/(Joy|JointState|FluidPressure)"
)
_DRAWING = " (visualization_msgs/"
"""Prefix of drawing message types, which are skipped without a note."""
_METADATA = ("header", "layout")
"""Message fields that contain no signals."""
_BODIES: dict[str, Callable[[str, Decoded], list[tuple[str, Decoded, Decoded]]]] = {
    "geometry_msgs/PoseStamped": lambda topic, message: [
        (topic, message, message.pose)
    ],
    "geometry_msgs/PoseWithCovarianceStamped": lambda topic, message: [
        (topic, message, message.pose.pose)
    ],
    "nav_msgs/Odometry": lambda topic, message: [(topic, message, message.pose.pose)],
    "nav_msgs/Path": lambda topic, message: [
        (topic, message, last.pose) for last in message.poses[-1:]
    ],
    "geometry_msgs/Pose": lambda topic, message: [(topic, message, message)],
    "geometry_msgs/PoseArray": lambda topic, message: [
        (f"{topic}_{k}", message, pose) for k, pose in enumerate(message.poses, start=1)
    ],
    "geometry_msgs/PointStamped": lambda topic, message: [
        (topic, message, message.point)
    ],
    "geometry_msgs/Point": lambda topic, message: [(topic, message, message)],
    "geometry_msgs/TransformStamped": lambda topic, message: [
        (message.child_frame_id or topic, message, message.transform)
    ],
    "tf2_msgs/TFMessage": lambda topic, message: [
        (stamped.child_frame_id or topic, stamped, stamped.transform)
        for stamped in message.transforms
    ],
}
"""Functions that return label, stamped part and pose, keyed by message type."""


@lru_cache(1000)
def _decoder(topic: Topic) -> tuple[str, str, Callable[[bytes], Decoded] | None]:
    kind = escape_unprintable(topic.kind[:80]).replace("/msg/", "/")
    kind = kind.replace("tf/tfMessage", "tf2_msgs/TFMessage")
    decode: Callable[[bytes], Decoded] | None = None
    if topic.encoding == "json":
        decode = partial(
            json.loads, object_hook=lambda fields: SimpleNamespace(**fields)
        )
    elif topic.encoding in ("cdr", "ros1") and (
        kind in _BODIES or _SIGNALS.fullmatch(kind)
    ):
        store = _definitions(topic.encoding)
        deserialize = getattr(store, f"deserialize_{topic.encoding}")
        decode = partial(deserialize, typename=kind.replace("/", "/msg/"))
    return escape_unprintable(topic.name[:200]), kind, decode


@cache
def _definitions(encoding: str) -> Typestore:
    """Return the ROS message definitions of `rosbags`.

    The definitions in a file are not used, because compiling them would be unsafe.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(
        Stores.ROS2_HUMBLE if encoding == "cdr" else Stores.ROS1_NOETIC
    )
    transforms = "geometry_msgs/TransformStamped[] transforms"
    store.register(get_types_from_msg(transforms, "tf2_msgs/msg/TFMessage"))
    return store


def _numbers(pose: Decoded) -> _Numbers:
    position: Decoded = getattr(pose, "position", getattr(pose, "translation", pose))
    rotation = getattr(pose, "orientation", getattr(pose, "rotation", None))
    if rotation is None:
        quaternion = (np.nan,) * 4
    else:
        quaternion = (rotation.x, rotation.y, rotation.z, rotation.w)
    return (position.x, position.y, position.z, *quaternion)


def _joints(message: Decoded) -> Iterator[tuple[str, float]]:
    for quantity in ("position", "velocity", "effort"):
        for joint, value in zip(message.name, getattr(message, quantity), strict=False):
            yield f".{joint}.{quantity}", float(value)


def _leaves(name: str, value: object) -> Iterator[tuple[str, float]]:
    if isinstance(value, int | float | np.number):
        yield name, float(value)
    elif isinstance(value, list | np.ndarray):
        for k, inner in enumerate(value):
            yield from _leaves(f"{name}[{k}]", inner)
    elif hasattr(value, "__dict__"):
        for key, inner in vars(value).items():
            yield from _leaves(f"{name}.{key}", inner) if key not in _METADATA else ()
