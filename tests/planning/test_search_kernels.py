"""Open list, closed set and grid distances, compared with plain Python."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from rectangles import rectangle

from srs_twin.planning.guidance import NO_HEURISTIC, grid_distance, grid_heuristic
from srs_twin.planning.search_kernels import (
    NODES,
    OPEN,
    cell_slot,
    empty_frontier,
    enlarged,
    pop,
    push,
)
from srs_twin.robot.world import Bounds, Circle, Goal, Pose, World

pytestmark = pytest.mark.fast

START = Pose(0.2, 0.5, 0.0)
GOAL = Goal(1.8, 0.5, None, 0.02)
FLOOR = Bounds((0.0, 2.0), (0.0, 1.0))


@given(st.lists(st.floats(-5, 5), min_size=1, max_size=60), st.integers(0, 30))
def test_heap_pops_nodes_in_key_order(keys, early):
    frontier = empty_frontier(64)
    for node, key in enumerate(keys):
        push(frontier, node, key)
    taken = [pop(frontier) for _ in range(min(early, len(keys)))]
    for node in taken:
        push(frontier, node, keys[node])
    order = [keys[pop(frontier)] for _ in keys]
    assert order == sorted(keys)
    assert frontier.counts[OPEN] == 0


@given(
    st.lists(
        st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-9, 9)),
        min_size=1,
        max_size=60,
    )
)
def test_poses_share_a_slot_exactly_if_they_share_a_cell(poses):
    cell = 0.5
    sector = math.pi / 6
    frontier = empty_frontier(64)
    slots = {}
    # Headings on the border of two sectors may fall into either.
    poses = [p for p in poses if abs(math.remainder(p[2] / sector, 1)) >= 1e-9]
    for k, (x, y, heading) in enumerate(poses):
        turned = (heading / sector) % 12
        name = (math.floor(x / cell), math.floor(y / cell), math.floor(turned))
        slot = cell_slot(frontier, x, y, heading, cell, sector)
        assert slots.setdefault(name, slot) == slot
        if frontier.owners[slot] == 0:
            frontier.owners[slot] = k + 1
            frontier.counts[NODES] += 1
    assert len(set(slots.values())) == len(slots)
    larger = enlarged(frontier)
    for pose in poses:
        before, after = (cell_slot(f, *pose, cell, sector) for f in (frontier, larger))
        assert frontier.owners[before] == larger.owners[after] > 0


def test_grid_distance_is_the_straight_distance_without_obstacles():
    guide = grid_heuristic(GOAL, START, World(bounds=FLOOR), 0.02, 1.0)
    for x, y in np.random.default_rng(0).uniform((0.05, 0.05), (1.95, 0.95), (200, 2)):
        straight = math.hypot(x - GOAL.x, y - GOAL.y)
        assert (
            straight - 2 * guide.cell
            <= grid_distance(guide, x, y)
            <= 1.0824 * straight + 2 * guide.cell
        )


def test_grid_distance_goes_round_walls_and_is_zero_in_closed_rooms():
    wall = rectangle(0.95, 1.05, -0.1, 0.8)
    guide = grid_heuristic(GOAL, START, World((), FLOOR, None, (wall,)), 0.05, 1.0)
    over = math.hypot(0.7, 0.35) + 0.2 + math.hypot(0.7, 0.35)
    assert over - 0.05 <= grid_distance(guide, START.x, START.y) <= 1.09 * over + 0.05
    assert grid_distance(guide, 1.0, 0.4) == 0
    ring = tuple(
        Circle(1.8 + 0.15 * math.cos(a), 0.5 + 0.15 * math.sin(a), 0.05)
        for a in np.arange(12) * math.pi / 6
    )
    closed = grid_heuristic(GOAL, START, World(ring, FLOOR), 0.02, 1.0)
    assert grid_distance(closed, START.x, START.y) == 0


def test_grid_distance_without_bounds_goes_round_all_obstacles():
    wall = rectangle(0.95, 1.05, -2.0, 2.0)
    guide = grid_heuristic(GOAL, START, World((), None, None, (wall,)), 0.05, 0.5)
    assert grid_distance(guide, START.x, START.y) == pytest.approx(
        2 * math.hypot(0.7, 1.55) + 0.2, rel=0.1
    )
    assert (
        grid_distance(guide, 50.0, 50.0) == 0 == grid_distance(NO_HEURISTIC, 0.0, 0.0)
    )
