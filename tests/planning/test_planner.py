"""Default planner: plans are collision-free, rejections have names, and infeasible goals are reported."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st
from plan_sampling import TOUCH, deepest, joints, misses
from plan_worlds import drawn_problem
from rectangles import rectangle

from srs_twin.errors import InputError
from srs_twin.planning.arcs import Primitives, arc_end
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.planner import plan
from srs_twin.planning.primitives import make_motion_primitives
from srs_twin.planning.problem import PlanOutcome, Problem, Settings
from srs_twin.planning.search_kernels import lower_bound
from srs_twin.planning.search_tree import make_target
from srs_twin.robot.world import (
    FIG54_GOAL,
    FIG54_START,
    Bounds,
    Circle,
    Goal,
    Polygon,
    Pose,
    World,
    fig54_world,
)

TEXT = load_footprint("gen2_section52")


def fig54(count: int, seed: int) -> Problem:
    return Problem(FIG54_START, FIG54_GOAL, fig54_world(count, seed), TEXT)


def ring(x: float, count: int) -> tuple[Circle, ...]:
    places = x + 0.4 * np.exp(2j * np.pi * np.arange(count) / count)
    return tuple(Circle(place.real, place.imag, 0.08) for place in places.tolist())


@pytest.mark.default_cases(at=[0, 2, 7, 30, 59])
@pytest.mark.parametrize("seed", range(60))
def test_plans_are_free_continuous_and_reach_the_goal(seed):
    problem = drawn_problem(seed)
    answer = plan(problem)
    if not answer.found:
        assert seed == 2 and answer.segments == () and answer.reason
        return
    assert deepest(answer, problem, 0.006) < TOUCH
    assert joints(answer, problem) < 1e-9 and answer.max_heading_jump == 0
    assert not misses(answer, problem)
    assert answer.least_length <= answer.length + 1e-9
    right, left = problem.footprint.tightest
    for segment in answer.segments:
        assert -right - 1e-9 <= segment.curvature <= left + 1e-9


def test_sampling_checker_detects_obstacles():
    problem = fig54(0, 0)
    answer = plan(problem)
    x, y, _ = answer.samples()[len(answer.samples()) // 2]
    assert deepest(answer, problem) < 0
    blocked = replace(problem, world=World((Circle(float(x), float(y) + 0.06, 0.04),)))
    assert deepest(answer, blocked) > 0.003
    corner = Polygon(((x + 0.01, y), (x + 0.05, y), (x + 0.05, y + 0.04)))
    assert deepest(answer, replace(problem, world=World(polygons=(corner,)))) == 1.0


def test_numbers_of_the_plan_table_are_right_aligned():
    answer = plan(fig54(0, 0))
    page = answer._repr_html_()
    for unit, number in (
        ("m", f"{answer.length:.4g}"),
        ("s", f"{sum(s.length / s.speed for s in answer.segments):.4g}"),
        ("1", len(answer.segments)),
        ("1", answer.expanded),
    ):
        assert f'<td>{unit}</td><td class="number">{number}</td>' in page


def test_fig_53():
    arcs = Primitives(5, math.pi / 3, 0.5)
    body = Footprint.box(0.05, 0.01, speed=1.0, curvature=math.pi / 3 / 0.5)
    goal = Goal(2.0, 1.0, -math.pi / 4 + math.pi, radius=0.02, heading_tolerance=0.05)
    problem = Problem(Pose(0.0, 0.0, -math.pi / 4), goal, World(), body, arcs)
    best = plan(problem)
    assert best.found and not misses(best, problem)
    # Without obstacles it is the Dubins path: left, straight, left.
    assert [
        math.copysign(round(abs(s.curvature), 6) > 0, s.curvature)
        for s in best.segments
    ] == [1, 0, 1]
    assert best.length == pytest.approx(
        lower_bound(0.0, 0.0, -math.pi / 4, make_target(goal, body)), abs=1e-6
    )
    assert best.duration == pytest.approx(best.length)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(("count", "seed"), [(3, 0), (5, 0), (5, 1), (8, 0), (18, 0)])
def test_fig_54(count, seed):
    problem = fig54(count, seed)
    answer = plan(problem)
    assert answer.found
    assert deepest(answer, problem, 0.003) < TOUCH
    assert math.hypot(2, 1) <= answer.length < 1.1 * math.hypot(2, 1)


@given(
    st.floats(-2, 2),
    st.floats(-2, 2),
    st.floats(-4, 4),
    st.integers(0, 8),
    st.floats(0.01, 1),
    st.booleans(),
)
def test_lower_bound_is_consistent(x, y, heading, move, length, free):
    """A bound that is 0 at the goal and consistent exceeds the length of no path."""
    body = load_footprint("gen4_table8")
    moves = make_motion_primitives(Primitives(5, 0.5, 0.4), body)
    curvature = moves.curvatures[move % len(moves.curvatures)]
    target = make_target(Goal(0.3, -0.2, None if free else 1.0, 0.0), body)
    assert lower_bound(0.3, -0.2, 1.0, target) == pytest.approx(0.0, abs=1e-9)
    after = arc_end(x, y, heading, curvature, length)
    assert (
        lower_bound(x, y, heading, target)
        <= length + lower_bound(*after, target) + 1e-6
    )


def test_plans_are_deterministic():
    problem = fig54(12, 3)
    assert plan(problem) == plan(problem)


def test_finer_levels_never_lengthen_a_plan():
    problem = fig54(18, 4)
    first = plan(problem, Settings(smooth=False))
    better = plan(problem, Settings(smooth=False, improve=True, levels=3, nodes=50_000))
    assert better.found and better.length <= first.length
    assert better.expanded > first.expanded


def test_weight_bounds_the_extra_length():
    problem = fig54(18, 4)
    shortest = plan(problem, Settings(smooth=False))
    hasty = plan(problem, Settings(smooth=False, weight=2.0))
    assert hasty.found and shortest.length <= hasty.length <= 2 * shortest.length
    assert hasty.expanded <= shortest.expanded


def test_cost_of_clearance_leads_a_path_farther_from_an_obstacle():
    """The cost of one metre is 1 + w exp(−clearance/width) metres."""
    post = Circle(0.75, 0.06, 0.05)
    problem = walled(world=World((post,)))
    straight = TEXT.at(0.0)
    width = straight.left + straight.right
    weight = 2.0

    def cost(answer):
        x, y, _ = answer.samples(0.001).T
        clearance = np.hypot(x - post.x, y - post.y) - post.radius - width / 2
        near = np.exp(-np.maximum(clearance, 0.0) / width)
        return answer.length * (1 + weight * near.mean()), clearance.min()

    shortest = plan(problem)
    clear = plan(problem, Settings(clearance_weight=weight))
    assert clear.found and deepest(clear, problem) < TOUCH
    assert cost(clear)[0] < cost(shortest)[0]
    assert cost(clear)[1] > cost(shortest)[1] + 0.01
    assert shortest.length < clear.length < shortest.length * (1 + weight)


def test_plan_from_the_goal_is_empty():
    problem = replace(fig54(3, 0), start=Pose(2.0, 1.0, math.pi / 4 + 0.01))
    answer = plan(problem)
    assert answer.found and answer.segments == ()
    assert answer.length == 0 and answer.end is None
    assert answer.samples().shape == (0, 3)


def test_a_time_budget_ends_the_search():
    wall = ring(1.5, 13)
    answer = plan(walled(world=World(wall)), Settings(nodes=10**8, seconds=0.001))
    assert answer.outcome is PlanOutcome.NOT_FOUND and answer.expanded < 10**7


def test_any_arrival_heading():
    goal = replace(FIG54_GOAL, heading=None)
    problem = replace(fig54(10, 2), goal=goal)
    answer = plan(problem)
    assert answer.found and not misses(answer, problem)
    assert answer.length <= plan(fig54(10, 2)).length + 1e-3


ROOM = Bounds((-1, 3), (-1, 1))


def walled(**changes) -> Problem:
    goal = Goal(1.5, 0, 0.0, 0.02)
    return replace(Problem(Pose(0, 0, 0), goal, World(bounds=ROOM), TEXT), **changes)


def test_walled_in_start_without_bounds_is_proven_unreachable():
    wall = ring(0, 14)
    answer = plan(walled(world=World(wall)))
    assert answer.outcome is PlanOutcome.PROVEN_IMPOSSIBLE and answer.segments == ()
    assert "no path of any shape" in answer.reason and "0.03 m" in answer.reason
    # Without the circle towards the goal, there is a path.
    assert plan(walled(world=World(wall[1:]))).found


@pytest.mark.slow
def test_goal_in_a_niche_too_small_to_turn_in_is_not_found():
    """The goal is at a wall that must be approached at right angles, with its heading along the wall."""
    left = rectangle(1.3, 1.4, -0.3, 0.3)
    right = rectangle(1.6, 1.7, -0.3, 0.3)
    lid = rectangle(1.3, 1.7, 0.3, 0.4)
    niche = World((), ROOM, None, (left, right, lid))
    problem = walled(world=niche, goal=Goal(1.5, 0.2, 0.0, 0.01))
    answer = plan(problem)
    assert answer.outcome is PlanOutcome.NOT_FOUND
    assert "no free arc leads back from the goal" in answer.reason
    # With its heading into the niche, the goal is reached.
    assert plan(replace(problem, goal=Goal(1.5, 0.2, math.pi / 2, 0.01))).found


def test_spent_budget_asks_for_more_nodes():
    answer = plan(fig54(18, 0), Settings(nodes=20))
    assert answer.outcome is PlanOutcome.NOT_FOUND and answer.expanded <= 20
    assert "increase `nodes`" in answer.reason


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"start": Pose(5, 0, 0)},
            r"start \(5, 0\) is not free because of the bounds \(x -1 to 3 m",
        ),
        (
            {"world": World((Circle(9, 9, 1), Circle(0, 0.1, 0.2)))},
            r"start \(0, 0\) is not free because of obstacle 2 \(radius 0.2",
        ),
        (
            {"world": World(polygons=(Polygon(((1, -1), (2, -1), (1.5, 1))),))},
            r"goal .* is not free because of polygon 1 \(3 corners",
        ),
        (
            {"world": World((Circle(0, 0.22, 0.2),))},
            "the footprint of the straight body touches obstacle 1",
        ),
        (
            {"start": Pose(-1, 0, 1.57)},
            "the footprint of the straight body touches the bounds",
        ),
        (
            {"goal": Goal(math.nan, 0, 0.0, 0.1)},
            r"goal \(nan, 0\) m is not allowed; both coordinates must be finite",
        ),
        ({"goal": Goal(0, -2001, 0.0, 0.1)}, "finite and between -2000 and 2000"),
        ({"start": Pose(0, 0, math.inf)}, "headings inf and 0 rad"),
        ({"goal": Goal(1, 0, -100.1, 0.1)}, "headings 0 and -100.1 rad"),
        ({"goal": Goal(1, 0, 0.0, -0.1)}, "the radius must be at least 0"),
        ({"goal": Goal(1, 0, 0.0, 0.1, 3.2)}, "`heading_tolerance` 3.2 rad is not"),
        (
            {"world": World((Circle(1, 1, 0),))},
            "obstacle 1 is not allowed; its position and radius must be finite",
        ),
        (
            {"world": World(polygons=(Polygon(((0, 0), (1, 1), (1, 0), (0, 1))),))},
            "polygon 1 .* its sides must not cross",
        ),
        (
            {"world": World(bounds=Bounds((1, -1), (0, 1)))},
            "each lower limit must be below its upper limit",
        ),
    ],
)
def test_invalid_problems_are_rejected_by_name(changes, words):
    with pytest.raises(InputError, match=words):
        plan(walled(**changes))


def test_invalid_settings_are_rejected():
    assert Settings(nodes=1, levels=5, weight=1.0, seconds=1e-9).clearance_weight == 0
    at_least = "are not allowed; each of them must be at least 1"
    for changes, words in (
        ({"nodes": 0}, f"nodes 0, levels 4, weight 1 {at_least}"),
        ({"levels": 0}, f"nodes 200000, levels 0, weight 1 {at_least}"),
        ({"weight": 0.9}, f"nodes 200000, levels 4, weight 0.9 {at_least}"),
        ({"levels": 6}, "`levels` 6 is not allowed; it must be at most 5"),
        ({"seconds": 0}, "`seconds` 0 is not allowed; it must be above 0"),
        ({"clearance_weight": -1}, "`clearance_weight` -1 is not allowed"),
    ):
        with pytest.raises(InputError, match=words):
            Settings(**changes)


COMPILED_LATER = """
import sys
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.planner import plan
from srs_twin.planning import planner
from srs_twin.planning.problem import Problem
from srs_twin.robot.world import Bounds, Circle, Goal, Polygon, Pose, World

def kernels():
    modules = [m for name, m in sorted(sys.modules.items()) if name.startswith("srs_twin.planning.")]
    return {
        (m.__name__, name): len(f.entry.signatures)
        for m in modules for name, f in vars(m).items() if hasattr(f, "entry")
    }

planner._compile()
before = kernels()
assert any(before.values())
body = load_footprint("gen4_ilc")
square = Polygon(((1.4, -0.3), (1.6, -0.3), (1.6, 0.1), (1.4, 0.1)))
for world in (World(), World((Circle(0.7, 0.05, 0.1),), Bounds((-1.0, 4.0), (-2.0, 2.0)), None, (square,))):
    for goal in (Goal(3, 0, None, 0.05), Goal(3, 0, 0.3, 0.05), Goal(2, 0, 0.3, 0.05)):  # integers as well
        assert plan(Problem(Pose(0, 0, 0), goal, world, body)).found
print([name for name, count in kernels().items() if count != before.get(name, 0)])
"""


def test_no_kernel_is_compiled_while_planning_is_timed():
    done = subprocess.run(
        [sys.executable, "-c", COMPILED_LATER],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "[]"
