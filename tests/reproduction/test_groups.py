"""Groups of predictions: a partition of the holdouts that agrees with their runs."""

from __future__ import annotations

import json
import re
from operator import attrgetter

import numpy as np
import pytest
from conftest import ROOT
from published_tables import published_runs

from srs_twin.control.gait import Gait
from srs_twin.reproduction.claims import COLUMNS, load_claims
from srs_twin.reproduction.report import MEANINGS, TITLES, by_category
from srs_twin.reproduction.runs import sweep_of
from srs_twin.reproduction.verdicts import MET, JudgedClaim, load_baseline
from srs_twin.robot.file import load_robot
from srs_twin.scenario.loading import load_scenario

pytestmark = pytest.mark.fast

CLAIMS = load_claims()
HOLDOUTS = [claim for claim in CLAIMS if claim.use == "holdout"]
GROUPS = (
    "headline",
    "own_tolerance",
    "fitted_robot",
    "chosen_parameter",
    "tuned_controller",
    "chosen_obstacles",
    "between_models",
)
NAMES = {"ids": lambda claim: claim.id}


def documents(claim):
    """Yield the documents of the scenarios that a row runs."""
    for measure in claim.all_measures:
        if measure.scenario is not None:
            yield load_scenario(measure.scenario).document
        elif measure.sweep is not None:
            yield sweep_of(measure.sweep).experiment.base


def test_groups_partition_the_holdouts():
    rows = by_category([JudgedClaim(claim) for claim in CLAIMS])
    assert (
        list(rows) == list(TITLES) == list(MEANINGS)
        and tuple(rows)[: len(GROUPS)] == GROUPS
    )
    grouped = [row.claim.id for name in GROUPS for row in rows[name]]
    assert sorted(grouped) == sorted(claim.id for claim in HOLDOUTS)
    all_rows = [row.claim.id for group in rows.values() for row in group]
    assert sorted(all_rows) == sorted(claim.id for claim in CLAIMS)
    assert all(rows[name] for name in GROUPS)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    "claim", [claim for claim in HOLDOUTS if claim.group == "headline"], **NAMES
)
def test_headline_predictions_have_no_tolerance_of_ours(claim):
    assert (
        claim.tolerance in ("dissertation", "measurement") and claim.limitation is None
    )
    assert claim.tol is None
    # A measurement error gives an interval around the value; a stated bound does not.
    assert (claim.tolerance == "measurement") == (claim.rule == "near")


def test_measurement_errors_are_the_differences_of_published_speeds():
    rows = {claim.id: claim for claim in CLAIMS}
    assert rows["gen1-forward"].allowed.low == pytest.approx(0.020)
    assert rows["gen2-top-speed"].allowed.high == pytest.approx(0.220)


@pytest.mark.default_cases(at=[0, 7, 10, 15, 32, 45, 55])
@pytest.mark.parametrize("claim", HOLDOUTS, **NAMES)
def test_limitations_agree_with_the_runs(claim):
    runs = list(documents(claim))
    is_fitted = any("calibration/fits/" in json.dumps(run["robot"]) for run in runs)
    assert is_fitted == (claim.group == "fitted_robot")
    # Its robot file says that the time constants were chosen with the speed in view.
    is_chosen = claim.robot == "gen1" and not claim.all_measures[0].metric.startswith(
        "comparison."
    )
    assert is_chosen == (claim.group == "chosen_parameter")
    has_obstacles = any(
        run.get("planner") or (run.get("world") or {}).get("obstacles") for run in runs
    )
    assert has_obstacles == (claim.group == "chosen_obstacles")
    is_comparison = all(
        measure.metric.startswith("comparison.") for measure in claim.all_measures
    )
    assert is_comparison == (claim.group == "between_models")
    is_tuned = any(
        run["controller"]["kind"] in ("direct_smc", "iterative_smc") for run in runs
    )
    assert not (is_tuned and claim.group == "headline")
    assert is_tuned or claim.group != "tuned_controller"


def test_missed_rows_are_documented_as_falsifiable():
    outcomes = load_baseline().outcomes
    for claim in CLAIMS:
        if any(outcome.verdict != MET for outcome in outcomes[claim.id].values()):
            assert claim.falsifiable, claim.id


def test_own_tolerances_are_stated():
    for claim in HOLDOUTS:
        if claim.tolerance == "ours":
            assert re.search(
                r"\bours?\b|we assume|was a condition|were searched", claim.could_fail
            ), claim.id


def test_a_line_through_the_fitted_rows_of_table_8_is_as_good_as_documented():
    """A line meets all predicted speeds and edges and three of four radii."""
    runs = {run.offset: run for run in published_runs()}
    fitted = [-0.3, 0.0, 0.3]
    predicted = [-0.2, -0.1, 0.1, 0.2]

    def ratios(value):
        line = np.interp(predicted, fitted, [value(runs[at]) for at in fitted])
        return line / [value(runs[at]) for at in predicted]

    for name in ("speed_m_s", "left_m", "right_m"):
        assert (np.abs(ratios(attrgetter(name)) - 1) <= 0.2).all(), name
    curvatures = ratios(lambda run: (1 if run.offset > 0 else -1) / run.radius_m)
    assert (np.abs(1 / curvatures - 1) <= 0.2).sum() == 3


def test_rows_that_repeat_a_fitted_number_are_not_predictions():
    table = {claim.id: claim for claim in CLAIMS if claim.id.startswith("table8.")}
    fitted = {
        (name.split(".")[1], abs(claim.value))
        for name, claim in table.items()
        if claim.use == "fit"
    }
    for name, claim in table.items():
        assert ((name.split(".")[1], abs(claim.value)) in fitted) == (
            claim.use == "fit"
        ), name


def test_mirror_image_of_a_gait_shifts_the_phase_by_half_a_period():
    (claim,) = (claim for claim in CLAIMS if claim.id == "gen3-symmetry.mirror")
    spec = load_robot("gen3")
    tick = 0.001
    gaits = []
    for measure in claim.all_measures:
        document = load_scenario(measure.scenario).document["controller"]
        settings = document | {
            key.removeprefix("controller."): value for key, value in measure.set.items()
        }
        gait = Gait(
            settings["frequency_hz"],
            settings["offset"],
            phase=settings.get("phase_rad", 0.0),
        )
        gait.reset(spec, tick)
        gaits.append(gait)
    for time in np.arange(0, 2 / gaits[0].frequency, tick):
        plus, mirrored = (gait.valves_at(time) for gait in gaits)
        assert (plus == mirrored[..., ::-1]).all(), time


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("title", TITLES.values())
def test_page_counts_the_rows_of_the_claims_file(title):
    page = (ROOT / "docs/reproduction.md").read_text("utf-8")
    (line,) = re.findall(
        rf"^\| \**{re.escape(title)}\** \| (.*?) \| (.*?) \|(.*)\|$", page, re.M
    )
    (category,) = (name for name, value in TITLES.items() if value == title)
    outcomes = load_baseline().outcomes
    for column, cell in zip(("twin", "analytical", "alone"), line, strict=True):
        assert column in COLUMNS
        verdicts = [
            outcomes[claim.id][column].verdict
            for claim in CLAIMS
            if claim.category == category and column in claim.columns
        ]
        assert cell.strip() == (
            f"{verdicts.count(MET)} of {len(verdicts)}" if verdicts else ""
        )
