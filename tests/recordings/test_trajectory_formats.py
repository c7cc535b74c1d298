"""Text formats of other programs: OpenSim's TRC, TUM trajectories, objects of Vicon Tracker."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from srs_twin import InputError
from srs_twin.recordings.formats import identify, read_markers

RATE = 100.0
FRAMES = 80
UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


def walk(markers):
    rng = np.random.default_rng(markers)
    steps = rng.normal(scale=2e-3, size=(FRAMES, markers, 3))
    points = rng.uniform(-1, 1, size=(1, markers, 3)) + np.cumsum(steps, axis=0)
    if markers > 1:
        points[20:25, 1] = np.nan
    return points


def cells(values, decimals, missing=""):
    return [
        missing if np.isnan(value) else f"{value:.{decimals}f}"
        for value in np.ravel(values)
    ]


def trc(points, unit="mm", *, rate=RATE, blank=True, tab=False, first=1, missing=""):
    count = points.shape[1]
    head = [
        "PathFileType\t4\t(X/Y/Z)\trun.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate:g}\t{rate:g}\t{len(points)}\t{count}\t{unit}\t{rate:g}\t1\t{len(points)}",
        "Frame#\tTime\t" + "\t\t\t".join(f"m{k}" for k in range(count)) + "\t\t\t",
        "\t\t"
        + "\t".join(f"{axis}{k + 1}" for k in range(count) for axis in "XYZ")
        + "\t",
        *([""] if blank else []),
    ]
    rows = [
        "\t".join(
            [
                f"{k + first}",
                f"{(k + first - 1) / rate:.3f}",
                *cells(row / UNITS[unit], 5, missing),
            ]
        )
        for k, row in enumerate(points)
    ]
    return "\r\n".join([*head, *(row + "\t" * tab for row in rows)]) + "\r\n"


@pytest.mark.parametrize(
    ("unit", "blank", "tab"),
    [("mm", True, False), ("cm", False, True), ("m", True, True)],
)
def test_trc_positions_are_read(tmp_path, unit, blank, tab):
    points = walk(4)
    (tmp_path / "run.txt").write_text(trc(points, unit, blank=blank, tab=tab))
    found = read_markers(tmp_path / "run.txt")
    assert found.kind == "TRC"
    assert found.labels == ("m0", "m1", "m2", "m3")
    assert found.header_frames == FRAMES
    assert (np.isnan(found.points) == np.isnan(points)).all()
    assert np.nanmax(np.abs(found.points - points)) <= 0.5e-5 * UNITS[unit] + 1e-9
    assert np.abs(found.time - np.arange(FRAMES) / RATE).max() < 1e-9


def test_trc_with_an_offset_start_and_a_rounded_rate(tmp_path):
    (tmp_path / "a.trc").write_text(trc(walk(3), rate=59.94, first=300))
    found = read_markers(tmp_path / "a.trc")
    assert np.abs(np.diff(found.time) - 1 / 59.94).max() < 1e-9
    assert abs(found.time[0] - 4.988) < 1e-9


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("\tmm\t", "\tfurlong\t", ":3: the unit of length 'furlong' is not known"),
        ("Frame#\tTime", "Frames\tTime", ":4: the header is incomplete"),
        (
            "m2",
            "m2\t\t\tm3",
            ":7: the row has 11 cells for 4 markers; each row must have 14 cells",
        ),
        ("100\t100", "0\t0", "frame rate '0' is not allowed"),
    ],
)
def test_damaged_trc_is_refused(tmp_path, old, new, words):
    (tmp_path / "a.trc").write_text(trc(walk(3)).replace(old, new))
    with pytest.raises(InputError, match=words):
        read_markers(tmp_path / "a.trc")


def tum(time, points, turns, space=" "):
    """Return poses in the TUM format; the quaternions may have any order."""
    rows = np.column_stack([time, points, turns])
    return "".join(space.join(f"{value:.9f}" for value in row) + " \n" for row in rows)


TURNS = Rotation.from_rotvec(np.linspace(0, [0, 0, 2], FRAMES)).as_quat()


@pytest.mark.parametrize(
    ("head", "origin", "space"),
    [
        ("# timestamp tx ty tz qx qy qz qw\n", 12.5, " "),
        ("", 0.0, "  "),
        ("# by evo\n#\n", 1_700_000_000.0, "\t"),
    ],
)
def test_tum_poses_are_read(tmp_path, head, origin, space):
    points = walk(1)
    time = np.arange(FRAMES) / RATE
    path = tmp_path / "head.tum"
    path.write_text(head + tum(origin + time, points[:, 0], TURNS, space))
    found = read_markers(path)
    assert identify(path) == found.kind == "TUM trajectory"
    assert found.labels == ("head",)
    assert np.abs(found.points - points).max() < 1e-9
    assert np.abs(found.rotations[:, 0] - TURNS).max() < 1e-9
    since_1970 = origin > 1e8
    assert found.time - time == pytest.approx(0.0 if since_1970 else origin, abs=1e-6)
    assert found.epoch_ns == (origin * 10**9 if since_1970 else None)


@pytest.mark.parametrize(
    "head",
    [
        "# timestamp tx ty tz qw qx qy qz\n",
        "\ufeff# timestamp tx ty tz qw qx qy qz\n",
        "# by SLAM\n#timestamp [s], tx [m], ty [m], tz [m], qw, qx, qy, qz\n",
    ],
)
def test_a_comment_states_the_order_of_a_quaternion(tmp_path, head):
    text = tum(np.arange(FRAMES) / RATE, walk(1)[:, 0], TURNS[:, [3, 0, 1, 2]])
    (tmp_path / "head.tum").write_text(head + text, encoding="utf-8")
    found = read_markers(tmp_path / "head.tum")
    assert found.rotations[:, 0] == pytest.approx(TURNS, abs=1e-8)


def test_eight_numbers_without_a_unit_quaternion_are_refused(tmp_path):
    (tmp_path / "a.txt").write_text("0.1 1 2 3 4 5 6 7\n" * 5)
    with pytest.raises(
        InputError, match="eight numbers per line are read as .* a quaternion"
    ):
        read_markers(tmp_path / "a.txt")
    (tmp_path / "b.txt").write_text(
        "0.1" + " " * 200_000 + "1 2 3 0 0 0 1\n0.2 1 2 3 0 0 0 1\n"
    )
    with pytest.raises(InputError):
        read_markers(tmp_path / "b.txt")


def test_damaged_tum_is_refused(tmp_path):
    rows = ["0.1 1 2 3 0 0 0 1"] * 5
    rows[3] = "0.1 1 a 3 0 0 0 1"
    (tmp_path / "a.tum").write_text("# t x y z\n" + "\n".join(rows) + "\n")
    with pytest.raises(InputError, match="a.tum:5:3: 'a' is not a number"):
        read_markers(tmp_path / "a.tum")


def tracker(points, turns, unit, angle):
    """Return a Tracker export; `angle` is rad or deg (rotation vectors), or a quaternion."""
    names = ["", ""]
    axes = ["Frame", "Sub Frame"]
    units = ["", ""]
    rows = []
    if angle == "quaternion":
        rotation = turns.as_quat().reshape(FRAMES, -1, 4)
        own = ["RX", "RY", "RZ", "RW"]
        said = [""] * 4
    else:
        rotation = turns.as_rotvec(degrees=angle == "deg").reshape(FRAMES, -1, 3)
        own = ["RX", "RY", "RZ"]
        said = [angle] * 3
    for k in range(points.shape[1]):
        names += [f"Global Angle snake:c{k}", *[""] * (len(own) + 2)]
        axes += [*own, "TX", "TY", "TZ"]
        units += [*said, *[unit] * 3]
    for k in range(FRAMES):
        row = [f"{k + 1}", "0"]
        for m, place in enumerate(points[k]):
            row += [*cells(rotation[k, m] * (np.nan if np.isnan(place[0]) else 1), 9)]
            row += cells(place / UNITS[unit], 6)
        rows.append(",".join(row))
    return (
        "\n".join(
            ["Objects", "100", ",".join(names), ",".join(axes), ",".join(units), *rows]
        )
        + "\n"
    )


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("unit", ["mm", "m"])
@pytest.mark.parametrize("angle", ["rad", "deg", "quaternion"])
def test_vicon_tracker_objects_are_read(tmp_path, unit, angle):
    points = walk(3)
    turns = Rotation.from_euler(
        "xyz", np.random.default_rng(2).uniform(-1, 1, size=(FRAMES * 3, 3))
    )
    (tmp_path / "a.csv").write_text(tracker(points, turns, unit, angle))
    found = read_markers(tmp_path / "a.csv")
    assert found.labels == ("snake:c0", "snake:c1", "snake:c2")
    assert found.kind == "Vicon CSV"
    assert (np.isnan(found.points) == np.isnan(points)).all()
    assert np.nanmax(np.abs(found.points - points)) < 0.5e-6 * UNITS[unit] + 1e-9
    expected = turns.as_quat().reshape(FRAMES, 3, 4)
    seen = ~np.isnan(points[..., 0])
    assert (np.isfinite(found.rotations).all(axis=-1) == seen).all()
    assert (
        np.abs(np.abs((found.rotations * expected).sum(axis=-1)[seen]) - 1).max() < 1e-6
    )
    assert np.abs(found.time - np.arange(FRAMES) / RATE).max() < 1e-9
