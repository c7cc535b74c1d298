"""Optimization studies: file, search on functions with known optima, resuming, and the command."""

from __future__ import annotations

import json
import math
import re
import sys
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

import srs_twin as srs
from srs_twin.compute.workers import TaskResult
from srs_twin.errors import InputError, InputFileError
from srs_twin.io.files import shipped_names
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.studies.optimization.command import _print_result
from srs_twin.studies.optimization.loading import DesignSpace, VariableFile, load_study
from srs_twin.studies.optimization.report import (
    bound_lines,
    draw_convergence,
    draw_parallel,
    write_result,
)
from srs_twin.studies.optimization.result import EvaluatedDesign, StudyResult
from srs_twin.studies.optimization.runs import PLANTS, Run, StudyRuns
from srs_twin.studies.optimization.search import _Search, front, search
from srs_twin.studies.sweep.task import DONE, FAILED, Row

STUDY = """
scenario: gen2_straight
variables:
  controller.frequency_hz: {{low: 0.5, high: 3.0}}
  controller.phase_step_rad: {{low: 0.4, high: 2.6}}
objectives: [{objectives}]
constraints: [{constraints}]
budget: {{compliant: {compliant}, twin: {twin}}}
seed: {seed}
"""
SPEED = "{metric: com_speed_m_s, goal: maximize}"
COST = "{metric: cost_of_transport, goal: minimize}"


def study(
    tmp_path,
    *,
    objectives=SPEED,
    constraints="",
    twin=24,
    compliant=150,
    seed=0,
    old="",
    new="",
):
    """Return a study whose file has the text `new` in place of `old`."""
    text = STUDY.format(
        objectives=objectives,
        constraints=constraints,
        twin=twin,
        compliant=compliant,
        seed=seed,
    )
    assert old in text
    path = tmp_path / "question.yaml"
    path.write_text(text.replace(old, new), "utf-8")
    return load_study(path)


def speed(f, p, part):
    """Return a Gaussian peak; that of the low-fidelity model is shifted, lower and tilted."""
    if part == "compliant":
        return (
            0.3 * math.exp(-(((f - 1.7) / 0.7) ** 2) - ((p - 1.3) / 0.5) ** 2)
            + 0.01 * f
        )
    return 0.4 * math.exp(-(((f - 2.0) / 0.6) ** 2) - ((p - 1.45) / 0.4) ** 2)


def cost(f, p, part):
    return 0.2 + (0.1 if part == "twin" else 0.08) * f**2


class Engine:
    """Engine with speed and cost by formula; it records the keys of its points."""

    def __init__(self, breaks_after=math.inf, speed=speed, cost=cost):
        self.keys = []
        self.changes = []
        self._left = breaks_after
        self._speed = speed
        self._cost = cost

    def __call__(self, experiment, points):
        (plant,) = experiment.plants
        part = {"analytical": "compliant"}.get(plant, plant)
        for number, point in enumerate(points):
            if self._left <= 0:
                raise KeyboardInterrupt
            self._left -= 1
            self.keys.append(point.key)
            self.changes.append(point.changes)
            f, p = (
                point.changes.get(f"controller.{name}", 1.0)
                for name in ("frequency_hz", "phase_step_rad")
            )
            if f > 2.9:
                yield TaskResult(
                    number, Row(point.key, FAILED, {}, 0.0, "diverged", 3), None
                )
                continue
            values = {
                f"{plant}.com_speed_m_s": self._speed(f, p, part),
                f"{plant}.cost_of_transport": self._cost(f, p, part),
            }
            yield TaskResult(number, Row(point.key, DONE, values), None)


def run_search(question, folder, engine=None):
    """Return the optimum of a study in a folder."""
    with StudyRuns(question, folder, engine or Engine()) as runs:
        return search(question, runs)


def test_the_function_gives_the_result_of_the_search(tmp_path):
    preset = "fixed: {plants.twin.preset: fast}\nvariables:"
    question = study(tmp_path, twin=8, compliant=40, old="variables:", new=preset)
    budget = question.file.budget.model_copy(update={"uncertain": 2})
    question = replace(
        question, file=question.file.model_copy(update={"budget": budget})
    )
    folder = tmp_path / "out"
    seen = []
    engine = Engine()
    found = srs.optimize(
        question, engine=engine, progress=lambda *each: seen.append(each)
    )
    with StudyRuns(question, folder, Engine()) as runs:
        expected = StudyResult.evaluate(question, search(question, runs), runs)
    assert found.document() == expected.document()
    assert seen[0] == ("question", 8 + 40 + 1 + 3 * (2 + 2) + 2, None)
    # The last runs are those of the same two robots with every design.
    robots = engine.changes[-2 * (1 + len(found.designs)) :]
    for name in ("robot.friction.mu_t", "plants.twin.timestep_s"):
        values = [changes[name] for changes in robots]
        assert values == values[:2] * (1 + len(found.designs))
    assert "controller.frequency_hz" not in robots[1] and robots[0] != robots[1]
    assert (
        robots[2]["controller.frequency_hz"]
        == found.document()["best"][0]["variables"]["controller.frequency_hz"]
    )
    assert [row.key for _, _, row in seen[1:]] == engine.keys and not found.files
    assert {part for part, _, _ in seen[1:]} == {"compliant", "twin"}
    assert not [
        path for path in tmp_path.iterdir() if path.name not in ("question.yaml", "out")
    ]


def test_an_interrupted_function_keeps_its_runs(tmp_path):
    question = study(tmp_path, twin=8, compliant=40)
    folder = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        srs.optimize(question, out=folder, engine=Engine(breaks_after=30))
    rest = Engine()
    found = srs.optimize(question, out=folder, engine=rest)
    whole = Engine()
    assert found.document() == srs.optimize(question, engine=whole).document()
    assert len(rest.keys) == len(whole.keys) - 30
    assert (
        {"study.json", "evaluations.parquet"}
        <= set(found.files)
        <= {str(path.relative_to(folder)) for path in folder.rglob("*")}
    )
    limit = "{metric: cost_of_transport, below: 0.4}"
    limited = study(tmp_path, twin=8, compliant=40, constraints=limit)
    reused = Engine()
    with StudyRuns(limited, folder, reused) as runs:
        runs.rows("twin", [{}])
    assert not reused.keys
    other = study(tmp_path, old="gen2_straight", new="gen2_turn")
    with pytest.raises(InputError, match="belong to another study"):
        run_search(other, folder)


def test_the_printed_table_holds_the_values_of_the_formulas(tmp_path, capsys):
    question = study(tmp_path, objectives=f"{SPEED}, {COST}", twin=8, compliant=40)
    result = srs.optimize(question, engine=Engine())
    _print_result(result)
    printed = capsys.readouterr().out
    numbers = {
        label: [
            float(cell.rstrip("†"))
            for cell in re.search(rf"{re.escape(label)} +(.*)", printed)[1].split()
        ]
        for label in (
            "gait frequency (Hz)",
            "controller phase step (rad)",
            "CoM speed (m/s)",
            "cost of transport",
        )
    }
    frequencies, phase_steps, (begun, *speeds), (first_cost, *costs) = numbers.values()
    assert [begun, first_cost] == pytest.approx(
        [speed(1.0, 1.0, "twin"), cost(1.0, 1.0, "twin")], rel=1e-3
    )
    assert len(frequencies) == min(5, len(result.document()["best"]))
    for f, p, v, c in zip(frequencies, phase_steps, speeds, costs, strict=True):
        assert [v, c] == pytest.approx(
            [speed(f, p, "twin"), cost(f, p, "twin")], rel=0.01
        )
    for name, values, before in (
        ("CoM speed (m/s)", speeds, begun),
        ("cost of transport", costs, first_cost),
    ):
        gain = float(re.search(rf"best/1: {re.escape(name)} \+([\d.]+) %", printed)[1])
        assert gain == pytest.approx(100 * (values[0] / before - 1), rel=2e-3)
    ran = [run.part for run in result.runs]
    failed = [run.part for run in result.runs if run.row.status == FAILED]
    assert result.document()["without_value"] == {"compliant": 1, "twin": 1}
    assert sorted(failed) == ["compliant", "twin"]
    missing = "(1 without a value of an objective or constraint)"
    assert printed.endswith(
        f"\n{ran.count('compliant')} runs of compliant {missing},"
        f" {ran.count('twin')} runs of twin {missing}\n"
    )


def test_the_document_compares_designs_over_the_same_robots(tmp_path, capsys):
    def run(speed, part="twin", design=(0.5, 0.5)):
        row = Row("", DONE, {f"{PLANTS[part]}.com_speed_m_s": speed})
        return Run(part, np.array(design), row)

    def evaluated(speed, refined, samples):
        refinements, robots = (
            tuple(run(each).row for each in speeds) for speeds in (refined, samples)
        )
        return EvaluatedDesign(run(speed), refinements, robots)

    twin = [1, 2, 3, 4, 5, 6, 7, 8]
    compliant = [1, 2, 3, 4, 8, 7, 6, 5]
    runs = [
        run(speed, part, (k / 10, 0.0))
        for part, speeds in (("twin", twin), ("compliant", compliant))
        for k, speed in enumerate(speeds)
    ]
    by_median = "{metric: com_speed_m_s, goal: maximize, quantile: 0.5}"
    result = StudyResult(
        study(
            tmp_path, objectives=by_median, old="twin: 24", new="twin: 24, uncertain: 3"
        ),
        tuple(runs),
        evaluated(0.2, (), (0.1, 0.2, 0.4)),
        (
            evaluated(0.3, (0.303, 0.27), (0.2, 0.3, 0.5)),
            evaluated(0.25, (0.25, 0.252), (0.25, 0.2, 0.2)),
        ),
    )
    document = result.document()
    best, second = (
        {name: design[name] for name in ("refined", "survives", "beats_next")}
        for design in document["best"]
    )
    name = "com_speed_m_s"
    assert best == {
        "refined": {name: pytest.approx(0.1)},
        "survives": False,
        "beats_next": pytest.approx(2 / 3),
    }
    assert second == {
        "refined": {name: pytest.approx(0.008)},
        "survives": True,
        "beats_next": None,
    }
    assert document["best"][0]["intervals"][name] == pytest.approx([0.205, 0.49])
    gain = document["best"][0]["gains"][name]
    assert gain["fraction"] == pytest.approx(0.5)
    assert gain["interval_95"] == pytest.approx([0.2625, 0.975])
    _print_result(result)
    lines = capsys.readouterr().out.splitlines()
    assert "best/1 is better than best/2 for 67 % of the random robots" in lines
    assert "best/1: CoM speed (m/s) +50.0 % (95 %: +26.2 % to +97.5 %)" in lines
    finer = ": changes by more than 1 % with a finer time step or more hinges"
    assert f"best/1{finer}" in lines and f"best/2{finer}" not in lines
    columns = result.table
    assert columns["controller.frequency_hz"][:2] == [0.5, 0.75]
    assert columns["com_speed_m_s"] == [*twin, *compliant]
    exchanged = replace(result, designs=result.designs[::-1])
    assert exchanged.ranked_by_quantile().designs[0] is result.designs[0]
    # Among the better half of the designs, the models disagree about the order.
    assert document["fidelities"][name] == pytest.approx({"all": 16 / 21, "near": -1})


def test_few_runs_of_the_twin_find_an_optimum_that_the_cheap_model_misses(tmp_path):
    question = study(tmp_path)
    result = run_search(question, tmp_path / "out")
    best, *others = result.best
    assert best.part == "twin" and sum(run.part == "twin" for run in result.runs) == 24
    assert best.metric("com_speed_m_s") > 0.98 * 0.4
    assert all(math.dist(best.fractions, run.fractions) > 0.1 for run in others)
    cheap = max(
        (run for run in result.runs if run.part == "compliant"),
        key=lambda run: run.metric("com_speed_m_s"),
    )
    assert speed(*question.space.values(cheap.fractions), "twin") < 0.9 * 0.4


@pytest.mark.slow
@pytest.mark.parametrize(("most_f", "most_p"), [(0.5, 2.6), (2.8, 0.4)])
def test_optimum_at_two_bounds_is_found(tmp_path, most_f, most_p):
    """For nine seeds the distance was at most 1 % of the ranges."""

    def slope(f, p, part):
        distance = abs(f - most_f) / 2.3 + abs(p - most_p) / 2.2
        return 1.0 - distance / (2 if part == "twin" else 3)

    question = study(tmp_path, compliant=80, twin=20, old="high: 3.0", new="high: 2.8")
    best, *_ = run_search(question, tmp_path / "out", Engine(speed=slope)).best
    bound = np.array([most_f == 2.8, most_p == 2.6])
    assert np.abs(best.fractions - bound).max() < 0.015


def test_designs_on_a_bound_are_marked_in_document_and_text(tmp_path):
    def slope(f, p, part):
        return f - (p - 1.5) ** 2

    question = study(
        tmp_path,
        compliant=40,
        twin=8,
        old="high: 3.0",
        new="high: 2.8, bounds_source: highest frequency measured",
    )
    answer = srs.optimize(question, engine=Engine(speed=slope))
    best, *_ = answer.document()["best"]
    row = {"bound": "high", "value": 2.8, "source": "highest frequency measured"}
    assert best["on_bound"] == {"controller.frequency_hz": row}
    first, *_, last = bound_lines(answer.document())
    assert (
        "best/1" in first
        and "is on its high bound 2.8 (highest frequency measured)" in first
    )
    assert "beyond such a bound" in last
    write_result(answer, tmp_path / "written")
    page = (tmp_path / "written/report.html").read_text("utf-8")
    assert "2.8†" in page
    parts = (row.split("</tr>")[0] for row in page.split("<tr")[1:])
    rows = [re.findall(r">([^<>]+)</t[dh]>", part) for part in parts]
    (initial,) = (row for row in rows if "initial scenario" in row)
    best_row = next(row for row in rows if "best/1.yaml" in row)
    p = best["variables"]["controller.phase_step_rad"]
    assert float(initial[1]) == pytest.approx(slope(1.0, 1.0, "twin"), rel=1e-3)
    assert best_row[1] == "2.8†"
    assert float(best_row[3]) == pytest.approx(slope(2.8, p, "twin"), rel=1e-3)


def test_plots_show_the_best_runs_and_the_reached_bounds():
    values = np.array([5.0, 1.0, 3.0, 2.0, 4.0])
    feasible = np.array([False, True, True, True, True])
    for maximize, best in ((True, [1, 3, 3, 4]), (False, [1, 1, 1, 1])):
        figure, _ = draw_convergence(values, feasible, "v", 2.5, maximize=maximize)
        each, misses, progress, start = figure.axes[0].lines
        assert each.get_xydata().tolist() == [[2, 1], [3, 3], [4, 2], [5, 4]]
        assert misses.get_xydata().tolist() == [[1, 5]]
        assert progress.get_ydata()[1:].tolist() == best
        assert list(start.get_ydata()) == [2.5, 2.5]
    space = DesignSpace({name: VariableFile(low=0, high=1) for name in "abc"}, {})
    runs = [
        Run("twin", np.array(design), Row("", DONE))
        for design in ((0.5, 0.5, 0.5), (0.0, 0.6, 1.0))
    ]
    figure, caption = draw_parallel(space, runs, np.array([1, 0]), runs[1:])
    worse, better, bounds = figure.axes[0].lines
    assert list(better.get_ydata()) == [0.0, 0.6, 1.0]
    assert (worse.get_alpha(), better.get_alpha()) == pytest.approx((0.15, 1))
    assert worse.get_color() != better.get_color()
    assert bounds.get_xydata().tolist() == [[0, 0], [2, 1]] and "Red" in caption


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("fraction", "bound"),
    [(0.0, "low"), (0.009, "low"), (0.011, None), (0.995, "high")],
)
@pytest.mark.parametrize("scale", ["linear", "log"])
def test_a_design_within_one_per_cent_of_the_range_is_on_the_bound(
    fraction, bound, scale
):
    space = DesignSpace({"a": VariableFile(low=1, high=100, scale=scale)}, {})
    assert space.bounds(np.array([fraction])) == ({} if bound is None else {"a": bound})


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("scale", ["linear", "log"])
@pytest.mark.parametrize("whole", [False, True])
def test_fractions_map_to_both_bounds_and_back(scale, whole):
    ranges = {
        name: VariableFile(low=low, high=high, scale=scale, whole=whole)
        for name, low, high in (("a", 1, 7), ("b", 3, 4000), ("c", 20, 21))
    }
    space = DesignSpace(ranges, {})
    for outside in (0.0, 0.1):
        assert space.values(np.full(3, -outside)) == (1, 3, 20)
        assert space.values(np.full(3, 1 + outside)) == (7, 4000, 21)
    for fraction in np.linspace(0, 1, 11):
        values = space.values(np.full(3, fraction))
        back = space.values(space.fractions(values))
        assert back == pytest.approx(values, rel=2e-6)
        if not whole:
            assert space.fractions(values) == pytest.approx(fraction, abs=1e-4)
    middle = space.values(np.full(3, 0.5))
    assert middle[0] == pytest.approx(
        {"linear": 4, "log": math.sqrt(7)}[scale], abs=0.5 if whole else 1e-5
    )


@pytest.mark.slow
def test_an_optimum_that_violates_a_constraint_of_the_low_fidelity_model_is_found(
    tmp_path,
):
    """The twin allows f = √2, at which the cost of the low-fidelity model is 0.56."""

    def dear(f, p, part):
        return 0.2 + (0.1 if part == "twin" else 0.18) * f**2

    question = study(
        tmp_path, constraints="{metric: cost_of_transport, below: 0.4}", twin=30
    )
    result = run_search(question, tmp_path / "out", Engine(cost=dear))
    best, *_ = result.best
    assert best.metric("cost_of_transport") <= 0.4
    assert best.metric("com_speed_m_s") > 0.98 * speed(math.sqrt(2), 1.45, "twin")
    cheap = [
        run
        for run in result.runs
        if run.part == "compliant"
        and run.fractions.tobytes() == best.fractions.tobytes()
    ]
    assert cheap[0].metric("cost_of_transport") > 0.5
    assert result.improvement < 0.005


def test_expected_improvement_is_the_mean_of_the_feasible_gains(tmp_path):
    """Reference: random draws of cost and excess, of which infeasible ones gain nothing."""
    question = study(tmp_path, constraints="{metric: cost_of_transport, below: 0.4}")
    with StudyRuns(question, tmp_path / "out", Engine()) as runs:
        state = _Search(question, runs)
        mean = np.array([[-0.30, -0.02]])
        sd = np.array([[0.05, 0.03]])
        known = np.array([[-0.31, -0.1]])
        found = state.improvement(mean, sd, known, 0)[0]
    draws = mean + sd * np.random.default_rng(1).normal(size=(400_000, 2))
    gains = np.maximum(-0.31 - draws[:, 0], 0.0) * (draws[:, 1] <= 0)
    assert found == pytest.approx(
        gains.mean(), abs=5 * gains.std() / math.sqrt(len(gains))
    )


def test_explored_designs_improve_the_second_best_region(tmp_path):
    question = study(tmp_path, constraints="{metric: cost_of_transport, below: 0.6}")
    designs = [(0.5, 0.52), (0.3, 0.85), (0.3, 0.82), (0.1, 0.1)]
    candidates = [Run("twin", np.array(d), Row("", DONE)) for d in designs]
    with StudyRuns(question, tmp_path / "out", Engine()) as runs:
        state = _Search(question, runs)
        state._run("twin", np.array([[0.5, 0.5], [0.3, 0.9]]))
        second, best = sorted(run.metric("com_speed_m_s") for run in state._twin_runs)
        cost = -np.array([best + 0.1, second + 0.02, second + 0.01, best + 0.1])
        mean = np.column_stack([cost, np.full(4, -0.1)])
        sd = np.full((4, 2), 1e-3)
        assert state._explored_candidate(candidates, mean, sd, [], 0) == 1
        chosen = [candidates[1].fractions]
        assert state._explored_candidate(candidates, mean, sd, chosen, 0) == 2
        mean[1:3, 1] = 0.1  # violates the constraint
        assert state._explored_candidate(candidates, mean, sd, [], 0) == 0


@pytest.mark.slow
def test_a_search_that_the_budget_ends_too_early_warns(tmp_path, capsys):
    results = {}
    for twin in (6, 30):
        limit = "{metric: cost_of_transport, below: 0.4}"
        question = study(tmp_path, constraints=limit, twin=twin)
        results[twin] = srs.optimize(question, engine=Engine())
    early = results[6]
    late = results[30]
    assert early.improvement > 0.005 > late.improvement
    reached = [
        result.designs[0].run.metric("com_speed_m_s") for result in (early, late)
    ]
    assert reached[1] > 1.02 * reached[0]
    # The fastest gait with a cost of 0.4 has f = √2.
    assert late.designs[0].run.metric("cost_of_transport") <= 0.4
    assert reached[1] > 0.95 * speed(math.sqrt(2), 1.45, "twin")
    document = early.document()
    assert document["expected_improvement"] == early.improvement
    expected = (
        f"expected to improve the best result by {100 * early.improvement:.1f} %; raise"
        " budget.twin."
    )
    assert document["warning"].startswith(
        "The budget ended the search, although one more run"
    )
    assert document["warning"].endswith(expected)
    assert late.document()["warning"] is None
    _print_result(early)
    printed = capsys.readouterr().out
    assert f"warning: {document['warning']}" in printed
    assert (
        f"expected to improve the best result by {100 * early.improvement:.2g} %\n"
        in printed
    )
    write_result(early, tmp_path / "written")
    assert document["warning"] in (tmp_path / "written/report.html").read_text("utf-8")


@pytest.mark.slow
def test_searches_with_infeasible_constraints_or_exhausted_spaces_end(tmp_path):
    question = study(tmp_path, constraints="{metric: cost_of_transport, below: 0.1}")
    best, *_ = run_search(question, tmp_path / "out").best
    assert best.metric("cost_of_transport") == pytest.approx(
        cost(0.5, 0, "twin"), rel=0.01
    )
    few = tmp_path / "few.yaml"
    few.write_text(
        "scenario: gen2_straight\nvariables:\n  robot.segments: {low: 2, high: 4,"
        f" whole: true}}\nobjectives: [{SPEED}]\n",
        "utf-8",
    )
    result = run_search(load_study(few), tmp_path / "few")
    assert {load_study(few).space.values(run.fractions) for run in result.runs} == {
        (2,),
        (3,),
        (4,),
    }


@pytest.mark.parametrize(
    ("twin", "warning"),
    [
        (4, ""),
        (
            40,
            "of 40 runs of the twin, because no other design was found among those of"
            " the model compliant; raise budget.compliant.",
        ),
    ],
)
def test_the_budget_is_used_or_the_result_says_why_not(tmp_path, twin, warning):
    line = "  controller.phase_step_rad: {low: 0.4, high: 2.6}\n"
    question = study(tmp_path, twin=twin, compliant=8, old=line)
    document = srs.optimize(question, engine=Engine()).document()
    assert (document["evaluations"]["twin"] < twin) == bool(warning)
    assert (document["warning"] or "").endswith(warning)
    if warning:
        ran = document["evaluations"]["twin"]
        assert document["warning"].startswith(f"The search ended after {ran} of 40 ")


def test_a_study_whose_twin_always_fails_is_refused_with_the_reason(tmp_path):
    class Broken(Engine):
        def __call__(self, experiment, points):
            if experiment.plants == ("analytical",):
                yield from super().__call__(experiment, points)
                return
            for number, point in enumerate(points):
                yield TaskResult(
                    number, Row(point.key, FAILED, {}, 0.0, "it diverged", 3), None
                )

    with pytest.raises(
        InputError, match="no run of the twin has a result: it diverged"
    ):
        run_search(study(tmp_path), tmp_path / "out", Broken())


@pytest.mark.slow
def test_the_pareto_front_agrees_with_the_formulas(tmp_path):
    """The front has the best phase and all frequencies up to the fastest; 93 % of its area is reached."""
    question = study(tmp_path, objectives=f"{SPEED}, {COST}", twin=40, compliant=300)
    best = run_search(question, tmp_path / "out").best
    result = np.array(
        [[run.metric("com_speed_m_s"), run.metric("cost_of_transport")] for run in best]
    )
    assert front(result * [-1, 1]).all()

    def area(points):
        """Return the area dominated by points (speed, cost), from speed 0 and cost 0.7."""
        order = points[np.argsort(points[:, 1])]
        order = order[order[:, 1] < 0.7]
        least = np.append(order[1:, 1], 0.7)
        return float(np.sum(np.maximum.accumulate(order[:, 0]) * (least - order[:, 1])))

    f = np.linspace(0.5, 2.0, 400)  # higher frequencies are slower and cost more
    truth = np.array(
        [
            [speed(frequency, 1.45, "twin"), cost(frequency, 1.45, "twin")]
            for frequency in f
        ]
    )
    assert area(result) > 0.93 * area(truth)


def test_the_number_of_segments_keeps_total_length_and_mass(tmp_path):
    path = tmp_path / "body.yaml"
    path.write_text(
        "scenario: gen2_straight\nvariables:\n  robot.segments: {low: 2, high: 8,"
        f" whole: true, hold: [total_length, total_mass]}}\nobjectives: [{SPEED}]\n",
        "utf-8",
    )
    question = load_study(path)
    before = load_scenario("gen2_straight").robot
    for count, fraction in ((2, 0.0), (5, 0.5), (8, 1.0)):
        changes = question.space.changes(np.array([fraction]))
        robot = parse_scenario(question.experiments["twin"].document(changes)).robot
        assert robot.segments == count
        assert robot.geometry.body_length == pytest.approx(before.geometry.body_length)
        assert robot.mass.array().sum() == pytest.approx(before.mass.array().sum())


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seed: 0", "fixed: {controller.frequency_hz: 2}", "this field is also fixed"),
        (
            "constraints: []",
            "constraints: [{metric: com_speed_m_s, below: 1, above: 2}]",
            "constraints[0]: the minimum of com_speed_m_s, 2.0, exceeds its maximum",
        ),
        (
            "constraints: []",
            "constraints: [{metric: com_speed_m_s, below: 1},"
            " {metric: com_speed_m_s, above: 2}]",
            "constraints[1]: the minimum of com_speed_m_s, 2.0, exceeds its maximum",
        ),
        (SPEED, f"{SPEED}, {SPEED}", "both objectives have the metric com_speed_m_s"),
        ("frequency_hz", "frequncy_hz", "unknown key; did you mean frequency_hz?"),
        (
            "low: 0.5, high: 3.0",
            "low: 3.0, high: 0.5",
            "`low` 3 must be below `high` 0.5",
        ),
        ("low: 0.5, high: 3.0", "low: -1, high: 3.0", "controller.frequency_hz"),
        ("com_speed_m_s", "com_sped_m_s", "did you mean com_speed_m_s"),
        ("maximize", "maximise", "did you mean maximize"),
        ("gen2_straight", "gen2_strait", "did you mean gen2_straight"),
    ],
)
def test_invalid_studies_are_refused_with_their_location(tmp_path, old, new, message):
    with pytest.raises(InputFileError) as error:
        study(tmp_path, old=old, new=new)
    assert message in str(error.value) and "question.yaml:" in str(error.value)


def test_a_wrong_budget_does_not_hide_wrong_fields(tmp_path):
    with pytest.raises(InputFileError) as error:
        study(tmp_path, twin=3, old="frequency_hz", new="frequncy_hz")
    field, budget = error.value.lines
    assert "did you mean frequency_hz?" in field and "budget.twin" in budget
    path = tmp_path / "question.yaml"
    path.write_text("budget")
    with pytest.raises(InputFileError, match="must be a block of keys"):
        load_study(path)


@pytest.mark.slow
def test_the_best_scenario_of_the_command_can_be_run(srs_twin, tmp_path):
    path = tmp_path / "question.yaml"
    path.write_text(
        STUDY.format(objectives=SPEED, constraints="", twin=6, compliant=24, seed=3),
        "utf-8",
    )
    options = (
        "optimize",
        "question.yaml",
        "--set",
        "duration_s=2",
        "--out",
        "found",
        "--json",
    )
    done = srs_twin(*options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout)
    best, *_ = printed["best"]
    assert best["plant"] == "twin" and printed["evaluations"]["twin"] == 6
    table = pq.read_table(tmp_path / "found/evaluations.parquet")
    twin = [row for row in table.to_pylist() if row["part"] == "twin"]
    assert best["metrics"]["com_speed_m_s"] == max(
        row["com_speed_m_s"] or 0.0 for row in twin
    )
    assert (
        srs_twin(
            "run", "found/best/1.yaml", "--out", "again", "--quiet", cwd=tmp_path
        ).returncode
        == 0
    )
    again = json.loads((tmp_path / "again/metrics.json").read_text("utf-8"))
    assert again["plants"]["twin"]["com_speed_m_s"] == pytest.approx(
        best["metrics"]["com_speed_m_s"], rel=1e-9
    )
    assert json.loads(srs_twin(*options, cwd=tmp_path).stdout) == printed


@pytest.mark.default_cases(at=[0, 1, 4, 8])
@pytest.mark.parametrize("name", shipped_names("study"))
def test_shipped_studies_load_and_their_designs_are_scenarios(name):
    question = load_study(name)
    for fraction in (0.0, 0.5, 1.0):
        design = question.space.changes(np.full(question.space.size, fraction))
        robot = parse_scenario(question.experiments["twin"].document(design)).robot
        assert robot.segments >= 2
        # The compliant model is planar.
        assert set(question.experiments) == (
            {"twin"} if robot.is_spatial else {"compliant", "twin"}
        )
    assert all(variable.bounds_source for variable in question.file.variables.values())


def test_without_cma_the_command_names_the_extra_before_any_run(
    srs_twin, tmp_path, monkeypatch
):
    monkeypatch.setitem(sys.modules, "cma", None)
    done = srs_twin(
        "optimize", "gen2_speed", "--workers", "1", "--out", "out", cwd=tmp_path
    )
    assert done.returncode == 2 and "pip install 'srs-twin[optimize]'" in done.stderr
    assert not (tmp_path / "out").exists()
