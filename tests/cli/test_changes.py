"""Overridden fields by options and from Python; `list`, `show` and JSON output; the headline."""

from __future__ import annotations

import itertools
import json
import os
import re
import subprocess
import sys

import pytest
from snakes import robot

import srs_twin as srs
from srs_twin import InputError, load_scenario
from srs_twin.cli.catalogue import scenario_groups
from srs_twin.comparison.metrics import (
    COMPARISON_UNITS,
    LIST_METRIC_UNITS,
    METRIC_UNITS,
    headline,
    meanings,
    published,
)
from srs_twin.io.files import shipped_names
from srs_twin.scenario.loading import parse_scenario

SHORT = {"duration_s": 1.0}


def test_override_equals_the_same_value_in_a_file():
    soft = load_scenario(
        "gen2_straight", set={"robot.bending.stiffness_nm_per_rad": 0.22, "seed": 7}
    )
    assert (soft.robot.bending.stiffness, soft.seed) == (0.22, 7)
    record = soft.document["robot"]["bending"]["stiffness_nm_per_rad"]
    assert (record["status"], record["unit"]) == ("estimated", "N*m/rad")
    assert (
        record["source"]
        == "set by set robot.bending.stiffness_nm_per_rad=0.22 over gen2"
    )
    assert soft.robot.friction == robot().friction


def test_a_resolved_scenario_can_be_changed_again():
    first = load_scenario("gen2_straight")
    changed = parse_scenario(
        first.document, name="again", set={"robot.friction.mu_t": 0.1}
    )
    assert changed.robot.friction.mu_t == 0.1
    assert changed.document["robot"]["friction"]["mu_t"]["source"].startswith(
        "set by set robot.friction.mu_t"
    )
    assert first.robot.friction.mu_t != 0.1  # what it was made from stays


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            "controller.frequency=3",
            "controller.frequency: unknown key; did you mean frequency_hz?",
        ),
        (
            "controler.frequency_hz=3",
            (
                "the field controler.frequency_hz does not exist; did you mean"
                " controller.frequency"
            ),
        ),
        # Only controllers of other kinds have the block controller.gait.
        ("gait.frequency=1", "frequency_ratio or controller.frequency_hz?"),
        (
            "robot.friction.mu_t=-1",
            "robot.friction.mu_t: must be a number from 0 to 10, not -1",
        ),
        ("robot=gen9", "unknown robot 'gen9'"),
        (
            "expect[40].near=1",
            "this entry does not exist; the list has 7 entries, counted from 0",
        ),
        ("world.polygons[0].corners_m=1", "the list has 0 entries, counted from 0"),
        ("supply.pressure_kpa=48300", "not 48300; did you mean 48.3?"),
        ("start.heading_rad=90", "did you mean 1.571?"),
        ("supply.pressure_kpa=[1", "not YAML"),
        ("duration_s", "must be FIELD=VALUE, as in controller.frequency_hz=1.5"),
        ("=3", "must be FIELD=VALUE"),
        ("stiffness=0.2", "did you mean robot.bending.stiffness_nm_per_rad?"),
        ("duration_s=&a 1", "anchors (&a) are not allowed; write each value out"),
    ],
)
def test_a_mistake_names_the_option_and_the_remedy(srs_twin, tmp_path, words, said):
    done = srs_twin("run", "gen2_straight", "--set", words, cwd=tmp_path)
    assert done.returncode == 2
    first = done.stderr.splitlines()[0]
    assert first.startswith(f"--set {words}:") and said in first
    assert not list(tmp_path.iterdir())


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("srs-twin compare gen2_s", {"gen2_straight"}),
        ("srs-twin sweep fig33", {"fig33", "fig33_simplified"}),
        ("srs-twin play gen4", {"gen4", "gen4_module", "gen4_straight", "gen4_turn"}),
        ("srs-twin rep", {"replay", "reproduce"}),
        ("srs-twin compare --exp", {"--explain"}),
    ],
)
def test_a_shell_completes_commands_options_and_shipped_names(typed, offered):
    count = str(len(typed.split()) - 1)
    more = {
        "_SRS_TWIN_COMPLETE": "complete_bash",
        "COMP_WORDS": typed,
        "COMP_CWORD": count,
    }
    words = [sys.executable, "-c", "from srs_twin.cli import main; main()"]
    done = subprocess.run(
        words, env=os.environ | more, capture_output=True, text=True, check=False
    )
    assert set(done.stdout.split()) == offered, done.stderr


def test_value_with_a_likely_unit_error_is_reported():
    def warned(value):
        return load_scenario(
            "gen2_straight", set={"robot.bending.stiffness_nm_per_rad": value}
        ).warnings

    path = "robot.bending.stiffness_nm_per_rad"
    reason = (
        "440 N*m/rad is 1000 times the 0.44 of gen2; 440 mN*m/rad would be 0.44 N*m/rad"
    )
    assert warned(440.0) == (f"set {path}=440.0: {path}: {reason}",)
    assert warned(44.0) == ()


def test_single_plant_has_no_expectations_of_the_other(srs_twin, tmp_path):
    words = "run gen2_straight --plants analytical --duration 3 --json --check"
    done = srs_twin(*words.split(), cwd=tmp_path)
    found = json.loads(done.stdout)
    assert done.returncode == 0
    assert list(found["plants"]) == ["analytical"]
    assert {each["of"] for each in found["expectations"]} == {"analytical"}
    stored = json.loads(
        (tmp_path / "runs/gen2_straight/metrics.json").read_text("utf-8")
    )
    assert found == stored


def test_json_of_several_runs_includes_errors(srs_twin, tmp_path):
    words = "run gen2_straight gen2_strait --duration 0.5 --plants analytical --json"
    done = srs_twin(*words.split(), cwd=tmp_path)
    first, second = json.loads(done.stdout)["runs"]
    assert done.returncode == 2
    assert first["scenario"] == "gen2_straight"
    assert second == {
        "scenario": "gen2_strait",
        "errors": ["unknown scenario 'gen2_strait'; did you mean gen2_straight?"],
    }


def test_every_metric_is_listed_with_unit_and_meaning(srs_twin, tmp_path):
    assert set(meanings()) == {*METRIC_UNITS, *LIST_METRIC_UNITS, *COMPARISON_UNITS}
    found = json.loads(srs_twin("list", "--json", cwd=tmp_path).stdout)
    assert list(found) == ["scenarios", "robots", "sweeps", "controllers", "metrics"]
    units = {each["name"]: each["unit"] for each in found["metrics"]}
    assert units["com_speed_m_s"] == "m/s" and units["yaw_rate_abs"] == "rad/s"
    assert {
        "name": "gen2_straight",
        "title": "Generation 2, straight, 2 Hz, 48.3 kPa",
    } in found["scenarios"]
    assert {each["name"] for each in found["controllers"]} >= {
        "gait",
        "ilc",
        "follow",
        "replay",
    }
    for each in found["robots"]:
        assert set(each) == {"name", "title"} and all(each.values())


def test_list_starts_with_six_scenarios_and_groups_all(srs_twin, tmp_path):
    first, *rest = re.split(
        r"^Scenarios: .* \(\d+\)$", srs_twin("list", cwd=tmp_path).stdout, flags=re.M
    )
    names = shipped_names("scenario")
    beginning = [
        line.split()[0] for line in first.splitlines() if re.match("  \\S", line)
    ]
    assert len(beginning) == 6 and set(beginning) <= set(names)
    groups = scenario_groups({"name": name} for name in names)
    assert "other" not in groups and len(groups) == len(rest) == 8
    assert [len(group) for group in groups.values()] == [
        len(set(names) & set(text.split())) for text in rest
    ]
    # At most one scenario per group to begin with; the studies are listed as well.
    for group in groups.values():
        assert len({*beginning} & {row["name"] for row in group}) <= 1
    assert set(shipped_names("study")) <= set(rest[-1].split())


@pytest.mark.parametrize("name", ["gen2_turn", "gen2"])
def test_show_prints_every_value_with_its_source(srs_twin, tmp_path, name):
    document = json.loads(srs_twin("show", name, "--json", cwd=tmp_path).stdout)
    snake = document if name == "gen2" else document["robot"]
    mu_t = snake["friction"]["mu_t"]
    text = " ".join(srs_twin("show", name, cwd=tmp_path).stdout.split())
    assert f"friction.mu_t: {mu_t['value']}; {mu_t['status']}: {mu_t['source']}" in text


def test_show_of_an_unknown_name_is_refused(srs_twin, tmp_path):
    done = srs_twin("show", "gen2_strait", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (
        2,
        "unknown scenario or robot 'gen2_strait'; did you mean gen2_straight?\n",
    )


def crawling(speed, rate=0.0):
    return {"com_speed_m_s": speed, "yaw_rate_rad_s": rate}


def both(speeds, rates=(0.0, 0.0), **more):
    analytical, twin = map(crawling, speeds, rates)
    return {"plants": {"analytical": analytical, "twin": twin}, "comparison": {}} | more


COMPLIANCE = (
    "Compliance: the segments of the twin yield to loads, those of the model do not."
)
CAUSE = {"name": "compliance", "com_speed_m_s": -0.03, "yaw_rate_rad_s": 0.0}


@pytest.mark.parametrize(
    ("metrics", "said"),
    [
        (
            both((0.2, 0.15)),
            "The twin crawls 25 % slower than the model (0.15 against 0.2 m/s).",
        ),
        (both((0.2, 0.201)), "The twin crawls like the model (0.201 against 0.2 m/s)."),
        (both((0.2, -0.1)), "The twin crawls unlike the model (-0.1 against 0.2 m/s)."),
        (
            both((0.2, 0.15), cause=CAUSE),
            (
                "The twin crawls 25 % slower than the model (0.15 against 0.2 m/s;"
                " compliance alone would slow it by 15 %, other effects by another 10"
                f" %). {COMPLIANCE}"
            ),
        ),
        (
            both((0.2, 0.15), cause=CAUSE | {"com_speed_m_s": -0.062}),
            (
                "The twin crawls 25 % slower than the model (0.15 against 0.2 m/s;"
                " compliance alone would slow it by 31 %, other effects offset 6 %)."
                f" {COMPLIANCE}"
            ),
        ),
        (
            both((0.2, 0.15), cause=CAUSE | {"com_speed_m_s": -0.05}),
            (
                "The twin crawls 25 % slower than the model (0.15 against 0.2 m/s;"
                f" compliance alone would slow it by 25 %). {COMPLIANCE}"
            ),
        ),
        # An assumption with the opposite effect is not a main cause.
        (
            both((0.2, 0.15), cause=CAUSE | {"com_speed_m_s": 0.03}),
            "The twin crawls 25 % slower than the model (0.15 against 0.2 m/s).",
        ),
        (
            both((0.2, 0.2), (1.0, 1.5)),
            (
                "The twin crawls like the model (0.2 against 0.2 m/s), and turns 50 %"
                " faster than the model (1.5 against 1 rad/s)."
            ),
        ),
    ],
)
def test_headline_names_difference_and_main_cause(metrics, said):
    assert headline(metrics) == said


@pytest.mark.parametrize(
    ("speeds", "said"),
    [
        ([0.13, 0.19], "between 35 and 5 % slower"),
        ([0.15, 0.23], "between 25 % slower and 15 % faster"),
        ([0.21, 0.3], "between 5 and 50 % faster"),
    ],
)
def test_headline_states_the_range_over_plausible_segments(speeds, said):
    metrics = both(
        (0.2, 0.16), intervals={"segments": {"stiffness_and_damping": speeds}}
    )
    sentence = (
        "For plausible values of the stiffness and damping of its segments, it is"
        f" {said}."
    )
    assert sentence in headline(metrics)


CHANGES = [-0.5049, 0.26, 0.505, 1.0, 1.004, 2.5]
"""Change of the speed due to compliance, as a multiple of the difference of the plants."""


@pytest.mark.parametrize("twin", [0.05, 0.1234, 0.15, 0.196, 0.2049, 0.25, 0.31])
def test_percentages_of_the_headline_add_up(twin):
    for effect, averaged in itertools.product(CHANGES, (False, True)):
        change = effect * (twin - 0.2)
        why = {"cause": CAUSE | {"com_speed_m_s": change}}
        if averaged:
            share = {"name": "compliance", "value": [change, 0.0]}
            measures = ["com_speed_m_s", "yaw_rate_rad_s"]
            why = {"attribution": {"measures": measures, "shares": [share]}}
        said = headline(both((0.2, twin), **why))
        whole, direction = re.search(r"(\d+) % (slower|faster)", said).groups()
        assert (direction == "slower") == (twin < 0.2)
        cause = re.search(r"compliance.* (?:slow|speed)s? it(?: up)? by (\d+) %", said)
        # A cause that acts the other way is not named.
        assert (cause is None) == (effect < 0)
        if cause is None:
            continue
        rest = 0
        if others := re.search(r"other effects (by another|offset) (\d+) %", said):
            rest = int(others[2])
            if others[1] == "offset":
                rest = -rest
        assert int(cause[1]) + rest == int(whole)
        assert int(cause[1]) == pytest.approx(100 * abs(change / 0.2), abs=0.5001)
        assert ("alone would" in said) != averaged


def test_only_expectations_of_plants_are_published_values():
    row = {"metric": "com_speed_m_s", "of": "twin", "near": 0.2, "source": "Table 10"}
    agreement = {
        "metric": "com_speed_rel",
        "of": "comparison",
        "near": 0,
        "source": "docs/verification.md",
    }
    assert published([row, agreement]) == {"com_speed_m_s": (0.2, "Table 10")}


def test_headline_tells_of_objects_and_of_a_body_that_passes_through_itself():
    twin = crawling(0.1)
    said = headline({"plants": {"twin": twin | {"object_moved_m": 0.42}}})
    assert (
        said == "The twin crawls at 0.1 m/s, straight on; it moves an object by 0.42 m."
    )
    said = headline({"plants": {"twin": twin | {"final_bend_rad": 0.1}}})
    assert said == "The twin ends with a bend of 0.1 rad in its first segment."
    said = headline({"plants": {"twin": twin}, "body_overlap_m": {"twin": 0.0384}})
    assert "overlap by up to 38 mm (twin)" in said


def test_headline_of_followers_names_each_plant():
    followed = {"goal_reached": 1, "cross_track_rms_m": 0.01}
    both_of = {"analytical": followed, "twin": followed | {"goal_reached": 0}}
    assert (
        headline({"plants": both_of, "comparison": None})
        == "The twin does not reach its goal, 10 mm RMS from its path; the model"
        " reaches its goal, 10 mm RMS from its path."
    )


@pytest.mark.parametrize(
    ("rate", "said"),
    [
        (0.0499, "straight on"),
        (0.05, "turning by 0.05 rad/s"),
        (-0.05, "turning by -0.05 rad/s"),
    ],
)
def test_a_run_turns_from_0_05_rad_per_s(rate, said):
    found = headline({"plants": {"twin": crawling(0.1, rate)}})
    assert found == f"The twin crawls at 0.1 m/s, {said}."


def test_a_scenario_is_compared_by_its_name():
    found = srs.compare("gen2_straight", set=SHORT)
    assert set(found.trajectories) == {"analytical", "twin"}
    again = srs.compare(*found.trajectories.values())
    assert found.metrics == again.metrics
    page = found._repr_html_()
    assert "<table>" in page and "data:image/svg+xml" in page and str(found) in page
    for each in (found.trajectories["twin"], again):
        assert "<table>" in each._repr_html_()
    with pytest.raises(InputError, match="did you mean frequency_hz"):
        srs.compare("gen2_straight", set={"controller.frequency": 1.0})
    with pytest.raises(InputError, match="two trajectories"):
        srs.compare(found.trajectories["twin"])


@pytest.mark.parametrize("name", [1, "", "a.", ".a", "a[x]"])
def test_an_invalid_field_name_in_a_program_is_refused(name):
    said = re.escape(f"'{name}' is not a valid field name; write it as in world.obs")
    with pytest.raises(InputError, match=said):
        load_scenario("gen2_straight", set={name: 2})
