"""Markers hidden for some frames: identities after the gap, and the body fitted to the visible markers."""

from __future__ import annotations

import numpy as np
import pytest

from srs_twin import InputError, load_robot
from srs_twin.recordings.body.frame_fit import MarkerPlacement, marker_offsets
from srs_twin.recordings.body.layout import body_order, rigid_pairs, robot_markers
from srs_twin.recordings.body.shape import LengthModel, fit_shape
from srs_twin.recordings.body.tracking import track_markers

GEOMETRY = load_robot("gen2").geometry


def test_hidden_markers_that_pass_each_other_keep_their_identity():
    """Each reappears where the other vanished, so that only the velocities distinguish them."""
    frames = np.arange(60)
    ways = np.stack([0.01 * (frames - 30.0), -0.01 * (frames - 30.0)], axis=1)
    points = np.stack([ways, np.broadcast_to([0.0, 0.012], ways.shape)], axis=-1)
    points[29:32] = np.nan
    after = frames > 31
    points[after] = points[after][:, ::-1]  # the file exchanges their columns
    columns = np.where(after[:, None], [1, 0], [0, 1])
    columns[29:32] = -1
    tracks, origin, dropped = track_markers(points, columns, longest=10, reach=0.1)
    assert dropped == 0 and tracks.shape == (60, 2, 2)
    seen = ~np.isnan(tracks[..., 0])
    for k in range(2):
        step = np.diff(tracks[seen[:, k], k, 0])
        assert (np.sign(step) == np.sign(step[0])).all()
        assert len(set(origin[seen[:, k], k])) == 1


def test_a_marker_with_a_hidden_neighbour_belongs_to_the_robot():
    """The next one on a body that bends a little is almost two segments away."""
    pitch = GEOMETRY.pitch
    count = GEOMETRY.connectors
    heading = 0.6 * np.arange(
        count
    )  # two straight steps of length 1 that turn by 0.6 span 2 cos(0.3) = 1.91
    body = np.cumsum(pitch * np.exp(1j * heading))
    tracks = np.append(body, body.mean() + 10 * pitch)  # and something else, far away
    points = np.tile(np.stack([tracks.real, tracks.imag], axis=-1), (100, 1, 1))
    points[30:, 1] = np.nan
    layouts, chosen = robot_markers(points, count, pitch, "auto", 0)
    assert (layouts, chosen.tolist()) == (["single"], list(range(count)))


STRAIGHT = [0.0, -0.055, -0.11]


@pytest.mark.parametrize(
    ("angle", "sides", "expected"),
    [
        (24.0, ("", ""), [0.01, -0.01]),
        (114.0, ("", ""), [0.01j, -0.01j]),
        (26.0, ("", ""), "makes an angle of 26° with the body"),
        (26.0, ("left", "right"), [0.01j, -0.01j]),
        (26.0, ("behind", ""), [-0.02, 0.0]),
        (26.0, ("ahead", "left"), [0.02 / 2**0.5, 0.02j / 2**0.5]),
        (26.0, ("left", "left"), "a and b are on the same side of one connector"),
    ],
)
def test_two_markers_of_a_connector_lie_along_or_across_the_body(
    angle, sides, expected
):
    """Markers a and b at the middle connector are 20 mm apart."""
    pair = STRAIGHT[1] + np.exp(1j * np.radians(angle)) * np.array([0.01, -0.01])
    places = np.array([STRAIGHT[0], *pair, STRAIGHT[2]])
    points = np.tile(np.stack([places.real, places.imag], axis=-1), (5, 1, 1))
    stations = [(0, ""), (2, sides[0]), (2, sides[1]), (4, "")]
    hidden = np.zeros((5, 4), dtype=bool)
    if isinstance(expected, str):
        with pytest.raises(InputError, match=expected):
            marker_offsets(points, hidden, stations, "_abc")
    else:
        found = marker_offsets(points, hidden, stations, "_abc")
        assert found == pytest.approx([0.0, *expected, 0.0])
    said = r"3 markers are assigned to one place .* \(a, b, c\), but at most two are"
    with pytest.raises(InputError, match=said):
        marker_offsets(points, hidden, [*stations[:3], (2, "")], "_abc")


def test_a_body_has_two_ends_and_rigid_pairs():
    star = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 1.0], [-1.0, -1.0]])
    with pytest.raises(InputError, match="connections have 3 ends instead of 2"):
        body_order(np.tile(star, (20, 1, 1)))
    # The median is 1, and the quartiles are 0.75 and 1.25: 0.74 times 0.5 is 37 %.
    points = np.zeros((21, 2, 2))
    points[:, 1, 0] = np.linspace(0.5, 1.5, 21)
    with pytest.raises(InputError, match="the distance of one pair changes by 37 %"):
        rigid_pairs(points, 1)


def test_body_is_recovered_while_a_marker_is_hidden():
    count = GEOMETRY.connectors - 1
    time = np.arange(200) / 100
    marks = MarkerPlacement(
        np.repeat(2 * np.arange(count + 1), 2),
        np.tile([0.02j, -0.02j], count + 1),
        GEOMETRY,
    )
    phase = 2 * np.pi * time[:, None] + np.arange(count)
    state = np.column_stack(
        [0.1 * time, 0.02 * np.sin(time), 0.3 * np.sin(5 * time), 0.5 * np.sin(phase)]
        + [np.full_like(time, GEOMETRY.segment_length)] * count
    )
    mark, _, node, theta = marks.kinematics(state)
    points = np.stack([mark.real, mark.imag], axis=-1)
    points += np.random.default_rng(1).normal(scale=1e-4, size=points.shape)
    missing = np.zeros(mark.shape, dtype=bool)
    missing[80:100, 4] = True
    points[missing] += 0.02  # what was interpolated is wrong
    shape = fit_shape(time, points, missing, marks, LengthModel.FREE)
    assert np.abs(shape.connector - node).max() < 2e-3
    assert np.abs(shape.theta - theta).max() < 0.05
