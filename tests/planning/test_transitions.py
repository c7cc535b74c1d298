"""Transition arcs: agreement with measured jumps, and plans that contain them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from plan_sampling import TOUCH, deepest, joints, misses

from srs_twin.planning import planner
from srs_twin.planning.arcs import arc_end
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.path import Segment, path_from_arcs
from srs_twin.planning.planner import plan, plan_with_transitions, with_transitions
from srs_twin.planning.problem import Problem, Settings
from srs_twin.robot.world import Bounds, Circle, Goal, Pose, World
from srs_twin.scenario.loading import load_scenario, parse_scenario

LEARNT = load_footprint("gen4_ilc")
OPEN = load_footprint("gen2_gait")
START = Pose(0.0, 0.0, 0.0)
FIELD = World(
    (Circle(0.9, 0.05, 0.1), Circle(1.7, -0.25, 0.12)), Bounds((-0.5, 3.0), (-1.0, 1.0))
)
GOAL = Goal(2.4, 0.3, 0.0, 0.05)


def curvature(footprint, offset):
    return footprint.curvatures[footprint.offsets.index(offset)]


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    "t", LEARNT.transients, ids=lambda t: f"{t.before:g} to {t.after:g}"
)
def test_transition_arcs_end_on_the_measured_path(t):
    """Compare the measured jump, at most 71 mm, with the transition arcs from where the command takes
    effect."""
    old, new = (curvature(LEARNT, offset) for offset in (t.before, t.after))
    path = with_transitions(
        path_from_arcs(START, [(old, 1.0), (new, 1.0)], LEARNT), LEARNT
    )
    assert len(path) == 3
    command = path[1].start
    settled = path[2]
    c = math.cos(command.heading)
    s = math.sin(command.heading)
    jumped = Pose(
        command.x + c * t.dx - s * t.dy,
        command.y + s * t.dx + c * t.dy,
        command.heading + t.dheading,
    )
    # Where the measured arc is after as much turning as the shaped path has done since.
    x, y, heading = arc_end(jumped.x, jumped.y, jumped.heading, new, path[1].length)
    if new:
        x, y, heading = arc_end(
            x, y, heading, new, (settled.start.heading - heading) / new
        )
    assert settled.start.heading == pytest.approx(heading, abs=0.02)
    beside = math.cos(heading) * (settled.start.y - y) - math.sin(heading) * (
        settled.start.x - x
    )
    assert abs(beside) < 0.012


def test_transition_arcs_keep_the_heading_and_turn_no_tighter():
    planned = path_from_arcs(START, [(1.0, 0.8), (-1.5, 0.8), (0.0, 0.5)], LEARNT)
    path = with_transitions(planned, LEARNT)
    assert path[-1].end.heading == pytest.approx(planned[-1].end.heading)
    assert sum(s.length for s in path) == pytest.approx(sum(s.length for s in planned))
    assert max(abs(s.curvature) for s in path) <= 1.5
    steps = [
        abs(b.curvature - a.curvature) for a, b in zip(path, path[1:], strict=False)
    ]
    assert max(steps) < 2.5 - 0.5


def test_changes_without_room_or_measurement_stay_jumps():
    short = path_from_arcs(START, [(1.0, 0.1), (-1.0, 0.1)], LEARNT)
    assert with_transitions(short, LEARNT) == short
    long = path_from_arcs(START, [(1.0, 0.8), (-1.0, 0.8)], LEARNT)
    assert with_transitions(long, replace(LEARNT, transients=())) == long
    assert with_transitions((), LEARNT) == ()


def test_plan_with_transitions_is_free_and_arrives():
    body = LEARNT.reduced(0.8, 0.03)
    problem = Problem(Pose(0.4, 0.0, 0.0), GOAL, FIELD, body)
    begin = (Segment(START, 0.0, 0.4, 0.0, 0.18),)
    answer = plan_with_transitions(problem, Settings(), begin)
    assert (
        answer.found
        and answer.reason == "a free path"
        and answer.segments[0].start == START
    )
    whole = replace(problem, start=START)
    assert (
        deepest(answer, whole) < TOUCH
        and joints(answer, whole) < 1e-6
        and not misses(answer, whole)
    )
    planned = (0.0, 0.5 * body.tightest[1], body.tightest[1])
    between = [
        s
        for s in answer.segments
        if min(abs(abs(s.curvature) - k) for k in planned) > 0.05
    ]
    assert len(between) >= 2, "changes have an arc between"


def test_plan_from_the_goal_needs_no_transitions():
    answer = plan_with_transitions(
        Problem(START, Goal(0.0, 0.0, None, 0.05), FIELD, LEARNT), Settings()
    )
    assert answer.found and answer.segments == () and "jumps" not in answer.reason


def test_nodes_and_time_are_totals_of_all_searches(monkeypatch):
    made = []

    def counted(problem, settings):
        made.append(plan(problem, settings))
        return made[-1]

    monkeypatch.setattr(planner, "plan", counted)
    answer = plan_with_transitions(
        Problem(START, GOAL, FIELD, LEARNT.reduced(0.8, 0.03)), Settings()
    )
    assert len(made) > 1
    assert answer.expanded == sum(each.expanded for each in made)
    assert answer.seconds >= max(each.seconds for each in made) > 0


@pytest.mark.slow
def test_reason_reports_a_plan_without_transitions():
    tight = World(
        (Circle(0.5, 0.25, 0.1), Circle(0.5, -0.25, 0.1), Circle(1.0, 0.02, 0.11)),
        FIELD.bounds,
    )
    answer = plan_with_transitions(
        Problem(START, Goal(1.3, 0.0, 0.0, 0.001, 0.0), tight, OPEN.reduced(0.4)),
        Settings(),
    )
    assert answer.found and "without transition arcs" in answer.reason


def test_shape_changes_of_a_scenario_plans_transitions():
    document = dict(load_scenario("follow_gen4_b").document)
    plans = [
        parse_scenario(
            {**document, "planner": {**document["planner"], "shape_changes": shape}}
        ).planner.plan()
        for shape in (False, True)
    ]
    assert all(answer.found for answer in plans)
    assert (
        plans[0].segments[0].length == pytest.approx(0.8)
        and plans[1].segments[0].length < 0.8
    )
    assert len(plans[1].segments) > len(plans[0].segments)
