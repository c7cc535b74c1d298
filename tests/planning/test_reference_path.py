"""Path coordinates, compared with a search over finely sampled poses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from srs_twin.planning.footprint import Footprint
from srs_twin.planning.path import EXTENSION_M, ReferencePath, path_from_arcs
from srs_twin.robot.world import Pose

pytestmark = pytest.mark.fast

ORIGIN = Pose(0.0, 0.0, 0.0)
BODY = Footprint.box(0.1, 0.0, speed=0.2, curvature=5.0)
PIECES = st.lists(
    st.tuples(st.floats(-5, 5), st.floats(0.05, 0.6)), min_size=1, max_size=5
)


def route(pieces, start=ORIGIN):
    return ReferencePath(path_from_arcs(start, pieces, BODY))


@settings(max_examples=40)
@given(PIECES, st.floats(-2, 2), st.floats(-2, 2), st.floats(-3, 3))
def test_nearest_point_is_nearer_than_all_samples(pieces, x, y, heading):
    way = route(pieces, Pose(0.3, -0.2, heading))
    place = way.nearest(x, y)
    samples = [
        way.pose(s) for s in np.linspace(-EXTENSION_M, way.length + EXTENSION_M, 3000)
    ]
    least = min(math.hypot(p.x - x, p.y - y) for p in samples)
    foot = way.pose(place.s)
    found = math.hypot(foot.x - x, foot.y - y)
    assert found <= least + 1e-9 and found >= least - 2e-3
    if -EXTENSION_M < place.s < way.length + EXTENSION_M:
        assert abs(place.n) == pytest.approx(found, abs=1e-6)


def test_left_is_positive_and_ends_are_extended_straight():
    way = route([(0.0, 1.0), (2.0, 0.5)])
    assert way.nearest(0.5, 0.2)[:2] == pytest.approx((0.5, 0.2))
    assert way.nearest(0.5, -0.2)[:2] == pytest.approx((0.5, -0.2))
    assert way.nearest(-0.3, 0.1)[:2] == pytest.approx((-0.3, 0.1))
    end = way.pose(way.length)
    assert end.heading == pytest.approx(1.0)
    ahead = way.nearest(end.x + 0.2 * math.cos(1), end.y + 0.2 * math.sin(1))
    assert ahead[:2] == pytest.approx((1.7, 0.0), abs=1e-9)
    assert (
        way.curvature(0.5),
        way.curvature(1.2),
        way.curvature(1.6),
        way.curvature(-1),
    ) == (0, 2, 0, 0)


def test_joint_of_two_arcs_has_the_curvature_of_the_second():
    way = route([(1.0, 0.5), (-2.0, 0.25), (3.0, 0.5)])
    assert [way.curvature(s) for s in (0.0, 0.5, 0.75, 1.25)] == [1.0, -2.0, 3.0, 0.0]
    for s in (0.0, 0.5, 0.75):
        before = way.pose(s - 1e-9)
        after = way.pose(s)
        assert [*after] == pytest.approx([*before], abs=1e-8)


def test_coordinates_are_unique_on_arcs_beyond_half_a_turn():
    way = route([(2.0, 2.8)])
    for s in np.linspace(0.01, 2.79, 40):
        pose = way.pose(s)
        assert way.nearest(pose.x, pose.y)[:2] == pytest.approx((s, 0.0), abs=1e-9)


def test_window_distinguishes_crossings_of_a_path():
    way = route([(5.0, 2 * math.pi / 5), (0.0, 1.0)])
    assert way.nearest(0.0, 0.0, -0.1, 0.3).s == pytest.approx(0.0, abs=1e-9)
    assert way.nearest(0.0, 0.0, 1.0, 1.5).s == pytest.approx(2 * math.pi / 5, abs=1e-9)
