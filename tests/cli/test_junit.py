"""JUnit reports: outcomes of runs and expectations as GitHub, GitLab and Jenkins read them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import pytest

from srs_twin.cli.junit import report_path, write_junit
from srs_twin.cli.run import Case, CaseResult, ReportOptions
from srs_twin.comparison.undefined import Undefined
from srs_twin.errors import DivergedError, InputError, WorkerDiedError
from srs_twin.experiment import RunResult
from srs_twin.scenario.expectation import Expectation

SCENARIO = """\
title: Brief
robot: gen2
duration_s: 0.2
supply: {pressure_kpa: 48.3}
controller: {kind: gait, frequency_hz: 2.0}
plants: {analytical: {}}
expect:
  - {metric: path_length_m, plant: analytical, below: 100}
  - {metric: path_length_m, plant: analytical, above: 100, source: "<&> nobody"}
"""
EXPECT = (
    Expectation(
        metric="com_speed_m_s", plant="twin", near=0.214, rel=0.15, source="Table 10"
    ),
    Expectation(metric="com_speed_rel", of="comparison", near=0.0, abs=0.12),
    Expectation(metric="com_speed_rel", of="comparison", above=-0.5),
)
FOUND = {
    "plants": {"twin": {"com_speed_m_s": 0.2}},
    "comparison": {"com_speed_rel": -0.2},
}
METRICS = FOUND | {"expectations": [each.check(FOUND) for each in EXPECT]}


def case(name, *, metrics=None, errors=(), ended=True):
    """A scenario with three expectations and what came of it."""
    found = Case(name, SimpleNamespace(label=name, expect=EXPECT), Path("runs") / name)
    result = None if metrics is None else RunResult(name, found.folder, {}, metrics)
    found.result = CaseResult(result, errors, 1.5) if ended else None
    return found


def read(path):
    """Return suite → test case → (outcome, its words), after a check of all that readers rely on."""
    text = path.read_text("utf-8")
    assert text.startswith("<?xml version='1.0' encoding='utf-8'?>\n")
    root = ElementTree.fromstring(text)
    assert root.tag == "testsuites"
    found = {}
    for suite in root:
        assert (suite.tag, suite.get("name") in found) == ("testsuite", False)
        tests = found[suite.get("name")] = {}
        for test in suite:
            assert test.tag == "testcase"
            assert set(test.attrib) == {"classname", "name", "time"}
            assert test.get("classname") == suite.get("name")
            assert test.get("name") not in tests, (
                "readers take tests of one name for one"
            )
            assert float(test.get("time")) >= 0
            (outcome,) = list(test) or [None]
            if outcome is None:
                tests[test.get("name")] = ("passed", "")
                continue
            assert outcome.get("message")
            assert (
                (outcome.tag == "skipped")
                == (outcome.get("type") is None)
                == (outcome.text is None)
            )
            words = outcome.get("message") + "\n" + (outcome.text or "")
            tests[test.get("name")] = (outcome.tag, words)
        check_sums(suite, tests.values())
    check_sums(root, [test for tests in found.values() for test in tests.values()])
    assert float(root.get("time")) == pytest.approx(
        sum(float(s.get("time")) for s in root), abs=2e-3
    )
    return found


def check_sums(element, tests):
    kinds = [kind for kind, _ in tests]
    assert set(element.attrib) == {
        "name",
        "tests",
        "failures",
        "errors",
        "skipped",
        "time",
    }
    assert int(element.get("tests")) == len(kinds)
    for name, kind in (
        ("failures", "failure"),
        ("errors", "error"),
        ("skipped", "skipped"),
    ):
        assert int(element.get(name)) == kinds.count(kind)


def kinds(tests):
    return [kind for kind, _ in tests.values()]


def test_each_outcome_becomes_its_junit_element(tmp_path):
    flew = DivergedError("twin", 1.5, "qpos is not finite")
    cases = [
        case("ran", metrics=METRICS),
        case("flew", metrics={}, errors=(flew,)),
        case("died", errors=(WorkerDiedError(-9, 3),)),
        case("unexplained", metrics=METRICS, errors=(flew,)),
        case("later", ended=False),
        Case(
            "./bad.yaml",
            result=CaseResult(
                None, (InputError("bad.yaml:1:2: wrong\nbad.yaml:3:4: too"),)
            ),
        ),
        Case("./never_read.yaml"),
    ]
    write_junit(tmp_path / "r.xml", cases)
    found = read(tmp_path / "r.xml")
    root = ElementTree.parse(tmp_path / "r.xml").getroot()
    # The four runs that ended took 1.5 s each.
    assert (root.get("name"), float(root.get("time"))) == ("srs-twin", 4 * 1.5)
    measured = ["passed", "failure", "passed"]
    assert {name: kinds(tests) for name, tests in found.items()} == {
        "ran": ["passed", *measured],
        "flew": ["error", *3 * ["skipped"]],
        "died": ["error", *3 * ["skipped"]],
        "unexplained": ["error", *measured],
        "later": 4 * ["skipped"],
        "bad": ["error"],
        "never_read": ["skipped"],
    }
    assert list(found["ran"]) == [
        "runs",
        "twin com_speed_m_s",
        "comparison com_speed_rel",
        "comparison com_speed_rel (2)",
    ]
    _, words = found["ran"]["comparison com_speed_rel"]
    assert (
        words == "comparison com_speed_rel = -0.2, allowed -0.12 to 0.12\n"
        "value: -0.2\nallowed: -0.12 to 0.12\nsource: none stated"
    )
    assert "twin diverged at t = 1.5 s" in found["flew"]["runs"][1]
    assert "killed by SIGKILL" in found["died"]["runs"][1]
    assert "bad.yaml:1:2: wrong\nbad.yaml:3:4: too" in found["bad"]["runs"][1]


def reported(tmp_path, rows, *, strict):
    """Return the test cases of a report with rows of expectations."""
    ran = case("ran", metrics=FOUND | {"expectations": rows})
    write_junit(
        tmp_path / "r.xml", [ran], ReportOptions(check=True, strict=strict).fails
    )
    return read(tmp_path / "r.xml")["ran"]


def test_known_miss_is_skipped_and_fails_with_strict(tmp_path):
    known = {"expected_failure": "never <measured>"}
    rows = [each.model_copy(update=known).check(FOUND) for each in EXPECT]
    found = reported(tmp_path, rows, strict=False)
    assert kinds(found) == ["passed", "passed", "skipped", "passed"]
    _, words = found["comparison com_speed_rel"]
    assert words == "expected failure: never <measured>\n"
    found = reported(tmp_path, rows, strict=True)
    assert kinds(found) == ["passed", *3 * ["failure"]]
    _, words = found["comparison com_speed_rel"]
    assert words == (
        "comparison com_speed_rel = -0.2, allowed -0.12 to 0.12\nvalue: -0.2\nallowed:"
        " -0.12 to 0.12\nsource: none stated\nexpected failure: never <measured>"
    )


@pytest.mark.parametrize(
    ("strict", "kind", "words"),
    [
        (False, "skipped", "not judged: the run is short\n"),
        (True, "failure", "reason: the run is short"),
    ],
)
def test_expectation_not_judged_is_skipped_and_fails_with_strict(
    tmp_path, strict, kind, words
):
    rows = [EXPECT[0].check({}, Undefined("the run is short")), EXPECT[0].check({})]
    found = reported(tmp_path, rows, strict=strict)
    assert kinds(found) == ["passed", kind, "failure"]
    assert found["twin com_speed_m_s"][1].endswith(words)


def test_expectations_of_omitted_plants_are_not_test_cases(tmp_path):
    assert list(reported(tmp_path, [], strict=False)) == ["runs"]


def test_characters_outside_xml_are_escaped(tmp_path):
    bad = CaseResult(None, (InputError("\x1b[31mred\x00 \ud800 \ufffe <&\"'> é 🐍"),))
    write_junit(tmp_path / "r.xml", [Case("a\udcff.yaml", result=bad)])
    (name,) = read(tmp_path / "r.xml")
    assert name == "a\\udcff"
    _, words = read(tmp_path / "r.xml")[name]["runs"]
    assert words.startswith("\\x1b[31mred\\x00 \\ud800 \\ufffe <&\"'> é 🐍\n")


@pytest.mark.parametrize("name", ["", "gen2.yaml", "reports/", ".xml"])
def test_report_name_without_xml_suffix_is_refused(name):
    # A scenario after a bare --junit must not be overwritten.
    with pytest.raises(
        InputError,
        match=r"--junit .* is not allowed; the file name of a report must end in .xml",
    ):
        report_path(name)


@pytest.fixture(scope="module")
def both(tmp_path_factory, srs_twin):
    """The same scenarios in worker processes and here: (room, what each start printed)."""
    room = tmp_path_factory.mktemp("both")
    (room / "a.yaml").write_text(SCENARIO)
    (room / "bad.yaml").write_text(SCENARIO.replace("gait", "gate"))
    (room / "b.yaml").write_text(
        SCENARIO.replace("2.0", "1.5").replace("{}}", "{}, twin: {}}")
    )
    outputs = []
    for words in (
        "run . --workers 2 --out many --junit many/x/out.xml",
        "run . -j 1 --out one --check --junit one/x/out.xml",
    ):
        done = srs_twin(*words.split(), cwd=room)
        assert done.returncode == 2, "the bad one"
        outputs.append(done.stdout)
    return room, *outputs


@pytest.mark.slow
def test_files_do_not_depend_on_check(both):
    room, _, _ = both
    ran = ["passed", "passed", "failure"]
    for folder in ("many", "one"):
        found = read(room / folder / "x/out.xml")
        assert {name: kinds(tests) for name, tests in found.items()} == {
            "a": ran,
            "b": ran,
            "bad": ["error"],
        }
        assert "source: <&> nobody" in found["a"]["analytical path_length_m (2)"][1]
        assert [path.name for path in (room / folder / "x").iterdir()] == ["out.xml"]


def test_worker_processes_give_identical_files_and_output(both):
    room, many, one = both
    for name in "ab":
        here, there = (room / where / name for where in ("many", "one"))
        files = {path.name for path in here.iterdir()}
        assert files == {path.name for path in there.iterdir()}
        # Recordings have random identifiers.
        for file in files - {"metrics.json", "recording.rrd", "report.html"}:
            assert (here / file).read_bytes() == (there / file).read_bytes(), file
        assert timeless(here) == timeless(there)
    assert without_wall_times(many) == without_wall_times(one)


def timeless(run):
    """Return the metrics of a run without those that the speed of this machine decides."""
    metrics = json.loads((run / "metrics.json").read_text())
    for plant in metrics["plants"].values():
        assert plant.pop("wall_s") > 0
        assert plant.pop("realtime_factor") > 0
    return metrics


def without_wall_times(text):
    """Return a table without the time to compute, and without widths."""
    lines = (line for line in text.splitlines() if "─" not in line)
    return [line.split() for line in lines if "realtime factor" not in line]


@pytest.mark.slow
@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_report_after_an_interrupt_marks_unfinished_runs(tmp_path, end):
    (tmp_path / "brief.yaml").write_text(SCENARIO)
    (tmp_path / "long.yaml").write_text(
        SCENARIO.replace("0.2", "600").replace("{}}", "{}, twin: {}}")
    )
    (tmp_path / "r.xml").write_text("of an earlier run")
    (kept := tmp_path / "runs/long/metrics.json").parent.mkdir(parents=True)
    kept.write_text("of an earlier run")
    script = str(Path(sys.executable).with_name("srs-twin"))
    words = ["run", "./long.yaml", "./brief.yaml", "--junit", "r.xml", "--workers", "2"]
    child = subprocess.Popen(
        [script, *words],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    latest = time.monotonic() + 600
    while (
        not (tmp_path / "runs/brief/metrics.json").exists()
        and time.monotonic() < latest
    ):
        time.sleep(0.05)
    assert kinds(read(tmp_path / "r.xml")["brief"]) == ["skipped"], (
        "before the end nothing is claimed"
    )
    time.sleep(0.5)
    os.killpg(child.pid, end)
    _, said = child.communicate(timeout=300)
    assert child.returncode == 130, said
    assert "interrupted; complete runs: runs/brief\n" in said
    assert "Traceback" not in said
    found = read(tmp_path / "r.xml")
    assert kinds(found["long"]) == 3 * ["skipped"]
    assert kinds(found["brief"]) == ["passed", "passed", "failure"]
    assert [path.name for path in kept.parent.iterdir()] == [kept.name]
    assert kept.read_text() == "of an earlier run"
