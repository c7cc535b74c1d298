"""Functions behind the commands: the same results as the commands, without output or files of their own."""

from __future__ import annotations

import contextlib
import io
import json
import shlex
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import srs_twin as srs
from srs_twin.cli import app
from srs_twin.compute.workers import TaskResult
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.identification.fit_file import load_fit
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.robot.file import load_robot_file
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.studies.sweep.task import run_point

EXAMPLES = Path(__file__).parents[1] / "calibration/examples/my_snake"
SWEEP = """\
scenario: gen2_straight
plants: [analytical]
fixed: {duration_s: 2}
vary:
  controller.frequency_hz: [2, 2.5]
  controller.offset: [0.0, 0.2]
"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    """An empty current folder with a short sweep in it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.yaml").write_text(SWEEP, "utf-8")
    return tmp_path


@pytest.fixture
def command(srs_twin, place):
    """Return a function from the words of a command to its JSON document."""

    def run(line):
        done = srs_twin(*shlex.split(line), cwd=place)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout) if "--json" in line else done

    return run


def here(experiment, points):
    """Run points one after the other in this process."""
    for number, point in enumerate(points):
        yield TaskResult(number, run_point(experiment, point), None)


def interrupted(experiment, points):
    """Run three points, then do what Ctrl-C does."""
    yield from here(experiment, points[:3])
    raise KeyboardInterrupt


def files(folder):
    return {path.name for path in folder.iterdir()}


def without_times(value):
    """Return JSON data without wall times."""
    if isinstance(value, dict):
        times = ("wall_s", "realtime_factor", "plan_s")
        return {
            key: without_times(each) for key, each in value.items() if key not in times
        }
    return [without_times(each) for each in value] if isinstance(value, list) else value


def test_a_sweep_gives_the_rows_of_the_command_and_leaves_nothing(
    command, place, capsys
):
    seen = []
    found = srs.sweep(
        "small.yaml", engine=here, progress=lambda *each: seen.append(each)
    )
    assert files(place) == {"small.yaml"} and capsys.readouterr() == ("", "")
    assert [(part, total, row is None) for part, total, row in seen] == [
        ("small", 4, True),
        *[("small", 4, False)] * 4,
    ]
    printed = command("sweep small.yaml --out out --workers 1 --json")
    assert (printed["rows"], printed["sha256"]) == (found.done, found.sha256)
    table = pq.read_table(place / "out/results.parquet").to_pydict()
    assert {
        name: list(values)
        for name, values in found.results.columns.items()
        if name != "wall_s"
    } == {name: values for name, values in table.items() if name != "wall_s"}


def test_an_interrupted_sweep_keeps_its_rows_and_resumes(place):
    with pytest.raises(KeyboardInterrupt) as stopped:
        srs.sweep("small.yaml", out="out", engine=interrupted)
    assert stopped.value.__notes__ == [
        "3 of 4 rows are kept; start the command again to resume"
    ]
    assert pq.read_table("out/results.parquet").num_rows == 3
    seen = []
    found = srs.sweep(
        "small.yaml",
        out="out",
        engine=here,
        progress=lambda *each: seen.append(each[2]),
    )
    assert found.done == 4 and len(seen) == 2 and seen[0] is None


def test_a_sweep_can_be_changed_by_name_but_not_when_loaded(place):
    loaded = load_sweep("small.yaml")
    found = srs.sweep(loaded, exclude=["controller.offset=0.2"], engine=here)
    assert (found.points, found.done) == (4, 2)
    changed = srs.sweep(
        "small.yaml",
        set={"robot.friction.mu_t": 0.1},
        exclude=["controller.offset=0.2"],
        engine=here,
    )
    assert (
        changed.ranges["analytical.com_speed_m_s"]
        != found.ranges["analytical.com_speed_m_s"]
    )
    with pytest.raises(
        InputError, match="a loaded sweep cannot be changed; give its name or path"
    ):
        srs.sweep(loaded, set={"duration_s": 3})


@pytest.mark.slow
def test_uncertainty_gives_the_document_of_the_command(command, place, capsys):
    options = {
        "plants": ["analytical"],
        "samples": 16,
        "set": {"controller.frequency_hz": 2.5, "duration_s": 2.0},
    }
    seen = []
    found = srs.uncertainty(
        "gen2_straight", engine=here, progress=lambda *e: seen.append(e), **options
    )
    assert (
        seen[0] == ("analytical", 19, None) and len(seen) == 20
    )  # 16 samples and 3 references
    assert files(place) == {"small.yaml"} and capsys.readouterr() == ("", "")
    line = (
        "uncertainty gen2_straight --plants analytical --samples 16 --set"
        " controller.frequency_hz=2.5"
    )
    printed = command(f"{line} --duration 2.0 --json")
    assert printed == json.loads(json.dumps(found.document()))
    with pytest.raises(InputError, match="controller.frequency_hz was changed"):
        found.keep()


@pytest.mark.slow
def test_claims_have_the_verdicts_of_the_command(command, place, capsys):
    seen = []
    found = srs.reproduce(
        ["eq33", "actuator-90"], figures=False, progress=lambda *each: seen.append(each)
    )
    assert files(place) == {"small.yaml"} and capsys.readouterr() == ("", "")
    assert [(part, row is None) for part, _, row in seen] == [("runs", True)] + [
        ("runs", False)
    ] * seen[0][1]
    printed = command(
        "reproduce --only eq33 --only actuator-90 --no-figures --out out --json"
    )
    verdicts = {row.claim.id: row.outcomes["alone"].verdict for row in found.rows}
    assert verdicts == {
        row["id"]: row["outcomes"]["alone"]["verdict"] for row in printed["rows"]
    }
    assert list(found.changes) == printed["changed_from_baseline"]


@pytest.mark.slow
def test_a_plan_is_that_of_the_command(command, place, capsys):
    found = srs.plan_scenario("follow_fig57", set={"seed": 3})
    assert files(place) == {"small.yaml"} and capsys.readouterr() == ("", "")
    assert found.plan.found and found.quality.clearance_m >= 0
    printed = command("plan follow_fig57 --seed 3 --out out --json")
    assert json.loads(json.dumps(found.document())) == printed
    assert set(srs.plan_scenario("follow_fig57", out="again").files) == files(
        place / "again"
    )
    with pytest.raises(InputError, match="gen2_straight: the scenario has no planner"):
        srs.plan_scenario("gen2_straight")


@pytest.mark.slow
def test_a_run_has_the_metrics_of_the_command(command, place, capsys):
    found = srs.run_scenario("gen2_turn", set={"duration_s": 2}, plants=["analytical"])
    assert files(place) == {"small.yaml"} and capsys.readouterr() == ("", "")
    assert isinstance(found.trajectories["analytical"], srs.Trajectory)
    printed = command(
        "run gen2_turn --duration 2 --plants analytical --out first --json"
    )
    assert without_times(printed) == without_times(found.metrics)
    srs.run_scenario(
        "gen2_turn", "second", set={"duration_s": 2, "seed": 1}, plants=["analytical"]
    )
    document = srs.diff("first", place / "second").document()
    assert document == json.loads(command_diff(place)) and document["same"] > 20


def command_diff(place):
    """Return what `diff` prints; its exit code depends on the result."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        app.command()(args=["diff", "first", "second", "--json"], prog_name="srs-twin")
    return out.getvalue()


@pytest.mark.slow
def test_a_replay_is_that_of_the_command(command, place, capsys):
    notes = []
    motion = EXAMPLES / "walk_left.csv"
    scenario = srs.replay_scenario(
        motion,
        "gen2",
        plants=["analytical"],
        set={"duration_s": 2.0},
        notify=notes.append,
    )
    found = srs.run_scenario(scenario)
    assert capsys.readouterr() == ("", "") and len(notes) == 1
    line = (
        f"replay {shlex.quote(str(motion))} --robot gen2 --plants analytical --duration"
        " 2 --out out --json"
    )
    printed = without_times(command(line))
    assert printed == without_times(found.metrics) and printed["residuals"]


def test_inspect_gives_the_facts_of_the_command(command):
    path = EXAMPLES / "walk_left.csv"
    found = srs.inspect(path, robot="gen2", map={"units": "mm"})
    line = f"inspect {shlex.quote(str(path))} --robot gen2 --units mm --json"
    assert [found.document()] == command(line)


def test_a_friction_fit_is_that_of_the_command(command, place, capsys):
    pulls = EXAMPLES / "pulls.csv"
    check = EXAMPLES / "pulls_check.csv"
    found = srs.calibrate_friction([pulls], "gen2", validate=[check])
    assert files(place) == {"small.yaml"} and capsys.readouterr() == ("", "")
    command(
        f"calibrate friction {pulls} --robot gen2 --validate {check} --out"
        " fits/command.yaml"
    )
    srs.calibrate_friction([pulls], "gen2", validate=[check], out="fits/python.yaml")
    fits = [load_fit(place / f"fits/{name}.yaml") for name in ("command", "python")]
    assert fits[0].parameters == fits[1].parameters and fits[0].data == fits[1].data
    values = {
        parameter.name: parameter.value for parameter in found.estimate.parameters
    }
    assert values == pytest.approx(
        {each.name: each.value for each in fits[1].parameters}, rel=1e-8
    )
    assert (
        fits[1].command.startswith("srs_twin.calibrate_friction(files=[")
        and "out" not in fits[1].command
    )
    assert files(place / "fits") == {
        "command.yaml",
        "command.html",
        "python.yaml",
        "python.html",
    }

    fitted = srs.calibrate_robot(
        [place / "fits/python.yaml"], "mine", out="robots/mine.yaml"
    )
    assert fitted.spec() == load_robot_file("robots/mine.yaml").spec()
    assert fitted.spec().friction.mu_t == pytest.approx(
        values["friction.mu_t"], rel=1e-8
    )
    with pytest.raises(InputError, match="the file already exists"):
        srs.calibrate_robot(
            [place / "fits/python.yaml"], "mine", out="robots/mine.yaml"
        )


def test_tables_of_constant_pressures_need_no_log():
    with pytest.raises(
        InputError, match="tables of constant pressures need no log; remove --valves"
    ):
        srs.calibrate_actuator([EXAMPLES / "held.csv"], "gen2", valves=["log.csv"])


@pytest.mark.nightly
def test_an_actuator_fit_is_that_of_the_command(command, place, capsys):
    held = EXAMPLES / "held.csv"
    found = srs.calibrate_actuator([held], srs.load_robot("gen2"))
    assert (
        found.method == "static"
        and found.robot == "gen2"
        and capsys.readouterr() == ("", "")
    )
    printed = command(f"calibrate actuator {held} --robot gen2 --json")
    values = {
        parameter["name"]: parameter.get("value") for parameter in printed["parameters"]
    }
    known = {
        each.name: each.value
        for each in found.estimate.parameters
        if each.value is not None
    }
    assert {
        name: value for name, value in values.items() if value is not None
    } == pytest.approx(known)


@pytest.mark.slow
def test_a_locomotion_fit_is_that_of_the_command(command, place):
    motion = EXAMPLES / "walk_straight.csv"
    found = srs.calibrate_locomotion(
        [motion],
        "gen2",
        parameters=["friction.mu_t"],
        compare_signals="averages",
        starts=1,
    )
    printed = command(
        f"calibrate locomotion {motion} --robot gen2 --parameters friction.mu_t --compare-signals"
        " averages --starts 1 --json"
    )
    values = {
        parameter["name"]: parameter.get("value") for parameter in printed["parameters"]
    }
    assert values == pytest.approx(
        {each.name: each.value for each in found.estimate.parameters}, rel=1e-8
    )


@pytest.mark.slow
def test_a_design_is_that_of_the_command(command):
    found = srs.calibrate_design("gen2", {"friction.mu_t": 0.2})
    printed = command(
        "calibrate design gen2 --target-accuracy friction.mu_t=20% --json"
    )
    assert json.loads(json.dumps(found.document())) == printed


def test_a_footprint_is_that_of_its_file(place, capsys):
    seen = []
    found = srs.calibrate_footprint(
        "gen2",
        out="prints",
        plant="analytical",
        offsets=np.array([0.2, -0.2, 0.0]),
        transients=False,
        phases=1,
        periods=3,
        progress=lambda *each: seen.append(each),
    )
    assert seen == [(1, 3), (2, 3), (3, 3)] and capsys.readouterr() == ("", "")
    body = load_footprint(place / "prints/gen2_gait.yaml")
    assert body.offsets == found.offsets == (-0.2, 0.0, 0.2)
    assert body.speeds == pytest.approx([path.speed for path in found.steady], rel=1e-3)


@pytest.mark.default_cases(at=[0, 3, 4, 5, 6, 7, 8, 9])
@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            lambda: srs.sweep("fig31_coars"),
            "unknown sweep 'fig31_coars'; did you mean fig31_coarse",
        ),
        (
            lambda: srs.optimize("gen2_sped"),
            "unknown study 'gen2_sped'; did you mean gen2_speed",
        ),
        (lambda: srs.uncertainty("gen2_strait"), "unknown scenario"),
        (
            lambda: srs.sweep("fig31_coarse", engine="locl"),
            "unknown engine 'locl'; did you mean local",
        ),
        (
            lambda: srs.uncertainty("gen2_straight", set={"duration": 2}),
            "did you mean duration_s",
        ),
        (
            lambda: srs.calibrate_design("gen2", {}),
            "give one or more, for example friction.mu_t",
        ),
        (lambda: srs.calibrate_margin("gen2_straight"), "planner"),
        (
            lambda: srs.calibrate_footprint("gen2", supply_pa=48.3, frequency_hz=9),
            "frequency 9 Hz",
        ),
        (lambda: srs.diff("nowhere", "nowhere"), "nowhere"),
        (lambda: srs.reproduce(["table88"]), "unknown claim 'table88'; did you mean"),
    ],
)
def test_wrong_names_have_the_messages_of_the_commands(call, words):
    with pytest.raises(InputError, match=words):
        call()


@pytest.mark.default_cases(at=[0, 1, 3, 4, 8])
@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: srs.sweep(3), "sweep: sweep 3 .* a text or a path or a Sweep"),
        (
            lambda: srs.sweep("fig31", set="duration_s=2"),
            "sweep: set 'duration_s=2' .* a mapping or a list",
        ),
        (
            lambda: srs.sweep("fig31", plants="twin"),
            "sweep: plants 'twin' .* a list, each a text",
        ),
        (
            lambda: srs.sweep("fig31", workers="two"),
            "sweep: workers 'two' .* a whole number or None",
        ),
        (
            lambda: srs.uncertainty(srs.load_robot("gen2")),
            "uncertainty: scenario of type RobotSpec",
        ),
        (lambda: srs.optimize(None), "optimize: study None"),
        (lambda: srs.plan_scenario("follow_fig57", out=3), "plan_scenario: out 3"),
        (
            lambda: srs.calibrate_friction("pulls.csv", "gen2"),
            "files 'pulls.csv' .* a list",
        ),
        (
            lambda: srs.calibrate_design("gen2", "friction.mu_t=5%"),
            "calibrate_design: target_accuracy",
        ),
    ],
)
def test_wrong_types_are_named(call, words):
    with pytest.raises(InputError, match=words):
        call()


def test_unknown_values_to_leave_out_are_named(place):
    with pytest.raises(
        UnknownNameError, match="unknown varied field 'controller.ofset'"
    ):
        srs.sweep("small.yaml", exclude=["controller.ofset=0.2"], engine=here)


@pytest.mark.parametrize(
    "call",
    [
        lambda: srs.run_scenario("gen2_straight", plants=[]),
        lambda: srs.uncertainty("gen2_straight", plants=[]),
        lambda: srs.calibrate_margin("follow_fig57", plants=[]),
    ],
)
def test_an_empty_list_of_plants_is_refused(call):
    with pytest.raises(InputError, match="the list of plants is empty; name at least"):
        call()
