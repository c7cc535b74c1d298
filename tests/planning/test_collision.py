"""Edges of the body along a path, bounds and nearest obstacles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rectangles import rectangle, turned

from srs_twin.planning.arcs import Primitives
from srs_twin.planning.collision import (
    Checker,
    obstacle_at,
    obstacle_grid,
)
from srs_twin.planning.footprint import Footprint, Transient
from srs_twin.planning.free_space import min_path_length
from srs_twin.planning.path import path_from_arcs
from srs_twin.planning.primitives import (
    follow_arc,
    initial_state,
    make_motion_primitives,
)
from srs_twin.robot.world import Bounds, Circle, Goal, Pose, World

BODY = Footprint(
    "unequal",
    "no two numbers are the same",
    (-0.3, 0.0, 0.3),
    (-2.0, 0.0, 2.0),
    (0.2, 0.2, 0.2),
    left=(0.06, 0.05, 0.04),
    right=(0.03, 0.07, 0.08),
    ahead=0.11,
    behind=0.13,
    transients=(
        Transient(0.3, 0.0, 0.02, 0.03, 0.4),
        Transient(0.0, 0.3, 0.045, 0.01, 0.6),
    ),
)
ORIGIN = Pose(0.0, 0.0, 0.0)
BEND = (2.0, 0.3)
STRAIGHT = (0.0, 1.0)
STEP = 1e-4


def frees(pieces: list[tuple[float, float]], world: World) -> tuple[bool, bool]:
    """Return whether a path from the origin is free, by the plan checker and by the search."""
    moves = make_motion_primitives(Primitives(3, 0.4, 0.2), BODY)
    free = True
    way = initial_state(0.0, 0.0, 0.0, moves)
    for curvature, length in pieces:
        move = int(np.argmin(abs(moves.curvatures - curvature)))
        passed, way = follow_arc(way, move, length, moves, obstacle_grid(world))
        free = free and bool(passed)
    path = path_from_arcs(ORIGIN, pieces, BODY)
    return Checker(world, BODY).is_path_free(path), free


def pin(pieces: list[tuple[float, float]], piece: int, s: float, n: float) -> World:
    """Return a world with a thin pin, s ahead of the start of a piece and n to its left, m."""
    x, y, heading = path_from_arcs(ORIGIN, pieces, BODY)[piece].start
    c = math.cos(heading)
    sn = math.sin(heading)
    return World((Circle(x + c * s - sn * n, y + sn * s + c * n, STEP),))


@pytest.mark.parametrize(
    ("pieces", "s", "n", "out"),
    [
        # A path from rest has steady edges from its start.
        pytest.param([STRAIGHT], 0.1, 0.05, (0, 1), id="left"),
        pytest.param([STRAIGHT], 0.1, -0.07, (0, -1), id="right"),
        pytest.param([STRAIGHT], -0.13, 0.0, (-1, 0), id="tail"),
        pytest.param([STRAIGHT], 1.0 + 0.11, 0.0, (1, 0), id="head"),
        # Transients widen the edges after the change of offset.
        pytest.param([BEND, STRAIGHT], 0.3, 0.05 + 0.02, (0, 1), id="left, changed"),
        pytest.param([BEND, STRAIGHT], 0.3, -0.07 - 0.03, (0, -1), id="right, changed"),
        pytest.param([BEND, STRAIGHT], 0.4 + 0.11, 0.06, (1, 0), id="left, settled"),
        pytest.param([BEND, STRAIGHT], 0.4 + 0.11, -0.09, (1, 0), id="right, settled"),
    ],
)
def test_body_collides_exactly_at_its_edges(pieces, s, n, out):
    last = len(pieces) - 1
    for beyond, free in ((2 * STEP, True), (0.0, False)):
        world = pin(pieces, last, s + beyond * out[0], n + beyond * out[1])
        assert frees(pieces, world) == (free, free)


@pytest.mark.parametrize(
    ("between", "left"), [(0.2, 0.045), (0.7, 0.02)], ids=["lasting", "over"]
)
def test_overlapping_transients_use_the_wider_edges(between, left):
    """The first change has the wider left edge, the second the wider right edge."""
    pieces = [(0.0, 0.2), (2.0, between), STRAIGHT]
    for n, out in ((0.05 + left, 1), (-0.07 - 0.03, -1)):
        for beyond, free in ((2 * STEP, True), (0.0, False)):
            assert frees(pieces, pin(pieces, 2, 0.3, n + beyond * out)) == (free, free)


@pytest.mark.parametrize(
    ("x", "y", "east", "north"),
    [(-1.0, 0.5, -1, 0), (2.0, 0.5, 1, 0), (0.5, -3.0, 0, -1), (0.5, 4.0, 0, 1)],
    ids=["west", "east", "south", "north"],
)
def test_crossing_a_bound_is_reported_on_each_side(x, y, east, north):
    world = World(bounds=Bounds((-1.0, 2.0), (-3.0, 4.0)))
    said = "the bounds (x -1 to 2 m, y -3 to 4 m)"
    body = Footprint.box(0.05, 0.0, speed=0.2, curvature=2.0, ahead=0.09)
    for gap, hit in ((0.001, ""), (-0.001, said)):
        assert obstacle_at(world, x - gap * east, y - gap * north) == hit
        facing = math.atan2(north, east)
        for reach, heading in ((0.09, facing), (0.025, facing + math.pi / 2)):
            far = reach + gap
            pose = Pose(x - far * east, y - far * north, heading)
            assert Checker(world, body).first_collision(pose) == hit


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("quarters", range(4))
def test_least_length_respects_each_bound(quarters):
    """The shortest path passes the near end of a wall if the gap to the bound is wide enough."""
    start, goal = (complex(x, 0.0) * 1j**quarters for x in (-2.0, 2.0))
    for gap, around in ((0.099, 3.0), (0.101, 0.5)):
        wall = rectangle(-0.01, 0.01, -3.0, 0.5)
        world = turned(
            World((), Bounds((-9, 9), (-9, 0.5 + gap)), None, (wall,)), quarters
        )
        ends = Pose(start.real, start.imag, 0.0), Goal(goal.real, goal.imag, None, 0.0)
        found = min_path_length(*ends, world, 0.05)
        assert (
            2 * math.hypot(1.99, around)
            < found
            < 2 * math.hypot(2.0, around + 0.06) + 0.02
        )
