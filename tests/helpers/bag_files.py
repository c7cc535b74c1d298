"""Bags of ROS 1 and ROS 2 with messages of any type, written by rosbags and mcap."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import (
    CompressionFormat,
    CompressionMode,
    StoragePlugin,
    Writer as Writer2,
)
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

RATE = 100.0
ORIGIN = 1_700_000_000_123_456_789  # ns
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS1.register(
    get_types_from_msg(
        "geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"
    )
)
TURN = np.array([0.0, 0.0, np.sin(0.3), np.cos(0.3)])


class Maker:
    """Makes messages of ROS 1 or 2."""

    def __init__(self, ros1):
        self.ros1 = ros1
        self.store = ROS1 if ros1 else ROS2

    def __call__(self, kind, **fields):
        return self.store.types[kind.replace("/", "/msg/")](**fields)

    def header(self, k, frame="world"):
        stamp = self(
            "builtin_interfaces/Time", sec=ns(k) // 10**9, nanosec=ns(k) % 10**9
        )
        return self(
            "std_msgs/Header",
            stamp=stamp,
            frame_id=frame,
            **({"seq": k} if self.ros1 else {}),
        )

    def point(self, place, kind="Point"):
        return self(
            f"geometry_msgs/{kind}", **dict(zip("xyz", map(float, place), strict=True))
        )

    def pose(self, place, turn=TURN):
        parts = dict(zip("xyzw", map(float, turn), strict=True))
        return self(
            "geometry_msgs/Pose",
            position=self.point(place),
            orientation=self("geometry_msgs/Quaternion", **parts),
        )

    def covariant(self, place):
        spread = np.zeros(36)
        return self(
            "geometry_msgs/PoseWithCovariance", pose=self.pose(place), covariance=spread
        )

    def transform(self, k, place, child, frame="world"):
        pose = self.pose(place)
        moved = self.point(place, "Vector3")
        moved = self(
            "geometry_msgs/Transform", translation=moved, rotation=pose.orientation
        )
        header = self.header(k, frame)
        return self(
            "geometry_msgs/TransformStamped",
            header=header,
            child_frame_id=child,
            transform=moved,
        )

    def twist(self):
        none = self.point(np.zeros(3), "Vector3")
        twist = self("geometry_msgs/Twist", linear=none, angular=none)
        return self(
            "geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36)
        )

    def array(self, kind, values, dtype):
        """Return the full kind and the message."""
        layout = self("std_msgs/MultiArrayLayout", dim=[], data_offset=0)
        data = np.array(values, dtype=dtype)
        return f"std_msgs/{kind}", self(f"std_msgs/{kind}", layout=layout, data=data)

    def serialized(self, message, kind):
        if kind == "json":
            return json.dumps(message).encode()
        name = kind.replace("/", "/msg/")
        write = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        return bytes(write(message, name))


def ns(k):
    return ORIGIN + round(k / RATE * 1e9)


def written(folder: Path, container: str, messages, **options) -> Path:
    """Write (topic, kind, time in ns, message of a Maker) with the library of the container.

    MCAP files may contain JSON, whose kind is "json". `options` are given to their
    writer.
    """
    how, _, compression = container.partition(" ")
    make = Maker("bag" in container or "ros1" in container)
    rows = [
        (topic, kind, time, make.serialized(message, kind))
        for topic, kind, time, message in messages(make)
    ]
    if how == "mcap":
        return by_mcap(folder / "walk.mcap", rows, make, compression, **options)
    path = folder / "walk.bag"
    if how == "bag":
        writer = Writer1(path)
        if compression:
            writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    else:
        writer = Writer2(
            folder / "walk", version=9, storage_plugin=StoragePlugin.SQLITE3
        )
        path = folder / "walk/walk.db3"
        if compression:
            writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, kind, time, data in rows:
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, kind.replace("/", "/msg/"), typestore=make.store
                )
            writer.write(connections[topic], time, data)
    return path


def by_mcap(path, rows, make, compression, chunk_size=4096, **options):
    how = CompressionType[(compression.removeprefix("ros1").strip() or "none").upper()]
    with path.open("wb") as stream:
        writer = McapWriter(stream, compression=how, chunk_size=chunk_size, **options)
        writer.start(profile="ros1" if make.ros1 else "ros2")
        channels = {}
        for topic, kind, time, data in rows:
            if topic not in channels:
                channels[topic] = channel(writer, topic, kind, make)
            writer.add_message(channels[topic], time, data, time)
        writer.finish()
    return path


def channel(writer, topic, kind, make):
    """Register a topic of an MCAP file."""
    if kind == "json":
        schema = writer.register_schema(topic, "jsonschema", b"{}")
        return writer.register_channel(topic, "json", schema)
    name = kind.replace("/", "/msg/")
    text = make.store.generate_msgdef(name, ros_version=2 - make.ros1)[0].encode()
    if make.ros1:
        schema = writer.register_schema(kind, "ros1msg", text)
        return writer.register_channel(topic, "ros1", schema)
    schema = writer.register_schema(name, "ros2msg", text)
    return writer.register_channel(topic, "cdr", schema)
