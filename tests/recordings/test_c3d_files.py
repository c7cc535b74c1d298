"""C3D files written by other programs: positions, rate and frames are recovered."""

from __future__ import annotations

import io
import struct
import warnings

import c3d
import ezc3d
import numpy as np
import pytest

from srs_twin import InputError
from srs_twin.recordings.formats import read_markers
from srs_twin.recordings.formats.base import Unstated

RATE = 100.0
FLOAT_STEP = 2.0**-24  # relative, of single precision


def walk(frames=60, markers=4, scale=300.0):
    """Return positions in mm, shape (frames, markers, 3)."""
    rng = np.random.default_rng(frames + markers)
    return rng.normal(size=(1, markers, 3)) * scale + np.cumsum(
        rng.normal(size=(frames, markers, 3)), axis=0
    )


def by_ezc3d(path, points, *, first=0, units=("mm",), analog=0, kinds=None):
    file = ezc3d.c3d()
    count = points.shape[1]
    file["parameters"]["POINT"]["RATE"]["value"] = [RATE]
    file["parameters"]["POINT"]["LABELS"]["value"] = [f"m{k}" for k in range(count)]
    file["parameters"]["POINT"]["UNITS"]["value"] = list(units)
    if kinds:
        file.add_parameter("POINT", "ANGLES", kinds)
    file["header"]["points"]["first_frame"] = first
    file["data"]["points"] = np.concatenate(
        [points.transpose(2, 1, 0), np.ones((1, count, len(points)))]
    )
    if analog:
        file["parameters"]["ANALOG"]["RATE"]["value"] = [10 * RATE]
        file["parameters"]["ANALOG"]["LABELS"]["value"] = [
            f"a{k}" for k in range(analog)
        ]
        file["data"]["analogs"] = np.random.default_rng(0).normal(
            size=(1, analog, 10 * len(points))
        )
    file.write(str(path))


def by_c3d(points, *, unit="mm", first=1, step=None, analog=0):
    """Return a file of the library c3d; `step` is the resolution of integers, mm."""
    count = points.shape[1]
    hidden = np.isnan(points[..., :1])
    # The library truncates where it should round.
    shift = np.sign(points) * step / 2 if step else 0.0
    places = np.nan_to_num(points + shift)
    rows = np.concatenate([places, np.where(hidden, -1.0, 0.0), 0.0 * hidden], axis=-1)
    channels = np.zeros((analog, 10)) if analog else np.zeros((0, 0))
    stream = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        writer = c3d.Writer(
            point_rate=RATE,
            analog_rate=10 * RATE if analog else 0.0,
            point_scale=step or -1.0,
            point_units=unit,
        )
        writer.set_point_labels([f"m{k}" for k in range(count)])
        if analog:
            writer.set_analog_labels([f"a{k}" for k in range(analog)])
        writer.add_frames([(row, channels) for row in rows.astype(np.float32)])
        writer.set_start_frame(first)
        writer.write(stream)
    return stream.getvalue()


def in_file(point, step, number, word):
    """Return a point and its residual in the number format of a file; hidden points have the residual −1."""
    seen = np.isfinite(point).all()
    row = [*(point if seen else (0.0, 0.0, 0.0)), 0.0 if seen else -1.0]
    if step:
        return [*(word(round(each / step)) for each in row[:3]), word(int(row[3]))]
    return [number(each) for each in row]


def by_hand(
    points,
    processor,
    *,
    step=None,
    analog=0,
    units="mm",
    more=(),
    group=None,
    counted=None,
):
    """Return a file in the number format of a processor: 84 Intel, 85 DEC, 86 MIPS."""
    order = ">" if processor == 86 else "<"
    frames, count, _ = points.shape

    def number(value):
        if processor != 85:
            return struct.pack(order + "f", value)
        raw = struct.pack("<f", 4 * value)
        return raw[2:] + raw[:2]

    def word(value):
        return struct.pack(order + "H", value % 65536)

    def parameter(group, name, size, shape, data):
        body = struct.pack("bB", size, len(shape)) + bytes(shape) + data + b"\0"
        return (
            struct.pack("bb", len(name), group)
            + name.encode()
            + word(len(body) + 2)
            + body
        )

    def named(group, name):
        return struct.pack("bb", len(name), -group) + name.encode() + word(3) + b"\0"

    scale = number(step or -1.0)
    labels = "".join(f"m{k}".ljust(4) for k in range(count)).encode()
    said = [
        named(1, "POINT"),
        parameter(1, "USED", 2, [], word(count)),
        parameter(1, "SCALE", 4, [], scale),
        parameter(1, "RATE", 4, [], number(RATE)),
        parameter(1, "LABELS", -1, [4, count], labels),
    ]
    if units:
        said.append(parameter(1, "UNITS", -1, [len(units)], units.encode("latin-1")))
    if any(group == 2 for group, *_ in more):
        said.append(named(2, "TRIAL"))
    if group:
        said.append(named(*group))
    said += [
        parameter(group, name, size, shape, make(number, word))
        for group, name, size, shape, make in more
    ]
    said = b"".join(said) + b"\0\0"
    blocks = -(-(4 + len(said)) // 512)
    last = counted or frames
    head = struct.pack("BB", 2, 80) + b"".join(
        map(word, (count, analog, 1, min(last, 65535), 10))
    )
    head += scale + word(2 + blocks) + word(1) + number(RATE)
    data = []
    for frame in points:
        data += [
            value for point in frame for value in in_file(point, step, number, word)
        ]
        data += [word(7) if step else number(7.0)] * analog
    parameters = (bytes([0, 0, blocks, processor]) + said).ljust(512 * blocks, b"\0")
    return head.ljust(512, b"\0") + parameters + b"".join(data)


def same(path, points, *, step=None, first=0.0, unit=1e-3):
    """Compare a file with positions in its unit, with a tolerance of half the resolution of the format."""
    found = read_markers(path)
    assert (
        found.points.shape == points.shape
        and found.labels[-1].strip() == f"m{points.shape[1] - 1}"
    )
    assert (np.isnan(found.points) == np.isnan(points)).all()
    most = step / 2 if step else np.nanmax(np.abs(points)) * FLOAT_STEP
    assert (
        np.nanmax(np.abs(found.points - unit * points))
        <= unit * most * (1 + 1e-6) + 1e-9
    )
    assert np.abs(found.time - first - np.arange(len(points)) / RATE).max() < 1e-9
    assert type(found.header_frames) is int and found.header_frames == len(points)
    return found


@pytest.mark.default_cases(at=[0, 4, 9])
@pytest.mark.parametrize("analog", [0, 3])
@pytest.mark.parametrize("first", [0, 1, 250])
@pytest.mark.parametrize("units", [("mm",), ("mm",) * 4])
def test_files_written_by_ezc3d_are_read(tmp_path, analog, first, units):
    points = walk()
    points[5:9, 1] = np.nan
    by_ezc3d(tmp_path / "a.c3d", points, first=first, units=units, analog=analog)
    same(tmp_path / "a.c3d", points, first=first / RATE)


@pytest.mark.default_cases(at=[0, 7, 8])
@pytest.mark.parametrize("analog", [0, 3])
@pytest.mark.parametrize("step", [None, 0.05])
@pytest.mark.parametrize("first", [0, 1, 250])
def test_files_written_by_c3d_are_read(tmp_path, analog, step, first):
    points = walk()
    points[5:9, 1] = np.nan
    content = by_c3d(points, first=first, step=step, analog=analog)
    (tmp_path / "a.c3d").write_bytes(content)
    same(
        tmp_path / "a.c3d",
        points,
        step=step and 1.001 * step,
        first=max(first - 1, 0) / RATE,
    )


@pytest.mark.default_cases(at=[0, 2, 10])
@pytest.mark.parametrize("processor", [84, 85, 86])
@pytest.mark.parametrize("step", [None, 0.05])
@pytest.mark.parametrize("analog", [0, 5])
def test_processors_and_analog_channels_without_parameters(
    tmp_path, processor, step, analog
):
    points = walk()
    points[5:9, 1] = np.nan
    (tmp_path / "a.c3d").write_bytes(
        by_hand(points, processor, step=step, analog=analog)
    )
    same(tmp_path / "a.c3d", points, step=step)


def test_more_than_255_labels_are_read(tmp_path):
    points = walk(5, 300)
    by_ezc3d(tmp_path / "a.c3d", points)
    found = same(tmp_path / "a.c3d", points)
    assert found.labels == tuple(f"m{k}" for k in range(300))


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("count", [65535, 65536])
def test_files_with_65535_frames_and_more_are_read(tmp_path, count):
    points = walk(count, 1)
    by_ezc3d(tmp_path / "a.c3d", points)
    same(tmp_path / "a.c3d", points)


@pytest.mark.parametrize(("processor", "key"), [(84, "TRIAL"), (86, "LONG_FRAMES")])
def test_conventions_for_long_files_are_read(tmp_path, processor, key):
    """The header overflows at 65,536 frames; the parameters contain the number."""
    some = walk(100, 1)
    more = {
        "TRIAL": [
            (2, "ACTUAL_START_FIELD", 2, [2], lambda number, word: word(1) + word(0)),
            (
                2,
                "ACTUAL_END_FIELD",
                2,
                [2],
                lambda number, word: word(66000) + word(66000 >> 16),
            ),
        ],
        "LONG_FRAMES": [
            (1, "LONG_FRAMES", 4, [], lambda number, word: number(66000.0))
        ],
    }[key]
    content = by_hand(some, processor, more=more, counted=66000 - 65536)
    frames = content[-len(some) * 16 :]  # four numbers of four bytes each
    (tmp_path / "a.c3d").write_bytes(content + frames * 659)
    same(tmp_path / "a.c3d", np.tile(some, (660, 1, 1)))


def test_parameters_in_conflict_with_the_file_are_ignored(tmp_path):
    points = walk()
    stale = [(2, "ACTUAL_END_FIELD", 2, [2], lambda number, word: word(5000) + word(0))]
    (tmp_path / "a.c3d").write_bytes(by_hand(points, 84, more=stale))
    same(tmp_path / "a.c3d", points)


def test_units_of_points_are_converted(tmp_path):
    points = walk(20, 3)
    by_ezc3d(tmp_path / "m.c3d", points / 1e3, units=("m",))
    same(tmp_path / "m.c3d", points / 1e3, unit=1.0)
    by_ezc3d(tmp_path / "mixed.c3d", points, units=("mm", "cm", "m"))
    expected = points * [[1e-3], [1e-2], [1.0]]
    assert np.abs(read_markers(tmp_path / "mixed.c3d").points - expected).max() < 1e-4
    (tmp_path / "none.c3d").write_bytes(by_hand(points, 84, units=""))
    with pytest.raises(
        InputError,
        match=r"the unit of length \(POINT:UNITS\) is missing; give it with --units",
    ):
        read_markers(tmp_path / "none.c3d")


def test_angles_are_skipped(tmp_path):
    by_ezc3d(tmp_path / "a.c3d", walk(20, 4), kinds=["m1"])
    found = read_markers(tmp_path / "a.c3d")
    assert found.labels == ("m0", "m2", "m3")
    assert (
        "1 points with angles, forces or similar quantities were skipped"
        in found.corrections
    )


def test_of_parameters_that_differ_in_case_the_first_is_used(tmp_path):
    points = walk()
    more = [
        (1, "rate", 4, [], lambda number, word: number(7.0)),
        (1, "Units", -1, [2], lambda number, word: b"cm"),
        (1, "DESCRIPTIONS", -1, [2], lambda number, word: b"ab"),
        (1, "Descriptions", -1, [2], lambda number, word: b"cd"),
    ]
    (tmp_path / "a.c3d").write_bytes(by_hand(points, 84, more=more))
    same(tmp_path / "a.c3d", points)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("processor", [84, 85, 86])
@pytest.mark.parametrize(("analog", "used"), [(12, 4), (0, 12), (12, 0)])
def test_the_analog_count_that_fills_the_file_is_used(
    tmp_path, processor, analog, used
):
    """Whichever of header and parameters is right, the points are read."""
    points = walk()
    said = [(3, "USED", 2, [], lambda number, word: word(used))]
    right = by_hand(points, processor, analog=analog, more=said, group=(3, "ANALOG"))
    (tmp_path / "a.c3d").write_bytes(right)
    same(tmp_path / "a.c3d", points)
    wrong = bytearray(
        by_hand(points, processor, analog=used, more=said, group=(3, "ANALOG"))
    )
    order = "big" if processor == 86 else "little"
    wrong[4:6] = analog.to_bytes(2, order)
    (tmp_path / "b.c3d").write_bytes(wrong)
    same(tmp_path / "b.c3d", points)


def test_an_undecidable_analog_count_is_refused(tmp_path):
    said = [(3, "USED", 2, [], lambda number, word: word(5))]
    content = by_hand(walk(), 84, analog=12, more=said, group=(3, "ANALOG"))
    (tmp_path / "a.c3d").write_bytes(content[:-3000])
    with pytest.raises(
        InputError,
        match="the header states 12 analog values per frame, but the parameters"
        " state 5",
    ):
        read_markers(tmp_path / "a.c3d")


def test_an_unknown_unit_is_settled_by_the_given_one(tmp_path):
    points = walk()
    (tmp_path / "a.c3d").write_bytes(by_hand(points, 84, units="m\xfcm"))
    with pytest.raises(InputError, match="unit of length"):
        read_markers(tmp_path / "a.c3d")
    found = read_markers(tmp_path / "a.c3d", Unstated(unit="mm"))
    assert np.abs(found.points - 1e-3 * points).max() < 1e-4
    assert any(
        "is not a known unit, so the given unit mm is used" in note
        for note in found.corrections
    )
