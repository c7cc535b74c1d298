"""Scorecard: grades follow from the verdicts of the baseline and the stored uncertainties."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest

from srs_twin.reproduction import report as module
from srs_twin.reproduction.claims import load_claims
from srs_twin.reproduction.report import FACTORS, UNVALIDATED, Grade, scorecard
from srs_twin.reproduction.verdicts import Baseline, load_baseline


def with_verdict(baseline, names, verdict):
    """Return a baseline with another verdict for the named rows."""
    outcomes = {
        name: (
            {k: replace(outcome, verdict=verdict) for k, outcome in row.items()}
            if name in names
            else row
        )
        for name, row in baseline.outcomes.items()
    }
    return Baseline(outcomes)


def test_every_claim_belongs_to_one_capability():
    for claim in load_claims():
        capabilities = [
            name
            for name, prefixes in module.CAPABILITIES.items()
            if claim.id.startswith(prefixes)
        ]
        assert len(capabilities) == 1, claim.id


def test_nothing_is_graded_as_validated_against_hardware():
    for row in scorecard(load_claims(), load_baseline()).values():
        assert set(row) == set(FACTORS)
        assert all(0 <= grade.grade <= 4 and grade.why for grade in row.values())
        assert row["validation"].grade <= 2
        assert UNVALIDATED in row["validation"].why


def test_a_missed_law_lowers_the_grade_of_the_verification():
    claims = load_claims()
    baseline = load_baseline()
    before = scorecard(claims, baseline)["crawling, generation 2"]
    assert (before["verification"].grade, before["validation"].grade) == (3, 1)
    laws = [claim.id for claim in claims if claim.use == "law"]
    worse = scorecard(claims, with_verdict(baseline, laws, "missed"))[
        "crawling, generation 2"
    ]
    assert (worse["verification"].grade, worse["validation"].grade) == (1, 1)


def test_robustness_names_the_parameter_with_most_of_the_variance():
    index = {"a": {"total": 0.3}, "b": {"total": 0.62}}
    document = {
        "target": {"plant": "twin", "metric": "v"},
        "plants": {"twin": {"v": {"sensitivity": index}}},
    }
    text = "1 of 2 orders and trends met"
    expected = Grade(2, f"most from b, 62 %; {text}")
    assert module._robustness((1, 2), [document]) == expected
    assert module._robustness((1, 2), []) == Grade(1, text)
    assert module._robustness((0, 0), []) == Grade(0, "no published trends")


def test_uncertainty_states_the_interval_and_the_published_value():
    metric = {"interval_95": [0.1, 0.2], "published": 0.15, "verdict": "within"}
    document = {
        "scenario": "s",
        "target": {"plant": "twin", "metric": "v"},
        "plants": {"twin": {"v": metric}},
    }
    text = "s, v: 0.1 to 0.2, published 0.15 within"
    assert module._uncertainty([document]) == Grade(2, text)
    assert module._uncertainty([]) == Grade(0, "no intervals")


def test_validation_needs_three_quarters_of_the_headline_predictions_alone():
    for met, grade in ((0, 0), (1, 1), (2, 1), (3, 2), (4, 2)):
        counts = dict.fromkeys(module.TITLES, (0, 0))
        counts |= {"headline": (met, 4), "fitted_robot": (4 - met, 9), "law": (1, 1)}
        text = f"headline {met} of 4 (separately: fitted {4 - met} of 9); {UNVALIDATED}"
        assert module._validation(counts) == Grade(grade, text)


@pytest.mark.parametrize(("measured", "grade"), [(3, 1), (4, 2), (7, 2), (8, 3)])
def test_input_pedigree_follows_the_fraction_of_measured_parameters(
    monkeypatch, measured, grade
):
    statuses = ["measured"] * measured + ["estimated"] * (10 - measured)
    records = {k: SimpleNamespace(status=status) for k, status in enumerate(statuses)}
    robot = SimpleNamespace(records=lambda: records)
    monkeypatch.setattr(module, "load_robot_file", lambda name: robot)
    found = scorecard(load_claims(), load_baseline())["crawling, generation 3"]
    assert found["input pedigree"] == Grade(
        grade, f"{measured} of 10 parameters measured"
    )


def test_predictions_of_other_groups_are_listed_separately():
    message = scorecard(load_claims(), load_baseline())["following"]["validation"].why
    assert message.startswith("no headline (separately: own obstacles 10 of 11)")


def test_the_command_prints_the_scorecard_without_a_run(srs_twin, tmp_path):
    done = srs_twin("reproduce", "--scorecard", "--json", cwd=tmp_path)
    assert done.returncode == 0
    assert set(json.loads(done.stdout)["planning"]) == set(FACTORS)
    shown = srs_twin("reproduce", "--scorecard", cwd=tmp_path)
    assert UNVALIDATED in shown.stdout
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("u_num", "grade"), [(1e-4, 3), (1.9e-3, 3), (2e-3, 2), (None, 2)]
)
def test_a_small_time_step_error_raises_the_grade(u_num, grade):
    uncertainty = {"u_num": u_num, "u_input": 0.01}
    document = {
        "plants": {"twin": {"m": uncertainty}},
        "target": {"plant": "twin", "metric": "m"},
    }
    found = module.verification_grade((3, 3), [document])
    text = "3 of 3 laws met"
    if grade == 3:
        text += f"; time step {1e4 * u_num:.0f} % of the input uncertainty"
    assert found == Grade(grade, text)
    assert module.verification_grade((2, 3), [document]).grade == 1
