"""Functions behind the commands: the same results as the commands, without output or files of their own."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import srs_twin as srs
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


def value_of(parameters):
    """Return the values of fitted parameters by name."""
    return {parameter.name: parameter.value for parameter in parameters}


def assert_quiet(place, capsys):
    """Assert that a function wrote no files and no output."""
    assert files(place) == {"small.yaml"} and capsys.readouterr() == ("", "")


def without_times(value):
    """Return JSON data without wall times."""
    if isinstance(value, list):
        return [without_times(each) for each in value]
    if isinstance(value, dict):
        times = {"wall_s", "realtime_factor", "plan_s"}
        return {key: without_times(value[key]) for key in value.keys() - times}
    return value


def test_a_sweep_gives_the_rows_of_the_command_and_leaves_nothing(
    command, place, capsys
):
    seen = []
    found = srs.sweep(
        "small.yaml", engine=here, progress=lambda *each: seen.append(each)
    )
    assert_quiet(place, capsys)
    started, *rows = [(part, total, row is None) for part, total, row in seen]
    assert started == ("small", 4, True)
    assert rows == [("small", 4, False)] * 4
    printed = command("sweep small.yaml --out out --workers 1 --json")
    assert (printed["rows"], printed["sha256"]) == (found.done, found.sha256)
    table = pq.read_table(place / "out/results.parquet").to_pydict()
    ours = {name: list(values) for name, values in found.results.columns.items()}
    assert without_times(ours) == without_times(table)


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
    options = {"exclude": ["controller.offset=0.2"], "engine": here}
    found = srs.sweep(loaded, **options)
    assert (found.points, found.done) == (4, 2)
    changed = srs.sweep("small.yaml", set={"robot.friction.mu_t": 0.1}, **options)
    speed = "analytical.com_speed_m_s"
    assert changed.ranges[speed] != found.ranges[speed]
    with pytest.raises(
        InputError, match="a loaded sweep cannot be changed; give its name or path"
    ):
        srs.sweep(loaded, set={"duration_s": 3})
    with pytest.raises(
        UnknownNameError, match="unknown varied field 'controller.ofset'"
    ):
        srs.sweep("small.yaml", exclude=["controller.ofset=0.2"], engine=here)


WALK = EXAMPLES / "walk_left.csv"


def replayed():
    notes = []
    scenario = srs.replay_scenario(
        WALK,
        "gen2",
        plants=["analytical"],
        set={"duration_s": 2.0},
        notify=notes.append,
    )
    assert len(notes) == 1
    metrics = srs.run_scenario(scenario).metrics
    assert metrics["residuals"]
    return metrics


@pytest.mark.parametrize(
    ("call", "line"),
    [
        pytest.param(
            lambda: [srs.inspect(WALK, robot="gen2", map={"units": "mm"}).document()],
            f"inspect {shlex.quote(str(WALK))} --robot gen2 --units mm --json",
            id="inspect",
        ),
        pytest.param(
            lambda: srs.plan_scenario("follow_fig57", set={"seed": 3}).document(),
            "plan follow_fig57 --seed 3 --out out --json",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            lambda: (
                srs.run_scenario(
                    "gen2_turn", set={"duration_s": 2}, plants=["analytical"]
                ).metrics
            ),
            "run gen2_turn --duration 2 --plants analytical --out out --json",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            replayed,
            f"replay {shlex.quote(str(WALK))} --robot gen2 --plants analytical"
            " --duration 2 --out out --json",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            lambda: srs.calibrate_design("gen2", {"friction.mu_t": 0.2}).document(),
            "calibrate design gen2 --target-accuracy friction.mu_t=20% --json",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_functions_give_the_documents_of_their_commands(
    call, line, command, place, capsys
):
    found = json.loads(json.dumps(call()))
    assert_quiet(place, capsys)
    assert without_times(found) == without_times(command(line))


@pytest.mark.slow
def test_uncertainty_gives_the_document_of_the_command(command, place, capsys):
    seen = []
    found = srs.uncertainty(
        "gen2_straight",
        engine=here,
        progress=lambda *each: seen.append(each),
        plants=["analytical"],
        samples=16,
        set={"controller.frequency_hz": 2.5, "duration_s": 2.0},
    )
    # 16 samples and 3 references.
    assert seen[0] == ("analytical", 19, None) and len(seen) == 20
    assert_quiet(place, capsys)
    printed = command(
        "uncertainty gen2_straight --plants analytical --samples 16 --set"
        " controller.frequency_hz=2.5 --duration 2.0 --json"
    )
    assert printed == json.loads(json.dumps(found.document()))
    with pytest.raises(InputError, match="controller.frequency_hz was changed"):
        found.keep()


@pytest.mark.slow
def test_claims_have_the_verdicts_of_the_command(command, place, capsys):
    seen = []
    found = srs.reproduce(
        ["eq33", "actuator-90"], figures=False, progress=lambda *each: seen.append(each)
    )
    assert_quiet(place, capsys)
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
def test_a_plan_is_found_and_written(place):
    found = srs.plan_scenario("follow_fig57", set={"seed": 3}, out="again")
    assert found.plan.found and found.quality.clearance_m >= 0
    assert set(found.files) == files(place / "again")


def test_a_friction_fit_is_that_of_the_command(command, place, capsys):
    pulls = EXAMPLES / "pulls.csv"
    check = EXAMPLES / "pulls_check.csv"
    found = srs.calibrate_friction([pulls], "gen2", validate=[check])
    assert_quiet(place, capsys)
    command(
        f"calibrate friction {pulls} --robot gen2 --validate {check} --out"
        " fits/command.yaml"
    )
    srs.calibrate_friction([pulls], "gen2", validate=[check], out="fits/python.yaml")
    fits = [load_fit(place / f"fits/{name}.yaml") for name in ("command", "python")]
    assert fits[0].parameters == fits[1].parameters and fits[0].data == fits[1].data
    values = value_of(found.estimate.parameters)
    assert values == pytest.approx(value_of(fits[1].parameters), rel=1e-8)
    line = fits[1].command
    assert line.startswith("srs_twin.calibrate_friction(files=[") and "out" not in line
    assert files(place / "fits") == {
        "command.yaml",
        "command.html",
        "python.yaml",
        "python.html",
    }

    options = {"name": "mine", "out": "robots/mine.yaml"}
    fitted = srs.calibrate_robot([place / "fits/python.yaml"], **options)
    assert fitted.spec() == load_robot_file("robots/mine.yaml").spec()
    mu_t = pytest.approx(values["friction.mu_t"], rel=1e-8)
    assert fitted.spec().friction.mu_t == mu_t
    with pytest.raises(InputError, match="the file already exists"):
        srs.calibrate_robot([place / "fits/python.yaml"], **options)


@pytest.mark.nightly
def test_an_actuator_fit_is_that_of_the_command(command, place, capsys):
    held = EXAMPLES / "held.csv"
    found = srs.calibrate_actuator([held], srs.load_robot("gen2"))
    assert (found.method, found.robot) == ("static", "gen2")
    assert_quiet(place, capsys)
    printed = command(f"calibrate actuator {held} --robot gen2 --json")
    values = {each["name"]: each.get("value") for each in printed["parameters"]}
    assert values == pytest.approx(value_of(found.estimate.parameters))


@pytest.mark.slow
def test_a_locomotion_fit_is_that_of_the_command(command, place):
    motion = EXAMPLES / "walk_straight.csv"
    options = {"compare_signals": "averages", "starts": 1}
    found = srs.calibrate_locomotion(
        [motion], "gen2", parameters=["friction.mu_t"], **options
    )
    printed = command(
        f"calibrate locomotion {motion} --robot gen2 --parameters friction.mu_t --compare-signals"
        " averages --starts 1 --json"
    )
    values = {each["name"]: each.get("value") for each in printed["parameters"]}
    assert values == pytest.approx(value_of(found.estimate.parameters), rel=1e-8)


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
            lambda: srs.plan_scenario("gen2_straight"),
            "gen2_straight: the scenario has no planner",
        ),
        (
            lambda: srs.calibrate_footprint("gen2", supply_pa=48.3, frequency_hz=9),
            "frequency 9 Hz",
        ),
        (lambda: srs.diff("nowhere", "nowhere"), "nowhere"),
        (lambda: srs.reproduce(["table88"]), "unknown claim 'table88'; did you mean"),
        (
            lambda: srs.calibrate_actuator(
                [EXAMPLES / "held.csv"], "gen2", valves=["a"]
            ),
            "tables of constant pressures need no log; remove --valves",
        ),
        (
            lambda: srs.run_scenario("gen2_straight", plants=[]),
            "the list of plants is empty; name at least",
        ),
        (
            lambda: srs.uncertainty("gen2_straight", plants=[]),
            "the list of plants is empty; name at least",
        ),
        (
            lambda: srs.calibrate_margin("follow_fig57", plants=[]),
            "the list of plants is empty; name at least",
        ),
    ],
)
def test_wrong_arguments_have_the_messages_of_the_commands(call, words):
    with pytest.raises(InputError, match=words):
        call()


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
        (
            lambda: srs.calibrate_friction("pulls.csv", "gen2"),
            "calibrate_friction: files 'pulls.csv' .* a list",
        ),
    ],
)
def test_wrong_types_are_named(call, words):
    with pytest.raises(InputError, match=words):
        call()
