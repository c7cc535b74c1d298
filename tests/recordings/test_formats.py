"""Formats of recordings: written data are recovered, and damaged or unknown files give one message."""

from __future__ import annotations

import random
import re
import sys
import tempfile
from pathlib import Path

import bag_files
import numpy as np
import pytest
from test_c3d_files import by_c3d
from test_trajectory_formats import cells, trc

from srs_twin import InputError
from srs_twin.recordings.formats import (
    FORMATS,
    identify,
    read_markers,
    topics,
)
from srs_twin.recordings.formats.base import Unstated, marker_table
from srs_twin.recordings.inspection import inspect_file
from srs_twin.recordings.recorded_file import RecordedFile
from srs_twin.recordings.recording_map import RecordingMap

pytestmark = [pytest.mark.fast, pytest.mark.filterwarnings("ignore:No analog data")]

FRAMES = 40
MARKERS = 4
RATE = 100.0
NAMES = [f"snake{k}" for k in range(MARKERS)]
TIME = np.arange(FRAMES) / RATE
PIXEL = 0.002  # m
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


def vicon(*, before="", after="", unit="mm", scale=1e3):
    names = ",," + ",,,".join(f"Snake:{name}" for name in NAMES)
    rows = [f"{k + 1},0," + ",".join(cells(scale * TRUTH[k], 6)) for k in range(FRAMES)]
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
            + cells(1e3 * TRUTH[k], 6, "0.000")
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
    lost = ["", "", ""] if animals else ["7", "8", "0.59"]
    for k in range(FRAMES):
        row = [f"{k}"]
        for x, y in flat[k]:
            row += lost if np.isnan(x) else [f"{x:.6f}", f"{y:.6f}", "0.6"]
        rows.append(row)
    return ("\n".join(",".join(line) for line in [*head, *rows]) + "\n").encode()


def plain():
    head = ",".join(
        ["time", *(f"{axis}_{k}_mm" for k in range(1, MARKERS + 1) for axis in "xyz")]
    )
    rows = [
        f"{TIME[k]:.6f}," + ",".join(cells(1e3 * TRUTH[k], 6)) for k in range(FRAMES)
    ]
    return ("\n".join([head, *rows]) + "\n").encode()


def motive(time, points, turns=None, *, names=NAMES, version="1.23", parent=False):
    """Return an export of rigid bodies, or of markers if there are no rotations."""
    kind = "Marker" if turns is None else "Rigid Body"
    rotation = ",Rotation" * 4 if turns is not None else ""
    axes = ",X,Y,Z,W" if turns is not None else ""
    values = points if turns is None else np.concatenate([turns, points], axis=-1)
    values = np.where(np.isnan(points[..., :1]), np.nan, values)
    count = values.shape[-1]
    head = [
        (
            f"Format Version,{version},Take Name,walk,Total Exported Frames,{len(time)},"
            "Rotation Type,Quaternion,Length Units,Meters,Coordinate Space,Global"
        ),
        "",
        ",Type" + f",{kind}" * count * len(names),
        ",Name" + "".join(f",{name}" * count for name in names),
        ",ID" + "".join(f",{k}" * count for k in range(len(names))),
        *([",Parent" + "," * count * len(names)] if parent else []),
        "," + (rotation + ",Position" * 3) * len(names),
        "Frame,Time (Seconds)" + (axes + ",X,Y,Z") * len(names),
    ]
    rows = [
        ",".join([f"{k}", f"{now:.6f}", *cells(row, 6)])
        for k, (now, row) in enumerate(zip(time, values, strict=True))
    ]
    return ("\r\n".join([*head, *rows]) + "\r\n").encode()


def bag(container, **options):
    """Return a bag with one topic of points for each body of `TRUTH`."""
    kind = "geometry_msgs/PointStamped"

    def messages(make):
        for k, places in enumerate(TRUTH):
            for name, place in zip(NAMES, places, strict=True):
                if not np.isnan(place[0]):
                    point = make(kind, header=make.header(k), point=make.point(place))
                    yield f"/{name}", kind, bag_files.ns(k), point

    with tempfile.TemporaryDirectory() as folder:
        path = bag_files.written(Path(folder), container, messages, **options)
        return path.read_bytes()


def tum():
    place = np.column_stack([TIME, TRUTH[:, 0], quaternions()[:, 0]])
    rows = [" ".join(f"{value:.9f}" for value in row) for row in place]
    return ("\n".join(["# timestamp tx ty tz qx qy qz qw", *rows]) + "\n").encode()


FILES = {
    "ROS 1 bag": lambda: bag("bag"),
    "ROS 2 bag": lambda: bag("db3"),
    "TRC": lambda: trc(TRUTH).encode(),
    "TUM trajectory": tum,
    "Motive CSV": lambda: motive(TIME, TRUTH, quaternions()),
    "Vicon CSV": vicon,
    "Qualisys TSV": qualisys,
    "DeepLabCut CSV": deeplabcut,
    "plain CSV": plain,
    "C3D": lambda: by_c3d(1e3 * TRUTH),
    "MCAP": lambda: bag("mcap zstd"),
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


@pytest.mark.parametrize(
    ("columns", "header", "trailing"),
    [(False, True, True), (True, True, False), (True, False, True)],
)
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
    # Markers 1 and 3 are hidden on 4 and 10 frames.
    for note in (
        f"{0 if animals else 14} samples with a likelihood below 0.6 are read as",
        "y is reversed, because it points down in images",
        "the coordinates are multiplied by 0.002 to convert them to m",
    ):
        assert note in " ".join(found.corrections)
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
    turns = np.where(np.isnan(TRUTH[..., :1]), np.nan, quaternions())
    text = motive(TIME, TRUTH, turns, version=version, parent=version > "1.23")
    found = read_markers(written(tmp_path, text))
    same(found)
    assert np.allclose(found.rotations, turns, rtol=0, atol=1e-6, equal_nan=True)
    used = "the file has no columns of type Marker, so positions of type Rigid Body are"
    assert used in found.corrections[0]
    markers = motive(TIME, TRUTH)
    assert read_markers(written(tmp_path, markers)).rotations is None
    two_kinds = markers.replace(b",Marker" * 6, b",Marker" * 3 + b",Rigid Body" * 3)
    found = read_markers(written(tmp_path, two_kinds))
    assert found.labels == ("snake0", "snake2")
    skipped = "2 columns with positions of type Rigid Body were skipped"
    assert found.corrections == (skipped,)


def test_truncated_c3d_keeps_its_whole_frames(tmp_path):
    found = read_markers(written(tmp_path, FILES["C3D"]()[:-1024]))
    assert 0 < len(found.time) < FRAMES
    assert any(f"of {FRAMES} frames" in each for each in found.corrections)
    same(found, TRUTH[: len(found.time)], time=TIME[: len(found.time)])


def test_declared_sizes_allocate_no_memory(tmp_path):
    """A chunk and a frame count declare far more than the file contains."""
    content = FILES["MCAP"]()
    at = content.index(b"zstd") - 4 - 4 - 8
    declared = content[:at] + (2**62).to_bytes(8, "little") + content[at + 8 :]
    with pytest.raises(
        InputError, match="is 4398046511104 MB, but at most 16 MB are allowed"
    ):
        read_markers(written(tmp_path, declared))
    bomb = bytearray(FILES["C3D"]())
    bomb[8:10] = b"\xff\xff"  # last frame
    found = read_markers(written(tmp_path, bytes(bomb)))
    assert len(found.time) == found.header_frames == FRAMES  # as its parameters say


def damaged(content, seed):
    """Yield 50 damaged copies of a file."""
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


def refusals(folder, kind, seed):
    """Read 50 damaged copies; return how many were refused, each in one line that names the file."""
    refused = 0
    make = FILES.get(kind, lambda: bag("mcap", enable_crcs=False))
    for number, content in enumerate(damaged(make(), seed)):
        path = written(folder, content)
        try:
            found = read_markers(path, TABLE)
        except InputError as error:
            assert re.fullmatch(".*take.data.*", str(error)), number
            assert len(str(error)) < 600, number
            refused += 1
        else:
            shape = found.points.shape
            assert shape[:2] == (len(found.time), len(found.labels)), number
            assert len(found.time), number
    assert number == 49
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


def test_implausible_positions_are_missing():
    """Each marker has one kind of position on its first frames."""
    points = np.full((9, 5, 3), 5.0)
    points[:2, 0] = points[:3, 1] = 0.0
    points[:4, 2, 1] = np.inf
    points[:5, 3, 2] = -1000.0
    points[:6, 4, 2] = -1000.1
    file = RecordedFile("take.data", b"")
    found = marker_table(file, "x", np.arange(9), points, [""] * 5, [])
    assert np.isnan(found.points).all(axis=2).sum(axis=0).tolist() == [0, 3, 4, 0, 6]
    assert found.labels[4] == "point 5"
    assert found.corrections == (
        "3 positions are exactly 0, 0, 0 and are read as missing",
        "4 positions lack a finite coordinate and are read as missing",
        "6 positions are over 1000 m away and are read as missing",
    )


def test_missing_files_are_reported(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        identify(tmp_path / "none.c3d")
    with pytest.raises(InputError, match="a folder; give one file"):
        identify(tmp_path)


def test_a_missing_library_is_reported_with_its_installation(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    topics._decoder.cache_clear()
    topics._definitions.cache_clear()
    with pytest.raises(
        InputError,
        match=r"install it with .*uv sync --extra recordings.*srs-twin\[recordings\]",
    ):
        read_markers(written(tmp_path, FILES["MCAP"]()))


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
    path = written(tmp_path, by_c3d(1e2 * TRUTH, unit=""))
    found = read_markers(path, Unstated(unit="cm"))
    same(found, most=1e-5)
    assert (
        "the unit of length (POINT:UNITS) is missing, so cm is used"
        in found.corrections
    )
