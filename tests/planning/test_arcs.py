"""Arcs and their swept regions, compared with integration and with finely drawn polygons (shapely)."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import assume, given, strategies as st
from scipy.integrate import solve_ivp

from srs_twin.errors import InputError
from srs_twin.planning.arcs import Extent, Primitives, arc_collides, arc_end
from srs_twin.planning.collision import Box, build_grid
from srs_twin.robot.world import Pose

CURVATURE = st.floats(-4, 4) | st.sampled_from([0.0, 1e-12, -1e-10, 1e-8, 1e-6, -1e-4])
PLACE = st.floats(-1.5, 1.5)
ANGLE = st.floats(-4, 4)
EDGE = st.floats(0.01, 0.2)
ARC = st.tuples(
    st.builds(Pose, PLACE, PLACE, ANGLE),
    CURVATURE,
    st.floats(0, 1.2),
    EDGE,
    EDGE,
    EDGE,
    EDGE,
)
NO_CIRCLES = np.empty((0, 3))
NO_SIDES = np.empty((0, 4))
ANYWHERE = Box()
NEAR = 1e-4
"""Tolerance between the drawn polygon and the region, m."""


def drawn(arc) -> shapely.Polygon:
    """The region of an arc with 1,200 corners, by integrating the heading's sine and cosine."""
    pose, k, length, ahead, behind, left, right = arc
    assume(abs(k) * (length + ahead + behind) < 6)
    s = np.linspace(-behind, length + ahead, 600)
    heading = pose.heading + k * s
    # Simpson's rule from 0 to each place.
    t = np.linspace(0, 1, 81)
    weights = np.r_[1, np.tile([4, 2], 40)[:-1], 1] / 240
    x = pose.x + s * (np.cos(pose.heading + k * np.outer(s, t)) @ weights)
    y = pose.y + s * (np.sin(pose.heading + k * np.outer(s, t)) @ weights)
    edges = [
        np.c_[x - n * np.sin(heading), y + n * np.cos(heading)] for n in (left, -right)
    ]
    return shapely.Polygon(np.r_[edges[0], edges[1][::-1]])


def touches(arc, circles=NO_CIRCLES, sides=NO_SIDES, bounds=ANYWHERE) -> bool:
    pose, k, length, *extent = arc
    around = build_grid(circles, sides, bounds)
    return arc_collides(tuple(pose), k, length, Extent(*extent), around)


@given(ARC, st.integers(0, 2**32 - 1))
def test_many_obstacles_collide_as_each_alone(arc, seed):
    rng = np.random.default_rng(seed)
    circles = np.column_stack([rng.uniform(-3, 3, (40, 2)), rng.uniform(0.01, 0.2, 40)])
    ends = rng.uniform(-3, 3, (40, 2))
    sides = np.column_stack([ends, ends + rng.uniform(-0.4, 0.4, (40, 2))])
    alone = [touches(arc, circles=circles[k : k + 1]) for k in range(40)]
    alone += [touches(arc, sides=sides[k : k + 1]) for k in range(40)]
    assert touches(arc, circles=circles, sides=sides) == any(alone)


@given(st.builds(Pose, PLACE, PLACE, ANGLE), CURVATURE, st.floats(-2, 2))
def test_arc_end_agrees_with_integration(pose, k, length):
    solved = solve_ivp(
        lambda _, z: [math.cos(z[2]), math.sin(z[2]), k],
        (0, abs(length)),
        [pose.x, pose.y, pose.heading],
        rtol=1e-10,
        atol=1e-12,
    )
    assume(length >= 0)
    assert arc_end(pose.x, pose.y, pose.heading, k, length) == pytest.approx(
        solved.y[:, -1], abs=1e-8
    )


@given(st.builds(Pose, PLACE, PLACE, ANGLE), st.floats(0.1, 3), st.floats(0.05, 1))
def test_children_are_the_ends_of_arcs_with_equally_spaced_turns(pose, turn, length):
    for i, child in enumerate(Primitives(5, turn, length).children(pose)):
        end = arc_end(*pose, turn * (i - 2) / 2 / length, length)
        assert (*child,) == pytest.approx(end, abs=1e-9)


@given(ARC, PLACE, PLACE, st.floats(0.01, 0.5))
def test_circles_collide_as_with_a_drawn_region(arc, x, y, radius):
    gap = drawn(arc).distance(shapely.Point(x, y)) - radius
    assume(abs(gap) > NEAR)
    assert touches(arc, circles=np.array([[x, y, radius]])) == (gap < 0)


@given(ARC, PLACE, PLACE, PLACE, PLACE)
def test_sides_collide_as_with_a_drawn_region(arc, ax, ay, bx, by):
    region = drawn(arc)
    side = shapely.LineString([(ax, ay), (bx, by)])
    hit = region.intersects(side)
    assume(
        hit
        == region.buffer(NEAR).intersects(side)
        == region.buffer(-NEAR).intersects(side)
    )
    assert touches(arc, sides=np.array([[ax, ay, bx, by]])) == hit


@given(
    ARC, st.floats(0.02, 2), st.floats(0.02, 2), st.floats(0.02, 2), st.floats(0.02, 2)
)
def test_bounds_are_left_as_by_a_drawn_region(arc, west, east, south, north):
    region = drawn(arc)
    pose = arc[0]
    box = (pose.x - west, pose.y - south, pose.x + east, pose.y + north)
    inside = shapely.box(*box).contains(region)
    assume(
        inside
        == shapely.box(*box).buffer(NEAR).contains(region)
        == shapely.box(*box).buffer(-NEAR).contains(region)
    )
    assert touches(arc, bounds=Box(box[0], box[2], box[1], box[3])) == (not inside)


def test_even_numbers_of_primitives_are_rejected():
    with pytest.raises(
        InputError, match="the number of primitives 4 is not allowed; it must be odd"
    ):
        Primitives(4, 1.0, 0.1)
    with pytest.raises(InputError, match="between 0 and pi"):
        Primitives(5, 3.2, 0.1)
