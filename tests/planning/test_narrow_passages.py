"""Narrow passages: their entry poses, and plans through gaps hardly wider than the body."""

from __future__ import annotations

import math

import numpy as np
import pytest
from plan_sampling import TOUCH, deepest, misses
from rectangles import rectangle, turned
from subsets import first_by_default
from witnessed_worlds import bodies, walls

from srs_twin.planning.collision import Checker
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.guidance import find_passages
from srs_twin.planning.path import path_from_arcs
from srs_twin.planning.planner import plan
from srs_twin.robot.world import Bounds, Circle, Pose, World

BODY = load_footprint("gen4_table8")


ABOVE = rectangle(-0.1, 0.1, 0.15, 0.35)
BELOW = rectangle(-0.1, 0.1, -0.35, -0.15)


AT_A_BOUND = World((Circle(0.0, -0.5, 0.35),), Bounds((-9, 9), (-9, 0.15)))


@pytest.mark.parametrize(
    ("world", "quarters"),
    [
        (World((Circle(0.0, 0.5, 0.35), Circle(0.0, -0.5, 0.35))), 0),
        (World(polygons=(ABOVE, BELOW)), 0),
        (World((Circle(0.0, -0.5, 0.35),), polygons=(ABOVE,)), 0),
        *((AT_A_BOUND, quarters) for quarters in range(4)),
    ],
)
def test_passages_lead_straight_through_the_middle_of_a_gap(world, quarters):
    world = turned(world, quarters)
    passages = find_passages(world, BODY)
    assert len(passages)
    straight = BODY.at(0.0)
    for x, y, heading, through in passages:
        path = path_from_arcs(Pose(x, y, heading), [(0.0, through)], BODY)
        assert Checker(world, BODY).is_path_free(path)
        # In the world that is not turned, the gap is along x.
        place = complex(x, y) / 1j**quarters
        direction = heading - quarters * math.pi / 2
        assert math.remainder(direction, math.pi) == pytest.approx(0.0, abs=1e-6)
        along = math.cos(direction)
        middle = place.imag + along * (straight.left - straight.right) / 2
        assert middle == pytest.approx(0.0, abs=1e-6)
        assert place.real * along < 0 < place.real * along + through


def test_entry_poses_allow_for_transients_and_round_obstacles():
    """The entry is 1 mm ahead of the gap, or farther by the longest transient, or by 0.3 widths more."""
    body = load_footprint("gen2_gait")
    straight = body.at(0.0)
    width = straight.left + straight.right
    settled = max(each.length for each in body.transients)
    early = settled + 0.3 * width
    passages = find_passages(
        World(tuple(Circle(0.0, y, 0.5 - 0.75 * width) for y in (-0.5, 0.5))), body
    )
    lead_ins = np.unique(np.round(passages[:, 3] - body.behind, 9))
    assert lead_ins == pytest.approx(body.ahead + 1e-3 + np.array([0, settled, early]))
    assert np.abs(passages[:, 0]) == pytest.approx(passages[:, 3] - body.behind)


def test_gaps_too_narrow_too_wide_or_filled_are_no_passages():
    def pair(gap: float, *more: Circle) -> World:
        return World(
            (Circle(0.0, gap / 2 + 0.3, 0.3), Circle(0.0, -gap / 2 - 0.3, 0.3), *more)
        )

    assert len(find_passages(pair(0.3), BODY))
    assert not len(find_passages(pair(0.19), BODY)) and not len(
        find_passages(pair(0.6), BODY)
    )
    assert not len(find_passages(pair(0.3, Circle(0.01, 0.0, 0.05)), BODY))


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("ratio", first_by_default(1, [1.05, 1.3]))
@pytest.mark.parametrize("name", bodies())
def test_plans_pass_narrow_gaps(name, ratio):
    """Two walls from bound to bound, each with one gap, 1.05 or 1.3 times as wide as the straight body."""
    case = walls(2, bodies()[name], ratio, 2)
    answer = plan(case.problem)
    assert answer.found, answer.reason
    assert deepest(answer, case.problem) <= TOUCH and not misses(answer, case.problem)
