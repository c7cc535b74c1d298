"""Bags of ROS 1 and ROS 2 written by rosbags and mcap: all message types, all containers."""

from __future__ import annotations

import sqlite3

import numpy as np
import pytest
from bag_files import RATE, TURN, ns, written

from srs_twin import InputError
from srs_twin.recordings.formats import bags, identify, read_markers, read_topics
from srs_twin.recordings.inspection import inspect_file
from srs_twin.recordings.recorded_file import read_bytes
from srs_twin.recordings.recording_map import NO_MAP

FRAMES = 50
LATE_NS = 4_000_000  # delay of the log times after the stamps
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
        header = make.header(k)

        def stamped(kind, header=header, **fields):
            return kind, make(kind, header=header, **fields)

        path = [
            make("geometry_msgs/PoseStamped", header=header, pose=make.pose(each))
            for each in PLACE[: k + 1, 0]
        ]
        moved = [make.transform(k, b, "e"), make.transform(k, c, "f")]
        messages = {
            "/a": stamped("geometry_msgs/PoseStamped", pose=make.pose(a)),
            "/b": stamped(
                "geometry_msgs/PoseWithCovarianceStamped", pose=make.covariant(b)
            ),
            "/odom": stamped(
                "nav_msgs/Odometry",
                child_frame_id="base_link",
                pose=make.covariant(c),
                twist=make.twist(),
            ),
            "/vicon/d": ("geometry_msgs/TransformStamped", make.transform(k, a, "d")),
            "/tf": ("tf2_msgs/TFMessage", make("tf2_msgs/TFMessage", transforms=moved)),
            "/path": stamped("nav_msgs/Path", poses=path),
            "/array": stamped(
                "geometry_msgs/PoseArray", poses=[make.pose(b), make.pose(c)]
            ),
            "/point": stamped("geometry_msgs/PointStamped", point=make.point(b)),
            "/air": stamped(
                "sensor_msgs/FluidPressure", fluid_pressure=1000.0 * k, variance=0.0
            ),
            "/joy": stamped(
                "sensor_msgs/Joy",
                axes=np.array([0.25 * k, -1.0], np.float32),
                buttons=np.array([k % 2], np.int32),
            ),
            "/joints": stamped(
                "sensor_msgs/JointState",
                name=["a", "b"],
                position=np.array([k, 2.0 * k]),
                velocity=np.array([1.0]),
                effort=np.zeros(0),
            ),
            "/cmd": make.array("Float32MultiArray", [k, -k], np.float32),
            "/valves": make.array("Int8MultiArray", [1, -1], np.int8),
            "/supply": ("std_msgs/Float64", make("std_msgs/Float64", data=0.5 * k)),
            "/word": ("std_msgs/String", make("std_msgs/String", data="hello")),
        }
        for topic, (kind, message) in messages.items():
            yield topic, kind, ns(k) + LATE_NS, message


BODIES = {"/a": 0, "/b": 1, "/odom": 2, "d": 0, "e": 1, "f": 2, "/path": 0}
BODIES |= {"/array_1": 1, "/array_2": 2, "/point": 1}


@pytest.mark.default_cases(at=[0, 4, 6, 8])
@pytest.mark.parametrize("container", CONTAINERS)
def test_all_message_types_of_all_containers_are_read(tmp_path, container):
    found = read_topics(written(tmp_path, container, everything))
    table = found.markers
    stamps = TIME - 1e-9 * LATE_NS
    assert table.labels == tuple(BODIES)
    assert np.abs(table.time - stamps).max() < 1e-6
    assert np.abs(table.points - PLACE[:, list(BODIES.values())]).max() < 1e-9
    assert np.abs(table.rotations[:, :-1] - TURN).max() < 1e-9
    assert np.isnan(table.rotations[:, -1]).all()
    k = np.arange(FRAMES)
    signals = {
        "/air.fluid_pressure": (stamps, 1e3 * k),
        "/air.variance": (stamps, 0 * k),
        "/joy.axes[0]": (stamps, 0.25 * k),
        "/joy.axes[1]": (stamps, 0 * k - 1),
        "/joy.buttons[0]": (stamps, k % 2),
        "/joints.a.position": (stamps, k),
        "/joints.b.position": (stamps, 2 * k),
        "/joints.a.velocity": (stamps, 0 * k + 1),
        "/cmd.data[0]": (TIME, k),
        "/cmd.data[1]": (TIME, -k),
        "/valves.data[0]": (TIME, 0 * k + 1),
        "/valves.data[1]": (TIME, 0 * k - 1),
        "/supply.data": (TIME, 0.5 * k),
    }
    assert found.signals.keys() == signals.keys()
    for name, (time, values) in signals.items():
        assert np.abs(found.signals[name] - np.array([time, values])).max() < 1e-6, name
    assert found.notes == (
        "the topic /word (std_msgs/String) with 50 messages was skipped",
    )


def test_each_number_of_a_json_message_is_a_signal(tmp_path):
    message = {"supply": {"kpa": 48.3}, "state": [1, -1, True], "word": "x", "no": None}

    def messages(make):
        for k in range(3):
            yield "/valves", "json", ns(k), message

    found = read_topics(written(tmp_path, "mcap", messages))
    assert found.markers is None
    assert {name: values.tolist() for name, (_, values) in found.signals.items()} == {
        "/valves.supply.kpa": [48.3] * 3,
        "/valves.state[0]": [1] * 3,
        "/valves.state[1]": [-1] * 3,
        "/valves.state[2]": [1] * 3,
    }


def test_signals_are_not_decoded_for_positions(tmp_path):
    path = written(tmp_path, "mcap", everything)
    found = bags.Mcap().read_topics(read_bytes(path), signals=False)
    assert found.signals == {}
    assert found.markers.labels == tuple(BODIES)


def test_stamps_of_another_clock_begin_at_0(tmp_path):
    def messages(make):
        for k, place in enumerate(PLACE[:, 0]):
            header = make.header(k)
            header.stamp.sec = 1
            header.stamp.nanosec = k * 10**7
            kind = "geometry_msgs/PointStamped"
            yield "/p", kind, ns(k), make(kind, header=header, point=make.point(place))

    found = read_markers(written(tmp_path, "mcap", messages))
    assert found.time == pytest.approx(TIME, abs=1e-6)
    assert found.rotations is None
    assert found.epoch_ns is None
    assert "the time stamps of /p differ by 1.7e+09 s from the log times" in (
        found.corrections
    )


def only(kind):
    """Yield the messages of one type."""
    return lambda make: (row for row in everything(make) if row[1] == kind)


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
def test_a_bag_without_positions_is_a_log(tmp_path, container):
    path = written(tmp_path, container, only("std_msgs/Int8MultiArray"))
    facts, _ = inspect_file(path, NO_MAP, None)
    assert facts.content == "log" and facts.rows == FRAMES
    assert [each.name for each in facts.signals] == [
        "/valves.data[0]",
        "/valves.data[1]",
    ]


def test_a_bag_without_positions_has_no_markers(tmp_path):
    path = written(tmp_path, "mcap", only("std_msgs/String"))
    said = (
        "the file has no topic with positions; .*; the topic /word"
        r" \(std_msgs/String\) with 50 messages was skipped"
    )
    with pytest.raises(InputError, match=said):
        read_markers(path)


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("container", ["bag lz4", "mcap"])
def test_truncated_bags_are_read_up_to_the_cut(tmp_path, container):
    def messages(make):
        for topic, kind, time, message in only("geometry_msgs/PoseStamped")(make):
            yield topic, kind, time, message
            filling = make("std_msgs/String", data="x" * 60_000)
            yield "/word", "std_msgs/String", time, filling

    path = written(tmp_path, container, messages)
    content = path.read_bytes()
    path.write_bytes(content[: int(0.6 * len(content))])
    found = read_topics(path)
    assert "the file is cut off; it was read up to the cut" in found.notes
    assert len(found.markers.time) > 0


@pytest.mark.parametrize(
    ("container", "size", "count"),
    [
        ("bag bz2", 1 << 20, 20),
        ("mcap zstd", 1 << 20, 20),
        ("mcap lz4", 1 << 16, 320),
    ],
)
def test_compression_bombs_are_refused_before_unpacking(
    tmp_path, monkeypatch, container, size, count
):
    """A file of a few hundred kB would unpack to more than a recording of its size contains."""

    def messages(make):
        text = make("std_msgs/String", data=" " * size)
        return (("/word", "std_msgs/String", ns(k), text) for k in range(count))

    options = {"chunk_size": 8 << 20} if "mcap" in container else {}
    path = written(tmp_path, container, messages, **options)
    monkeypatch.setattr(bags, "unpacked", None)  # not one chunk is
    with pytest.raises(
        InputError,
        match=r"unpacked size is 2\d MB, but at most 1\d MB .* a file of \d+ kB",
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
