"""Edges of the body along a path, bounds and nearest obstacles."""

from __future__ import annotations

import math

import numpy as np
import pytest

from srs_twin.planning.arcs import Primitives
from srs_twin.planning.collision import (
    Checker,
    obstacle_at,
    obstacle_grid,
)
from srs_twin.planning.footprint import Footprint, Transient
from srs_twin.planning.free_space import min_path_length
from srs_twin.planning.guidance import find_passages
from srs_twin.planning.path import path_from_arcs
from srs_twin.planning.primitives import (
    follow_arc,
    initial_state,
    make_motion_primitives,
)
from srs_twin.robot.world import Bounds, Circle, Goal, Polygon, Pose, World

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
    return (
        Checker(world, BODY).is_path_free(
            path_from_arcs(Pose(0.0, 0.0, 0.0), pieces, BODY)
        ),
        free,
    )


def pin(pieces: list[tuple[float, float]], piece: int, s: float, n: float) -> World:
    """Return a world with a thin pin, s ahead of the start of a piece and n to its left, m."""
    x, y, heading = path_from_arcs(Pose(0.0, 0.0, 0.0), pieces, BODY)[piece].start
    c = math.cos(heading)
    sn = math.sin(heading)
    return World((Circle(x + c * s - sn * n, y + sn * s + c * n, STEP),))


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    ("s", "n", "out"),
    [
        pytest.param(
            0.3, 0.05 + 0.02, (0, 1), id="left, just after the change of offset"
        ),
        pytest.param(
            0.3, -0.07 - 0.03, (0, -1), id="right, just after the change of offset"
        ),
        pytest.param(0.8, 0.05, (0, 1), id="left, settled"),
        pytest.param(0.8, -0.07, (0, -1), id="right, settled"),
        pytest.param(0.4 + 0.11, 0.06, (1, 0), id="left, where the change has settled"),
        pytest.param(
            0.4 + 0.11, -0.09, (1, 0), id="right, where the change has settled"
        ),
        pytest.param(1.0 + 0.11, 0.0, (1, 0), id="head"),
    ],
)
def test_body_collides_exactly_at_its_edges(s, n, out):
    pieces = [BEND, STRAIGHT]
    for beyond, free in ((2 * STEP, True), (0.0, False)):
        world = pin(pieces, 1, s + beyond * out[0], n + beyond * out[1])
        assert frees(pieces, world) == (free, free)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    ("s", "n", "out"),
    [
        (0.5, 0.05, (0, 1)),
        (0.5, -0.07, (0, -1)),
        (-0.13, 0.0, (-1, 0)),
        (1.11, 0.0, (1, 0)),
    ],
    ids=["left", "right", "tail", "head"],
)
def test_path_from_rest_has_steady_edges(s, n, out):
    for beyond, free in ((2 * STEP, True), (0.0, False)):
        world = pin([STRAIGHT], 0, s + beyond * out[0], n + beyond * out[1])
        assert frees([STRAIGHT], world) == (free, free)


@pytest.mark.parametrize(
    ("between", "left"), [(0.2, 0.045), (0.7, 0.02)], ids=["lasting", "over"]
)
def test_overlapping_transients_use_the_wider_edges(between, left):
    """The first change has the wider left edge, the second the wider right edge."""
    pieces = [(0.0, 0.2), (2.0, between), STRAIGHT]
    for n, out in ((0.05 + left, 1), (-0.07 - 0.03, -1)):
        for beyond, free in ((2 * STEP, True), (0.0, False)):
            assert frees(pieces, pin(pieces, 2, 0.3, n + beyond * out)) == (free, free)


ROOM = Bounds((-1.0, 2.0), (-3.0, 4.0))
WALLS = {
    "west": (-1.0, 0.5, -1, 0),
    "east": (2.0, 0.5, 1, 0),
    "south": (0.5, -3.0, 0, -1),
    "north": (0.5, 4.0, 0, 1),
}


@pytest.fixture(params=WALLS)
def wall(request):
    return WALLS[request.param]


@pytest.mark.default_cases(3)
def test_crossing_a_bound_is_reported_on_each_side(wall):
    x, y, east, north = wall
    world = World(bounds=ROOM)
    said = "the bounds (x -1 to 2 m, y -3 to 4 m)"
    body = Footprint.box(0.05, 0.0, speed=0.2, curvature=2.0, ahead=0.09)
    for gap, hit in ((0.001, ""), (-0.001, said)):
        assert obstacle_at(world, x - gap * east, y - gap * north) == hit
        facing = Pose(
            x - (0.09 + gap) * east, y - (0.09 + gap) * north, math.atan2(north, east)
        )
        assert Checker(world, body).first_collision(facing) == hit
        sideways = Pose(
            x - (0.025 + gap) * east,
            y - (0.025 + gap) * north,
            facing.heading + math.pi / 2,
        )
        assert Checker(world, body).first_collision(sideways) == hit


def turned(world: World, quarters: int) -> World:
    """Return the world after quarter turns to the left about the origin."""
    if quarters == 0:
        return world
    (west, east), (south, north) = world.bounds.x, world.bounds.y
    circles = tuple(Circle(-c.y, c.x, c.radius) for c in world.obstacles)
    polygons = tuple(
        Polygon(tuple((-y, x) for x, y in p.corners)) for p in world.polygons
    )
    return turned(
        World(circles, Bounds((-north, -south), (west, east)), None, polygons),
        quarters - 1,
    )


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("quarters", range(4))
def test_least_length_respects_each_bound(quarters):
    """The shortest path passes the near end of a wall if the gap to the bound is wide enough."""
    start, goal = (complex(x, 0.0) * 1j**quarters for x in (-2.0, 2.0))
    for gap, around in ((0.099, 3.0), (0.101, 0.5)):
        wall = Polygon(((-0.01, -3.0), (0.01, -3.0), (0.01, 0.5), (-0.01, 0.5)))
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


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("quarters", range(4))
def test_passages_at_a_bound_rotate_with_the_world(quarters):
    world = World((Circle(0.0, -0.5, 0.35),), Bounds((-9, 9), (-9, 0.15)))
    body = Footprint.box(0.2, 0.0, speed=0.2, curvature=2.0)

    def passages(world: World) -> np.ndarray:
        x, y, heading, through = find_passages(world, body).T
        rows = np.column_stack([x, y, np.cos(heading), np.sin(heading), through])
        return rows[np.lexsort(rows.round(6).T)]

    c = round(math.cos(quarters * math.pi / 2))
    s = round(math.sin(quarters * math.pi / 2))
    turn = np.array([[c, s], [-s, c]])
    before = passages(world)
    assert len(before)
    expected = np.column_stack(
        [before[:, :2] @ turn, before[:, 2:4] @ turn, before[:, 4]]
    )
    expected = expected[np.lexsort(expected.round(6).T)]
    assert passages(turned(world, quarters)) == pytest.approx(expected, abs=1e-6)
