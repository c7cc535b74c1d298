"""Command line: exit codes, output, and files."""

from __future__ import annotations

import os
import pickle
import re
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import pytest
from subsets import first_by_default

from srs_twin.cli import main
from srs_twin.cli.app import command
from srs_twin.cli.console import ScenarioProgress
from srs_twin.cli.table import needs_explanation, rows
from srs_twin.cli.view import find_recording
from srs_twin.compute.workers import TaskResult
from srs_twin.errors import DivergedError, InputError, TaskFailedError, WorkerDiedError
from srs_twin.experiment import RECORDING, RunResult
from srs_twin.scenario.expectation import Expectation

COMMAND = Path(sys.executable).with_name("srs-twin")
HEAVY = (
    "mujoco",
    "dm_control",
    "rerun",
    "numpy",
    "scipy",
    "matplotlib",
    "pyarrow",
    "pydantic",
    "numba",
)
REASON = "the drag was never measured (docs/planar-models.md)"
EXPECTED = (
    Expectation(
        metric="com_speed_m_s", plant="twin", near=0.214, rel=0.15, source="Table 10"
    ),
    Expectation(metric="com_speed_rel", of="comparison", near=0.0, abs=0.12),
)
FOUND = {
    "plants": {
        "analytical": {
            "com_speed_m_s": 0.25,
            "yaw_rate_rad_s": 0.001,
            "realtime_factor": 1234.5,
        },
        "twin": {
            "com_speed_m_s": 0.2,
            "yaw_rate_rad_s": -0.002,
            "realtime_factor": 12.3,
        },
    },
    "comparison": {"com_speed_rel": -0.2, "shape_rms_m": 0.00321},
    "changes": [],
    "left_out": [],
}


def judged(*known, expected=EXPECTED):
    """Return metrics in which the expectations with the given numbers are known misses."""
    rows = [each.check(FOUND) for each in expected]
    for k in known:
        expected_failure = {"expected_failure": REASON}
        rows[k] = expected[k].model_copy(update=expected_failure).check(FOUND)
    return FOUND | {"expectations": rows}


UNJUDGED = {
    "state": "not_judged",
    "reason": "the run is short",
    "value": None,
    "met": False,
}
ATTRIBUTION = {
    "measures": ["com_speed_m_s", "yaw_rate_rad_s"],
    "window_s": 4.0,
    "shares": [
        {
            "name": "compliance",
            "value": [-0.04, 5e-5],
            "low": [-0.05, 0.0],
            "high": [-0.03, 2e-4],
        },
        {"name": "contact", "value": [0.01, 0], "low": [0.01, 0], "high": [0.01, 0]},
    ],
    "remainder": [-0.02, 4.9e-5],
    "gap": [-0.05, -0.003],
    "matched": [0.001, 0.0],
    "damping": {"longer damping": [-2e-4, -4.9e-5]},
}
GIVEN = {
    "explained": judged() | {"attribution": ATTRIBUTION},
    "met": judged(expected=EXPECTED[:1]),
    "missed": judged(),
    "expected_failure": judged(1),
    "holds": judged(0, 1),
    "not_judged": FOUND
    | {"expectations": [each | UNJUDGED for each in judged(1)["expectations"]]},
}


@dataclass
class Job:
    """Fake prepared run with a given outcome."""

    name: str
    folder: Path
    log: list[str]
    outcome: object

    def execute(self, progress, main_cause=None):
        self.log.append(f"run {self.name}")
        if isinstance(self.outcome, DivergedError):
            return RunResult(
                self.name, self.folder, {"twin": object()}, diverged=(self.outcome,)
            )
        if isinstance(self.outcome, BaseException):
            raise self.outcome
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / RECORDING).touch()
        return RunResult(
            self.name, self.folder, {"twin": object()}, GIVEN[self.outcome]
        )


def last_first(task, arguments, *, workers):
    """Fake worker processes that finish in reverse order."""
    for number in reversed(range(len(arguments))):
        try:
            done = TaskResult(number, task(arguments[number]), None)
            # Results are pickled between processes.
            yield pickle.loads(pickle.dumps(done))
        except RuntimeError as error:
            yield TaskResult(number, None, TaskFailedError(error))
        except MemoryError:
            yield TaskResult(number, None, WorkerDiedError(-signal.SIGKILL, 3))


@pytest.fixture
def start(monkeypatch, capsys, tmp_path):
    """Run `srs-twin` with fake runs, scenario name → outcome; return exit code, stdout, stderr and log."""
    monkeypatch.chdir(tmp_path)

    def run(*words, **endings):
        log = []

        def load(name, *, set):  # noqa: A002 - as `load_scenario`
            log.append(f"load {name}")
            if isinstance(endings[name], InputError):
                raise endings[name]
            expect = EXPECTED[:1] if endings[name] == "met" else EXPECTED
            warned = (f"{name} is warned of",)
            scenario = SimpleNamespace(
                name=name, label=name, expect=expect, warnings=warned
            )
            scenario.run_on = lambda plants: scenario
            return scenario

        def prepare(scenario, folder, *, plants):
            return Job(scenario.name, folder, log, endings[scenario.name])

        monkeypatch.setattr("srs_twin.scenario.loading.load_scenario", load)
        monkeypatch.setattr(
            "srs_twin.experiment.check_run", lambda scenario, folder: None
        )
        monkeypatch.setattr("srs_twin.experiment.prepare", prepare)
        monkeypatch.setattr("srs_twin.compute.workers.run_tasks", last_first)
        with pytest.raises(SystemExit) as left:
            main(list(words))
        said = capsys.readouterr()
        return SimpleNamespace(
            code=left.value.code or 0, out=said.out, err=said.err, log=log
        )

    return run


def test_command_line_imports_nothing_heavy():
    code = (
        f"import sys, srs_twin.cli.app as a; a.command(); print([m for m in {HEAVY} if"
        " m in sys.modules])"
    )
    assert (
        subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"
    )


def test_exit_collects_no_garbage():
    """The collections at the end of the interpreter would take a quarter of the time of `compare`."""
    code = (
        "import atexit, gc; atexit.register(lambda: print(gc.get_count()[0] <"
        " gc.get_freeze_count()))\nfrom srs_twin.cli import main; main(['--version'])"
    )
    said = subprocess.check_output([sys.executable, "-c", code], text=True)
    assert said.splitlines()[1:] == ["True"]


def commands(of=None, words=()):
    of = of or command()
    yield words, of
    for name, each in getattr(of, "commands", {}).items():
        yield from commands(each, (*words, name))


HELPS = [words for words, _ in commands()]


@pytest.mark.default_cases(at=[0, 22, 37])
@pytest.mark.parametrize("words", HELPS, ids=" ".join)
def test_help_is_complete_and_not_truncated(start, monkeypatch, words):
    monkeypatch.setenv("COLUMNS", "80")
    left = start(*words, "--help")
    assert left.code == 0
    listed = left.out.partition("Commands:")[2]
    assert "..." not in listed
    assert (
        "......" not in left.out and "...}..." not in left.out and "[[" not in left.out
    )
    # Types of Python are no words for a value.
    assert not re.findall(r"--[a-z-]+ +<", left.out)
    assert not re.findall(r"\[default: [^]]*\]\s+\[default", left.out)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["comparee"], "Did you mean 'compare'?"),
        (["compare"], "Missing argument 'SCENARIO'"),
        (["run", "x", "--chek"], "--check"),
        (["run", "x", "--workers=0"], "--workers"),
        (["run", "x", "--workers=two"], "--workers"),
        (["compare", "a", "b"], "unexpected extra argument"),
    ],
)
def test_usage_error_exits_with_2(start, words, said):
    left = start(*words)
    assert left.code == 2
    assert said in left.err
    assert left.out == ""
    assert not set("─│╭╰") & set(left.err)


@pytest.mark.parametrize(
    ("words", "ending", "code"),
    [
        ("run a", "missed", 0),
        ("run a --check", "met", 0),
        ("run a --check", "missed", 1),
        ("compare a --check", "missed", 1),
        ("run a --check", "holds", 0),
        ("run a --strict", "met", 0),
        ("run a --strict", "holds", 1),
        ("compare a --check", "expected_failure", 0),
        ("compare a --strict", "expected_failure", 1),
        ("run a", InputError("x.yaml:1:2: no"), 2),
        ("run a", DivergedError("twin", 1.5, "qpos is not finite"), 3),
        ("run a", RuntimeError("nobody foresaw this"), 4),
        ("run a", KeyboardInterrupt(), 130),
    ],
)
def test_exit_codes(start, words, ending, code):
    assert start(*words.split(), a=ending).code == code


def test_invalid_scenario_is_reported_first_and_does_not_stop_the_rest(start):
    endings = {"a": "met", "bad": InputError("bad.yaml:3:1: wrong"), "c": "missed"}
    left = start("run", "a", "bad", "c", "--workers", "1", **endings)
    assert left.log == ["load a", "load bad", "load c", "run a", "run c"]
    assert left.err.startswith("bad.yaml:3:1: wrong\n")
    assert left.code == 2
    several = start("run", "a", "bad", "c", "--workers", "2", **endings)
    assert several.log == ["load a", "load bad", "load c", "run c", "run a"]
    assert (several.code, several.out, several.err) == (left.code, left.out, left.err)


@pytest.mark.parametrize("jobs", ["1", "2", "7"])
def test_exit_code_is_the_highest_of_all_scenarios(start, jobs):
    diverged = DivergedError("twin", 1.5, "qpos is not finite", history=[1])
    left = start(
        "run", "a", "b", "c", "--check", "-j", jobs, a="missed", b=diverged, c="met"
    )
    assert left.code == 3
    assert "twin diverged at t = 1.5 s: qpos is not finite" in left.err
    assert {"run a", "run b", "run c"} <= set(left.log)


def test_output_follows_the_order_of_the_scenarios(start):
    endings = {name: "met" for name in "abcd"} | {
        "b": DivergedError("twin", 1.5, "b flew")
    }
    one, many = (
        start("run", *"abcd", "--workers", jobs, **endings) for jobs in ("1", "4")
    )
    assert one.log == [
        *(f"load {name}" for name in "abcd"),
        *(f"run {name}" for name in "abcd"),
    ]
    assert many.log[4:] == one.log[:3:-1]
    assert (many.out, many.err) == (one.out, one.err)
    assert [
        line.strip() for line in many.out.splitlines() if len(line.strip()) == 1
    ] == ["a", "c", "d"]
    assert [text for text in many.err.splitlines() if "warn" not in text] == [
        "files in runs/a; `srs-twin view runs/a` shows the run",
        "twin diverged at t = 1.5 s: b flew",
        "files in runs/c; `srs-twin view runs/c` shows the run",
        "files in runs/d; `srs-twin view runs/d` shows the run",
    ]


@pytest.mark.parametrize(
    ("metric", "met", "more", "asks"),
    [
        ("com_speed_rel", False, {}, True),
        ("yaw_rate_abs", False, {}, True),
        ("com_speed_rel", True, {}, False),
        ("com_speed_m_s", False, {}, False),
        ("com_speed_rel", False, {"attribution": {}}, False),
    ],
)
def test_unexpected_difference_needs_explanation(metric, met, more, asks):
    metrics = {"expectations": [{"metric": metric, "met": met}], **more}
    assert needs_explanation(metrics) is asks


KNOWN = f"comparison com_speed_rel = -0.2, allowed -0.12 to 0.12; expected failure: {REASON}"


def test_known_misses_are_counted_separately(start):
    left = start("run", *"abc", "--check", a="missed", b="expected_failure", c="holds")
    assert left.code == 1
    labels = re.findall("^(met|MISSED|expected|HOLDS) +[tc]", left.out, re.MULTILINE)
    assert labels == ["met", "MISSED", "met", "expected", "HOLDS", "expected"]
    summary = (
        "expectations: 2 met, 1 missed, 2 known to be missed, 1 met though known to be"
        " missed"
    )
    assert f"{summary} (take `expected_failure` out)\n" in left.err


def test_quiet_prints_failed_and_newly_met_expectations(start):
    left = start("run", *"ab", "--check", "-q", a="expected_failure", b="holds")
    assert (left.code, left.out) == (0, "")
    holds = (
        "twin com_speed_m_s = 0.2, allowed 0.1819 to 0.2461 (Table 10); expected failure:"
        f" {REASON}"
    )
    assert left.err == f"HOLDS  {holds}\n"
    left = start("run", *"ab", "--strict", "-q", a="expected_failure", b="holds")
    assert (left.code, left.err) == (
        1,
        f"expected {KNOWN}\nHOLDS  {holds}\nexpected {KNOWN}\n",
    )


def test_expectations_not_judged_are_counted_with_their_reason(start):
    left = start("run", *"ab", "--check", a="met", b="not_judged")
    assert left.code == 0 and "expectations: 1 met, 2 not judged\n" in left.err
    words = (
        "not judged twin com_speed_m_s = none, allowed 0.1819 to 0.2461 (Table 10);"
        " reason: the run is short"
    )
    assert words in " ".join(left.out.split())
    assert "to find the causes of the difference" not in left.err
    for option, code in (("--check", 0), ("--strict", 1)):
        quiet = start("run", "a", option, "-q", a="not_judged")
        assert (quiet.code, quiet.err.splitlines()[0]) == (code, words)
    assert start("run", "a", a="not_judged").code == 0


def test_worker_death_and_internal_error_affect_only_their_scenario(start):
    endings = {
        "a": "met",
        "b": MemoryError(),
        "c": RuntimeError("nobody foresaw this"),
        "d": "met",
    }
    left = start("run", *"abcd", "--workers", "2", **endings)
    assert left.code == 4
    for words in (
        "b: the worker process was killed by SIGKILL, 3 times in a row; the machine ran"
        " out of",
        "c: internal error: RuntimeError: nobody foresaw this (test_cli.py:",
        "files in runs/a;",
        "files in runs/d;",
    ):
        assert words in left.err


def test_interrupt_names_complete_runs(start):
    endings = {"a": "met", "b": KeyboardInterrupt(), "c": "met"}
    left = start("run", "a", "b", "c", "--workers", "1", **endings)
    assert left.code == 130
    assert "interrupted; complete runs: runs/a\n" in left.err
    assert "run c" not in left.log
    # c was finished, its table waited for those of a and b.
    assert (
        "interrupted; complete runs: runs/c\n"
        in start("run", "a", "b", "c", "-j", "2", **endings).err
    )


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_junit_report_is_written_for_every_outcome(start, tmp_path, jobs):
    def outcomes():
        tests = ElementTree.parse(tmp_path / "r.xml").iter("testcase")
        return [
            (t.get("classname"), t.get("name"), t[0].tag if len(t) else "passed")
            for t in tests
        ]

    words = ("run", "a", "bad", "c", "--junit", "r.xml", "--workers", jobs)
    bad = InputError("bad.yaml:3:1: wrong")
    assert start(*words, a="met", bad=bad, c="missed").code == 2
    of_c = [
        ("c", "runs", "passed"),
        ("c", "twin com_speed_m_s", "passed"),
        ("c", "comparison com_speed_rel", "failure"),
    ]
    assert outcomes()[2:] == [("bad", "runs", "error"), *of_c]
    stop = KeyboardInterrupt()
    assert start(*words, a=stop, bad=bad, c=stop).code == 130
    tags = [tag for *_, tag in outcomes()]
    assert tags == [*3 * ["skipped"], "error", *3 * ["skipped"]]
    flew = DivergedError("twin", 1.5, "it flew")
    assert start(*words, a="met", bad=bad, c=flew).code == 3
    tags = [tag for *_, tag in outcomes()]
    assert tags == [*2 * ["passed"], *2 * ["error"], *2 * ["skipped"]]
    start("compare", "c", "--junit", "r.xml", c="missed")
    assert outcomes() == of_c


def test_unwritable_folder_is_reported_once(start, tmp_path):
    (tmp_path / "file").touch()
    left = start("run", "a", "b", "--out", "file/below", a="met", b="met")
    assert (left.code, left.log) == (2, ["load a", "load b"])
    assert (
        left.err
        == "file/below: cannot write there (Not a directory); give another folder with"
        " --out\n"
    )


def test_internal_error_is_one_line_with_contact(start, monkeypatch):
    left = start("run", "a", a=RuntimeError("two\nlines"))
    lines = [line for line in left.err.splitlines() if "warn" not in line]
    assert len(lines) == 1
    assert "internal error: RuntimeError: two lines (test_cli.py:" in lines[0]
    assert "report it with the command and your files" in lines[0]
    monkeypatch.setenv("SRS_TWIN_DEBUG", "1")
    assert (
        "Traceback (most recent call last)"
        in start("run", "a", a=RuntimeError("x")).err
    )


def test_several_runs_get_subfolders(start):
    assert "files in out;" in start("run", "a", "--out", "out", a="met").err
    several = start(
        "run", "a", "b", "--out", "out", "--workers", "1", a="met", b="met"
    ).err
    assert "files in out/a;" in several
    assert "files in out/b;" in several
    assert "files in runs/a;" in start("run", "a", a="met").err


def test_the_only_scenario_of_a_folder_gets_a_subfolder(start, tmp_path):
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "a.yaml").touch()
    left = start("run", "set", "--out", "out", **{"set/a.yaml": "met"})
    assert "files in out/set/a.yaml;" in left.err


def test_folder_argument_runs_all_its_files(start, tmp_path):
    (tmp_path / "set").mkdir()
    for name in ("b.yaml", "a.yaml", "notes.txt"):
        (tmp_path / "set" / name).touch()
    left = start("run", "set", **{"set/a.yaml": "met", "set/b.yaml": "met"})
    assert [each for each in left.log if each.startswith("load")] == [
        "load set/a.yaml",
        "load set/b.yaml",
    ]


def test_table_fits_80_columns_and_marks_missed_expectations(start, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    left = start("compare", "a", a="missed")
    assert all(len(line) <= 80 for line in left.out.splitlines())
    (speed,) = (line.split() for line in left.out.splitlines() if "CoM speed " in line)
    assert speed == ["CoM", "speed", "m/s", "0.25", "0.2", "-0.05", "-20.0", "0.214"]
    (yaw,) = (line.split() for line in left.out.splitlines() if "yaw rate " in line)
    assert yaw == ["yaw", "rate", "rad/s", "0.001", "-0.002", "-0.003"]
    assert (
        "met    twin com_speed_m_s = 0.2, allowed 0.1819 to 0.2461 (Table 10)"
        in left.out
    )
    assert "MISSED comparison com_speed_rel = -0.2, allowed -0.12 to 0.12" in left.out


def test_table_of_the_attribution_has_signed_contributions(start):
    left = start("compare", "a", a="explained")
    printed = [" ".join(line.split()) for line in left.out.splitlines()]
    for line in (
        "(first 4 s of the runs)",
        "compliance -0.0400 +0.0001",
        "lowest, any order -0.0500 0",
        "highest, any order -0.0300 +0.0002",
        "contact +0.0100 0",
        "not explained -0.0200 0",
        "difference -0.0500 -0.0030",
        "matched (stiff bends) +0.0010 0",
        "change with a longer damping -0.0002 0",
    ):
        assert line in printed
    assert left.out.count("any order") == 2


def test_quiet_leaves_stdout_and_stderr_empty(start):
    left = start("run", "a", "--quiet", a="met")
    assert (left.code, left.out, left.err) == (0, "", "")
    missed = start("run", "a", "-q", "--check", a="missed")
    assert (missed.code, missed.out) == (1, "")
    assert (
        missed.err == "MISSED comparison com_speed_rel = -0.2, allowed -0.12 to 0.12\n"
    )


def test_progress_starts_after_two_seconds(monkeypatch, capsys):
    now = [100.0]
    monkeypatch.setattr("srs_twin.cli.console.time.monotonic", lambda: now[0])
    with ScenarioProgress("gen2") as progress:
        for second in range(30):
            now[0] = 100.0 + second
            progress("twin", second / 30)
    assert capsys.readouterr().err == "gen2: twin 7%\ngen2: twin 40%\ngen2: twin 73%\n"
    with ScenarioProgress("gen2", quiet=True) as progress:
        now[0] += 60
        progress("twin", 0.5)
    assert capsys.readouterr().err == ""


def test_long_stage_is_announced_at_once_with_its_estimated_time(monkeypatch, capsys):
    now = [100.0]
    monkeypatch.setattr("srs_twin.cli.console.time.monotonic", lambda: now[0])
    with ScenarioProgress("gen2") as progress:
        progress("attribution", 0.0, 12.3)
        now[0] += 3
        progress("attribution", 0.25, 9.0)
        now[0] += 8
        progress("attribution", 0.9, 1.2)
    first = "gen2: attribution 0%, about 12 s left\n"
    assert capsys.readouterr().err == first + "gen2: attribution 90%, about 1 s left\n"


def test_view_looks_in_the_run_folder_and_under_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    recording = tmp_path / "runs/a/recording.rrd"
    recording.parent.mkdir(parents=True)
    recording.touch()
    for given in ("a", "runs/a", "runs/a/recording.rrd"):
        assert find_recording(given).resolve() == recording
    with pytest.raises(
        InputError,
        match=r"^b: no recording was found \(looked for b/recording\.rrd, runs/b/",
    ):
        find_recording("b")
    (tmp_path / "x.csv").touch()
    with pytest.raises(InputError, match=r"^x.csv: this is not a recording"):
        find_recording("x.csv")


BRIEF = """\
robot: gen2
duration_s: 2
supply: {pressure_kpa: 48.3}
controller: {kind: gait, frequency_hz: 2.0}
plants: {analytical: {}}
expect: [{metric: com_speed_m_s, plant: analytical, near: 0, abs: LIMIT}]
"""


def into_closed_pipe(words, folder, closed):
    """Run `srs-twin` with streams that lead to a pipe whose reader has left."""
    reader, writer = os.pipe()
    os.close(reader)
    try:
        streams = dict.fromkeys(("stdout", "stderr"), subprocess.PIPE) | dict.fromkeys(
            closed, writer
        )
        return subprocess.run(
            [COMMAND, *words], check=False, cwd=folder, text=True, **streams
        )
    finally:
        os.close(writer)


@pytest.mark.parametrize(
    "words", first_by_default(2, ["schema", "list metrics", "--help", "--version"])
)
def test_closed_pipe_is_not_an_error(tmp_path, words):
    done = into_closed_pipe(words.split(), tmp_path, ["stdout"])
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("last", "code", "closed"),
    [("1", 0, ["stdout"]), ("none", 2, ["stdout", "stderr"])],
)
def test_closed_pipe_stops_output_but_not_the_runs(tmp_path, last, code, closed):
    for name, limit in (("a", "1"), ("b", "1"), ("c", last)):
        (tmp_path / f"{name}.yaml").write_text(BRIEF.replace("LIMIT", limit))
    words = (
        "run",
        "./a.yaml",
        "./b.yaml",
        "./c.yaml",
        "--check",
        "--workers",
        "2",
        "--junit",
        "r.xml",
    )
    done = into_closed_pipe(words, tmp_path, closed)
    assert done.returncode == code
    assert "BrokenPipe" not in (done.stderr or "")
    ran = {path.parent.name for path in tmp_path.glob("runs/*/metrics.json")}
    assert ran == ({"a", "b"} if code == 2 else {"a", "b", "c"})
    assert len(ElementTree.parse(tmp_path / "r.xml").findall(".//testsuite")) == 3


def test_gap_factor_has_a_row_only_if_it_is_used():
    def second_row(comparison):
        heading, _, value, *_ = rows(judged() | {"comparison": comparison})[1]
        return heading, value

    for comparison in (None, {}, {"gap_factor": 1.0}):
        assert second_row(comparison)[0] == "yaw rate"
    used = second_row({"gap_factor": 0.9123})
    assert used == ("… by the gap factor", "× 0.9123")
