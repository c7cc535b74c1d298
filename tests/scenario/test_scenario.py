"""Scenarios: loading, plants and controllers, expectations and the JSON Schema."""

from __future__ import annotations

import copy
import json
import math
import re

import pytest
from published_tables import claim

from srs_twin import LoadedContact
from srs_twin.errors import InputFileError, UnknownNameError
from srs_twin.io.documents import dump_yaml
from srs_twin.io.files import data_root, shipped_names
from srs_twin.robot.file import load_robot
from srs_twin.scenario.expectation import known_metrics, verdict
from srs_twin.scenario.loading import (
    load_scenario,
    parse_scenario,
    scenario_json_schema,
)
from srs_twin.scenario.scenario import IGNORED_OBSTACLES

pytestmark = pytest.mark.fast

MINIMAL = {
    "robot": "gen2",
    "duration_s": 1,
    "controller": {"kind": "gait", "frequency_hz": 2.0},
}


def scenario(**changes):
    return parse_scenario(MINIMAL | changes)


def refusal(**changes) -> list[str]:
    with pytest.raises(InputFileError) as error:
        scenario(**changes)
    return [line.removeprefix("scenario: ") for line in error.value.lines]


def plants(**options):
    return {"analytical": options}


# What loads


def test_the_defaults():
    s = scenario()
    assert (s.name, s.title, s.seed, s.record_hz, s.pose) == (
        "scenario",
        "scenario",
        0,
        100.0,
        (0.0, 0.0, 0.0),
    )
    assert list(s.plants) == ["analytical", "twin"]
    assert s.robot == load_robot("gen2") and s.supply_pa == s.robot.supply.nominal
    assert s.warnings == ()


def test_units_are_converted_to_si():
    s = scenario(
        supply={"pressure_kpa": 50},
        controller={
            "kind": "gait",
            "frequency_hz": 1,
            "offset": -0.2,
            "phase_rad": 1,
            "phase_step_rad": 2,
        },
        start={"x_m": 1, "y_m": -2, "heading_rad": 0.5},
        world={
            "obstacles": [{"x_m": 1, "y_m": 2, "radius_m": 0.1}],
            "bounds": {"x_m": [-1, 3], "y_m": [0, 1]},
            "goal": {"x_m": 2, "y_m": 1},
        },
        plants={
            "analytical": {
                "gaps": False,
                "timestep_s": 0.002,
                "tick_s": 0.01,
                "slip_speed_m_s": 0.002,
            }
        },
    )
    assert s.supply_pa == 50_000 and s.pose == (1, -2, 0.5)
    gait = s.build_controller()
    assert gait._phase_step == 2  # noqa: SLF001
    assert (gait.frequency, gait.offset, gait.phase) == (1, -0.2, 1)
    assert (
        s.world.obstacles[0].radius == 0.1
        and s.world.bounds
        and s.world.bounds.x == (-1, 3)
    )
    assert s.world.goal and (s.world.goal.heading, s.world.goal.radius) == (None, 0.05)
    idle, ignored = s.warnings
    assert "`goal` and `bounds` have no effect" in idle and ignored == IGNORED_OBSTACLES
    plant = s.build_plant("analytical")
    assert (plant.tick, plant.timestep) == (0.01, 0.002)
    assert plant.spec.geometry.rigid_gap == 0 and s.robot.geometry.rigid_gap == 0.018


def test_plants_and_controllers_are_new_each_time():
    s = scenario(plants={"twin": {"hinges_per_segment": 2}})
    assert s.build_controller() is not s.build_controller()
    twin = s.build_plant("twin")
    assert twin.name == "twin" and twin.describe()["hinges_per_segment"] == 2
    assert s.build_plant("analytical").name == "analytical", (
        "compare runs both, named or not"
    )
    with pytest.raises(
        UnknownNameError, match=r"unknown plant 'twinn'; did you mean twin\?"
    ):
        s.build_plant("twinn")


@pytest.mark.parametrize("kind", ["analytical", "twin"])
def test_defaults_are_those_of_the_plants(kind):
    from srs_twin.plants.analytical import AnalyticalSnake
    from srs_twin.plants.twin.snake import TwinSnake

    plant = {"analytical": AnalyticalSnake, "twin": TwinSnake}[kind]
    s = scenario()
    assert s.plants[kind].gaps
    assert s.build_plant(kind).describe() == plant(s.robot).describe()


def test_skids_and_their_law_reach_the_plants():
    s = scenario(
        plants={"analytical": {"friction": "ellipse"}, "twin": {"wheels": "skid"}}
    )
    assert s.build_plant("analytical").friction == "ellipse"
    assert s.build_plant("twin").contact == LoadedContact("ellipse")


# Robots in scenarios


def test_plain_number_overrides_a_record_with_a_note():
    s = scenario(
        robot={
            "base": "gen2",
            "bending": {"stiffness_nm_per_rad": 0.2},
            "geometry": {"connectors": 7},
        }
    )
    assert s.robot.bending.stiffness == 0.2 and s.robot.bending.damping_time == 0.00214
    assert len(s.robot.mass.connectors) == 7
    assert s.robot.title.endswith(", modified")
    record = s.document["robot"]["bending"]["stiffness_nm_per_rad"]
    assert record == {
        "value": 0.2,
        "unit": "N*m/rad",
        "status": "estimated",
        "source": "set in scenario over gen2",
    }


def test_a_list_and_a_whole_record_override():
    masses = [0.03, 0.03, 0.03, 0.03, 0.1]
    record = {"value": 0.5, "unit": "1", "status": "measured", "source": "my floor"}
    s = scenario(
        robot={
            "base": "gen2",
            "mass": {"connectors_kg": masses},
            "friction": {"mu_n": record},
        }
    )
    assert s.robot.mass.connectors == tuple(masses) and s.robot.friction.mu_n == 0.5
    assert s.document["robot"]["friction"]["mu_n"] == record


def test_a_robot_by_path(tmp_path, monkeypatch):
    text = (data_root() / "calibration/robots/gen2.yaml").read_text("utf-8")
    (tmp_path / "mine.yaml").write_text(
        text.replace("name: gen2", "name: mine"), "utf-8"
    )
    monkeypatch.chdir(tmp_path)
    assert scenario(robot="mine.yaml").robot.name == "mine"
    assert scenario(robot={"base": "./mine.yaml", "name": "ours"}).robot.name == "ours"


@pytest.mark.parametrize(
    ("robot", "words"),
    [
        ("gen5", "robot: unknown robot 'gen5'; did you mean gen"),
        (
            {"base": 5},
            "robot.base: must be a robot name, a path, or a block of keys with `base`",
        ),
        ("no/such.yaml", "robot: no/such.yaml: no such file"),
        (
            {"base": "gen2", "bending": {"stifness_nm_per_rad": 1}},
            "unknown key; did you mean stiffness_nm_per_rad?",
        ),
        (
            {"base": "gen2", "bending": {"stiffness_nm_per_rad": "x"}},
            "must be a number from 1e-10 to 1000000000, not te",
        ),
        (
            {"base": "gen2", "bending": {"stiffness_nm_per_rad": {"value": 1}}},
            "stiffness_nm_per_rad.unit: missing",
        ),
        (
            {"base": "gen2", "mass": {"connectors_kg": -1}},
            "robot.mass.connectors_kg: must be a number from 1e-10",
        ),
        (
            {"base": "gen3", "geometry": {"connectors": 6}},
            "mass.connectors_kg.value: 5 masses are given for 6 connectors; give 6"
            " masses",
        ),
        ({"title": "x"}, "robot.name: missing"),
    ],
)
def test_invalid_robots_are_rejected(robot, words):
    assert words in "\n".join(refusal(robot=robot))


def test_problems_of_a_robot_file_name_that_file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("name: mine\ntitel: x\n")
    found = refusal(robot=str(path), seed=-1)
    assert (
        found[0]
        == f"{path}:1:1: title: missing; it must be text of 1 to 200 characters"
    )
    assert found[1].startswith(
        f"{path}:1:1: geometry: missing; it must be a block of keys (connectors, "
    )
    assert f"{path}:2:1: titel: unknown key; did you mean title?" in found
    assert found[-1] == "seed: must be a whole number from 0 to 4294967295, not -1"


# Pneumatics


def test_the_default_pneumatics_are_written_out():
    s = scenario()
    lag = {"kind": "lag", "leak_per_s": 0.0, "valve_delay_s": 0.0}
    assert s.document["pneumatics"] == lag
    assert s.build_plant("analytical").pneumatics.describe() == lag


@pytest.mark.parametrize("plant", ["analytical", "twin"])
@pytest.mark.parametrize(
    ("given", "described"),
    [
        (
            {"leak_per_s": 0.2, "valve_delay_s": 0.004},
            {"kind": "lag", "leak_per_s": 0.2, "valve_delay_s": 0.004},
        ),
        (
            {"kind": "orifice", "flow_limit_l_per_min": 2.0, "valve_delay_s": 0.01},
            {
                "kind": "orifice",
                "critical_ratio": 0.3,
                "flow_limit_l_per_min": 2.0,
                "line_volume_ml": 50.0,
                "leak_per_s": 0.0,
                "valve_delay_s": 0.01,
            },
        ),
    ],
)
def test_pneumatics_reach_both_plants(plant, given, described):
    s = scenario(
        pneumatics=given, plants={"analytical": {}, "twin": {"timestep_s": 0.00025}}
    )
    first, second = (s.build_plant(plant).pneumatics for _ in range(2))
    assert first is not second, "chambers have a state"
    told = first.describe()
    assert {key: told[key] for key in described} == pytest.approx(described)
    assert parse_scenario(s.document) == s
    assert s.document["pneumatics"] == described


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            {"kind": "orifise"},
            (
                "pneumatics.kind: must be one of lag, orifice, not text 'orifise'; did"
                " you mean orifice?"
            ),
        ),
        (
            {"leek_per_s": 1},
            "pneumatics.leek_per_s: unknown key; did you mean leak_per_s?",
        ),
        (
            {"critical_ratio": 0.3},
            (
                "pneumatics: `critical_ratio` is allowed only with `kind: orifice`;"
                " set `kind: orifice`, or remove `critical_ratio`"
            ),
        ),
        (
            {"kind": "orifice", "line_volume_ml": 5.0},
            "pneumatics: `line_volume_ml` needs a supply with limited flow; set"
            " `flow_limit_l_per_min`",
        ),
        (
            "lag",
            (
                "pneumatics: must be a block of keys (kind, leak_per_s, valve_delay_s,"
                " critical_ratio, "
            ),
        ),
    ],
)
def test_invalid_pneumatics_are_rejected(given, words):
    assert words in "\n".join(refusal(pneumatics=given))


# Pressure


def test_a_pressure_above_the_limit_is_refused_with_its_source():
    (line,) = refusal(supply={"pressure_kpa": 80})
    assert (
        line == "supply.pressure_kpa: 80 kPa is above the limit of gen2 in pulses of"
        " a gait, which is 68.9476 kPa (Sections 1.3 and 2.3.1: runs 'under"
        " 10 psi', 'typically below 10 psi'); lower the pressure, or set"
        " `allow_overpressure: true`"
    )


@pytest.mark.parametrize(
    "allow",
    [
        {"allow_overpressure": True},
        {"supply": {"pressure_kpa": 80, "allow_overpressure": True}},
    ],
)
def test_an_allowed_overpressure_runs_with_a_warning(allow):
    s = scenario(**({"supply": {"pressure_kpa": 80}} | allow))
    assert s.supply_pa == 80_000 and s.file.allow_overpressure
    (warning,) = s.warnings
    assert "80 kPa is above the limit of gen2" in warning
    assert parse_scenario(s.document) == s


def test_pulses_may_exceed_the_continuous_limit():
    assert scenario(robot="gen4", supply={"pressure_kpa": 51}).warnings == ()


def test_pressure_is_checked_even_if_another_key_is_invalid():
    assert len(refusal(supply={"pressure_kpa": 80}, seed="x")) == 2


def test_the_limit_follows_an_override():
    robot = {"base": "gen2", "supply": {"nominal_kpa": 90, "pulsed_limit_kpa": 90}}
    assert scenario(robot=robot, supply={"pressure_kpa": 80}).warnings == ()


# Times


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"plants": {"twin": {"tick_s": 0.0205, "timestep_s": 0.001}}},
            "plants.twin.tick_s: tick 0.0205 s is not a multiple of time",
        ),
        (
            {"plants": {"twin": {"timestep_s": 0.0015}}},
            "plants.twin.tick_s: tick 0.02 s is not a multiple of time",
        ),
        (
            {"duration_s": 1.01},
            "duration_s: duration 1.01 s is not a multiple of the analytical plant's",
        ),
        (
            {"record_hz": 60},
            (
                "record_hz: the analytical plant's tick 0.02 s is not a multiple of"
                " recording int"
            ),
        ),
        (
            {"record_hz": 30},
            (
                "record_hz: recording interval 0.0333333 s is not a multiple of the"
                " analytical pl"
            ),
        ),
        (
            {"plants": {"twin": {}}, "record_hz": 2500},
            (
                "record_hz: recording interval 0.0004 s is not a multiple of the twin's"
                " time step"
            ),
        ),
    ],
)
def test_times_that_are_no_multiples_are_rejected(changes, words):
    assert words in refusal(**changes)[0]


@pytest.mark.default_cases(at=[0, 9, 10])
@pytest.mark.parametrize("record_hz", [7.14286, 3.33333, 0.100001, 333.3, 9999.0])
@pytest.mark.parametrize(
    "ticks", [(0.02, 0.02, 0.001), (0.02, 0.03, 0.0005), (0.001, 0.02, 0.0005)]
)
def test_proposed_recording_rate_suits_both_plants(record_hz, ticks):
    analytical, twin, step = ticks
    both = {
        "analytical": {"tick_s": analytical},
        "twin": {"tick_s": twin, "timestep_s": step},
    }
    lines = refusal(plants=both, record_hz=record_hz, duration_s=6)
    proposed = {
        found[1]
        for line in lines
        if (found := re.search(r"use `record_hz: (\S+)`", line))
    }
    (rate,) = proposed
    assert scenario(
        plants=both, record_hz=float(rate), duration_s=6
    ).record_hz == float(rate)


def test_no_recording_rate_is_proposed_for_incompatible_ticks():
    both = {"analytical": {"tick_s": 0.9999}, "twin": {"tick_s": 0.02}}
    (line,) = refusal(plants=both, duration_s=199.98)
    assert "no rate fits the ticks of the plants; change `tick_s`" in line


# Expectations


def expectation(**keys):
    (each,) = scenario(
        expect=[{"metric": "com_speed_m_s", "plant": "twin"} | keys]
    ).expect
    return each


@pytest.mark.parametrize(
    ("keys", "inside", "outside", "allowed"),
    [
        ({"near": 0.2, "rel": 0.1}, (0.181, 0.219), (0.179, 0.221), "0.18 to 0.22"),
        ({"near": -0.2, "rel": 0.1}, (-0.181, -0.219), (-0.179, 0.2), "-0.22 to -0.18"),
        ({"near": 0, "abs": 0.1}, (0.1, -0.1), (0.11, -0.11), "-0.1 to 0.1"),
        ({"below": 0.12}, (0.12, -5), (0.13,), "at most 0.12"),
        ({"above": 0.12}, (0.12, 5), (0.11, math.inf), "at least 0.12"),
    ],
)
def test_what_expectations_allow(keys, inside, outside, allowed):
    each = expectation(**keys)
    assert each.check({})["allowed"] == allowed

    def met(value):
        return each.check(
            {"plants": {"twin": {"com_speed_m_s": value}}, "comparison": {}}
        )["met"]

    assert all(map(met, inside)) and not any(map(met, outside))


def test_row_contains_the_published_value():
    outcome = expectation(near=0.214, rel=0.15, source="Table 10").check(
        {"plants": {"twin": {"com_speed_m_s": 0.2}}}
    )
    assert outcome == {
        "metric": "com_speed_m_s",
        "of": "twin",
        "value": 0.2,
        "allowed": "0.1819 to 0.2461",
        "met": True,
        "state": "met",
        "reason": None,
        "near": 0.214,
        "source": "Table 10",
        "expected_failure": None,
    }


@pytest.mark.parametrize(
    ("known", "value", "expected"),
    [
        (None, 0.2, "met"),
        (None, 0.3, "missed"),
        ("drag", 0.2, "holds"),
        ("drag", 0.3, "expected_failure"),
    ],
)
def test_known_miss_of_an_expectation(known, value, expected):
    each = expectation(near=0.214, rel=0.15, expected_failure=known)
    outcome = each.check({"plants": {"twin": {"com_speed_m_s": value}}})
    assert (outcome["expected_failure"], verdict(outcome)) == (known, expected)
    assert outcome["met"] == (value == 0.2)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        (
            {"metric": "com_sped_m_s"},
            (
                "expect[0].metric: unknown metric 'com_sped_m_s'; did you mean"
                " com_speed_m_s?"
            ),
        ),
        (
            {"metric": "com_speed_rel"},
            "expect[0]: the metric `com_speed_rel` needs `of: comparison`",
        ),
        (
            {"plant": None, "of": "comparison"},
            "expect[0]: the metric `com_speed_m_s` needs `plant: analytical` or"
            " `plant: twin`",
        ),
        (
            {"of": "comparison"},
            "expect[0]: an expectation concerns one plant or the comparison",
        ),
        (
            {"plant": "both"},
            "expect[0].plant: must be one of analytical, twin, not text 'both'",
        ),
        (
            {"above": 0},
            "expect[0]: an expectation needs exactly one of the keys `near`, `below`,"
            " `above` and `published`",
        ),
        ({"abs": 1}, "expect[0]: `near` needs a tolerance"),
        (
            {"below": None, "near": 1},
            "expect[0]: `near` needs a tolerance",
        ),
        (
            {"below": None, "near": 1, "rel": 0.1, "abs": 1},
            "expect[0]: `near` needs a tolerance",
        ),
        (
            {"below": None, "near": 0, "rel": 0.1},
            "expect[0]: `near: 0` cannot have a relative tolerance; give `abs`"
            " instead of `rel`",
        ),
    ],
)
def test_invalid_expectations_are_rejected(keys, words):
    each = {"metric": "com_speed_m_s", "plant": "twin", "below": 1} | keys
    (line,) = refusal(
        expect=[{key: value for key, value in each.items() if value is not None}]
    )
    assert line.startswith(words)


def test_expectations_need_their_plants_to_run():
    found = refusal(
        plants=plants(),
        expect=[
            {"metric": "com_speed_m_s", "plant": "twin", "below": 1},
            {"metric": "com_speed_rel", "of": "comparison", "below": 1},
        ],
    )
    assert found == [
        "expect[0].plant: the plant `twin` does not run here; add it to `plants`",
        "expect[1].of: a comparison needs both plants; add the other one to `plants`",
    ]


# Resolved documents

ROOM = data_root() / "calibration/examples/room"
WORLD = {
    "obstacles": [{"x_m": 3.0, "y_m": 2.0, "radius_m": 0.25}],
    "circles": str((ROOM / "posts.csv").resolve()),
    "map": str((ROOM / "room.yaml").resolve()),
    "polygons": [{"corners_m": [[3.0, 3.0], [4.0, 3.0], [4.0, 5.0]]}],
    "random": {
        "kind": "strewn",
        "count": 2,
        "seed": 5,
        "area": {"x_m": [2.0, 9.0], "y_m": [2.0, 9.0]},
        "radius_m": [0.03, 0.04],
        "gap_m": 0.1,
        "clear_m": 0.4,
    },
    "pegs": {
        "spacing_m": 0.2,
        "radius_m": 0.02,
        "rows": 2,
        "columns": 3,
        "jitter_m": 0.01,
        "staggered": True,
        "x_m": 1.0,
        "y_m": 0.1,
        "seed": 6,
    },
    "obstacle_friction": 0.4,
    "floor": {"tilt_deg": 3.0, "uphill_deg": 90.0},
    "steps": [{"x_m": 0.5, "height_m": 0.002}],
    "bounds": {"x_m": [-9.0, 9.0], "y_m": [-9.0, 9.0]},
    "goal": {
        "x_m": 1.0,
        "y_m": 2.0,
        "heading_rad": 0.5,
        "radius_m": 0.06,
        "heading_tolerance_rad": 0.2,
    },
}
CYLINDER = {
    "kind": "cylinder",
    "radius_m": 0.04,
    "mass_kg": 0.1,
    "friction": 0.3,
    "x_m": 2.0,
    "y_m": 0.0,
    "heading_rad": 0.1,
}
COMPLETE = [
    ("supply", {"pressure_kpa": 31.0}),
    ("valves", {"layout": "in_out"}),
    (
        "start",
        {
            "x_m": 0.1,
            "y_m": -0.2,
            "heading_rad": 0.3,
            "velocity_m_s": [0.1, -0.2],
            "yaw_rate_rad_s": 0.4,
            "bend_rad": [0.1, 0.0, -0.3, 0.0],
            "bend_rate_rad_s": [1.0, 0.0, 0.0, 0.0],
            "pressure_kpa": [[10.0, 0.0]] * 4,
        },
    ),
    (
        "sensor",
        {
            "kind": "hall",
            "span_rad": 1.1,
            "distance_mm": 12.0,
            "orientation": "side",
            "chamber": "rectangular",
            "noise_uv": 3.0,
            "bits": 12,
            "bias_v": 0.1,
            "gain_error": 0.2,
        },
    ),
    (
        "pneumatics",
        {
            "kind": "orifice",
            "leak_per_s": 0.1,
            "valve_delay_s": 0.004,
            "critical_ratio": 0.4,
            "flow_limit_l_per_min": 100.0,
            "line_volume_ml": 80.0,
            "initial_line_pressure_kpa": 20.0,
        },
    ),
    ("world", WORLD),
    ("world", WORLD | {"steps": [], "objects": [CYLINDER]}),
    (
        "plants",
        {
            "analytical": {
                "gaps": False,
                "timestep_s": 0.002,
                "tick_s": 0.01,
                "model": "simplified",
                "friction_torque": False,
                "inertia": "point",
                "friction": "wheel",
                "load": "static",
                "contact": False,
                "slip_speed_m_s": 0.002,
            },
            "twin": {
                "gaps": False,
                "timestep_s": 0.0005,
                "tick_s": 0.01,
                "wheels": "skid",
                "contact": "loaded",
                "friction": "ellipse",
                "hinges_per_segment": 3,
            },
        },
    ),
    ("comparison", {"gap_factor": True}),
]
"""Sections in which all keys have values, most of them other than the default."""
PLANTS_OF = {
    "comparison": {"analytical": {"gaps": False}, "twin": {}},
    "pneumatics": plants(),
    "world": {"twin": {}},
}


@pytest.mark.parametrize(("section", "given"), COMPLETE)
def test_keys_of_sections_survive_resolution(section, given):
    s = scenario(**{"plants": PLANTS_OF.get(section, {"twin": {}}), section: given})
    assert s.document[section] == given
    assert parse_scenario(s.document) == s


def test_a_resolved_file_keeps_the_name_of_the_scenario(tmp_path):
    path = tmp_path / "scenario.resolved.yaml"
    s = load_scenario("gen2_straight")
    path.write_text(dump_yaml(s.document), "utf-8")
    assert load_scenario(path) == s


def test_document_is_independent_of_its_source_data():
    data = copy.deepcopy(MINIMAL)
    parse_scenario(data)
    assert data == MINIMAL


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("a b.yaml", "a b"),
        (".hidden.yaml", "hidden"),
        ("größe.v2.yaml", "größe.v2"),
        ("...yaml", "scenario"),
    ],
)
def test_invalid_names_are_rejected_as_folders(tmp_path, file, name):
    path = tmp_path / file
    path.write_text(dump_yaml(MINIMAL), "utf-8")
    s = load_scenario(path)
    assert s.name == name
    assert parse_scenario(s.document) == s


# Shipped scenarios


@pytest.mark.default_cases(at=[0, 2, 5, 31, 34, 37, 52])
@pytest.mark.parametrize("name", shipped_names("scenario"))
def test_shipped_expectations_can_fail_and_cite_sources(name):
    s = load_scenario(name)
    # Only a pressure above the limit, asked for knowingly, and a model without contacts
    # are warned of.
    others = [text for text in s.warnings if text != IGNORED_OBSTACLES]
    assert s.name == name and len(others) == s.file.allow_overpressure
    analytical = s.file.plants.analytical
    ignores = bool(s.world.has_obstacles and analytical and not analytical.contact)
    assert s.warnings.count(IGNORED_OBSTACLES) == ignores
    # Only the twin has movable objects; spatial robots can do without a second plant.
    plants = ["twin"] if s.world.objects else ["analytical", "twin"]
    assert list(s.plants) == plants or s.robot.is_spatial
    plants = list(s.plants)
    assert {each.subject for each in s.expect} == {
        *plants,
        *(["comparison"] if len(plants) > 1 else []),
    }
    assert all(not each.check({})["met"] for each in s.expect)
    assert any(each.source for each in s.expect)


@pytest.mark.parametrize(
    ("name", "published", "tol"),
    [
        ("gen1_straight", "gen1-forward", 0.3),
        ("gen2_straight", "gen2-top-speed", 0.15),
        ("gen3_straight", "gen3-speed", 0.3),
    ],
)
def test_published_speeds_have_an_interval_and_a_tolerance(name, published, tol):
    row = claim(published)
    found = [
        e
        for e in load_scenario(name).expect
        if e.metric == "com_speed_m_s" and e.plant == "twin"
    ]
    by_interval, each = sorted(found, key=lambda e: e.published is None)
    assert by_interval.published == each.near == row["value"]
    assert by_interval.within == "interval_95"
    assert each.allowed[1] - each.near <= tol * row["value"] * (1 + 1e-9)


@pytest.mark.parametrize(
    ("name", "offset"), [("gen4_straight", 0.0), ("gen4_turn", 0.3)]
)
def test_generation_4_is_compared_with_table_8(name, offset):
    table = claim("table8")
    (row,) = [r for r in table["rows"] if r["offset"] == offset]
    published = {"com_speed_m_s": row["speed"], "turning_radius_m": row["radius"]}
    found = [e for e in load_scenario(name).expect if e.metric in published]
    assert {each.published for each in found} <= {None, *published.values()}
    held = [each for each in found if each.published is None]
    assert held
    for each in held:
        assert each.near == published[each.metric]
        assert each.allowed[1] - each.near <= table["tol"] * each.near * (1 + 1e-9)


# The schema


def walk(node, schema):
    """Yield every property of a schema with its path."""
    for name, each in schema.get("properties", {}).items():
        yield f"{node}.{name}", each


def test_the_schema_describes_every_key():
    schema = scenario_json_schema()
    json.dumps(schema)
    parts = {"": schema} | {
        name: each for name, each in schema["$defs"].items() if "Record" not in name
    }
    for part, each in parts.items():
        for path, prop in walk(part, each):
            assert prop.get("description") or "$ref" in prop, path
    assert schema["properties"]["duration_s"] == {
        "title": "Simulated duration",
        "description": "Simulated duration in s, 0.001 to 3600.",
        "type": "number",
        "minimum": 0.001,
        "maximum": 3600.0,
        "unit": "s",
    }
    named, from_outside = schema["$defs"]["Expectation"]["properties"]["metric"][
        "anyOf"
    ]
    assert named["enum"] == list(known_metrics()) and re.match(
        from_outside["pattern"], "my_module:metric"
    )


def test_references_of_the_schema_resolve():
    schema = scenario_json_schema()

    def references(node):
        if isinstance(node, dict):
            yield from ([node["$ref"]] if "$ref" in node else [])
            for value in node.values():
                yield from references(value)
        elif isinstance(node, list):
            for value in node:
                yield from references(value)

    found = set(references(schema))
    assert found == {f"#/$defs/{name}" for name in schema["$defs"]}


def test_schema_describes_overrides():
    override = scenario_json_schema()["properties"]["robot"]["anyOf"][1]
    stiffness = override["properties"]["bending"]["properties"]["stiffness_nm_per_rad"]
    assert stiffness["anyOf"][0] == {"type": "number", "minimum": 1e-10, "maximum": 1e9}
    assert override["required"] == ["base"]
