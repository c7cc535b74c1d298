"""Planner of the dissertation: chosen arcs, joint and outcomes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st
from plan_sampling import TOUCH, deepest

from srs_twin.errors import InputError
from srs_twin.planning.arcs import Primitives, arc_end
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.greedy import arc_through
from srs_twin.planning.planner import plan
from srs_twin.planning.problem import Outcome, Problem
from srs_twin.robot.world import (
    FIG54_GOAL,
    FIG54_START,
    Circle,
    Goal,
    Pose,
    World,
    fig54_world,
)

TEXT = load_footprint("gen2_section52")
ARCS = Primitives(21, math.pi / 3, 0.2)


def fig54(count: int, seed: int) -> Problem:
    return Problem(FIG54_START, FIG54_GOAL, fig54_world(count, seed), TEXT, ARCS)


@given(
    st.floats(-2, 2),
    st.floats(-2, 2),
    st.floats(-3, 3),
    st.floats(-2, 2),
    st.floats(-2, 2),
)
def test_arc_through_passes_the_point(x, y, heading, to_x, to_y):
    curvature, length = arc_through(Pose(x, y, heading), to_x, to_y)
    if math.isfinite(length) and length < 50:
        end = arc_end(x, y, heading, curvature, length)
        assert end[:2] == pytest.approx((to_x, to_y), abs=1e-6)
        assert length >= math.hypot(to_x - x, to_y - y) - 1e-9
    assert math.isinf(arc_through(Pose(0, 0, 0), -1, 0)[1])


def test_fig_53_turns_toward_the_target_from_both_ends():
    goal = Goal(2.0, 1.0, -math.pi / 4 + math.pi, radius=0.02)
    body = Footprint.box(0.05, 0.01, speed=1.0, curvature=math.pi / 3 / 0.5)
    problem = Problem(
        Pose(0.0, 0.0, -math.pi / 4),
        goal,
        World(),
        body,
        Primitives(5, math.pi / 3, 0.5),
    )
    answer = plan(problem, planner="greedy")
    assert answer.found
    first = answer.segments[0]
    last = answer.segments[-1]
    # The nearest of the five children is the one that turns left by alpha_max; so on
    # the other side.
    assert first.curvature == pytest.approx(math.pi / 3 / 0.5) == last.curvature
    assert (answer.end.x, answer.end.y) == pytest.approx((2.0, 1.0))
    assert math.remainder(
        answer.end.heading - goal.heading, 2 * math.pi
    ) == pytest.approx(0)
    for s in answer.segments:
        step = s.length * s.curvature / (math.pi / 6)
        assert s.length < 0.5 or step == pytest.approx(round(step))


def test_first_arc_has_the_lowest_score():
    problem = fig54(0, 0)
    start = problem.start
    goal = problem.goal
    scores = [
        0.001 * abs(i - 10) + arc_through(child, goal.x, goal.y)[1]
        for i, child in enumerate(ARCS.children(start))
    ]
    first = plan(problem, planner="greedy").segments[0]
    assert first.curvature == pytest.approx(ARCS.curvatures[int(np.argmin(scores))])


def test_colliding_arcs_are_not_chosen():
    problem = fig54(0, 0)
    free = plan(problem, planner="greedy")
    middle = free.segments[1].end
    world = World((Circle(middle.x, middle.y, 0.05),), problem.world.bounds)
    blocked = replace(problem, world=world)
    assert deepest(free, blocked) > TOUCH
    answer = plan(blocked, planner="greedy")
    assert answer.segments and deepest(answer, blocked) < TOUCH


@pytest.mark.parametrize("count", [1, 3, 5, 8])
def test_greedy_plans_are_free_with_a_kink_at_the_joint_only(count):
    found = 0
    for seed in range(8):
        problem = fig54(count, seed)
        answer = plan(problem, planner="greedy")
        if answer.found:
            found += 1
            assert deepest(answer, problem) < TOUCH
            ends = [problem.start, *(s.end for s in answer.segments)]
            jumps = [
                abs(math.remainder(a.heading - s.start.heading, 2 * math.pi))
                for a, s in zip(ends, answer.segments, strict=False)
            ]
            assert sum(jump > 1e-6 for jump in jumps) <= 1
            assert all(
                math.hypot(a.x - s.start.x, a.y - s.start.y) < 1e-9
                for a, s in zip(ends, answer.segments, strict=False)
            )
        else:
            assert (
                answer.outcome is Outcome.STUCK and "does not go back" in answer.reason
            )
    assert found


def test_success_falls_with_obstacles_and_the_default_solves_what_greedy_solves():
    solved = {}
    for count in (1, 9, 18):
        answers = [
            (plan(fig54(count, seed), planner="greedy"), plan(fig54(count, seed)))
            for seed in range(15)
        ]
        assert all(default.found for greedy, default in answers if greedy.found)
        solved[count] = sum(greedy.found for greedy, _ in answers)
    assert solved[1] > solved[9] > solved[18]


def test_reversing_a_footprint_twice_restores_it():
    body = load_footprint("gen4_table8")
    back = body.backward
    assert back.backward == body
    for k in body.curvatures:
        assert (back.at(-k).left, back.at(-k).right) == (
            body.at(k).right,
            body.at(k).left,
        )


def test_greedy_requires_primitives_and_an_arrival_heading():
    problem = fig54(1, 0)
    with pytest.raises(InputError, match="greedy needs primitives"):
        plan(
            Problem(problem.start, problem.goal, problem.world, TEXT), planner="greedy"
        )
    with pytest.raises(InputError, match="a goal with a heading"):
        plan(
            Problem(problem.start, Goal(2, 1, None, 0.1), problem.world, TEXT, ARCS),
            planner="greedy",
        )
