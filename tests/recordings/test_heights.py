"""Heights of markers: masts, a tilted floor, lamps above the robot and people next to it."""

from __future__ import annotations

import numpy as np
import pytest
from recorded import NOISE, SPEC, csv_text, motion, true_at
from scipy.spatial.transform import Rotation
from synthetic_takes import Take, markers

from srs_twin.recordings.body.floor import map_to_floor
from srs_twin.recordings.facts import in_words
from srs_twin.recordings.inspection import inspect_file
from srs_twin.recordings.recording import read_motion
from srs_twin.recordings.recording_map import NO_MAP, RecordingMap

MASTS = (0.09, 0.03, 0.15, 0.03, 0.09)


def raised(heights, seed=0, layout="single"):
    """Return markers at these heights with noise, shape (frames, markers, 3), m."""
    place = markers(motion(), Take(layout=layout))
    height = np.broadcast_to(np.asarray(heights), place.shape[:2])
    points = np.concatenate([place, height[..., None]], axis=-1)
    return points + NOISE * np.random.default_rng(seed).standard_normal(points.shape)


def written(path, points, names=("c1", "c2", "c3", "c4", "c5")):
    """Write markers as a plain CSV file."""
    head = ["time", *(f"{name}_{axis}" for name in names for axis in "xyz")]
    rows = np.column_stack([motion().time, points.reshape(len(points), -1)])
    path.write_text(csv_text(head, rows))
    return path


def bend_error(found):
    error = found.trajectory.stack("bend") - true_at(found.trajectory, motion()).stack(
        "bend"
    )
    return np.sqrt((error**2).mean())


@pytest.mark.parametrize("heights", [MASTS, (0.09, 0.03, 0.03, 0.03, 0.03)])
def test_markers_on_masts_are_detected_and_used(tmp_path, heights):
    path = written(tmp_path / "masts.csv", raised(heights))
    facts, _ = inspect_file(path, NO_MAP, None)
    assert [each.coverage for each in facts.markers] == [1.0] * 5
    assert [each.height_mm for each in facts.markers] == pytest.approx(
        1e3 * np.array(heights), abs=0.1
    )
    assert not any("levelled" in each or "left out" in each for each in facts.notes)
    spacing = {tuple(each.markers): each.median_mm for each in facts.distances}
    flat, _ = inspect_file(
        written(tmp_path / "flat.csv", raised((0.03,) * 5)), NO_MAP, None
    )
    for each in flat.distances:
        assert spacing[tuple(each.markers)] == pytest.approx(each.median_mm, abs=0.05)
    assert "never seen" not in in_words(facts) and "90 mm high" in in_words(facts)
    assert bend_error(read_motion(path, SPEC)) < 0.04


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("seed", range(9))
def test_tilted_floor_is_levelled_with_markers_on_masts(seed):
    """Up to half of the markers are on masts and the tilt is 3 to 20°; the error is below 0.1°."""
    random = np.random.default_rng(seed)
    layout = ("single", "head", "pair")[seed % 3]
    points = raised(0.0, seed, layout)
    count = points.shape[1]
    heights = np.full(count, 0.03)
    high = random.choice(count, count // 2, replace=False)
    heights[high] = random.uniform(0.06, 0.2, len(high))
    points[..., 2] += heights
    direction, turn = random.uniform(0, 2 * np.pi, 2)
    tilt = np.radians(random.uniform(3.1, 20))
    axis = [tilt * np.cos(direction), tilt * np.sin(direction), 0.0]
    rotation = Rotation.from_rotvec(axis) * Rotation.from_euler("z", turn)
    tilted = points @ rotation.as_matrix().T + [0, 0, 1]
    found = map_to_floor(tilted, "auto", "z", level=True)
    assert found.up == "z"
    x, y, z = np.moveaxis(found.points, -1, 0)
    plane = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    slope = np.linalg.lstsq(plane, (z - heights).ravel(), rcond=None)[0]
    assert np.degrees(np.hypot(*slope[:2])) < 0.05


def test_markers_on_lamps_people_and_carts_are_left_out(tmp_path):
    """A lamp above the path does not move, a cap on a head moves up and down, and a cart passes."""
    time = motion().time
    middle = motion().position[:, 2]
    lamp = np.column_stack(
        [np.tile(middle[200], (len(time), 1)), np.full(len(time), 1.5)]
    )
    cap = np.column_stack([middle + [0.2, 0.1], 1.7 + 0.03 * np.sin(12 * time)])
    cart = np.column_stack(
        [0.05 + 0.8 * time, 0.1 - 0.3 * time, np.full(len(time), 0.4)]
    )
    others = np.stack([lamp, cap, cart], axis=1)
    points = np.concatenate([raised(MASTS), others], axis=1)
    path = written(tmp_path / "x.csv", points, [*"abcde", "lamp", "cap", "cart"])
    facts, _ = inspect_file(path, NO_MAP, None)
    assert [each.coverage for each in facts.markers] == [1.0] * 8
    found = read_motion(path, SPEC)
    for said in (facts.notes, found.summary.corrections):
        out = [each for each in said if "left out" in each]
        assert (
            "the marker 'lamp' was left out: it is 1500 mm high, and it does not move"
            " with the other markers" in out
        )
        assert any(
            "'cap' was left out: it is 170" in each and "its height varies by" in each
            for each in out
        )
        assert any("'cart' was left out: it is 400 mm high" in each for each in out)
        assert len(out) == 3
    assert found.summary.markers.samples_other == 3 * len(time)
    assert bend_error(found) < 0.04


def test_markers_in_a_map_belong_to_the_robot(tmp_path):
    """A named marker is used at any height, and swaps of names between heights are tracked."""
    points = raised((0.03, 0.03, 0.25, 0.03, 0.03))
    points[250:, [1, 2]] = points[250:, [2, 1]]
    path = written(tmp_path / "x.csv", points)
    places = RecordingMap(markers={f"c{k}": {"connector": k} for k in range(1, 6)})
    found = read_motion(path, SPEC, map=places)
    assert found.summary.markers.moves == 2
    assert bend_error(found) < 0.04
    facts, _ = inspect_file(path, NO_MAP, None)
    assert facts.in_other_columns == pytest.approx(2 * 151 / (5 * 401))
