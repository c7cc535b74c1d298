"""Planning study: its tables count the plans, and its baseline passes the same checks."""

from __future__ import annotations

import planning as study
import pytest
from plan_sampling import TOUCH, deepest, joints, misses

from srs_twin.errors import InputError
from srs_twin.planning.planner import plan
from srs_twin.planning.problem import Settings


def test_study_counts_the_plans_of_each_planner(capsys):
    answers = study.study(1)
    found = study.summary(answers)
    for name in ("greedy", "best_first"):
        plans = [p for each in answers[name].values() for p in each]
        assert found[name]["solved"] == sum(p.found for p in plans)
        assert sum(found[name]["outcomes"].values()) == len(study.COUNTS) == len(plans)
        assert found[name]["drivable"] <= found[name]["solved"] <= found["solved_by_any"]
    assert found["best_first"]["misses_of_greedy"] == 0
    assert found["greedy"]["misses_of_greedy"] == 0
    lines = study.tables(found).splitlines()
    assert lines[0].startswith("| planner | solved of 18 |")
    assert [line.split(" | ")[0] for line in lines[2:4]] == ["| greedy", "| best_first"]


def test_safety_study_reports_colliding_plans(monkeypatch):
    assert study.safety(6)["bad_seeds"] == []
    monkeypatch.setattr(study, "deepest", lambda *_: 0.01)
    assert study.safety(6)["bad_seeds"]


def test_ompl_plans_are_free_and_continuous():
    pytest.importorskip("ompl")
    for count in (4, 12):
        problem = study.fig54_problem(count, 1, arcs=False)
        answer = plan(problem, Settings(seconds=5), planner="ompl")
        assert answer.found
        assert deepest(answer, problem) < TOUCH and joints(answer, problem) < 1e-6
        assert not misses(answer, problem)


def test_missing_ompl_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ompl", None)
    with pytest.raises(InputError, match=r"pip install 'srs-twin\[ompl\]'"):
        plan(study.fig54_problem(4, 1, arcs=False), planner="ompl")
