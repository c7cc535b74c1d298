"""Verdicts from numbers that are given: rules, combinations, causes, changes from the baseline."""

from __future__ import annotations

import json
import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from srs_twin.errors import InputError
from srs_twin.reproduction.claims import Cause, Claim, Measure
from srs_twin.reproduction.report import count, summary_line
from srs_twin.reproduction.runs import Job
from srs_twin.reproduction.verdicts import (
    Baseline,
    Judged,
    Outcome,
    combined,
    judge,
    load_baseline,
    taken,
    write_baseline,
)
from srs_twin.studies.sweep.task import DONE, Row

pytestmark = pytest.mark.fast


def claim(rule="near", value=1.0, names=("a",), **more):
    """Return a row, within 0.1 of its value, whose measures are scenarios of these names."""
    measures = [Measure(scenario=name, metric="m") for name in names]
    found = {"measure": measures[0]} if len(measures) == 1 else {"measures": measures}
    found |= {"abs": 0.1} if rule == "near" else {}
    found |= {"use": "shape", "could_fail": "Yes: a robot that stands still misses"} | more
    found |= {"tolerance": "measurement"} if found["use"] == "holdout" else {}
    return Claim(id="row", source="Table 8", says="it moves", rule=rule, value=value, **found)


class Numbers:
    """A store: a run's values are looked up by the scenario's name and the fields that are set."""

    def __init__(self, values):
        self._values, self.run_names = values, []

    def jobs(self, runs):
        return (Job(" ".join([runs.name, *map(str, runs.set.items())])),)

    def run(self, jobs, **_):
        self.run_names += dict.fromkeys(job.key for job in jobs)

    def row(self, key):
        found = self._values.get(key)
        return None if found is None else Row(key, DONE, {"analytical.m": found[0], "twin.m": found[1]})

    def failure(self, key):
        return "" if key in self._values else "it diverged"


def judged(row, values):
    numbers = Numbers(values)
    ((found),) = (judge([row], numbers),)
    return found[0].outcomes, numbers.run_names


def test_plants_are_judged_by_themselves_and_bounds_are_allowed():
    found, _ = judged(claim(), {"a": (0.9, 0.89)})
    assert (found["analytical"].verdict, found["twin"].verdict) == ("met", "missed")
    assert found["twin"].error == pytest.approx(-0.11)


def test_a_run_without_a_number_is_missed_and_says_why():
    found, _ = judged(claim(), {})
    assert found["twin"].verdict == "missed" and "it diverged" in found["twin"].why
    found, _ = judged(claim(), {"a": (None, 1.0)})
    assert (found["analytical"].verdict, found["twin"].verdict) == ("missed", "met")


def test_an_ordering_needs_each_above_the_next():
    row = claim("ordering", None, names=("a", "b", "c"))
    found, _ = judged(row, {"a": (3, 3), "b": (2, 2), "c": (1, 2)})
    assert (found["analytical"].verdict, found["twin"].verdict) == ("met", "missed")


SWITCH = Cause(says="an estimate", columns=["twin"], switch="compliance", set={"k": 1})
DOCS = Cause(says="it is known", columns=["analytical"], docs="docs/models.md")


def test_a_cause_must_be_shown():
    row = claim(cause=[SWITCH, DOCS])
    shown, ran = judged(row, {"a": (2, 2), "a ('k', 1)": (9, 1.05)})
    assert shown["twin"].verdict == "explained" and "compliance" in shown["twin"].why
    assert shown["analytical"].verdict == "explained" and "docs/models.md" in shown["analytical"].why
    assert ran == ["a", "a ('k', 1)"]
    not_shown, _ = judged(row, {"a": (2, 2), "a ('k', 1)": (9, 1.5)})
    assert not_shown["twin"].verdict == "missed" and "not met either" in not_shown["twin"].why


def test_a_cause_that_is_only_supposed_explains_nothing():
    found, ran = judged(claim(cause=[Cause(says="an estimate", columns=["twin"])]), {"a": (2, 2)})
    assert found["twin"].verdict == "missed" and found["twin"].why == "presumed cause: an estimate"
    assert (found["analytical"].why, ran) == ("", ["a"])


def test_nothing_is_explained_that_is_met():
    found, ran = judged(claim(cause=[SWITCH]), {"a": (1, 1)})
    assert found["twin"].verdict == "met" and ran == ["a"]


numbers = st.floats(-1e6, 1e6).filter(lambda x: abs(x) > 1e-6)


@given(numbers, numbers)
def test_combinations(a, b):
    assert combined("ratio", (a, b)) == a / b
    assert combined("excess", (a, b)) == pytest.approx((a - b) / b, rel=1e-9, abs=1e-9)
    assert combined("difference", (a, b)) == a - b
    assert combined("unevenness", (a, -a)) == 0
    assert combined("unevenness", (a, a)) == pytest.approx(2)
    assert math.isnan(combined("ratio", (a, 0.0)))


def test_what_is_taken_of_several():
    values = np.array([1.0, 2.0, 4.0])
    assert [taken(how, values) for how in ("most", "least", "mean")] == [4, 1, pytest.approx(7 / 3)]
    assert taken("spread", values) == pytest.approx(3 / (7 / 3))
    assert all(
        math.isnan(taken(how, np.array([1.0, math.nan]))) for how in ("most", "least", "mean", "spread")
    )


def rows(**verdicts):
    outcomes = {
        column: Outcome(verdict, (0.123456,), 0.123456, math.nan) for column, verdict in verdicts.items()
    }
    return (Judged(claim(), outcomes),)


@pytest.mark.parametrize(("before", "now"), list(product(("met", "explained", "missed"), repeat=2)))
def test_a_verdict_that_is_not_the_baselines_is_a_change_better_or_worse(before, now, tmp_path):
    path = write_baseline(rows(twin=before), tmp_path / "baseline.json")
    found = load_baseline(path).changes(rows(twin=now, analytical="missed"))
    assert found == ([] if before == now else [f"row, twin: {now}, was {before}"])
    assert load_baseline(path).outcomes["row"]["twin"].value == 0.1235


def test_a_row_that_is_new_has_not_changed():
    assert Baseline({}, {}).changes(rows(twin="missed")) == []


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"rows": {"a": 1}, "versions": {}}', '{"rows": 3}'])
def test_no_baseline(text, tmp_path):
    path = tmp_path / "baseline.json"
    with pytest.raises(InputError, match="no such file"):
        load_baseline(path)
    path.write_text(text)
    with pytest.raises(InputError, match="not JSON|not a baseline; --write-baseline writes one"):
        load_baseline(path)


def test_fitted_rows_are_no_predictions():
    outcomes = {"twin": Outcome("met", (1.0,), 1.0, 0.0)}
    fitted, held = (Judged(claim(use=use), outcomes) for use in ("fit", "holdout"))
    assert count([fitted, held], "twin", ("holdout",)) == {"met": 1, "explained": 0, "missed": 0, "all": 1}
    line = summary_line([fitted, held])
    assert "1 of 1 headline predictions" in line and "(separately: 1 of 1 rows for calibration)" in line


def test_what_is_written_is_json(tmp_path):
    path = write_baseline(
        (Judged(claim(), {"twin": Outcome("missed", (math.nan,), math.nan, math.inf)}),), tmp_path / "b"
    )
    found = json.loads(path.read_text("utf-8"))["rows"]["row"]["twin"]
    assert (found["values"], found["value"], found["error"]) == ([None], None, None)
