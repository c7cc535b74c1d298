"""The baseline planner of OMPL passes the checks of the planner."""

from __future__ import annotations

import pytest
from plan_sampling import TOUCH, deepest, joints, misses
from plan_worlds import fig54_problem

from srs_twin.errors import InputError
from srs_twin.planning.planner import plan
from srs_twin.planning.problem import Settings


def test_ompl_plans_are_free_and_continuous():
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
