"""`srs-twin diff`: differences between two sets of results."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
from xml.etree import ElementTree

import pytest
from conftest import ROOT
from hypothesis import given, strategies as st

from srs_twin.cli import main
from srs_twin.comparison.diff import (
    Results,
    Tolerance,
    diff,
    load_tolerances,
    read_results,
)
from srs_twin.errors import InputError

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


def call(capsys, *words):
    """Return the exit code, stdout and stderr of a command that runs here."""
    with pytest.raises(SystemExit) as ended:
        main(list(words))
    said = capsys.readouterr()
    return ended.value.code or 0, said.out, said.err


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Return a folder with two runs of one scenario, and one of another offset."""
    folder = tmp_path_factory.mktemp("runs")
    for name, offset in (("a", 0.0), ("b", 0.0), ("c", 0.001)):
        (folder / "walk.yaml").write_text(SCENARIO.format(offset=offset))
        with pytest.raises(SystemExit):
            main(
                [
                    "run",
                    str(folder / "walk.yaml"),
                    "--out",
                    str(folder / name / "walk"),
                    "--quiet",
                ]
            )
    return folder


def test_run_has_no_difference_from_itself(runs, capsys):
    code, out, err = call(capsys, "diff", str(runs / "a"), str(runs / "b"))
    assert (code, err) == (0, "") and out.startswith("0 different, ")
    assert int(out.split()[2]) > 20  # wall times, which do differ, are left out


def test_files_of_a_killed_run_are_not_results(runs, capsys, tmp_path):
    shutil.copytree(runs / "a", tmp_path / "a")
    shutil.copytree(runs / "c/walk", tmp_path / "a/walk/.part-killed/.earlier")
    assert call(capsys, "diff", str(runs / "a"), str(tmp_path / "a"))[0] == 0


def test_changed_offset_changes_the_yaw_rate(runs, capsys, tmp_path):
    a = str(runs / "a/walk")
    c = str(runs / "c/walk/metrics.json")
    report = tmp_path / "moved.xml"
    code, out, _ = call(capsys, "diff", a, c, "--json", "--junit", str(report))
    found = json.loads(out)
    assert code == 1 and set(found) == {"moved", "same"}
    moved = {each["metric"]: each for each in found["moved"]}
    before = json.loads((runs / "a/walk/metrics.json").read_text())["plants"][
        "analytical"
    ]
    after = json.loads((runs / "c/walk/metrics.json").read_text())["plants"][
        "analytical"
    ]
    yaw = moved["analytical.yaw_rate_rad_s"]
    assert (yaw["where"], yaw["a"], yaw["b"]) == (
        "walk",
        before["yaw_rate_rad_s"],
        after["yaw_rate_rad_s"],
    )
    assert yaw["rel"] == pytest.approx((yaw["b"] - yaw["a"]) / abs(yaw["a"]))
    assert "analytical.wall_s" not in moved and "expectations[0].met" not in moved
    (case,) = ElementTree.parse(report).iter("testcase")
    assert "analytical.yaw_rate_rad_s: " in case.find("failure").text
    # The difference is small: wide tolerances, of all or of one metric, take it in.
    assert call(capsys, "diff", a, c, "--rel", "1", "--abs", "10")[0] == 0
    (tmp_path / "wide.yaml").write_text("metrics: {yaw_rate_rad_s: {abs: 10}}\n")
    _, out, _ = call(
        capsys, "diff", a, c, "--tolerances", str(tmp_path / "wide.yaml"), "--json"
    )
    assert {each["metric"] for each in json.loads(out)["moved"]} == moved.keys() - {
        yaw["metric"]
    }


def test_missing_scenario_is_a_difference(runs, capsys, tmp_path):
    shutil.copytree(runs / "a", tmp_path / "more")
    shutil.copytree(runs / "a/walk", tmp_path / "more/other")
    code, out, _ = call(
        capsys, "diff", str(runs / "a"), str(tmp_path / "more"), "--json"
    )
    moved = json.loads(out)["moved"]
    assert code == 1 and {each["where"] for each in moved} == {"other/walk"}
    assert {each["a"] for each in moved} == {None}


def test_sweeps_are_paired_by_their_fields(capsys, tmp_path, monkeypatch):
    """Keys may differ: another target or another commit has other keys."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sweep.yaml").write_text(SWEEP + "plants: [analytical]\n")
    (tmp_path / "turned.yaml").write_text(
        SWEEP.replace("[41, 55]", "[55, 41]") + "plants: [analytical]\n"
    )
    for name in ("sweep", "turned"):
        call(
            capsys, "sweep", f"{name}.yaml", "--out", name, "--quiet", "--workers", "1"
        )
    assert call(capsys, "diff", "sweep", "turned")[0] == 0
    (tmp_path / "other.yaml").write_text(
        SWEEP.replace("41", "42") + "plants: [analytical]\n"
    )
    call(capsys, "sweep", "other.yaml", "--out", "other", "--quiet", "--workers", "1")
    code, out, _ = call(capsys, "diff", "sweep/results.parquet", "other", "--json")
    moved = json.loads(out)["moved"]
    assert code == 1
    assert {each["where"] for each in moved} == {
        "supply.pressure_kpa=41",
        "supply.pressure_kpa=42",
    }


def test_expectation_that_is_no_longer_judged_is_a_difference(capsys, tmp_path):
    row = {"metric": "com_speed_m_s", "of": "twin", "met": True}
    for name, found in (("a", row), ("b", row | {"met": False, "state": "not_judged"})):
        run = {
            "scenario": "walk",
            "plants": {},
            "comparison": None,
            "expectations": [found],
            "versions": {},
        }
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.json").write_text(json.dumps(run))
    code, out, _ = call(
        capsys, "diff", str(tmp_path / "a"), str(tmp_path / "b"), "--json"
    )
    (moved,) = json.loads(out)["moved"]
    assert (code, moved["metric"], moved["a"], moved["b"]) == (
        1,
        "expectations[0].met",
        True,
        "not judged",
    )


def test_changed_verdict_is_a_difference(capsys, tmp_path):
    outcome = {"verdict": "met", "value": 1.0, "values": [1.0], "error": 0.0, "why": ""}
    rows = [{"id": "row", "outcomes": {"twin": outcome}}]
    for name, verdict in (("a", "met"), ("b", "missed")):
        outcome["verdict"] = verdict
        (tmp_path / f"{name}.json").write_text(
            json.dumps({"rows": rows, "versions": {"mujoco": name, f"of {name}": "1"}})
        )
    code, out, err = call(
        capsys, "diff", str(tmp_path / "a.json"), str(tmp_path / "b.json")
    )
    assert (
        code == 1
        and "row, twin" in out
        and "missed" in out
        and "1 different, 1 equal" in out
    )
    assert err == "different versions of mujoco: a → b\n"


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_control_characters_in_results_are_escaped(capsys, tmp_path, options):
    for name, verdict in (("a", "met"), ("b", "[red]x\x1b[31m\x9b")):
        outcomes = {"twin": {"verdict": verdict, "value": 1.0}}
        document = {
            "rows": [{"id": "\x1b[31mrow\x7f", "outcomes": outcomes}],
            "versions": {},
        }
        (tmp_path / f"{name}.json").write_text(json.dumps(document))
    code, out, _ = call(
        capsys, "diff", str(tmp_path / "a.json"), str(tmp_path / "b.json"), *options
    )
    assert code == 1 and "[red]x" in out and not set(out) & set("\x1b\x9b")


@pytest.mark.default_cases(at=[0, 2, 3, 5, 7, 8, 9])
@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("nowhere", "a"), "nowhere: no such file"),
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
        (("list.json", "a"), "list.json: the file does not contain results"),
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
def test_bad_input(runs, capsys, monkeypatch, words, said):
    monkeypatch.chdir(runs)
    (runs / "empty").mkdir(exist_ok=True)
    (runs / "junk.json").write_text('{"plants": 3')
    (runs / "list.json").write_text("[1]")
    (runs / "bad.yaml").write_text("rel: 2\n")
    (runs / "unknown.yaml").write_text("metrics: {com_sped_m_s: {rel: 0.1}}\n")
    code, out, err = call(capsys, "diff", *words)
    assert code == 2 and said in err and out == ""


def test_invalid_input_replaces_an_earlier_report_by_an_error(runs, capsys, tmp_path):
    report = tmp_path / "moved.xml"
    report.write_text("<testsuites/>")
    words = ("diff", str(runs / "a"), str(runs / "absent"), "--junit", str(report))
    code, _, err = call(capsys, *words)
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
    assert diff(Results(one, {}), Results(other, {})).same == 2
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
    results = {}
    for name, tunables in (("own", ""), ("other", "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4")):
        words = [
            sys.executable,
            "-P",
            "-c",
            "from srs_twin.cli import main; main()",
            "sweep",
            "sweep.yaml",
        ]
        words += ["--out", name, "--workers", "1"]
        environment = {**os.environ, "GLIBC_TUNABLES": tunables}
        subprocess.run(
            words, cwd=tmp_path, env=environment, check=True, capture_output=True
        )
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
    assert (
        allowed.for_metric("analytical.com_speed_m_s").rel
        == allowed.for_metric("twin.com_speed_m_s").rel
        == 0.01
    )
    assert (
        allowed.for_metric("twin.yaw_rate_rad_s").abs
        == 0.005
        != allowed.for_metric("analytical.yaw_rate_rad_s").abs
    )


def test_foreign_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="the folder contains no results"):
        read_results(tmp_path)


def sweep_of(path, value: float):
    """Write results of a sweep with one row and one metric."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    row = {
        "key": ["k"],
        "seed": [1],
        "status": ["done"],
        "exit_code": [0],
        "twin.com_speed_m_s": [value],
    }
    pq.write_table(
        pa.table(row).replace_schema_metadata({"srs_twin.sweep": '{"versions": {}}'}),
        path,
    )
    return str(path)


@pytest.mark.parametrize(
    ("value", "text"),
    [(math.nan, "NaN"), (math.inf, "Infinity"), (-math.inf, "-Infinity")],
)
def test_numbers_that_json_does_not_have_are_printed_as_text(
    capsys, tmp_path, value, text
):
    a = sweep_of(tmp_path / "a.parquet", 0.1)
    b = sweep_of(tmp_path / "b.parquet", value)
    code, out, _ = call(capsys, "diff", a, b, "--json")
    (moved,) = json.loads(out, parse_constant=pytest.fail)["moved"]
    assert (code, moved["b"], moved["rel"]) == (1, text, None)
    code, out, _ = call(capsys, "diff", b, b, "--json")
    assert (code, json.loads(out)) == (0, {"moved": [], "same": 2})


@pytest.mark.default_cases(at=[0, 7, 29])
@pytest.mark.parametrize(
    "content",
    [
        "[]",
        "null",
        "3",
        "{}",
        '{"versions": 3}',
        '{"versions": {}, "rows": {"a": 1}}',
        '{"versions": {}, "rows": [1]}',
        (
            '{"versions": {}, "scenario": "s", "plants": [], "comparison": {},'
            ' "expectations": [1]}'
        ),
    ],
)
@pytest.mark.parametrize(
    "name", ["metrics.json", "plan.json", "sweep.json", "reproduce.json"]
)
def test_json_of_something_else_is_refused(capsys, tmp_path, name, content):
    (tmp_path / name).write_text(content)
    code, out, err = call(
        capsys, "diff", str(tmp_path / name), str(tmp_path / name), "--json"
    )
    assert (code, out) == (
        2,
        "",
    ) and "the file does not contain results" in err


def test_results_are_found_in_nested_folders(capsys, tmp_path, monkeypatch):
    levels = sys.getrecursionlimit() + 50
    monkeypatch.chdir(tmp_path)
    for _ in range(levels):
        os.mkdir("a")
        os.chdir("a")
    try:
        code, _, err = call(capsys, "diff", str(tmp_path / "a"), str(tmp_path / "a"))
    finally:
        os.chdir(tmp_path)
        for _ in range(levels):
            os.chdir("a")
        for _ in range(levels):  # pytest's own removal recurses
            os.chdir("..")
            os.rmdir("a")
    assert code == 2 and "a: the folder contains no results" in err
