"""Modified scenarios: changed fields in titles and reports, and invalidated expectations."""

from __future__ import annotations

import json
from xml.etree import ElementTree

import numpy as np
import pytest
from snakes import robot

import srs_twin as srs
from srs_twin import InputError, load_scenario
from srs_twin.experiment import load_run
from srs_twin.io.documents import Override, dump_yaml, parse_yaml
from srs_twin.io.files import data_root
from srs_twin.robot.file import load_robot_file
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.modified import affects, marked
from srs_twin.scenario.provenance import judged_provenance, run_provenance
from srs_twin.studies.optimization.loading import load_study
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.studies.sweep.points import RUNNER
from srs_twin.viewing.html.report import robot_table
from srs_twin.viewing.mujoco.live import LiveSnake

TITLE = "Generation 2, straight, 2 Hz, 48.3 kPa"
SLOW = {"controller.frequency_hz": 1.0}
SLOWER = "(modified: controller.frequency_hz 2 → 1)"


PEG = {"x_m": 1.0, "y_m": 2.0, "radius_m": 0.1}


def read_json(path):
    return json.loads(path.read_text("utf-8"))


def gen2(**fields):
    return load_scenario("gen2_straight", set=fields)


def changed(scenario):
    return {each["field"]: (each["from"], each["to"]) for each in scenario.changes}


@pytest.mark.parametrize(
    ("fields", "listed"),
    [
        (SLOW, {"controller.frequency_hz": (2.0, 1.0)}),
        (
            {"controller.offset": 0.3},
            {"controller.offset": (0.0, 0.3)},
        ),  # the file has 0.0, too
        (
            {"start.x_m": 1.0, "seed": 4},
            {"start.x_m": (0.0, 1.0), "seed": (0, 4)},
        ),  # the file has neither
        (
            {"robot": {"base": "gen2", "friction": {"mu_t": 0.1}}},
            {"robot.friction.mu_t": (0.043, 0.1)},
        ),
        ({"robot.base": "gen3"}, {"robot": ("gen2", "gen3")}),
        ({"plants.twin.preset": "fast"}, {"plants.twin.preset": (None, "fast")}),
        (
            {"plants": {"twin": {}}, "expect": []},
            {"plants": (["analytical", "twin"], ["twin"])},
        ),
        ({"world.obstacles": [PEG]}, {"world.obstacles": ([], [PEG])}),
        ({"expect[0].rel": 0.5}, {"expect[0].rel": (0.15, 0.5)}),
        # Nothing else is run than the file says.
        (
            {
                "controller.frequency_hz": 2,
                "duration_s": 10,
                "robot": "gen2",
                "title": TITLE,
            },
            {},
        ),
        ({"robot.friction.mu_t": 0.043, "valves.layout": "3/2", "start.x_m": 0}, {}),
    ],
)
def test_changed_fields_are_listed(fields, listed):
    found = gen2(**fields)
    pairs = changed(found)
    pairs.pop("expect", None)
    assert pairs == listed
    assert ("modified" in found.title) == bool(found.changes)


def test_title_names_few_changes_and_counts_many():
    assert gen2(**SLOW).title == f"{TITLE} {SLOWER}"
    assert gen2(**SLOW).label == f"gen2_straight {SLOWER}"
    assert gen2().title == TITLE
    many = {
        "controller.offset": 0.1,
        "seed": 3,
        "duration_s": 4,
        "robot.friction.mu_n": 0.5,
    }
    assert gen2(**many).title == f"{TITLE} (modified: 4 fields)"
    # A title has one line of a picture, however long values are.
    far = [PEG | {"x_m": float(k)} for k in range(400)]
    obstacles = gen2(**{"world.obstacles": far})
    assert obstacles.title == f"{TITLE} (modified: world.obstacles none → 1200 values)"
    assert gen2(**{"world.obstacles": far[1:] + far[:1]}).changes != obstacles.changes
    long = "a" * 100
    change = {"field": long, "from": 1, "to": 2}
    assert marked("x", [change]) == f"x (modified: {long})"


def test_changes_are_kept_until_a_value_is_restored():
    slow = gen2(**SLOW, seed=5)
    read = parse_yaml(dump_yaml(slow.document), "scenario.resolved.yaml").data
    assert parse_scenario(read, name="again") == slow
    once_more = parse_scenario(
        read, set={"controller.frequency_hz": np.array(3.0), "duration_s": 4.0}
    )
    assert changed(once_more) == {
        "controller.frequency_hz": (2.0, 3.0),
        "seed": (0, 5),
        "duration_s": (10.0, 4.0),
    }
    restored = parse_scenario(read, set={"controller.frequency_hz": 2.0, "seed": 0})
    assert restored == gen2()
    assert len(restored.expect) == 7
    with pytest.raises(InputError, match="set seed=1j: must consist of"):
        parse_scenario(read, set={"seed": 1j})


def test_hand_edited_value_is_listed_with_its_present_value():
    document = gen2(**SLOW).document
    edited = {**document["controller"], "frequency_hz": 1.5}
    document = {**document, "controller": edited}
    assert changed(parse_scenario(document)) == {"controller.frequency_hz": (2.0, 1.5)}


def test_keys_of_runs_do_not_depend_on_how_a_value_was_set():
    data = parse_yaml(
        (data_root() / "scenarios/gen2_straight.yaml").read_text("utf-8"), "x"
    ).data
    data["controller"]["frequency_hz"] = 1.0
    written = parse_scenario(data, name="other").document
    was_set = gen2(**SLOW).document
    assert "changes" in was_set and "changes" not in written
    assert (
        run_provenance(was_set, ["twin"], RUNNER).key
        == run_provenance(written, ["twin"], RUNNER).key
    )
    assert judged_provenance(was_set).key == judged_provenance(written).key


def test_reworded_source_keeps_an_interval_and_another_value_does_not():
    document = gen2().document
    digest = judged_provenance(document).key
    friction = document["robot"]["friction"]["mu_n"]
    wider = {**friction["uncertain"], "high": 0.6}
    reworded = _with_mu_n(document, source="reworded", status="estimated")
    assert judged_provenance(reworded).key == digest
    for change in ({"value": friction["value"] + 0.01}, {"uncertain": wider}):
        assert judged_provenance(_with_mu_n(document, **change)).key != digest


def _with_mu_n(document, **change):
    """Return a copy of a resolved scenario with another description of the transverse friction."""
    robot = document["robot"]
    friction = {**robot["friction"], "mu_n": {**robot["friction"]["mu_n"], **change}}
    return {**document, "robot": {**robot, "friction": friction}}


def test_the_list_of_changes_cannot_be_set():
    with pytest.raises(
        InputError, match="the list `changes` is written by srs_twin and cannot be set"
    ):
        gen2(changes=[])


OURS = [("comparison", "shape_rms_body")]


@pytest.mark.parametrize(
    ("fields", "left_out"),
    [
        (SLOW, {"analytical", "twin", "comparison"}),
        ({"robot.friction.drag_n": 0.1}, {"analytical", "twin", "comparison"}),
        ({"plants.twin.wheels": "skid"}, {"twin", "comparison"}),
        ({"plants.analytical.friction": "wheel"}, {"analytical", "comparison"}),
        # None of these is a condition of the published experiment.
        ({"seed": 3}, set()),
        ({"duration_s": 5.0}, set()),
        ({"allow_overpressure": True}, set()),
    ],
)
def test_published_values_are_not_expected_under_other_conditions(fields, left_out):
    plain = gen2()
    found = gen2(**fields)
    gone = [each for each in plain.expect if each not in found.expect]
    assert {each.subject for each in gone} == left_out
    assert all(each.source or each.expected_failure for each in gone)
    assert not {(each.subject, each.metric) for each in gone} & set(OURS)
    assert [(each["of"], each["metric"]) for each in found.left_out] == [
        (e.subject, e.metric) for e in gone
    ]
    assert all(each["because"] == list(fields) for each in found.left_out)


def test_duration_affects_totals_but_not_period_means():
    sine = load_scenario("module_square_2hz_direct", set={"duration_s": 4.0})
    assert {each["metric"] for each in sine.left_out} == {"inlet_openings"}
    assert affects("duration_s", "path_length_m", "twin")
    assert not affects("duration_s", "com_speed_m_s", "twin")
    assert not affects("duration_s", "com_speed_rel", "comparison")


@pytest.fixture(scope="module")
def slow_run(tmp_path_factory, srs_twin):
    """Run of the analytical model at another frequency."""
    folder = tmp_path_factory.mktemp("modified")
    words = (
        "run gen2_straight --plants analytical --set controller.frequency_hz=1.0"
        " --duration 5 --check --junit out.xml"
    )
    done = srs_twin(*words.split(), cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder, done


ALL_THREE = "(modified: 3 fields)"


def test_files_of_a_modified_run_are_marked(slow_run):
    folder, done = slow_run
    run = folder / "runs/gen2_straight"
    page = (run / "report.html").read_text("utf-8")
    for tag in ("h1", "title"):
        assert f"<{tag}>{TITLE} {ALL_THREE}</{tag}>" in page
    for field, was, now in (("controller.frequency_hz", 2, 1), ("duration_s", 10, 5)):
        assert f"<tr><td>{field}</td><td>{was}</td><td>{now}</td></tr>" in page
    assert f"gen2_straight {ALL_THREE}" in done.stdout
    for text in (page.partition("Definitions")[0], done.stdout):
        assert "published" not in text.casefold() and "0.214" not in text
        assert "eft out: 2 expectations of the unmodified scenario" in text
    assert done.stderr.splitlines()[-1] == "expectations: none, 2 left out"
    assert f"{TITLE} {ALL_THREE}".encode() in (run / "recording.rrd").read_bytes()
    # `render` reads the scenario of the run folder.
    assert load_run(run).scenario.title == f"{TITLE} {ALL_THREE}"
    suites = ElementTree.parse(folder / "out.xml").getroot()
    assert [suite.get("name") for suite in suites] == [f"gen2_straight {ALL_THREE}"]
    assert "analytical com_speed_m_s" not in {
        case.get("name") for case in suites.iter("testcase")
    }


def test_metrics_list_the_changed_fields_and_the_expectations_left_out(slow_run):
    folder, _ = slow_run
    metrics = read_json(folder / "runs/gen2_straight/metrics.json")
    assert metrics["scenario"] == "gen2_straight"
    assert metrics["changes"] == [
        {"field": "controller.frequency_hz", "from": 2.0, "to": 1.0},
        {"field": "duration_s", "from": 10.0, "to": 5.0},
        {"field": "plants", "from": ["analytical", "twin"], "to": ["analytical"]},
    ]
    assert {each["of"] for each in metrics["left_out"]} == {"analytical"}
    for each in metrics["left_out"]:
        assert each["because"] == ["controller.frequency_hz"]


def test_an_unmodified_run_lists_nothing(shipped_run):
    run = shipped_run("gen2_straight")
    metrics = read_json(run / "metrics.json")
    assert metrics["changes"] == metrics["left_out"] == []
    assert "modified" not in (run / "report.html").read_text("utf-8")
    assert "changes" not in load_run(run).scenario.document


def test_comparison_from_python_names_the_changes():
    found = srs.compare(
        "gen1_straight", set={"controller.frequency_hz": 1.0, "duration_s": 0.2}
    )
    assert found.title.endswith("→ 0.2)") and found.title in found._repr_html_()
    assert [each["field"] for each in found.results["changes"]] == [
        "controller.frequency_hz",
        "duration_s",
    ]


def test_intervals_of_a_modified_scenario_are_stored_separately(srs_twin, tmp_path):
    words = "uncertainty gen2_straight --set controller.frequency_hz=1 --write"
    done = srs_twin(*words.split(), cwd=tmp_path)
    assert done.returncode == 2
    assert (
        "intervals of unmodified scenarios, but controller.frequency_hz was changed"
        in done.stderr
    )
    assert not list(tmp_path.iterdir())


def test_a_modified_plan_is_marked(srs_twin, tmp_path):
    words = "plan follow_gen4_a --set world.goal.radius_m=0.12 --check"
    done = srs_twin(*words.split(), cwd=tmp_path)
    assert done.stdout.startswith("follow_gen4_a (modified: world.goal.radius_m ")
    plan = read_json(tmp_path / "runs/follow_gen4_a/plan.json")
    assert [each["field"] for each in plan["changes"]] == ["world.goal.radius_m"]


def set_to(field, value):
    return [Override(f"--set {field}={value}", tuple(field.split(".")), value)]


def test_modified_sweep_is_marked():
    plain = load_sweep("table8")
    found = load_sweep("table8", set=set_to("robot.friction.mu_t", 0.2))
    assert found.title == f"{plain.title} (modified: robot.friction.mu_t 0.0901 → 0.2)"
    # The document is written as sweep.yaml.
    assert found.document["title"] == found.title
    again = load_sweep("table8", set=set_to("seed", 3), plants=["twin"])
    assert "modified: seed" in again.title and "plants" in again.title


def test_the_scenario_of_a_sweep_names_its_fixed_fields(tmp_path):
    sweep = (
        "{scenario: gen2_straight, fixed: {controller.frequency_hz: 1.0}, vary: {seed:"
        " [0, 1]}}"
    )
    (tmp_path / "x.yaml").write_text(sweep)
    found = load_sweep(tmp_path / "x.yaml")
    assert found.title == "x" and not found.changes
    assert parse_scenario(found.experiment.base).title == f"{TITLE} {SLOWER}"
    # Points are those of a scenario file with that value.
    assert "changes" not in found.experiment.document({"seed": 0})
    again = load_sweep(tmp_path / "x.yaml", set=set_to("controller.frequency_hz", 1.5))
    assert again.title == "x (modified: controller.frequency_hz 1 → 1.5)"


def test_a_modified_study_is_marked(tmp_path):
    of = "scenario: gen2_straight, fixed: {duration_s: 3.0}, budget: {twin: 4}"
    (tmp_path / "x.yaml").write_text(
        f"{{{of}, variables: {{controller.offset: {{low: 0, high: 0.3}}}}, "
        "objectives: [{metric: com_speed_m_s, goal: maximize}]}"
    )
    found = load_study(
        tmp_path / "x.yaml", set=[*set_to("duration_s", 4.0), *set_to("seed", 2)]
    )
    assert found.title == "x (modified: duration_s 3 → 4, seed 0 → 2)"


def test_a_played_robot_shows_its_changed_fields():
    lines = dict(
        LiveSnake(robot(), modified="robot.friction.mu_t 0.1 to 0.2").status_lines()
    )
    assert lines["modified"] == "robot.friction.mu_t 0.1 to 0.2"
    assert "modified" not in dict(LiveSnake(robot()).status_lines())


@pytest.mark.parametrize("name", ["gen2", "gen4"])
def test_every_number_of_a_robot_has_its_unit(name):
    file = load_robot_file(name)
    rows = robot_table(file.spec()).rows
    units = {parameter: unit for parameter, unit, _ in rows}
    values = {parameter: value for parameter, _, value in rows}
    texts = {"name", "title", "supply.limit_source", "variation", "tail", "skin"}
    assert {parameter for parameter, unit in units.items() if not unit} <= texts
    assert (units["bending.stiffness"], units["friction.mu_n"]) == ("N·m/rad", "1")
    for parameter, unit, value in (
        ("chamber.dead_volume", "m³", 1e-6 * file.chamber.dead_volume_ml.value),
        ("supply.nominal", "Pa", 1e3 * file.supply.nominal_kpa.value),
    ):
        assert units[parameter] == unit
        assert float(values[parameter]) == pytest.approx(value, rel=1e-3)
