"""Dubins paths against numerical search, and the laws that any shortest path obeys."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import example, given, strategies as st
from scipy.optimize import fsolve

from srs_twin.planning.dubins import shortest_path
from srs_twin.robot.world import Pose

pytestmark = pytest.mark.fast

PLACE = st.floats(-3, 3)
ANGLE = st.floats(-4, 4)
POSE = st.builds(Pose, PLACE, PLACE, ANGLE)
RADIUS = st.floats(0.1, 2)


def rolled(pose: Pose, pieces) -> np.ndarray:
    """End pose by the circle's centre, (x, y, heading)."""
    x = pose.x
    y = pose.y
    heading = pose.heading
    for k, s in pieces:
        if k == 0:
            x = x + s * math.cos(heading)
            y = y + s * math.sin(heading)
            continue
        cx = x - math.sin(heading) / k
        cy = y + math.cos(heading) / k
        heading += k * s
        x = cx + math.sin(heading) / k
        y = cy - math.cos(heading) / k
    return np.array([x, y, heading])


def total(pieces) -> float:
    return sum(length for _, length in pieces)


def length(a: Pose, b: Pose, radius: float) -> float:
    return total(shortest_path(a, b.x, b.y, b.heading, radius))


@given(POSE, POSE, RADIUS)
def test_path_ends_at_the_pose(a, b, radius):
    path = shortest_path(a, b.x, b.y, b.heading, radius)
    end = rolled(a, path)
    assert end[:2] == pytest.approx([b.x, b.y], abs=1e-7)
    assert math.remainder(end[2] - b.heading, 2 * math.pi) == pytest.approx(0, abs=1e-7)
    assert all(abs(k) in (0, pytest.approx(1 / radius)) and s >= 0 for k, s in path)


@given(POSE, PLACE, PLACE, RADIUS)
@example(Pose(0.0, 0.0, 0.0), 0.0, 7e-17, 1.0)
@example(Pose(0.3, -0.2, 1.0), 0.3, -0.2 + 1e-17, 0.5)
@example(Pose(0.0, 0.0, 0.0), 0.0, 6.323302607585437e-11, 1.0)
@example(
    Pose(0.0, 1.9567953203528943, 0.0), 1.9567953203528943, 0.0, 1.9567953203528943
)  # on the turning circle
def test_path_to_a_point_ends_there_and_no_arrival_heading_is_shorter(a, x, y, radius):
    path = shortest_path(a, x, y, None, radius)
    end = rolled(a, path)
    assert end[:2] == pytest.approx([x, y], abs=1e-7)
    others = [
        total(shortest_path(a, x, y, heading, radius))
        for heading in np.linspace(0, 2 * math.pi, 60)
    ]
    assert total(path) <= min(others) + 1e-7
    assert total(path) == pytest.approx(
        total(shortest_path(a, x, y, end[2], radius)), abs=1e-6
    )


@given(POSE, POSE, RADIUS)
def test_backwards_and_in_the_mirror_it_is_as_long(a, b, radius):
    there = length(a, b, radius)
    back = length(
        Pose(b.x, b.y, b.heading + math.pi), Pose(a.x, a.y, a.heading + math.pi), radius
    )
    mirrored = length(Pose(a.x, -a.y, -a.heading), Pose(b.x, -b.y, -b.heading), radius)
    # A full turn may appear or vanish by rounding where it is no turn at all.
    for other in (back, mirrored):
        difference = abs(there - other)
        assert difference < 1e-6 or abs(difference - 2 * math.pi * radius) < 1e-3


@given(POSE, POSE, POSE, RADIUS)
def test_no_way_round_is_shorter(a, b, c, radius):
    assert length(a, c, radius) <= length(a, b, radius) + length(b, c, radius) + 1e-6


@given(POSE, POSE, RADIUS, st.floats(1, 3))
def test_wider_turns_are_never_shorter(a, b, radius, more):
    assert length(a, b, radius) <= length(a, b, radius * more) + 1e-6


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("seed", range(5))
def test_no_three_pieces_found_by_search_are_shorter(seed):
    """All words of three pieces, their lengths by a root finder from many guesses."""
    rng = np.random.default_rng(seed)
    a = Pose(0, 0, rng.uniform(-3, 3))
    b = Pose(*rng.uniform(-2.5, 2.5, 2), rng.uniform(-3, 3))
    found = []
    for word in itertools.product((1.0, 0.0, -1.0), repeat=3):
        if word[0] == word[1] or word[1] == word[2]:
            continue

        def miss(lengths, word=word):
            end = rolled(a, zip(word, lengths, strict=True))
            return [end[0] - b.x, end[1] - b.y, 2 * math.sin((end[2] - b.heading) / 2)]

        for _ in range(12):
            lengths, _, solved, _ = fsolve(miss, rng.uniform(0, 5, 3), full_output=True)
            if solved == 1 and min(lengths) >= 0 and np.abs(miss(lengths)).max() < 1e-8:
                found.append(float(sum(lengths)))
    assert length(a, b, 1.0) == pytest.approx(min(found), abs=1e-6)
