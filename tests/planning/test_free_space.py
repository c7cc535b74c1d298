"""Proof that no path exists, lower bound on path lengths, and clearance of paths."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from rectangles import rectangle
from subsets import first_by_default
from witnessed_worlds import KINDS, bodies, drawn

from srs_twin.planning.collision import MAX_CLEARANCE_M, Checker
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.free_space import is_disconnected, min_path_length
from srs_twin.planning.path import path_from_arcs
from srs_twin.robot.world import Bounds, Circle, Goal, Pose, World

START = Pose(-2.0, 0.0, 0.0)
GOAL = Goal(2.0, 0.0, None, 0.0)
BODY = Footprint.box(0.1, 0.0, speed=0.1, curvature=2.0)


def test_min_path_length_without_obstacles_is_the_distance():
    assert min_path_length(START, GOAL, World(), 0.05) == pytest.approx(4.0, abs=1e-9)
    wide = replace(GOAL, radius=0.5)
    assert min_path_length(START, wide, World(), 0.05) == pytest.approx(3.5, abs=1e-9)


@pytest.mark.parametrize("clearance", [0.05, 0.2])
def test_min_path_length_round_a_circle_is_two_tangents_and_an_arc(clearance):
    """The circle is replaced by inscribed chords, so the bound is slightly smaller."""
    radius = 0.5 + clearance
    exact = 2 * (math.sqrt(4 - radius**2) + radius * math.asin(radius / 2))
    found = min_path_length(START, GOAL, World((Circle(0.0, 0.0, 0.5),)), clearance)
    assert exact * 0.995 < found <= exact + 1e-9


def test_min_path_length_is_infinite_without_a_path():
    wall = rectangle(-0.1, 0.1, -5.0, 5.0)
    closed = World((), Bounds((-9, 9), (-5, 5)), None, (wall,))
    assert min_path_length(START, GOAL, closed, 0.05) == math.inf


def test_clearance_is_the_distance_of_the_edge_from_the_nearest_obstacle():
    path = path_from_arcs(START, [(0.0, 4.0)], BODY)
    world = World((Circle(0.0, 0.4, 0.1), Circle(0.0, -0.5, 0.1)))
    assert Checker(world, BODY).clearance(path) == pytest.approx(0.25, abs=2e-4)
    assert Checker(World(), BODY).clearance(path) == pytest.approx(
        MAX_CLEARANCE_M, abs=2e-4
    )


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", first_by_default(1, bodies()))
def test_ends_of_a_known_path_are_never_disconnected(kind, name):
    body = bodies()[name]
    for seed in range(100, 103):
        case = drawn(kind, seed, body).problem
        assert not is_disconnected(case.start, case.goal, case.world, body.narrowest)
