"""Verdicts from given numbers: rules, combinations, causes, changes from the baseline."""

from __future__ import annotations

import json
import math
from itertools import product

import pytest
from hypothesis import given, strategies as st

from srs_twin.errors import InputError
from srs_twin.reproduction.claims import Cause, Claim, Measure
from srs_twin.reproduction.report import count_verdicts, summary_line
from srs_twin.reproduction.runs import ReproductionJob
from srs_twin.reproduction.verdicts import (
    Baseline,
    ClaimOutcome,
    JudgedClaim,
    combine,
    judge,
    load_baseline,
    write_baseline,
)
from srs_twin.studies.sweep.task import DONE, Row

pytestmark = pytest.mark.fast


def claim(rule="near", value=1.0, names=("a",), **fields):
    """Return a row with a tolerance of 0.1 and one measure per scenario name."""
    measures = [Measure(scenario=name, metric="m") for name in names]
    keys = {"measure": measures[0]} if len(measures) == 1 else {"measures": measures}
    keys |= {"abs": 0.1} if rule == "near" else {}
    keys |= {
        "use": "shape",
        "could_fail": "Yes: a robot that stands still misses",
    } | fields
    keys |= {"tolerance": "measurement"} if keys["use"] == "holdout" else {}
    return Claim(
        id="row", source="Table 8", says="it moves", rule=rule, value=value, **keys
    )


class FakeStore:
    """Store whose values are looked up by the scenario's name and the changed fields."""

    def __init__(self, values):
        self._values = values
        self.run_names = []

    def jobs(self, runs):
        changes = map(str, runs.set.items())
        words = [" ".join([name, *changes]) for name in runs.name.split("+")]
        return tuple(map(ReproductionJob, words))

    def run(self, jobs, **_):
        self.run_names += dict.fromkeys(job.key for job in jobs)

    def row(self, key):
        values = self._values.get(key)
        return (
            None
            if values is None
            else Row(key, DONE, {"analytical.m": values[0], "twin.m": values[1]})
        )

    def failure(self, key):
        return "" if key in self._values else "it diverged"


def judge_values(row, values):
    """Return the outcomes of a row and the names of the runs, in order."""
    store = FakeStore(values)
    (judged,) = judge([row], store)
    return judged.outcomes, store.run_names


def test_plants_are_judged_separately_and_bounds_are_allowed():
    outcomes, _ = judge_values(claim(), {"a": (0.9, 0.89)})
    assert (outcomes["analytical"].verdict, outcomes["twin"].verdict) == (
        "met",
        "missed",
    )
    assert outcomes["twin"].error == pytest.approx(-0.11)


@pytest.mark.parametrize(
    ("take", "size", "value"),
    [
        ("most", False, 2),
        ("most", True, 3),
        ("least", True, 2),
        ("mean", True, 2.5),
        ("spread", False, 10),
        (None, False, math.nan),
    ],
)
def test_values_of_a_sweep_are_aggregated(take, size, value):
    measure = Measure(sweep="a+b", metric="m", take=take, size=size)
    outcomes, _ = judge_values(claim(measure=measure), {"a": (0, -3), "b": (0, 2)})
    assert outcomes["twin"].value == pytest.approx(value, nan_ok=True)


def test_a_row_without_a_value_is_missed_with_the_reason():
    outcomes, _ = judge_values(claim(), {})
    assert (
        outcomes["twin"].verdict == "missed" and "it diverged" in outcomes["twin"].why
    )
    outcomes, _ = judge_values(claim(), {"a": (None, 1.0)})
    assert (outcomes["analytical"].verdict, outcomes["twin"].verdict) == (
        "missed",
        "met",
    )


def test_an_ordering_needs_strictly_decreasing_values():
    row = claim("ordering", None, names=("a", "b", "c"))
    outcomes, _ = judge_values(row, {"a": (3, 3), "b": (2, 2), "c": (1, 2)})
    assert (outcomes["analytical"].verdict, outcomes["twin"].verdict) == (
        "met",
        "missed",
    )


SWITCH = Cause(says="an estimate", columns=["twin"], switch="compliance", set={"k": 1})
DOCS = Cause(says="it is known", columns=["analytical"], docs="docs/planar-models.md")


def test_a_switched_cause_explains_only_if_the_row_is_then_met():
    row = claim(cause=[SWITCH, DOCS])
    shown, ran = judge_values(row, {"a": (2, 2), "a ('k', 1)": (9, 1.05)})
    assert shown["twin"].verdict == "explained" and "compliance" in shown["twin"].why
    assert (
        shown["analytical"].verdict == "explained"
        and "docs/planar-models.md" in shown["analytical"].why
    )
    assert ran == ["a", "a ('k', 1)"]
    not_shown, _ = judge_values(row, {"a": (2, 2), "a ('k', 1)": (9, 1.5)})
    assert (
        not_shown["twin"].verdict == "missed"
        and "not met either" in not_shown["twin"].why
    )


def test_a_presumed_cause_explains_nothing():
    outcomes, ran = judge_values(
        claim(cause=[Cause(says="an estimate", columns=["twin"])]), {"a": (2, 2)}
    )
    assert (
        outcomes["twin"].verdict == "missed"
        and outcomes["twin"].why == "presumed cause: an estimate"
    )
    assert (outcomes["analytical"].why, ran) == ("", ["a"])


def test_a_met_row_needs_no_cause():
    outcomes, ran = judge_values(claim(cause=[SWITCH]), {"a": (1, 1)})
    assert outcomes["twin"].verdict == "met" and ran == ["a"]


numbers = st.floats(-1e6, 1e6).filter(lambda x: abs(x) > 1e-6)


@given(numbers, numbers)
def test_combinations(a, b):
    assert combine("ratio", (a, b)) == a / b
    assert combine("excess", (a, b)) == pytest.approx((a - b) / b, rel=1e-9, abs=1e-9)
    assert combine("difference", (a, b)) == a - b
    assert combine("unevenness", (a, -a)) == 0
    assert combine("unevenness", (a, a)) == pytest.approx(2)
    assert math.isnan(combine("ratio", (a, 0.0)))


def rows(**verdicts):
    outcomes = {
        column: ClaimOutcome(verdict, (0.123456,), 0.123456, math.nan)
        for column, verdict in verdicts.items()
    }
    return (JudgedClaim(claim(), outcomes),)


@pytest.mark.default_cases(at=[0, 1, 8])
@pytest.mark.parametrize(
    ("before", "now"), list(product(("met", "explained", "missed"), repeat=2))
)
def test_changed_verdicts_are_listed_better_or_worse(before, now, tmp_path):
    path = write_baseline(rows(twin=before), tmp_path / "baseline.json")
    changes = load_baseline(path).changes(rows(twin=now, analytical="missed"))
    assert changes == ([] if before == now else [f"row, twin: {now}, was {before}"])
    assert load_baseline(path).outcomes["row"]["twin"].value == 0.1235


def test_a_new_row_is_not_a_change():
    assert Baseline({}).changes(rows(twin="missed")) == []


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"rows": {"a": 1}, "versions": {}}', '{"rows": 3}']
)
def test_a_missing_or_invalid_baseline_is_refused(text, tmp_path):
    path = tmp_path / "baseline.json"
    with pytest.raises(InputError, match="no such file"):
        load_baseline(path)
    path.write_text(text)
    with pytest.raises(
        InputError,
        match="file is not valid JSON|file is not a baseline; --write-baseline writes",
    ):
        load_baseline(path)


def test_fitted_rows_are_not_predictions():
    outcomes = {"twin": ClaimOutcome("met", (1.0,), 1.0, 0.0)}
    fitted, held = (JudgedClaim(claim(use=use), outcomes) for use in ("fit", "holdout"))
    assert count_verdicts([fitted, held], "twin", ("holdout",)) == {
        "met": 1,
        "explained": 0,
        "missed": 0,
        "all": 1,
    }
    missed = JudgedClaim(
        claim(use="law"), {"alone": ClaimOutcome("missed", (1.0,), 1.0, 0.0)}
    )
    assert summary_line([fitted, held, missed]) == (
        "Of 3 rows the twin meets 1 of 1 headline predictions (separately: 1 of 1 rows"
        " for calibration); without a plant 0 of 1 laws."
    )


def test_missing_numbers_are_null_in_the_baseline(tmp_path):
    path = write_baseline(
        (
            JudgedClaim(
                claim(),
                {"twin": ClaimOutcome("missed", (math.nan,), math.nan, math.inf)},
            ),
        ),
        tmp_path / "b",
    )
    outcome = json.loads(path.read_text("utf-8"))["rows"]["row"]["twin"]
    assert (outcome["values"], outcome["value"], outcome["error"]) == (
        [None],
        None,
        None,
    )
