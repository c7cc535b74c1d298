"""Bags of ROS 1 and ROS 2 written by rosbags and mcap: all message types, all containers."""

from __future__ import annotations

import sqlite3

import numpy as np
import pytest
from bag_files import TURN, ns, written

from srs_twin import InputError
from srs_twin.cli import main
from srs_twin.recordings.formats import bags, identify, read_markers, read_topics
from srs_twin.recordings.inspection import inspect_file
from srs_twin.recordings.recording_map import NO_MAP

FRAMES = 50
RATE = 100.0
TIME = np.arange(FRAMES) / RATE
RNG = np.random.default_rng(5)
PLACE = np.cumsum(RNG.normal(scale=3e-3, size=(FRAMES, 3, 3)), axis=0) + RNG.uniform(
    -1, 1, size=(3, 3)
)
CONTAINERS = (
    "bag",
    "bag bz2",
    "bag lz4",
    "db3",
    "db3 zstd",
    "mcap",
    "mcap zstd",
    "mcap ros1",
    "mcap ros1 lz4",
)


def everything(make):
    """Yield a message of each type on each frame, for bodies at three positions."""
    for k, (a, b, c) in enumerate(PLACE):
        at = ns(k) + 4_000_000
        header = make.header(k)
        yield (
            "/a",
            "geometry_msgs/PoseStamped",
            at,
            make("geometry_msgs/PoseStamped", header=header, pose=make.pose(a)),
        )
        covariant = make(
            "geometry_msgs/PoseWithCovarianceStamped",
            header=header,
            pose=make.covariant(b),
        )
        yield "/b", "geometry_msgs/PoseWithCovarianceStamped", at, covariant
        fields = {
            "header": header,
            "child_frame_id": "base_link",
            "pose": make.covariant(c),
            "twist": make.twist(),
        }
        yield "/odom", "nav_msgs/Odometry", at, make("nav_msgs/Odometry", **fields)
        yield (
            "/vicon/d",
            "geometry_msgs/TransformStamped",
            at,
            make.transform(k, a, "d"),
        )
        moved = make(
            "tf2_msgs/TFMessage",
            transforms=[make.transform(k, b, "e"), make.transform(k, c, "f")],
        )
        yield "/tf", "tf2_msgs/TFMessage", at, moved
        poses = [
            make("geometry_msgs/PoseStamped", header=header, pose=make.pose(each))
            for each in PLACE[: k + 1, 0]
        ]
        yield (
            "/path",
            "nav_msgs/Path",
            at,
            make("nav_msgs/Path", header=header, poses=poses),
        )
        point = make("geometry_msgs/PointStamped", header=header, point=make.point(b))
        yield "/point", "geometry_msgs/PointStamped", at, point
        air = make(
            "sensor_msgs/FluidPressure",
            header=header,
            fluid_pressure=1000.0 * k,
            variance=0.0,
        )
        yield "/air", "sensor_msgs/FluidPressure", at, air
        yield (
            "/cmd",
            "std_msgs/Float32MultiArray",
            at,
            make.array("Float32MultiArray", [k, -k], np.float32),
        )
        yield (
            "/valves",
            "std_msgs/Int8MultiArray",
            at,
            make.array("Int8MultiArray", [1, -1], np.int8),
        )
        yield "/supply", "std_msgs/Float64", at, make("std_msgs/Float64", data=0.5 * k)
        yield "/word", "std_msgs/String", at, make("std_msgs/String", data="hello")


BODIES = {"/a": 0, "/b": 1, "/odom": 2, "d": 0, "e": 1, "f": 2, "/path": 0, "/point": 1}


@pytest.mark.default_cases(at=[0, 3, 8])
@pytest.mark.parametrize("container", CONTAINERS)
def test_all_message_types_of_all_containers_are_read(tmp_path, container):
    found = read_topics(written(tmp_path, container, everything))
    table = found.markers
    shift = -0.004
    assert table.labels == tuple(BODIES)
    assert np.abs(table.time - shift - TIME).max() < 1e-6
    for k, which in enumerate(BODIES.values()):
        assert np.abs(table.points[:, k] - PLACE[:, which]).max() < 1e-9
    assert (
        np.abs(table.rotations[:, :7] - TURN).max() < 1e-9
        and np.isnan(table.rotations[:, 7]).all()
    )
    k = np.arange(FRAMES)
    signals = {
        "/cmd.data[1]": -k,
        "/valves.data[1]": 0 * k - 1,
        "/supply.data": 0.5 * k,
        "/air.fluid_pressure": 1e3 * k,
    }
    for name, values in signals.items():
        time, said = found.signals[name]
        assert np.abs(said - values).max() < 1e-9
        assert np.abs(time - TIME - (shift if "air" in name else 0.0)).max() < 1e-6
    assert (
        "the topic /word (std_msgs/String) with 50 messages was skipped" in found.notes
    )


def only(kind):
    """Yield the messages of one type."""
    return lambda make: (row for row in everything(make) if row[1] == kind)


@pytest.mark.default_cases(at=[0, 4, 8, 12, 19, 20, 25])
@pytest.mark.parametrize("container", ["bag", "db3", "mcap", "mcap ros1"])
@pytest.mark.parametrize(
    "kind",
    [
        "geometry_msgs/PoseStamped",
        "geometry_msgs/PoseWithCovarianceStamped",
        "nav_msgs/Odometry",
        "geometry_msgs/TransformStamped",
        "tf2_msgs/TFMessage",
        "nav_msgs/Path",
        "geometry_msgs/PointStamped",
    ],
)
def test_bags_with_one_message_type_are_read(tmp_path, container, kind):
    table = read_markers(written(tmp_path, container, only(kind)))
    label = table.labels[0]
    assert (
        len(table.time) == FRAMES
        and np.abs(np.diff(table.time) - 1 / RATE).max() < 1e-6
    )
    assert np.abs(table.points[:, 0] - PLACE[:, BODIES[label]]).max() < 1e-9


def test_the_folder_of_a_bag_is_read(tmp_path):
    path = written(tmp_path, "db3", everything)
    assert identify(path.parent) == "ROS 2 bag" == read_markers(path.parent).kind
    (path.parent / "walk_1.db3").write_bytes(path.read_bytes())
    with pytest.raises(
        InputError,
        match=r"the folder has 2 bags; give one of them \(walk.db3, walk_1.db3",
    ):
        identify(path.parent)


def test_bodies_with_different_stamps_and_gaps_are_aligned(tmp_path):
    """Each transform has its own, slightly later message; the first body is missing for some time."""

    def messages(make):
        for k, places in enumerate(PLACE):
            for m in range(3):
                if m == 0 and 10 <= k < 15:
                    continue
                moved = make.transform(k, places[m], f"body{m}")
                moved.header.stamp.nanosec += 300_000 * m
                said = make("tf2_msgs/TFMessage", transforms=[moved])
                yield "/tf", "tf2_msgs/TFMessage", ns(k), said

    table = read_markers(written(tmp_path, "mcap", messages))
    assert table.points.shape == (FRAMES, 3, 3)
    expected = PLACE.copy()
    expected[10:15, 0] = np.nan
    assert (np.isnan(table.points) == np.isnan(expected)).all()
    assert np.nanmax(np.abs(table.points - expected)) < 1e-9


def test_transforms_relative_to_another_body_are_composed(tmp_path):
    def messages(make):
        static = make(
            "tf2_msgs/TFMessage",
            transforms=[make.transform(0, [1.0, 0.0, 0.0], "tip", "base")],
        )
        yield "/tf_static", "tf2_msgs/TFMessage", ns(0), static
        for k, places in enumerate(PLACE):
            said = make(
                "tf2_msgs/TFMessage", transforms=[make.transform(k, places[0], "base")]
            )
            yield "/tf", "tf2_msgs/TFMessage", ns(k), said

    table = read_markers(written(tmp_path, "bag", messages))
    tip = table.points[:, table.labels.index("tip")]
    assert np.abs(tip - PLACE[:, 0] - [np.cos(0.6), np.sin(0.6), 0.0]).max() < 1e-9
    assert (
        "1 transforms relative to another body were converted to the root frame"
        in table.corrections
    )


@pytest.mark.default_cases(at=[0, 1, 3])
@pytest.mark.parametrize("container", ["bag", "db3", "mcap", "mcap ros1"])
def test_a_bag_without_positions_is_a_log(tmp_path, container, capsys):
    path = written(tmp_path, container, only("std_msgs/Int8MultiArray"))
    facts, _ = inspect_file(path, NO_MAP, None)
    assert facts.content == "log" and facts.rows == FRAMES
    assert [each.name for each in facts.signals] == [
        "/valves.data[0]",
        "/valves.data[1]",
    ]
    with pytest.raises(InputError, match="no topic with positions"):
        read_markers(path)
    with pytest.raises(SystemExit) as left:
        main(["inspect", str(path), "--json"])
    assert not left.value.code and '"/valves.data[1]"' in capsys.readouterr().out


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("container", ["bag lz4", "mcap"])
def test_truncated_bags_are_read_up_to_the_cut(tmp_path, container):
    path = written(
        tmp_path,
        container,
        lambda make: (row for _ in range(20) for row in everything(make)),
    )
    content = path.read_bytes()
    path.write_bytes(content[: int(0.6 * len(content))])
    found = read_topics(path)
    assert (
        "the file is cut off; it was read up to the cut" in found.notes
        and len(found.markers.time) > 0
    )


def test_a_compression_bomb_in_a_bag_is_refused_before_unpacking(tmp_path, monkeypatch):
    def messages(make):
        for k in range(60):
            yield (
                "/word",
                "std_msgs/String",
                ns(k),
                make("std_msgs/String", data=" " * (1 << 20)),
            )

    path = written(tmp_path, "bag bz2", messages)
    monkeypatch.setattr(bags, "unpacked", None)
    with pytest.raises(
        InputError,
        match=r"the unpacked size is 60 MB, but at most 16 MB .* a file of \d+ kB",
    ):
        read_markers(path)


def test_foreign_databases_are_refused(tmp_path):
    with sqlite3.connect(tmp_path / "a.db3") as base:
        base.execute("CREATE TABLE notes (text)")
    with pytest.raises(
        InputError,
        match=r"not a ROS 2 bag; it lacks the tables `topics` and `messages`",
    ):
        read_markers(tmp_path / "a.db3")
    with sqlite3.connect(tmp_path / "b.db3") as base:
        base.execute(
            "CREATE TABLE topics (id INTEGER PRIMARY KEY, name, type,"
            " serialization_format)"
        )
        base.execute(
            "INSERT INTO topics VALUES (1, '/a', 'std_msgs/msg/Float64', 'cdr')"
        )
        base.execute(
            "CREATE TABLE messages (topic_id, timestamp, data AS (zeroblob(900000000)))"
        )
        base.execute("INSERT INTO messages VALUES (1, 1)")
    with pytest.raises(InputError, match="ROS 2 bag file is damaged"):
        read_markers(tmp_path / "b.db3")
    with sqlite3.connect(tmp_path / "c.db3") as base:
        base.execute(
            "CREATE TABLE topics (id INTEGER PRIMARY KEY, name, type,"
            " serialization_format)"
        )
        endless = (
            "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) SELECT x"
            " FROM n"
        )
        base.execute(f"CREATE VIEW messages (topic_id) AS {endless}")
    with pytest.raises(InputError, match="not a ROS 2 bag"):
        read_markers(tmp_path / "c.db3")


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("zeros", [1, 4, 8, 4096])
def test_zeros_before_the_index_of_a_ros1_bag_are_skipped(tmp_path, zeros):
    path = written(tmp_path, "bag", everything)
    content = path.read_bytes()
    whole = read_topics(path)
    place = content.index(b"index_pos=") + len(b"index_pos=")
    index = int.from_bytes(content[place : place + 8], "little")
    path.write_bytes(content[:index] + bytes(zeros) + content[index:])
    padded = read_topics(path)
    assert np.array_equal(padded.markers.points, whole.markers.points)
