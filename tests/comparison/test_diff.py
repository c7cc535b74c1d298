"""`srs-twin diff`: differences between two sets of results."""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
from pathlib import Path
from xml.etree import ElementTree

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import ROOT
from hypothesis import given, strategies as st
from processes import python

from srs_twin.cli.diff import _cells, _show
from srs_twin.comparison.diff import (
    ChangedValue,
    Difference,
    Results,
    Tolerance,
    Tolerances,
    diff,
    load_tolerances,
    read_results,
)

SCENARIO = """\
robot: gen2
duration_s: 3
controller: {{kind: gait, frequency_hz: 2.0, offset: {offset}}}
plants: {{analytical: {{}}}}
expect: [{{metric: path_length_m, plant: analytical, below: 100}}]
"""
SWEEP = """\
scenario: gen2_straight
fixed: {duration_s: 1.5}
vary: {supply.pressure_kpa: [41, 55]}
"""


@pytest.fixture
def call(srs_twin, tmp_path):
    """Return a function that gives the exit code, stdout and stderr of a `diff`."""

    def run(*words):
        done = srs_twin("diff", *map(str, words), cwd=tmp_path)
        return done.returncode, done.stdout, done.stderr

    return run


@pytest.fixture(scope="module")
def runs(tmp_path_factory, srs_twin):
    """Return a folder with two runs of one scenario, and one of another offset."""
    folder = tmp_path_factory.mktemp("runs")
    for name, offset in (("a", 0.0), ("b", 0.0), ("c", 0.001)):
        (folder / "walk.yaml").write_text(SCENARIO.format(offset=offset))
        srs_twin("run", "walk.yaml", "--out", f"{name}/walk", "--quiet", cwd=folder)
    return folder


def test_run_has_no_difference_from_itself(runs, call):
    code, out, err = call(runs / "a", runs / "b")
    assert (code, err) == (0, "") and out.startswith("0 different, ")
    assert int(out.split()[2]) > 20  # wall times, which do differ, are left out


def test_files_of_a_killed_run_are_not_results(runs, call, tmp_path):
    shutil.copytree(runs / "a", tmp_path / "a")
    shutil.copytree(runs / "c/walk", tmp_path / "a/walk/.part-killed/.earlier")
    assert call(runs / "a", "a")[0] == 0


def test_changed_offset_changes_the_yaw_rate(runs, call, tmp_path):
    a, c = (runs / f"{name}/walk/metrics.json" for name in "ac")
    code, out, _ = call(a.parent, c, "--json", "--junit", "moved.xml")
    found = json.loads(out)
    assert code == 1 and set(found) == {"moved", "same"}
    moved = {each["metric"]: each for each in found["moved"]}
    before, after = (
        json.loads(path.read_text())["plants"]["analytical"]["yaw_rate_rad_s"]
        for path in (a, c)
    )
    assert moved["analytical.yaw_rate_rad_s"] == {
        "where": "walk",
        "metric": "analytical.yaw_rate_rad_s",
        "a": before,
        "b": after,
        "rel": pytest.approx((after - before) / abs(before)),
    }
    assert "analytical.wall_s" not in moved and "expectations[0].met" not in moved
    (case,) = ElementTree.parse(tmp_path / "moved.xml").iter("testcase")
    assert "analytical.yaw_rate_rad_s: " in case.find("failure").text
    # The difference is small: wide tolerances, of all or of one metric, take it in.
    assert call(a, c, "--rel", "1", "--abs", "10")[0] == 0
    (tmp_path / "wide.yaml").write_text("metrics: {yaw_rate_rad_s: {abs: 10}}\n")
    _, out, _ = call(a, c, "--tolerances", "wide.yaml", "--json")
    del moved["analytical.yaw_rate_rad_s"]
    assert {each["metric"] for each in json.loads(out)["moved"]} == moved.keys()


def test_missing_scenario_is_a_difference(runs, call, tmp_path):
    shutil.copytree(runs / "a", tmp_path / "more")
    shutil.copytree(runs / "a/walk", tmp_path / "more/other")
    code, out, _ = call(runs / "a", "more", "--json")
    moved = json.loads(out)["moved"]
    assert code == 1 and {each["where"] for each in moved} == {"other/walk"}
    assert {each["a"] for each in moved} == {None}


def test_sweeps_are_paired_by_their_fields(call, srs_twin, tmp_path):
    """Keys may differ: another target or another commit has other keys."""
    for name, pressures in (
        ("sweep", "[41, 55]"),
        ("turned", "[55, 41]"),
        ("other", "[42, 55]"),
    ):
        text = SWEEP.replace("[41, 55]", pressures) + "plants: [analytical]\n"
        (tmp_path / f"{name}.yaml").write_text(text)
        words = ("--out", name, "--quiet", "--workers", "1")
        srs_twin("sweep", f"{name}.yaml", *words, cwd=tmp_path)
    assert call("sweep", "turned")[0] == 0
    code, out, _ = call("sweep/results.parquet", "other", "--json")
    assert code == 1
    assert {each["where"] for each in json.loads(out)["moved"]} == {
        "supply.pressure_kpa=41",
        "supply.pressure_kpa=42",
    }


def test_expectation_that_is_no_longer_judged_is_a_difference(call, tmp_path):
    row = {"metric": "com_speed_m_s", "of": "twin", "met": True}
    for name, found in (("a", row), ("b", row | {"met": False, "state": "not_judged"})):
        run = {
            "scenario": "walk",
            "plants": {},
            "comparison": None,
            "expectations": [found],
            "versions": {},
        }
        (tmp_path / f"{name}.json").write_text(json.dumps(run))
    code, out, _ = call("a.json", "b.json", "--json")
    assert code == 1
    change = {"a": True, "b": "not judged", "rel": None}
    where = {"where": "walk", "metric": "expectations[0].met"}
    assert json.loads(out)["moved"] == [where | change]


def test_changed_verdict_is_a_difference(call, tmp_path):
    for name, verdict in (("a", "met"), ("b", "missed")):
        rows = [{"id": "row", "outcomes": {"twin": {"verdict": verdict, "value": 1.0}}}]
        versions = {"mujoco": name, f"of {name}": "1"}
        document = {"rows": rows, "versions": versions}
        (tmp_path / f"{name}.json").write_text(json.dumps(document))
    code, out, err = call("a.json", "b.json")
    assert code == 1
    for words in ("row, twin", "missed", "1 different, 1 equal"):
        assert words in out
    assert err == "different versions of mujoco: a → b\n"


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_control_characters_in_results_are_escaped(call, tmp_path, options):
    for name, verdict in (("a", "met"), ("b", "[red]x\x1b[31m\x9b")):
        outcomes = {"twin": {"verdict": verdict, "value": 1.0}}
        rows = [{"id": "\x1b[31mrow\x7f", "outcomes": outcomes}]
        document = {"rows": rows, "versions": {}}
        (tmp_path / f"{name}.json").write_text(json.dumps(document))
    code, out, _ = call("a.json", "b.json", *options)
    assert code == 1 and "[red]x" in out and not set(out) & set("\x1b\x9b")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ("empty", "a"),
            (
                "empty: the folder contains no results; give a folder with files such as"
                " metrics.json, results.parquet, reproduce.json"
            ),
        ),
        (
            ("a/walk/analytical.parquet", "a"),
            "analytical.parquet: the file does not contain results",
        ),
        (("junk.json", "a"), "junk.json:1:13: the file is not valid JSON"),
        (("a", "a", "--rel", "-1"), "--rel -1 is not allowed"),
        (("a", "a", "--abs", "nan"), "--abs nan is not allowed"),
        (
            ("a", "a", "--tolerances", "bad.yaml"),
            "bad.yaml:1:6: rel: must be a number from 0 to 1",
        ),
        (
            ("a", "a", "--tolerances", "unknown.yaml"),
            "unknown metric of a tolerance 'com_sped_m_s'",
        ),
        (
            ("a", "a", "--junit", "a.yaml"),
            "--junit a.yaml is not allowed; the file name of a report must end in .xml",
        ),
    ],
)
def test_bad_input(runs, call, tmp_path, words, said):
    (tmp_path / "a").symlink_to(runs / "a")
    (tmp_path / "empty").mkdir()
    (tmp_path / "junk.json").write_text('{"plants": 3')
    (tmp_path / "bad.yaml").write_text("rel: 2\n")
    (tmp_path / "unknown.yaml").write_text("metrics: {com_sped_m_s: {rel: 0.1}}\n")
    code, out, err = call(*words)
    assert code == 2 and said in err and out == ""


def test_invalid_input_replaces_an_earlier_report_by_an_error(runs, call, tmp_path):
    report = tmp_path / "moved.xml"
    report.write_text("<testsuites/>")
    code, _, err = call(runs / "a", "absent", "--junit", report)
    assert code == 2
    (case,) = ElementTree.parse(report).iter("testcase")
    message = case.find("error").get("message")
    assert "absent: no such file" in message and message in err


numbers = (
    st.none()
    | st.booleans()
    | st.floats(allow_nan=False)
    | st.integers()
    | st.text(max_size=3)
)


@given(
    st.dictionaries(st.tuples(st.text(max_size=2), st.text(max_size=4)), numbers),
    st.data(),
)
def test_every_value_is_counted_once(values, data):
    other = {place: data.draw(numbers) for place in values if data.draw(st.booleans())}
    found = diff(Results(values, {}), Results(other, {}))
    assert len(found.moved) + found.same == len(values)
    lost = {
        place for place in values.keys() - other.keys() if values[place] is not None
    }
    assert {(each.where, each.metric) for each in found.moved} >= lost
    assert not diff(Results(values, {}), Results(values, {})).moved


def test_single_runs_are_compared_regardless_of_their_names():
    one, other = (
        {(name, "twin.com_speed_m_s"): 0.2, (name, "twin.yaw_rate_rad_s"): None}
        for name in "ab"
    )
    found = diff(Results(one, {}), Results(other, {}))
    assert (found.same, found.wheres) == (2, ("a",))
    assert len(diff(Results(one | {("c", "x"): 1}, {}), Results(other, {})).moved) == 3


@given(st.floats(-1e300, 1e300), st.floats(0, 0.1))
def test_the_tolerance_is_that_of_its_docstring(a, rel):
    b = a * (1 + 0.05)
    expected = abs(a - b) <= max(1e-9, rel * max(abs(a), abs(b)))
    assert Tolerance(rel=rel, abs=1e-9).allows(a, b) == expected
    assert not Tolerance().allows(True, 1) and not Tolerance().allows(None, 0.0)


@pytest.mark.slow
def test_rounding_differences_are_within_the_default_tolerances(tmp_path):
    """The C library's other variants of sin and exp: last digits differ, no metric moves."""
    (tmp_path / "sweep.yaml").write_text(SWEEP)
    program = "from srs_twin.cli import main; main()"
    results = {}
    for name, tunables in (("own", ""), ("other", "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4")):
        words = ("sweep", "sweep.yaml", "--out", name, "--workers", "1")
        python("-P", "-c", program, *words, cwd=tmp_path, GLIBC_TUNABLES=tunables)
        results[name] = read_results(tmp_path / name)
    if results["own"].versions == results["other"].versions:
        pytest.skip("this processor has one variant only")
    found = diff(results["own"], results["other"])
    assert not found.moved and found.same > 50 and set(found.versions) == {"arithmetic"}


def test_documented_tolerances_load(tmp_path):
    page = (ROOT / "docs/ci.md").read_text("utf-8")
    _, _, rest = page.partition("```yaml tolerances\n")
    (tmp_path / "tolerances.yaml").write_text(rest.partition("```")[0])
    allowed = load_tolerances(tmp_path / "tolerances.yaml")
    assert allowed.for_metric("analytical.com_speed_m_s").rel == 0.01
    assert allowed.for_metric("twin.com_speed_m_s").rel == 0.01
    assert allowed.for_metric("twin.yaw_rate_rad_s").abs == 0.005
    assert allowed.for_metric("analytical.yaw_rate_rad_s").abs != 0.005


@pytest.mark.parametrize("metric", ["plan.duty[3][0]", "twin.duty_minus_3_period_12"])
def test_one_tolerance_covers_all_numbers_of_a_list(metric):
    allowed = Tolerances(rel=0.1, metrics={"duty": Tolerance(abs=0.5)})
    assert allowed.for_metric(metric).abs == 0.5
    assert allowed.for_metric("twin.duty_lowest").rel == 0.1


def sweep_of(path: Path, value: float) -> Path:
    """Write results of a sweep with one row and one metric."""
    row = {
        "key": ["k"],
        "seed": [1],
        "status": ["done"],
        "exit_code": [0],
        "twin.com_speed_m_s": [value],
    }
    metadata = {"srs_twin.sweep": '{"versions": {}}'}
    pq.write_table(pa.table(row).replace_schema_metadata(metadata), path)
    return path


@pytest.mark.parametrize(
    ("value", "text"),
    [(math.nan, "NaN"), (math.inf, "Infinity"), (-math.inf, "-Infinity")],
)
def test_numbers_that_json_does_not_have_are_printed_as_text(
    call, tmp_path, value, text
):
    a = sweep_of(tmp_path / "a.parquet", 0.1)
    b = sweep_of(tmp_path / "b.parquet", value)
    code, out, _ = call(a, b, "--json")
    (moved,) = json.loads(out, parse_constant=pytest.fail)["moved"]
    assert (code, moved["b"], moved["rel"]) == (1, text, None)
    code, out, _ = call(b, b, "--json")
    assert (code, json.loads(out)) == (0, {"moved": [], "same": 2})


@pytest.mark.parametrize(
    ("metric", "a", "b", "cells"),
    [
        ("twin.com_speed_m_s", 0.123456, 0.25, ["0.1235", "0.25", "+0.127", "+103"]),
        (
            "twin.com_speed_m_s",
            0.12345678,
            0.123457,
            ["0.1234568", "0.123457", "+2.2e-07", "+0.000178"],
        ),
        # Yaw rates below 0.05 rad/s are near zero.
        ("twin.yaw_rate_rad_s", 0.049, 0.06, ["0.049", "0.06", "+0.011", ""]),
        ("twin.contacts", None, 3, ["–", "3", "", ""]),
    ],
)
def test_table_has_the_digits_that_show_a_difference(metric, a, b, cells):
    assert _cells(ChangedValue("walk", metric, a, b)) == cells


def test_long_table_ends_with_the_number_of_further_differences(capsys):
    moved = [ChangedValue("walk", f"m_{i}", i, i + 1) for i in range(42)]
    _show(Difference(tuple(moved), 5, ("walk",), {}))
    out = capsys.readouterr().out
    assert " m_39 " in out.replace("\n", " ") and " m_40 " not in out
    last = "and 2 more; list all with --json\n42 different, 5 equal\n"
    assert out.endswith(last)


@pytest.mark.parametrize(
    "content",
    [
        "[]",
        "{}",
        '{"versions": "ab"}',
        '{"versions": {}, "rows": [{"id": "a", "outcomes": 3}]}',
        '{"versions": {}, "scenario": "s", "plants": [], "comparison": {}}',
    ],
)
def test_json_of_something_else_is_refused(call, tmp_path, content):
    (tmp_path / "metrics.json").write_text(content)
    code, out, err = call("metrics.json", "metrics.json", "--json")
    assert (code, out) == (2, "")
    assert "metrics.json: the file does not contain results" in err


def test_folders_are_searched_to_any_depth(call, tmp_path, monkeypatch):
    levels = sys.getrecursionlimit() + 50
    monkeypatch.chdir(tmp_path)
    for _ in range(levels):
        os.mkdir("a")
        os.chdir("a")
    try:
        code, _, err = call("a", "a")
    finally:
        for _ in range(levels):  # pytest's own removal recurses
            os.chdir("..")
            os.rmdir("a")
    assert code == 2 and "a: the folder contains no results" in err
