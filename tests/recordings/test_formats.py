"""Formats of recordings: written data are recovered, and damaged or unknown files give one message."""

from __future__ import annotations

import io
import json
import random
import re
import sys
import tempfile
from pathlib import Path

import bag_files
import c3d
import numpy as np
import pytest
from mcap.writer import CompressionType, Writer as McapWriter
from mcap_ros2.writer import Writer as RosWriter
from recorded import SPEC, motion
from synthetic_takes import Take, write_motive
from test_trajectory_formats import trc

from srs_twin import InputError
from srs_twin.recordings.formats import (
    FORMATS,
    bags,
    identify,
    read_markers,
    read_topics,
    topics,
)
from srs_twin.recordings.formats.base import Unstated, marker_table
from srs_twin.recordings.inspection import inspect_file
from srs_twin.recordings.recorded_file import RecordedFile, read_bytes
from srs_twin.recordings.recording import read_motion
from srs_twin.recordings.recording_map import RecordingMap

pytestmark = [pytest.mark.fast, pytest.mark.filterwarnings("ignore:No analog data")]

FRAMES = 40
MARKERS = 4
RATE = 100.0
NAMES = [f"snake{k}" for k in range(MARKERS)]
TIME = np.arange(FRAMES) / RATE
PIXEL = 0.002  # m
ORIGIN = 1_700_000_000_123_456_789  # ns
TABLE = Unstated(RATE, scale_m=PIXEL)


def truth(axes=3):
    """Return positions with gaps, (frames, markers, axes), m."""
    rng = np.random.default_rng(3)
    points = np.cumsum(
        rng.normal(scale=0.003, size=(FRAMES, MARKERS, axes)), axis=0
    ) + rng.uniform(-1, 1, size=(MARKERS, axes))
    points[5:9, 1] = np.nan
    points[30:, 3] = np.nan
    return points


TRUTH = truth()


def quaternions():
    """Return unit quaternions, (frames, markers, 4)."""
    turns = np.random.default_rng(4).normal(size=(FRAMES, MARKERS, 4))
    return turns / np.linalg.norm(turns, axis=-1, keepdims=True)


def cells(row, empty=""):
    return [empty if np.isnan(value) else f"{value:.6f}" for value in np.ravel(row)]


def vicon(*, before="", after="", unit="mm", scale=1e3):
    names = ",," + ",,,".join(f"Snake:{name}" for name in NAMES)
    rows = [f"{k + 1},0," + ",".join(cells(scale * TRUTH[k])) for k in range(FRAMES)]
    head = [
        "Trajectories",
        "100",
        names,
        "Frame,Sub Frame" + ",X,Y,Z" * MARKERS,
        "," + f",{unit}" * 3 * MARKERS,
    ]
    return (before + "\r\n".join([*head, *rows]) + "\r\n" + after).encode()


def qualisys(*, columns=False, header=True, trailing=False, extra=()):
    head = [
        "NO_OF_FRAMES\t40",
        "NO_OF_CAMERAS\t8",
        f"NO_OF_MARKERS\t{MARKERS}",
        "FREQUENCY\t100",
        "NO_OF_ANALOG\t0",
        "ANALOG_FREQUENCY\t0",
        "DESCRIPTION\t--",
        "TIME_STAMP\t2024-04-15, 10:39:38.777\t406646.66137317",
        "DATA_INCLUDED\t3D",
        *extra,
        "EVENT\tstart\t1\t0.00000",
        "\t".join(["MARKER_NAMES", *NAMES]) + "\t" * trailing,
        "\t".join(["TRAJECTORY_TYPES", *["Measured"] * MARKERS]),
    ]
    if columns and header:
        head.append(
            "\t".join(
                [
                    "Frame",
                    "Time",
                    *(f"{name} {axis}" for name in NAMES for axis in "XYZ"),
                ]
            )
        )
    rows = [
        "\t".join(
            ([f"{k + 1}", f"{k / RATE:.5f}"] if columns else [])
            + cells(1e3 * TRUTH[k], "0.000")
        )
        + "\t" * trailing
        for k in range(FRAMES)
    ]
    return ("\r\n".join([*head, *rows]) + "\r\n").encode()


def deeplabcut(*, animals=False):
    flat = TRUTH[..., :2] * [1, -1] / PIXEL
    parts = NAMES if not animals else ["head", "tail"] * (MARKERS // 2)
    head = [["scorer"] + ["DLC_resnet50_snakeMay1shuffle1_100000"] * 3 * MARKERS]
    if animals:
        head.append(
            ["individuals", *(f"s{k // 2}" for k in range(MARKERS) for _ in "xyl")]
        )
    head.append(["bodyparts", *(part for part in parts for _ in "xyl")])
    head.append(["coords"] + ["x", "y", "likelihood"] * MARKERS)
    rows = []
    for k in range(FRAMES):
        row = [f"{k}"]
        for x, y in flat[k]:
            lost = np.isnan(x)
            row += (
                [f"{x:.6f}", f"{y:.6f}", "0.99"]
                if not lost
                else ["", "", ""]
                if animals
                else ["7", "8", "0.1"]
            )
        rows.append(row)
    return ("\n".join(",".join(line) for line in [*head, *rows]) + "\n").encode()


def plain():
    head = ",".join(
        ["time", *(f"{axis}_{k}_mm" for k in range(1, MARKERS + 1) for axis in "xyz")]
    )
    rows = [f"{TIME[k]:.6f}," + ",".join(cells(1e3 * TRUTH[k])) for k in range(FRAMES)]
    return ("\n".join([head, *rows]) + "\n").encode()


def motive(*, version="1.23", bodies=True, parent=False):
    kind = "Rigid Body" if bodies else "Marker"
    count = 7 if bodies else 3
    turns = quaternions()
    head = [
        (
            f"Format Version,{version},Take Name,walk,Capture Frame Rate,100.0,Export"
            " Frame Rate,100.0,Total Exported Frames,40,Rotation"
            " Type,Quaternion,Length Units,Meters,Coordinate Space,Global"
        ),
        "",
        ",Type" + f",{kind}" * count * MARKERS,
        ",Name" + "".join(f",{name}" * count for name in NAMES),
        ",ID" + "".join(f",{k}" * count for k in range(MARKERS)),
        *([",Parent" + "," * count * MARKERS] if parent else []),
        "," + (",Rotation" * 4 * bodies + ",Position" * 3) * MARKERS,
        "Frame,Time (Seconds)" + (",X,Y,Z,W" * bodies + ",X,Y,Z") * MARKERS,
    ]
    rows = []
    for k in range(FRAMES):
        row = [f"{k}", f"{TIME[k]:.4f}"]
        for m in range(MARKERS):
            lost = np.isnan(TRUTH[k, m, 0])
            row += cells(turns[k, m] * (np.nan if lost else 1)) if bodies else []
            row += cells(TRUTH[k, m])
        rows.append(",".join(row))
    return ("\r\n".join([*head, *rows]) + "\r\n").encode()


def c3d_file(points=TRUTH, *, unit="mm", scale=1e3, whole=None, names=NAMES):
    """Write a file with the library; `whole` is the resolution of integers, mm."""
    writer = c3d.Writer(point_rate=RATE, point_scale=whole or -1.0, point_units=unit)
    label = "".join(name.ljust(16) for name in names[:255])
    writer.point_group.add_str("LABELS", "", label, 16, len(names[:255]))
    if names[255:]:
        more = "".join(name.ljust(16) for name in names[255:])
        writer.point_group.add_str("LABELS2", "", more, 16, len(names[255:]))
        writer.point_group.add_str("DESCRIPTIONS", "", " ", 1, 1)
    for frame in points:
        seen = ~np.isnan(frame[:, :1])
        rows = np.hstack(
            [
                np.nan_to_num(frame) * scale,
                np.where(seen, 0.0, -1.0),
                np.zeros_like(seen),
            ]
        )
        writer.add_frames([(rows.astype(np.float32), np.zeros((0, 0)))])
    stream = io.BytesIO()
    writer.write(stream)
    return stream.getvalue()


STAMP = "builtin_interfaces/Time stamp\nstring frame_id"
LINE = "\n" + "=" * 80 + "\nMSG: "
HEADER = f"{LINE}std_msgs/Header\n{STAMP}"
POINT = f"{LINE}geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z"
POSE = (
    f"{LINE}geometry_msgs/Pose\nPoint position\nQuaternion orientation{POINT}"
    f"{LINE}geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w"
)
DEFINED = {
    "geometry_msgs/msg/PoseStamped": f"std_msgs/Header header\nPose pose{HEADER}{POSE}",
    "geometry_msgs/msg/PoseArray": (
        f"std_msgs/Header header\nPose[] poses{HEADER}{POSE}"
    ),
    "geometry_msgs/msg/PointStamped": (
        f"std_msgs/Header header\nPoint point{HEADER}{POINT}"
    ),
    "geometry_msgs/msg/Point": "float64 x\nfloat64 y\nfloat64 z",
    "sensor_msgs/msg/Joy": (
        f"std_msgs/Header header\nfloat32[] axes\nint32[] buttons{HEADER}"
    ),
    "sensor_msgs/msg/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\n"
        f"float64[] velocity\nfloat64[] effort{HEADER}"
    ),
    "std_msgs/msg/Float64MultiArray": (
        "MultiArrayLayout layout\nfloat64[]"
        f" data{LINE}std_msgs/MultiArrayLayout\nMultiArrayDimension[] dim\nuint32"
        f" data_offset{LINE}std_msgs/MultiArrayDimension\nstring label\nuint32"
        " size\nuint32 stride"
    ),
    "std_msgs/msg/String": "string data",
}


def pose(point, turn):
    return {
        "position": dict(zip("xyz", map(float, point), strict=True)),
        "orientation": dict(zip("xyzw", map(float, turn), strict=True)),
    }


def ns(seconds):
    return ORIGIN + round(seconds * 1e9)


def stamped(nanoseconds):
    return {
        "stamp": {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9},
        "frame_id": "world",
    }


def mcap_file(compression=CompressionType.ZSTD, *, signals=True, checked=True):
    """Write two stamped bodies, a slower array, points, a joystick, joints, valves, JSON and text."""
    turns = quaternions()
    stream = io.BytesIO()
    writer = RosWriter(
        stream, chunk_size=4096, compression=compression, enable_crcs=checked
    )
    schemas = {
        name: writer.register_msgdef(name, text) for name, text in DEFINED.items()
    }

    def write(topic, kind, message, at):
        writer.write_message(topic, schemas[kind], message, log_time=at)

    raw = writer._writer
    channel = raw.register_channel(
        "/valves", "json", raw.register_schema("valves", "jsonschema", b"{}")
    )
    write("/info", "std_msgs/msg/String", {"data": "hello"}, ORIGIN)
    for k in range(FRAMES):
        stamp = ns(TIME[k])
        log = ns(TIME[k]) + 4_000_000
        header = stamped(stamp)
        body = {"header": header, "pose": pose(TRUTH[k, 0], turns[k, 0])}
        write("/body", "geometry_msgs/msg/PoseStamped", body, log)
        if not np.isnan(TRUTH[k, 1, 0]):
            point = {
                "header": header,
                "point": dict(zip("xyz", TRUTH[k, 1], strict=True)),
            }
            write("/point", "geometry_msgs/msg/PointStamped", point, log)
        if k % 2 == 0:
            some = [
                pose(TRUTH[k, m], turns[k, m])
                for m in (2, 3)
                if not np.isnan(TRUTH[k, m, 0])
            ]
            write(
                "/two",
                "geometry_msgs/msg/PoseArray",
                {"header": header, "poses": some},
                log,
            )
        if not signals:
            continue
        joy = {"header": header, "axes": [0.25 * k, -1.0], "buttons": [k % 2]}
        write("/joy", "sensor_msgs/msg/Joy", joy, log)
        joints = {
            "header": header,
            "name": ["a", "b"],
            "position": [k, 2.0 * k],
            "velocity": [1.0],
            "effort": [],
        }
        write("/joints", "sensor_msgs/msg/JointState", joints, log)
        write("/cmd", "std_msgs/msg/Float64MultiArray", {"data": [k, -k]}, log)
        text = json.dumps(
            {
                "supply": {"kpa": 48.3 + k},
                "state": [1, -1, True],
                "word": "x",
                "none": None,
            }
        ).encode()
        raw.add_message(channel, log, text, log)
    writer.finish()
    return stream.getvalue()


def bag(kind):
    """Return a bag of rosbags with one topic of points for each body of `TRUTH`."""

    def messages(make):
        for k, places in enumerate(TRUTH):
            for name, place in zip(NAMES, places, strict=True):
                if not np.isnan(place[0]):
                    point = make(
                        "geometry_msgs/PointStamped",
                        header=make.header(k),
                        point=make.point(place),
                    )
                    yield (
                        f"/{name}",
                        "geometry_msgs/PointStamped",
                        bag_files.ns(k),
                        point,
                    )

    with tempfile.TemporaryDirectory() as folder:
        return bag_files.written(Path(folder), kind, messages).read_bytes()


def tum():
    place = np.column_stack([TIME, TRUTH[:, 0], quaternions()[:, 0]])
    rows = [" ".join(f"{value:.9f}" for value in row) for row in place]
    return ("\n".join(["# timestamp tx ty tz qx qy qz qw", *rows]) + "\n").encode()


FILES = {
    "ROS 1 bag": lambda: bag("bag"),
    "ROS 2 bag": lambda: bag("db3"),
    "TRC": lambda: trc(TRUTH).encode(),
    "TUM trajectory": tum,
    "Motive CSV": motive,
    "Vicon CSV": vicon,
    "Qualisys TSV": qualisys,
    "DeepLabCut CSV": deeplabcut,
    "plain CSV": plain,
    "C3D": c3d_file,
    "MCAP": mcap_file,
}


def written(folder, content, name="take.data"):
    path = folder / name
    path.write_bytes(content)
    return path


def same(found, points=TRUTH, *, time=TIME, most=1e-6):
    assert found.points.shape == points.shape
    assert (np.isnan(found.points) == np.isnan(points)).all()
    assert np.nanmax(np.abs(found.points - points)) < most
    assert np.abs(found.time - time).max() < 1e-6


@pytest.mark.default_cases(at=[0, 1, 2, 4, 5, 8, 9])
@pytest.mark.parametrize("kind", FORMATS)
def test_formats_are_known_by_their_content(tmp_path, kind):
    path = written(tmp_path, FILES[kind](), "take.bin")
    assert identify(path) == kind
    assert read_markers(path, TABLE).kind.startswith(kind)


def test_vicon_positions_and_rotations_are_read(tmp_path):
    devices = (
        "Devices\r\n1000\r\n,,Imported Force Plate #1 - Force\r\nFrame,Sub"
        " Frame,Fx\r\n,,N\r\n"
        + "".join(f"{k // 10 + 1},{k % 10},1.5\r\n" for k in range(400))
    )
    path = written(
        tmp_path, vicon(before=devices + "\r\n", after="\r\nJoints\r\n100\r\n,,a\r\n")
    )
    found = read_markers(path)
    same(found)
    assert found.labels == tuple(f"Snake:{name}" for name in NAMES)
    assert {
        "the section Devices was skipped",
        "the section Joints was skipped",
    } <= set(found.corrections)
    assert "lengths were converted from mm to m" in found.corrections
    same(read_markers(written(tmp_path, b"\r\n\r\n" + vicon(unit="m", scale=1))))
    with pytest.raises(
        InputError, match=r":5:3: the unit of length 'furlong' is not known"
    ):
        read_markers(written(tmp_path, vicon(unit="furlong")))
    with pytest.raises(InputError, match=r":9:6: 'a' is not a number"):
        cut = vicon().split(b"\r\n")
        row = cut[8].split(b",")
        cut[8] = b",".join([*row[:5], b"a", *row[6:]])
        read_markers(written(tmp_path, b"\r\n".join(cut)))
    with pytest.raises(
        InputError,
        match=r"the section Trajectories is missing \(the file has the sections"
        r" Devices\)",
    ):
        read_markers(written(tmp_path, devices.encode()))


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("columns", [False, True])
@pytest.mark.parametrize("header", [False, True])
@pytest.mark.parametrize("trailing", [False, True])
def test_qualisys_positions_are_read(tmp_path, columns, header, trailing):
    found = read_markers(
        written(tmp_path, qualisys(columns=columns, header=header, trailing=trailing))
    )
    same(found)
    assert found.labels == tuple(NAMES) and found.header_frames == FRAMES


def test_qualisys_export_kinds_and_clocks(tmp_path):
    good = qualisys()
    for kind in (b"2D", b"6D"):
        with pytest.raises(
            InputError, match=f"{kind.decode()} exports of Qualisys cannot be read"
        ):
            read_markers(
                written(
                    tmp_path,
                    good.replace(b"DATA_INCLUDED\t3D", b"DATA_INCLUDED\t" + kind),
                )
            )
    with pytest.raises(InputError, match="6D exports"):
        read_markers(written(tmp_path, qualisys(extra=["NO_OF_BODIES\t1"])))
    external = good.replace(b"FREQUENCY\t100\r", b"FREQUENCY\tEXT\r")
    with pytest.raises(InputError, match="frame rate 'EXT' is not allowed"):
        read_markers(written(tmp_path, external))
    same(read_markers(written(tmp_path, external), Unstated(RATE)))
    timed = qualisys(columns=True).replace(b"FREQUENCY\t100\r", b"FREQUENCY\tEXT\r")
    same(read_markers(written(tmp_path, timed)))


@pytest.mark.parametrize("animals", [False, True])
def test_deeplabcut_positions_are_scaled(tmp_path, animals):
    path = written(tmp_path, deeplabcut(animals=animals))
    same(found := read_markers(path, TABLE), TRUTH[..., :2])
    assert found.labels == (
        ("s0:head", "s0:tail", "s1:head", "s1:tail") if animals else tuple(NAMES)
    )
    assert "y is reversed, because it points down in images" in found.corrections
    with pytest.raises(InputError, match=r"give `rate_hz` .* and `scale_m` "):
        read_markers(path)
    with pytest.raises(InputError, match=r"give `scale_m` "):
        read_markers(path, Unstated(rate_hz=RATE))
    same(
        read_markers(path, Unstated(rate_hz=RATE, unit="m")),
        TRUTH[..., :2] / PIXEL,
        most=1e-3,
    )


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("version", ["1.0", "1.1", "1.2", "1.23", "1.24", "1.25"])
def test_motive_rigid_bodies_have_rotations(tmp_path, version):
    found = read_markers(
        written(tmp_path, motive(version=version, parent=version > "1.23"))
    )
    same(found)
    turns = np.where(np.isnan(TRUTH[..., :1]), np.nan, quaternions())
    assert (np.isnan(found.rotations) == np.isnan(turns)).all()
    assert np.nanmax(np.abs(found.rotations - turns)) < 1e-6
    assert read_markers(written(tmp_path, motive(bodies=False))).rotations is None


def test_c3d_with_integers_and_with_many_points(tmp_path):
    same(read_markers(written(tmp_path, c3d_file(whole=0.1))), most=1.01e-4)
    names = [f"p{k}" for k in range(300)]
    points = np.random.default_rng(1).uniform(-1, 1, (5, 300, 3))
    found = read_markers(written(tmp_path, c3d_file(points, names=names)))
    same(found, points, time=TIME[:5])
    assert found.labels == tuple(names)
    with pytest.raises(InputError, match="the unit of length 'mile' is not known"):
        read_markers(written(tmp_path, c3d_file(unit="mile")))


@pytest.mark.slow
def test_a_motion_is_the_same_in_another_format(tmp_path):
    path = tmp_path / "take.csv"
    write_motive(motion(), Take(layout="head", noise=0.0, up="z"), path)
    table = read_markers(path)
    expected = read_motion(path, SPEC)
    found = read_motion(
        written(tmp_path, c3d_file(table.points, names=table.labels), "take.c3d"), SPEC
    )
    assert np.abs(found.trajectory.position - expected.trajectory.position).max() < 1e-5
    assert found.summary.kind == "C3D"


def test_truncated_c3d_keeps_its_whole_frames(tmp_path):
    found = read_markers(written(tmp_path, c3d_file()[:-1024]))
    assert 0 < len(found.time) < FRAMES
    assert any(f"of {FRAMES} frames" in each for each in found.corrections)
    same(found, TRUTH[: len(found.time)], time=TIME[: len(found.time)])


@pytest.mark.parametrize("compression", list(CompressionType))
def test_mcap_positions_and_signals_are_read(tmp_path, compression):
    topics = read_topics(written(tmp_path, mcap_file(compression)))
    expected = TRUTH.copy()
    expected[1::2, 2:] = np.nan
    shift = (ns(0) - topics.origin_ns) / 1e9
    same(topics.markers, expected, time=TIME + shift)
    assert topics.markers.labels == ("/body", "/point", "/two_1", "/two_2")
    turns = np.where(np.isnan(expected[..., :1]), np.nan, quaternions())
    turns[:, 1] = np.nan
    assert (np.isnan(topics.markers.rotations) == np.isnan(turns)).all()
    assert np.nanmax(np.abs(topics.markers.rotations - turns)) < 1e-9
    k = np.arange(FRAMES)
    for name, values, delay in [
        ("/joy.axes[0]", 0.25 * k, 0.0),
        ("/joy.axes[1]", -1 + 0 * k, 0.0),
        ("/joy.buttons[0]", k % 2, 0.0),
        ("/joints.a.position", k, 0.0),
        ("/joints.b.position", 2 * k, 0.0),
        ("/joints.a.velocity", 1 + 0 * k, 0.0),
        ("/cmd.data[0]", k, 0.004),
        ("/cmd.data[1]", -k, 0.004),
        ("/valves.supply.kpa", 48.3 + k, 0.004),
        ("/valves.state[1]", -1 + 0 * k, 0.004),
        ("/valves.state[2]", 1 + 0 * k, 0.004),
    ]:
        at, found = topics.signals[name]
        assert np.abs(found - values).max() < 1e-9, name
        assert np.abs(at - TIME - shift - delay).max() < 1e-6, name
    assert len(topics.signals) == 12
    assert (
        "the topic /info (std_msgs/String) with 1 messages was skipped" in topics.notes
    )


def test_mcap_without_positions_and_with_two_clocks(tmp_path):
    stream = io.BytesIO()
    with RosWriter(stream) as writer:
        kind = "geometry_msgs/msg/PointStamped"
        schema = writer.register_msgdef(kind, DEFINED[kind])
        for k in range(20):
            point = {
                "header": stamped(10**9 + k * 10**7),
                "point": dict(x=0.1 * k, y=0.0, z=0.0),
            }
            writer.write_message("/p", schema, point, log_time=ns(k / RATE))
    found = read_markers(written(tmp_path, stream.getvalue()))
    assert np.abs(np.diff(found.time) - 0.01).max() < 1e-6 and found.rotations is None
    assert any("s from the log times" in each for each in found.corrections)
    stream = io.BytesIO()
    with RosWriter(stream) as writer:
        schema = writer.register_msgdef(
            "std_msgs/msg/String", DEFINED["std_msgs/msg/String"]
        )
        writer.write_message("/info", schema, {"data": "x"}, log_time=ORIGIN)
    with pytest.raises(
        InputError,
        match=r"the file has no topic with positions; .*; the topic /info"
        r" \(std_msgs/String\) with 1 messages was skipped",
    ):
        read_markers(written(tmp_path, stream.getvalue()))


def test_declared_sizes_allocate_no_memory(tmp_path):
    """A chunk and a frame count declare far more than the file contains."""
    content = mcap_file()
    at = content.index(b"zstd") - 4 - 4 - 8
    with pytest.raises(
        InputError, match="is 4398046511104 MB, but at most 16 MB are allowed"
    ):
        read_markers(
            written(
                tmp_path,
                content[:at] + (2**62).to_bytes(8, "little") + content[at + 8 :],
            )
        )
    bomb = bytearray(c3d_file())
    bomb[8:10] = b"\xff\xff"  # last frame
    found = read_markers(written(tmp_path, bytes(bomb)))
    assert len(found.time) == found.header_frames == FRAMES  # as its parameters say


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
@pytest.mark.parametrize("kind", ["one large message", "many small messages"])
def test_compression_bombs_are_refused_before_unpacking(
    tmp_path, monkeypatch, compression, kind
):
    """Files of a few hundred kB would unpack to more than a recording of that size contains."""
    size, count = {
        "one large message": (1 << 22, 50),
        "many small messages": (1000, 50_000),
    }[kind]
    stream = io.BytesIO()
    writer = McapWriter(stream, compression=compression, chunk_size=8 << 20)
    writer.start()
    channel = writer.register_channel(
        "/t", "json", writer.register_schema("x", "jsonschema", b"{}")
    )
    for _ in range(count):
        writer.add_message(
            channel,
            log_time=ORIGIN,
            data=b"[" + b" " * size + b"]",
            publish_time=ORIGIN,
        )
    writer.finish()
    path = written(tmp_path, stream.getvalue())
    monkeypatch.setattr(bags, "unpacked", None)  # not one chunk is
    with pytest.raises(
        InputError,
        match=(r"unpacked size is \d+ MB, but at most \d+ MB .* a file of \d+ kB"),
    ):
        read_markers(path)


def test_signals_are_not_decoded_for_positions(tmp_path):
    path = written(tmp_path, mcap_file())
    found = bags.Mcap().read_topics(read_bytes(path), signals=False)
    assert found.signals == {} != read_topics(path).signals
    assert found.markers.labels == read_topics(path).markers.labels


def damaged(content, seed):
    """Yield 56 damaged copies of a file."""
    rng = random.Random(seed)
    text = b"\0" not in content
    yield from (content[: rng.randrange(1, len(content))] for _ in range(20))
    for _ in range(20):
        copy = bytearray(content)
        for _ in range(rng.choice((1, 3, 30))):
            end = len(copy) if rng.random() < 0.5 else min(len(copy), 1200)
            copy[rng.randrange(end)] = (
                rng.randrange(32, 127) if text else rng.randrange(256)
            )
        yield bytes(copy)
    lines = content.split(b"\n")
    for old, new in (
        (b"mm", b"ft"),
        (b"mm", b"xx"),
        (b"Meters", b"Parsec"),
        (b"X", b"Y"),
        (b",", b";"),
    ):
        yield (
            content.replace(old, new)
            if text
            else content.replace(b"POINT", b"POINS").replace(b"zstd", new * 4)
        )
    if text:
        separator = b"\t" if b"\t" in content else b","
        yield b"\n".join(
            separator.join(reversed(line.split(separator))) for line in lines
        )
        yield b"\n".join(separator.join(line.split(separator)[1:]) for line in lines)
    else:
        yield content[::-1]
        yield content[:300] + content[900:]
    yield b""
    yield (
        b"\n".join(line for line in lines if not line[:1].isdigit())
        if text
        else content[:512]
    )
    yield content[: len(content) // 3] + content
    # A name is missing or another one, and a number is text, infinite or missing.
    names = (
        set(re.findall(rb'"\w+"', content) or re.findall(rb"[A-Za-z_]{2,}", content))
        if text
        else ()
    )
    numbers = set(re.findall(rb"\d+\.?\d*", content)) if text else ()
    for old, changes in (
        (names, (b"", b'"other"', b"null")),
        (numbers, (b'"text"', b"1e999", b"null")),
    ):
        for new in changes:
            yield content.replace(rng.choice(sorted(old)), new, 1) if old else content


def refusals(folder, kind, seed):
    """Read 56 damaged copies; return how many were refused, each in one line that names the file."""
    refused = 0
    made = (
        FILES[kind]()
        if kind in FILES
        else mcap_file(CompressionType.NONE, checked=False)
    )
    for number, content in enumerate(damaged(made, seed)):
        path = written(folder, content)
        try:
            found = read_markers(path, TABLE)
        except InputError as error:
            assert (
                "take.data" in str(error)
                and "\n" not in str(error)
                and len(str(error)) < 600
            ), number
            refused += 1
        else:
            shape = found.points.shape
            assert shape[:2] == (len(found.time), len(found.labels)) and len(
                found.time
            ), number
    assert number == 55
    return refused


KINDS = [*FORMATS, "MCAP unchecked"]


@pytest.mark.default_cases(10)
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_are_read_or_refused_in_one_line(tmp_path, kind, capfd):
    assert refusals(tmp_path, kind, len(kind)) >= 10
    assert capfd.readouterr().err == ""


@pytest.mark.nightly
@pytest.mark.parametrize("kind", KINDS)
def test_many_damaged_files_are_read_or_refused_in_one_line(tmp_path, kind):
    assert sum(refusals(tmp_path, kind, seed) for seed in range(100, 160)) >= 600


def test_a_missing_column_is_reported_at_the_header(tmp_path):
    """The same rows can be read with the column."""
    names = "time,a_x,a_y,b_x,b_y,b_z"
    rows = "0,1,2,3,4,5\n0.1,1,2,3,4,5\n"
    with pytest.raises(
        InputError,
        match=r"m\.csv:1: the column a_z is missing, although other markers have",
    ):
        read_markers(written(tmp_path, f"{names}\n{rows}".encode(), "m.csv"))
    whole = names.replace("a_y", "a_y,a_z") + "\n" + rows.replace("2,3", "2,0,3")
    assert read_markers(written(tmp_path, whole.encode(), "m.csv")).points.shape == (
        2,
        2,
        3,
    )


def test_a_recording_without_frames_is_refused():
    """A parser that finds none must not be followed by an error of the inspection."""
    file = RecordedFile("take.data", b"{}")
    with pytest.raises(
        InputError,
        match=r"^take\.data: the recording has no frames; record or export it again$",
    ):
        marker_table(file, "JSON", np.zeros(0), np.zeros((0, 1, 3)), ["head"], [])


def test_missing_files_are_reported(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        identify(tmp_path / "none.c3d")
    with pytest.raises(InputError, match="a folder; give one file"):
        identify(tmp_path)


@pytest.mark.parametrize(
    ("kind", "package"), [("MCAP", "rosbags.typesys"), ("ROS 1 bag", "rosbags.typesys")]
)
def test_a_missing_library_is_reported_with_its_installation(
    tmp_path, monkeypatch, kind, package
):
    monkeypatch.setitem(sys.modules, package, None)
    topics._decoder.cache_clear()
    topics._definitions.cache_clear()
    with pytest.raises(
        InputError,
        match=r"install it with .*uv sync --extra recordings.*srs-twin\[recordings\]",
    ):
        read_markers(written(tmp_path, FILES[kind]()))


def test_size_limits_apply_to_all_formats(tmp_path, monkeypatch):
    monkeypatch.setattr("srs_twin.recordings.recorded_file.MAX_BYTES", 1 << 10)
    for content in FILES.values():
        with pytest.raises(InputError, match="MB, but at most 0 MB are allowed"):
            read_markers(written(tmp_path, content() + b"\n" * (1 << 20)), TABLE)


STATED = {
    "Motive CSV": "m",
    "Vicon CSV": "mm",
    "Qualisys TSV": "mm",
    "C3D": "mm",
    "TRC": "mm",
    "TUM trajectory": "m",
}


@pytest.mark.parametrize("kind", STATED)
def test_a_unit_in_conflict_with_the_file_is_refused(tmp_path, kind):
    path = written(tmp_path, FILES[kind]())
    words = (
        f"take.data: the lengths are in {STATED[kind]} according to the file, but in ft"
        " according to the map or --units; correct one"
    )
    with pytest.raises(InputError, match=words):
        read_markers(path, Unstated(unit="ft"))
    with pytest.raises(InputError, match=words):
        inspect_file(path, RecordingMap(units="ft"), None)
    same_unit = read_markers(path, Unstated(unit=STATED[kind]))
    alone = read_markers(path)
    assert np.array_equal(same_unit.points, alone.points, equal_nan=True)


def test_a_unit_that_the_file_lacks_is_used(tmp_path):
    path = written(tmp_path, c3d_file(unit="", scale=1e2))
    found = read_markers(path, Unstated(unit="cm"))
    same(found, most=1e-5)
    assert (
        "the unit of length (POINT:UNITS) is missing, so cm is used"
        in found.corrections
    )
