"""Numbers in a wrong unit are found by the other numbers of the robot, and scaled robots are plausible."""

# ruff: noqa: E501 - one mistake per line, as a table

from __future__ import annotations

import copy
import warnings

import pytest
import yaml

from srs_twin import load_robot, load_scenario
from srs_twin.errors import InputError, UnitWarning
from srs_twin.io.documents import dump_yaml
from srs_twin.io.files import data_root, shipped_names

ROBOTS = sorted((data_root() / "calibration/robots").rglob("*.yaml"))
POWERS = {"m": 1.0, "kg": 3.0, "ml": 3.0, "N*m/rad": 4.0, "s": 0.5}
"""Unit → power of the scale with which a number grows if the scaled robot makes the same motion."""

GEN2 = yaml.safe_load((data_root() / "calibration/robots/gen2.yaml").read_text("utf-8"))

# Keys and values in gen2.yaml, whether they are an error, and part of the message.
MISTAKES = [
    (
        {"geometry.segment_length_m": 3.7},
        False,
        (
            "geometry.segment_length_m.value: 3.7 m does not fit the other lengths of"
            " the robot, such as wheel_radius_m, 0.008 m; 3.7 cm would be 0.037 m"
        ),
    ),
    (
        {"geometry.segment_length_m": 37.0},
        True,
        (
            "37 m does not fit the other lengths of the robot, such as wheel_radius_m,"
            " 0.008 m; 37 mm would be 0.037 m"
        ),
    ),
    ({"geometry.segment_length_m": 0.37}, False, "a tenth of it would be 0.037 m"),
    ({"geometry.half_track_m": 1.5}, False, "1.5 cm would be 0.015 m"),
    ({"geometry.wheel_radius_m": 0.8}, False, "0.8 cm would be 0.008 m"),
    ({"geometry.com_height_m": 1.5}, False, "1.5 cm would be 0.015 m"),
    ({"geometry.width_m": 0.4}, False, "a tenth of it would be 0.04 m"),
    (
        {"geometry.segment_length_m": 3.7, "geometry.rigid_gap_m": 1.8},
        False,
        "1.8 cm would be 0.018 m",
    ),
    (
        {"mass.connectors_kg": 30.0},
        True,
        (
            "mass.connectors_kg.value: 30 kg is implausible for a part of 0.055 m by"
            " 0.04 m, because the density would be 3.4e+05 kg/m³; 30 g would be 0.03"
            " kg"
        ),
    ),
    (
        {"supply.nominal_kpa": 0.483},
        False,
        (
            "0.483 kPa does not fit the other pressures of the robot, such as"
            " continuous_limit_kpa, 68.95 kPa; 0.483 bar would be 48.3 kPa"
        ),
    ),
    ({"actuator.at_pressure_kpa": 7.0}, False, "7 psi would be 48.26 kPa"),
    (
        {"supply.pulsed_limit_kpa": 0.69},
        True,
        "48.3 kPa is above `pulsed_limit_kpa`, which is 0.69 kPa; 0.69 bar would be 69 kPa",
    ),
    (
        {"actuator.tau_vent_s": 60.0},
        False,
        (
            "60 s does not fit the other times of the robot, such as tau_fill_s, 0.1107"
            " s; 60 ms would be 0.06 s"
        ),
    ),
    (
        {"bending.stiffness_nm_per_rad": 440.0},
        False,
        (
            "440 N*m/rad does not fit the other stiffnesses of the robot, such as"
            " weight times body length, 0.4047 N*m/rad; 440 mN*m/rad would be 0.44"
            " N*m/rad"
        ),
    ),
    ({"actuator.tau_mode_s": 2.14}, False, "2.14 ms would be 0.00214 s"),
    ({"bending.pitch_stiffness_nm_per_rad": 100.0}, False, "would be 0.1 N*m/rad"),
    (
        {"actuator.bend_rad": 90.0},
        True,
        "must be a number from 0.001 to 6.3, not 90; did you mean 1.571?",
    ),
]


def changed(numbers):
    robot = copy.deepcopy(GEN2)
    for path, value in numbers.items():
        section, key = path.split(".")
        robot[section][key] |= {"value": value}
        robot[section][key].pop("uncertain", None)
    return robot


def write(tmp_path, robot):
    path = tmp_path / "mine.yaml"
    path.write_text(dump_yaml(robot), "utf-8")
    return path


@pytest.mark.parametrize(("numbers", "is_error", "words"), MISTAKES)
def test_number_in_another_unit_is_reported_with_its_line(
    tmp_path, monkeypatch, numbers, is_error, words
):
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path, changed(numbers))
    if is_error:
        with pytest.raises(InputError) as error:
            load_robot(path)
        (message,) = str(error.value).splitlines()
    else:
        with pytest.warns(UnitWarning) as found:
            load_robot(path)
        assert len(found) == len(numbers), [str(warning.message) for warning in found]
        message = str(found[-1].message)
    place, words_found = message.split(": ", 1)
    assert words in words_found
    name, line, column = place.split(":")
    key = path.read_text("utf-8").splitlines()[int(line) - 2].strip(" :")
    assert (name, key) in {
        ("mine.yaml", each.partition(".")[2]) for each in numbers
    } | {("mine.yaml", "nominal_kpa")}


@pytest.mark.default_cases(at=[0, 5, 8, 10, 17, 29])
@pytest.mark.parametrize("path", ROBOTS, ids=lambda path: path.stem)
@pytest.mark.parametrize("scale", [1 / 16, 1.0, 16.0])
def test_robot_scaled_as_a_whole_is_plausible(tmp_path, path, scale):
    robot = yaml.safe_load(path.read_text("utf-8"))
    for section in robot.values():
        for record in section.values() if isinstance(section, dict) else ():
            if (
                isinstance(record, dict)
                and record.get("unit") in POWERS
                and scale != 1.0
            ):
                factor = scale ** POWERS[record["unit"]]
                many = isinstance(record["value"], list)
                record.pop("uncertain", None)
                record["value"] = (
                    [factor * x for x in record["value"]]
                    if many
                    else factor * record["value"]
                )
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnitWarning)
        load_robot(write(tmp_path, robot))


@pytest.mark.default_cases(at=[0, 2, 5, 25, 34, 37, 52])
@pytest.mark.parametrize("name", shipped_names("scenario"))
def test_shipped_scenario_has_no_doubtful_number(name):
    assert not [
        text
        for text in load_scenario(name).warnings
        if "would be" in text or "unit" in text
    ]


def test_scenario_warns_about_its_robot_file_and_its_own_numbers(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, changed({"geometry.width_m": 4.0}))
    text = "duration_s: 1\ncontroller: {kind: gait, frequency_hz: 2.0}\n"
    (tmp_path / "walk.yaml").write_text(
        f"robot: mine.yaml\nsupply: {{pressure_kpa: 0.4}}\n{text}"
    )
    warned = load_scenario("walk.yaml").warnings
    assert [line.split(": ")[1] for line in warned] == [
        "geometry.width_m.value",
        "supply.pressure_kpa",
    ]
    assert warned[0].startswith("mine.yaml:")
    assert (
        warned[1] == "walk.yaml:2:24: supply.pressure_kpa: 0.4 kPa is far below the"
        " nominal pressure 48.3 kPa of gen2; 0.4 bar would be 40 kPa"
    )
    override = (
        "robot: {base: gen2, geometry: {wheel_radius_m: 0.8}, mass: {connectors_kg:"
        " 0.031}}\n"
    )
    (tmp_path / "walk.yaml").write_text(override + text)
    (warning,) = load_scenario("walk.yaml").warnings
    assert warning.startswith(
        "walk.yaml:1:48: robot.geometry.wheel_radius_m: 0.8 m does not fit the other"
    )
    assert warning.endswith("; 0.8 cm would be 0.008 m")


@pytest.mark.default_cases(at=[0, 1, 2, 4])
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "--length 40",
            (
                "--length 40 is in m, which is unusual for this robot; scaled from the generation 2 robot, it would be 0.22 m; 40"
                " cm would be 0.4 m"
            ),
        ),
        ("--length 400", "400 mm would be 0.4 m"),
        (
            "--mass 500",
            (
                "--mass 500 is in kg, which is unusual for this robot; scaled from the generation 2 robot, it would be 0.15 kg;"
                " 500 g would be 0.5 kg"
            ),
        ),
        ("--pressure 48300", "48300 Pa would be 48.3 kPa"),
        ("--bend 90", "90 deg would be 1.571 rad"),
    ],
)
def test_new_robot_speaks_of_its_options(srs_twin, tmp_path, words, message):
    done = srs_twin("new", "robot", "worm", *words.split(), cwd=tmp_path)
    assert done.returncode == 2 and message in done.stderr
    assert "worm.yaml" not in done.stderr, "lines of a file that was not written"
    assert not list(tmp_path.iterdir())


def test_new_files_with_doubtful_or_wrong_options(srs_twin, tmp_path):
    done = srs_twin("new", "robot", "worm", "--pressure", "7", cwd=tmp_path)
    assert done.returncode == 0 and "7 psi would be 48.26 kPa" in done.stderr
    done = srs_twin("new", "scenario", "walk", "--frequency", "500", cwd=tmp_path)
    assert (
        done.stderr
        == "controller.frequency_hz: must be a number from 0.01 to 50, not 500\n"
    )
