"""Robots: shipped robots against the dissertation, and rejected robot files."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from srs_twin.errors import InputError, InputFileError
from srs_twin.io.documents import dump_yaml
from srs_twin.robot.file import load_robot, load_robot_file
from srs_twin.robot.spec import Friction, Geometry, RobotSpec
from srs_twin.scenario.loading import load_scenario, parse_scenario

pytestmark = pytest.mark.fast

PSI = 6894.757
ROBOTS = ["gen1", "gen2", "gen3", "gen4"]


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a copy of gen2 with changes, path → value, and returns its file."""

    def write(changes):
        data = load_robot_file("gen2").model_dump()
        for path, value in changes.items():
            *parents, last = path.split(".")
            at = data
            for part in parents:
                at = at[part]
            if value is None:
                del at[last]
            else:
                at[last] = value
        path = tmp_path / "mine.yaml"
        path.write_text(dump_yaml(data))
        return path

    return write


def refusal(path) -> tuple[str, ...]:
    with pytest.raises(InputFileError) as error:
        load_robot(path)
    return tuple(line.removeprefix(f"{path.parent}/") for line in error.value.lines)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (
            {"robot": {"base": "gen2"}, "controller": {"kind": "gait"}},
            "1:1: this is a scenario, not a robot file; ",
        ),
        ({"base": "gen2"}, "1:1: base: this key is allowed only in a scenario, "),
    ],
)
def test_another_kind_of_file_is_refused_with_one_message(tmp_path, data, message):
    path = tmp_path / "mine.yaml"
    path.write_text(dump_yaml(data))
    (line,) = refusal(path)
    assert line.startswith(f"mine.yaml:{message}")


def test_the_robot_of_a_resolved_scenario_is_a_robot_file(tmp_path):
    robot = {"base": "gen2", "friction": {"mu_t": 0.05}}
    data = load_scenario("gen2_straight").document | {"robot": robot}
    scenario = parse_scenario(data, name="mine")
    path = tmp_path / "mine.yaml"
    path.write_text(dump_yaml(scenario.document["robot"]))
    assert load_robot(path) == scenario.robot


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    ("name", "length", "psi_for", "bend", "limit_psi"),
    [
        ("gen1", 0.24, 3.75, 68 * 0.025, 5),
        ("gen2", 0.22, 7, math.pi / 2, 10),
        ("gen3", 0.22, 7, math.pi / 2, 16),
        ("gen4", 0.30, 8, 0.8366, 19),
    ],
)
def test_robots_have_the_published_dimensions_gains_and_limits(
    name, length, psi_for, bend, limit_psi
):
    robot = load_robot(name)
    assert robot.geometry.body_length == pytest.approx(length)
    assert robot.actuator.gain * psi_for * PSI == pytest.approx(bend)
    assert robot.supply.pulsed_limit == pytest.approx(limit_psi * PSI)


def test_gen4_actuator_has_the_published_coefficients():
    """Eq. 15's a, b and c of Fig. 20 follow from the two time constants (E1, E2)."""
    actuator = load_robot("gen4").actuator
    fill = actuator.tau_fill
    mode = actuator.tau_mode
    assert 1 / (fill * mode) == pytest.approx(4221.8, rel=1e-3)
    assert 1 / fill + 1 / mode == pytest.approx(476.4912, rel=1e-3)
    assert 0.8366 / (fill * mode) == pytest.approx(3532.2, rel=1e-3)


def test_phase_steps_differ_by_generation():
    assert load_robot("gen1").phase_step == pytest.approx(2 * math.pi / 5)
    assert {load_robot(n).phase_step for n in ROBOTS[1:]} == {math.pi / 2}


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("name", ROBOTS)
def test_every_number_has_a_source(name):
    sources = load_robot_file(name).records()
    assert len(sources) == 27 + (name in ("gen1", "gen2"))  # robots with axial drag
    for path, record in sources.items():
        words = record.source.lower()
        cited = any(w in words for w in ("table", "section", "fig"))
        assert cited or record.status == "estimated", path
        assert record.status != "calibrated", f"{path}: there are no fits yet"


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("name", ROBOTS)
def test_written_robot_is_read_back_unchanged(name, tmp_path):
    path = tmp_path / "again.yaml"
    path.write_text(dump_yaml(load_robot_file(name).model_dump()))
    assert load_robot(path) == load_robot(name)


def test_one_mass_applies_to_all_connectors(write):
    record = load_robot_file("gen2").mass.connectors_kg.model_dump(
        exclude={"uncertain"}
    )
    assert load_robot(
        write({"mass.connectors_kg": record | {"value": [0.03] * 5}})
    ) == load_robot("gen2")


def test_unit_must_match_the_key(write):
    (line,) = refusal(write({"geometry.rigid_gap_m.unit": "mm"}))
    assert line.endswith("geometry.rigid_gap_m.unit: must be m, not text 'mm'")


def test_all_problems_of_a_robot_are_reported_at_once(write):
    path = write(
        {
            "friction.mu_t.value": -0.1,
            "friction.mu_n.status": "guessed",
            "bending.stiffness_nm_per_rad.source": None,
            "geometry.connectors.value": 5.5,
            "supply.nominal_kpa": 48.3,
            "gait.phase_step_rad.value": float("nan"),
        }
    )
    words = [
        "geometry.connectors.value: must be a whole number from 2 to 64, not 5.5",
        "friction.mu_t.value: must be a number from 0 to 10, not -0.1",
        (
            "friction.mu_n.status: must be one of measured, calibrated, estimated, not"
            " text 'guessed'"
        ),
        (
            "bending.stiffness_nm_per_rad.source: missing; it must be text of 1 to 1000"
            " characters"
        ),
        (
            "supply.nominal_kpa: must be a block of keys (value, unit, status, source,"
            " uncertain), not 48.3"
        ),
        "gait.phase_step_rad.value: must be a number from -6.3 to 6.3, not NaN",
    ]
    problems = refusal(path)
    assert [line.split(": ", 1)[1] for line in problems] == words
    assert problems[0].startswith("mine.yaml:5:12: ")


METRES = {"unit": "m", "status": "estimated", "source": "for a test"}
TAIL = {"axle_m": 0.06, "com_m": 0.07, "com_height_m": 0.02, "gyration_m": 0.02}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {
                "mass.connectors_kg.value": [0.1, 0.2],
                "mass.connectors_kg.uncertain": None,
            },
            "2 masses are given for 5 connectors; give 5 masses, or one number for all of them",
        ),
        (
            {"mass.wheel_kg.value": 0.02},
            (
                "two wheels of 0.02 kg are too heavy for the lightest connector"
                " (0.03 kg); the mass of a wheel must not exceed 0.0135 kg"
            ),
        ),
        (
            {"tail": {key: METRES | {"value": value} for key, value in TAIL.items()}},
            "the centre of mass at 0.07 m is behind the second axle at 0.06 m, so the"
            " tail would tip over; move the centre of mass in front of this axle",
        ),
        (
            {"supply.nominal_kpa.value": 80.0},
            "80 kPa is above `pulsed_limit_kpa`, which is 68.9476 kPa",
        ),
    ],
)
def test_contradicting_numbers_are_rejected(write, changes, words):
    (line,) = refusal(write(changes))
    assert line.endswith(words)


@pytest.mark.parametrize("count", [2, 3, 64])
def test_number_of_connectors_is_free(write, count):
    robot = load_robot(write({"geometry.connectors.value": count}))
    assert robot.segments == count - 1 == len(robot.mass.connectors) - 1


@pytest.mark.parametrize(
    ("part", "changes", "words"),
    [
        ("geometry", {"connectors": 1}, "a snake needs 2 or more"),
        (
            "geometry",
            {"segment_length": 0.0},
            "segment_length: 0.0 is not allowed; it must be finite and above 0",
        ),
        (
            "friction",
            {"mu_n": -1.0},
            "mu_n: -1.0 is not allowed; it must be finite and at least 0",
        ),
        ("bending", {"stiffness": math.inf}, "it must be finite and above 0"),
        (
            "mass",
            {"connectors": (0.03, -0.03, 0.03, 0.03, 0.03)},
            "mass of connector 2: -0.03 is not allowed",
        ),
    ],
)
def test_invalid_parameters_of_a_spec_are_rejected(part, changes, words):
    robot = load_robot("gen2")
    with pytest.raises(InputError, match=words):
        dataclasses.replace(
            robot, **{part: dataclasses.replace(getattr(robot, part), **changes)}
        )


def test_derived_quantities():
    geometry = Geometry(3, 0.04, 0.01, 0.015, 0.008, 0.015, 0.04)
    assert (geometry.segments, geometry.pitch, geometry.body_length) == (2, 0.05, 0.1)
    robot: RobotSpec = load_robot("gen2")
    assert robot.mass.total == pytest.approx(0.15)
    assert robot.bending.damping == pytest.approx(
        robot.bending.stiffness * robot.actuator.tau_mode
    )
    assert robot.friction == Friction(mu_t=0.043, mu_n=0.57)


def test_default_gyration_of_a_connector_is_that_of_a_block():
    spec = load_robot("gen2")
    g = spec.geometry
    assert spec.connector_gyration == pytest.approx(
        math.sqrt((g.rigid_gap**2 + 4 * g.half_track**2) / 12)
    )
    measured = dataclasses.replace(
        spec, mass=dataclasses.replace(spec.mass, connector_gyration=0.005)
    )
    assert measured.connector_gyration == 0.005
    # A wheel is a thin disc on end, half a track away.
    wheel = spec.mass.wheel
    disc = wheel * (g.wheel_radius**2 / 4 + g.half_track**2)
    assert measured.yaw_inertia() == pytest.approx(
        (0.03 - 2 * wheel) * 0.005**2 + 2 * disc
    )


def test_a_point_between_connectors_is_carried_by_both():
    weights = load_robot("gen2").connector_weights(0.055 * np.array([0.0, 2.25, 4.0]))
    expected = np.zeros((5, 3))
    expected[0, 0] = expected[4, 2] = 1.0
    expected[2:4, 1] = 0.75, 0.25
    assert weights == pytest.approx(expected)


def test_robot_file_may_give_the_gyration_of_connectors(write):
    number = {"value": 0.007, "unit": "m", "status": "measured", "source": "a swing"}
    assert (
        load_robot(write({"mass.connector_gyration_m": number})).connector_gyration
        == 0.007
    )


@pytest.mark.parametrize("key", ["gain", "tau_fill", "tau_vent"])
def test_modules_may_differ_by_a_factor_of_ten(key):
    def with_factor(factor: float) -> RobotSpec:
        values = [[factor, 1.0]] + [[1.0, 1.0]] * 3
        robot = {"base": "gen2", "modules": {"seed": 0, key: values}}
        return load_scenario("gen2_straight", set={"robot": robot}).robot

    for factor in (0.1, 10.0):
        assert with_factor(factor).modules.array(key)[0, 0] == factor
    for factor in (0.099, 10.01):
        with pytest.raises(InputError, match=key):
            with_factor(factor)
