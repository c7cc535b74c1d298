"""The planning benchmark, its check of plans, and the OMPL baseline."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from benchmark_runs import run_benchmark
from plan_sampling import TOUCH, deepest, is_faulty, joints, misses
from plan_worlds import fig54_problem

from srs_twin.errors import InputError
from srs_twin.planning.planner import plan
from srs_twin.planning.problem import Settings
from srs_twin.robot.random_worlds import FIG54_SITES
from srs_twin.robot.world import Circle


def test_planning_benchmark_counts_the_plans_of_each_planner(tmp_path):
    """One world for each number of obstacles; both planners solve whatever `greedy` solves."""
    out = tmp_path / "planning.json"
    words = ("--draws", "1", "--worlds", "6", "--maps", "0", "--json", str(out))
    run = run_benchmark("planning.py", *words)
    assert run.returncode in (0, 1), run.stderr  # 1: a time limit was exceeded
    values = json.loads(out.read_text("utf-8"))
    for name in ("greedy", "best_first"):
        planner = values["study"][name]
        assert sum(planner["outcomes"].values()) == len(FIG54_SITES)
        assert planner["solved"] == sum(planner["success"].values())
        assert planner["drivable"] <= planner["solved"] <= values["study"]["solved_by_any"]
        assert planner["misses_of_greedy"] == 0
    assert values["safety"]["bad_seeds"] == []
    lines = run.stdout.splitlines()
    assert lines[0].startswith("| planner | solved of 18 |")
    assert [line.split(" | ")[0] for line in lines[2:4]] == ["| greedy", "| best_first"]


def test_a_plan_through_an_obstacle_is_faulty():
    problem = fig54_problem(4, 1, arcs=False)
    answer = plan(problem)
    assert answer.found and not is_faulty(answer, problem)
    end = answer.segments[-1].start
    obstacles = (*problem.world.obstacles, Circle(end.x, end.y, 0.05))
    blocked = replace(problem, world=replace(problem.world, obstacles=obstacles))
    assert is_faulty(answer, blocked)


def test_ompl_plans_pass_the_same_checks():
    pytest.importorskip("ompl")
    for count in (4, 12):
        problem = fig54_problem(count, 1, arcs=False)
        answer = plan(problem, Settings(seconds=5), planner="ompl")
        assert answer.found
        assert deepest(answer, problem) < TOUCH and joints(answer, problem) < 1e-6
        assert not misses(answer, problem)


def test_missing_ompl_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ompl", None)
    with pytest.raises(InputError, match=r"pip install 'srs-twin\[ompl\]'"):
        plan(fig54_problem(4, 1, arcs=False), planner="ompl")
