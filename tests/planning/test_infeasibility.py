"""Proofs of infeasibility: dead ends are proven, feasible problems never are."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from plan_sampling import TOUCH, deepest, misses
from subsets import first_by_default
from witnessed_worlds import KINDS, bodies, drawn

from srs_twin.planning.arcs import arc_end
from srs_twin.planning.collision import obstacle_grid
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.infeasibility import COARSE, FINE, _step_boxes, prove_unreachable
from srs_twin.planning.planner import plan
from srs_twin.planning.problem import Problem
from srs_twin.robot.world import Bounds, Goal, Polygon, Pose, World

BODY = load_footprint("gen4_table8")


def pocket(half: float, depth: float = 0.8, thick: float = 0.05) -> World:
    """Return walls around the origin that are open on the left."""
    top = Polygon(
        ((-depth, half), (depth, half), (depth, half + thick), (-depth, half + thick))
    )
    end = Polygon(
        (
            (depth, -half - thick),
            (depth + thick, -half - thick),
            (depth + thick, half),
            (depth, half),
        )
    )
    below = Polygon(tuple((x, -y) for x, y in top.corners))
    return World(bounds=Bounds((-4.0, 3.0), (-3.0, 3.0)), polygons=(top, end, below))


def problem(world: World, heading: float) -> Problem:
    return Problem(
        Pose(-3.0, 0.0, 0.0), Goal(0.0, 0.0, heading, 0.02, 0.1), world, BODY
    )


def test_dead_end_is_reached_facing_in_and_proven_infeasible_facing_out():
    inwards, outwards = (
        plan(problem(pocket(0.12), heading)) for heading in (0.0, math.pi)
    )
    assert inwards.found
    assert outwards.proven and "the goal has too little room" in outwards.reason


def test_dead_end_at_the_start_is_proven():
    out = problem(pocket(0.12), 0.0)
    back = Problem(
        Pose(0.0, 0.0, 0.0), Goal(-3.0, 0.0, 0.0, 0.02, 0.1), out.world, BODY
    )
    answer = plan(back)
    assert answer.proven and "the start has too little room" in answer.reason


@pytest.mark.parametrize("quarters", range(4))
def test_dead_end_between_bounds_is_proven_in_every_direction(quarters):
    """The bounds are a corridor; the goal faces away from its closed end."""
    turn = 1j**quarters
    start = -3.0 * turn
    angle = quarters * math.pi / 2
    for half, proven in ((0.12, "goal"), (1.7, "")):
        ends = np.array([complex(-3.4, -half), complex(0.8, half)]) * turn
        x, y = (
            tuple(sorted(each.round(9).tolist())) for each in (ends.real, ends.imag)
        )
        goal = Goal(0.0, 0.0, angle + math.pi, 0.02, 0.1)
        around = obstacle_grid(World(bounds=Bounds(x, y)))
        assert (
            prove_unreachable(
                Pose(start.real, start.imag, angle), goal, BODY, around, COARSE
            )
            == proven
        )


def test_dead_end_with_room_to_turn_is_not_infeasible():
    wide = problem(pocket(1.7), math.pi)
    answer = plan(wide)
    assert answer.found and deepest(answer, wide) < TOUCH and not misses(answer, wide)


def test_goal_without_heading_in_a_dead_end_is_reached():
    free = problem(pocket(0.12), 0.0)
    free = replace(free, goal=replace(free.goal, heading=None))
    assert plan(free).found


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", first_by_default(1, bodies()))
def test_feasible_problems_are_never_proven_infeasible(kind, name):
    body = bodies()[name]
    for seed in range(100, 103):
        case = drawn(kind, seed, body).problem
        for how in (COARSE, FINE):
            assert (
                prove_unreachable(
                    case.start, case.goal, body, obstacle_grid(case.world), how
                )
                == ""
            )


# gen2_gait turns within little more than its width; gen4_ilc needs more cells than the
# limit.
PROVEN = [each for each in bodies() if each not in ("gen2_gait", "gen4_ilc")]


@pytest.mark.parametrize("name", PROVEN)
def test_goals_facing_out_of_dead_ends_are_proven_infeasible(name):
    body = bodies()[name]
    for seed in range(3):
        case = drawn("pockets", seed, body).problem
        goal = replace(case.goal, heading=case.goal.heading + math.pi)
        around = obstacle_grid(case.world)
        assert "goal" in [
            prove_unreachable(case.start, goal, body, around, how)
            for how in (COARSE, FINE)
        ]


@settings(max_examples=200, deadline=None)
@given(
    tight=st.floats(0.5, 20.0),
    turn=st.floats(0.05, 0.5),
    shares=st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=12),
)
def test_paths_of_a_step_end_in_the_box_of_their_turn(tight, turn, shares):
    """Sequences of arcs stay within the bounds of turning first to one side and then to the other."""
    step = turn / tight
    sector = 0.1 * turn
    moves = _step_boxes(tight, step, sector)
    x = y = heading = 0.0
    for share in shares:
        x, y, heading = arc_end(x, y, heading, share * tight, step / len(shares))
    for begin in (-0.49, 0.0, 0.49):  # of a sector
        turned = math.floor((begin + 0.5) + heading / sector)
        (row,) = moves[moves[:, 0] == turned]
        assert row[1] <= x <= row[2] and row[3] <= y <= row[4]
    way = [(0.0, 0.0, 0.0)]
    at = (0.0, 0.0, 0.0)
    for share in shares:
        for _ in range(10):
            at = arc_end(*at, share * tight, step / len(shares) / 10)
            way.append(at)
    places = np.array(way)[:, :2]
    chord = np.linspace(0.0, 1.0, len(places))[:, None] * [x, y]
    assert np.hypot(*(places - chord).T).max() <= tight * step**2 / 8 + 1e-9


@pytest.mark.parametrize(
    ("tight", "turn", "parts"), [(4.5, 0.5, 6), (4.5, 0.5, 10), (12.0, 0.3, 8)]
)
def test_boxes_are_as_narrow_as_two_tightest_arcs_allow(tight, turn, parts):
    """A path with the largest turn Δ within two sectors turns left first, then right, as in θ_hi."""
    step = turn / tight
    sector = turn / parts
    for turned, _, _, low, high in _step_boxes(tight, step, sector):
        for side, bound in ((1, high), (-1, -low)):
            most = min((side * turned + 1) * sector, turn)
            first = (step + most / tight) / 2
            _, aside, _ = arc_end(
                *arc_end(0.0, 0.0, 0.0, tight, first), -tight, step - first
            )
            assert aside <= bound <= aside + 3 * step / 64**2
