"""Typical mistakes in commands and scenario files: every message names the place and a remedy."""

# ruff: noqa: E501 - one mistake per line, as a table
from __future__ import annotations

import os
from typing import Annotated

import pytest
from conftest import ROOT
from malformed_scenarios import SCENARIO
from malformed_yaml import NOT_NUMBERS
from pydantic import Field

from srs_twin.errors import InputError
from srs_twin.io.documents import Document
from srs_twin.io.validation import StrictModel, validate
from srs_twin.scenario.loading import load_scenario

GOOD = SCENARIO.decode()
MINE = """title: Mine
robot: gen2
duration_s: 2
supply: {pressure_kpa: 48.3}
controller: {kind: gait, frequency_hz: 2.0, offset: 0.0}
plants: {analytical: {}, twin: {}}
"""

# Command line, and part of the message.
COMMANDS = [
    ("run mine.yml", "mine.yml: no such file"),
    (
        f"run {ROOT}/calibration/robots/gen2.yaml",
        "gen2.yaml: this is a robot file; give a scenario that contains `robot: ",
    ),
    ("compare gen2_straight --explian", "--explain"),
    ("compare gen2_straight --set robot.mu_t=0.2", "did you mean robot.friction.mu_t?"),
    (
        "compare gen2_straight --set friction.mu_t=0.2",
        "did you mean robot.friction.mu_t?",
    ),
    (
        "compare gen2_straight --duration=-1",
        "--duration -1: duration_s: must be a number from 0.001",
    ),
    (
        "compare gen2_straight --duration 3s",
        "write the number without its unit, which the key states",
    ),
    ("run gen2_straight --seed 1.5", "--seed 1.5: seed: must be a whole number from 0"),
    (
        "run gen2_straight --plants both",
        "--plants: 'both' is unknown; allowed: analytical, twin",
    ),
    ("list robot", "unknown kind 'robot'; did you mean robots?"),
    ("models export gen2 --contact loaded", "an exported snake would slide freely"),
    ("models check model.xml", "was retired"),
    (
        "play gen2 --set controller.offset=0.1",
        "only fields of the robot can be set",
    ),
    ("reproduce --only XY", "docs/reproduction.md lists them"),
    ("schema robots", "(available: inspect, scenario, setup, study, sweep)"),
    ("replay walk.csv --robot gen2", "walk.csv: no such file"),
    (
        "run gen2_straight --plants=",
        "--plants: '' is unknown; allowed: analytical, twin",
    ),
]

# Text of MINE, its replacement, and part of the message of `srs-twin run`.
SCENARIO_EDITS = [
    (
        "robot: gen2",
        "robot: gen 2",
        "2:8: robot: unknown robot 'gen 2'; did you mean gen2?",
    ),
    (
        "title: Mine",
        "title: Mine\nbending: {k: 1}",
        "2:1: bending: unknown key; did you mean robot.bending?",
    ),
    (
        "frequency_hz: 2.0",
        "frequency_hz: 2,0",
        "unknown key; a decimal number is written with a point, not with a comma",
    ),
    (
        "frequency_hz: 2.0",
        "frequency_hz: 2 Hz",
        "not text '2 Hz'; write the number without its unit",
    ),
    (
        "pressure_kpa: 48.3",
        "pressure_psi: 7",
        "supply.pressure_psi: unknown key; did you mean pressure_kpa?",
    ),
    (
        "duration_s: 2",
        "duration_s: 2\n\tseed: 1",
        "YAML is indented with spaces, not tabs",
    ),
    (
        "twin: {}",
        "twin: {wheels: skis}",
        "one of rolling, skid, not text 'skis'; did you mean skid?",
    ),
    (
        "twin: {}",
        "twin: {timestep_ms: 1}",
        "plants.twin.timestep_ms: unknown key; did you mean timestep_s?",
    ),
    (
        "twin: {}",
        "twin: {contact: preloaded, friction: wheel}",
        "plants.twin: `friction` is allowed only with `contact: loaded`",
    ),
    ("analytical: {}", "analytical: {model: compliance}", "did you mean compliant?"),
    (
        "twin: {}}",
        "twin: {contact: preloaded}}\nworld: {floor: {tilt_deg: 3}}",
        "7:16: world.floor: contact 'preloaded' does not support a floor that slopes; use contact 'loaded'",
    ),
    (
        "title: Mine",
        "title: Mine\nworld: {obstacles: [{x: 1}]}",
        "allowed: x_m, y_m, radius_m",
    ),
    (
        "title: Mine",
        "title: Mine\nexpect: [{metric: com_speed_m_s, plant: twin, near: 1}]",
        "give `rel` or `abs` with `near`",
    ),
    (
        "robot: gen2",
        "robot: {base: gen2, geometry: {segment_length_m: 37}}",
        (
            "robot.geometry.segment_length_m: 37 m does not fit the other lengths of"
            " the robot, such as wheel_radius_m, 0.008 m; 37 mm would be 0.037 m"
        ),
    ),
    (
        "pressure_kpa: 48.3",
        "pressure_kpa: 1200",
        "or set `allow_overpressure: true`; 1200 mbar would be 120 kPa",
    ),
    (
        "title: Mine",
        "title: Mine: the second",
        (
            "1:12: not YAML: mapping values are not allowed here; a text that contains"
            " a colon and a space must be in quotes"
        ),
    ),
    (
        "robot: gen2",
        "  robot: gen2",
        (
            "2:8: not YAML: mapping values are not allowed here; the indentation is"
            " wrong, because all keys of a block must begin in the same column"
        ),
    ),
    (
        "robot: gen2",
        "supply:\n    pressure_kpa: 40\n  robot: gen2",
        "the indentation is wrong, because all keys of a block must begin in the",
    ),
    (
        "robot: gen2",
        "robot gen2",
        "could not find expected ':'; a key must be followed by a colon and a space",
    ),
    (
        "title: Mine",
        "zzz: 1",
        (
            "1:1: zzz: unknown key; allowed: name, title, robot, duration_s, seed,"
            " record_hz, supply, pneumatics, allow_overpressure, valves, sensor,"
            " faults, … (`srs-twin schema` lists all "
        ),
    ),
    (
        "supply: {pressure_kpa: 48.3}",
        "supply: 48.3",
        "4:9: supply: must be a block of keys (pressure_kpa,",
    ),
    (
        "controller:",
        "controllers:",
        "5:1: controllers: unknown key; did you mean controller?",
    ),
]

# Text of GOOD, its replacement, and the message of `load_scenario`.
POSITIONS = [
    ("2.0", "2,0", "5:42: controller.0: unknown key"),
    (
        "2.0",
        "",
        "5:26: controller.frequency_hz: must be a number from 0.01 to 50, not nothing",
    ),
    (
        "offset: 0.0",
        "offset: 1",
        "5:53: controller.offset: must be a number from -0.95 to 0.95, not 1",
    ),
    (
        "duration_s: 1",
        "duration_s: 1e9",
        "3:13: duration_s: must be a number from 0.001 to 3600, not 10000",
    ),
    (
        "duration_s: 1",
        "duration: 1",
        "3:1: duration: unknown key; did you mean duration_s?",
    ),
    (
        "world: {}",
        "world: []",
        (
            "6:8: world: must be a block of keys (obstacles, circles, map, polygons,"
            " random, pegs, obstacle_friction, floor, steps, objects, bounds, goal), "
        ),
    ),
    (
        "world: {}",
        "world: {floor: {tilt_deg: 90}}",
        "6:27: world.floor.tilt_deg: must be a number from 0 to 60, not 90",
    ),
    (
        "world: {}",
        "world: {steps: [{x_m: 0.5, height_m: 0.002}]}",
        (
            "6:16: world.steps: model 'complete' does not support a floor with steps;"
            " use the twin"
        ),
    ),
    (
        "friction: axis",
        "load: instantaneous",
        "8:39: plants.analytical.load: instantaneous loads need two contacts per"
        " connector",
    ),
    (
        "twin: {wheels: rolling}",
        "twin:",
        "8:3: plants: the section `twin` is empty; write `twin: {}` to",
    ),
    (
        "48.3",
        "48kPa",
        (
            "4:24: supply.pressure_kpa: must be a number from 0.1 to 2000, not text"
            " '48kPa'"
        ),
    ),
    (
        "48.3}",
        "96, allow_overpressure: yes}",
        "4:48: supply.allow_overpressure: must be true or false, not t",
    ),
    (
        "wheels: rolling",
        "wheels: ski",
        (
            "9:18: plants.twin.wheels: must be one of rolling, skid, not text 'ski';"
            " did you mean sk"
        ),
    ),
    (
        "gen2\n",
        "{base: gen2, mass: {wheel_kg: -1}}\n",
        "2:38: robot.mass.wheel_kg: must be a number from 1e-10",
    ),
    (
        "gen2\n",
        "{base: gen2, modules: {gain: [1.2, 0.8]}}\n",
        (
            "2:38: robot.modules.gain[0]: must be a list of 2 to 8 (each a number from"
            " 0.1 to 10), not 1.2"
        ),
    ),
    (
        "gen2\n",
        "gen2\nrobot: gen3\n",
        "3:1: robot: the key is given twice; the first one is on line 2",
    ),
    (
        "gen2\n",
        "../../../etc/passwd\n",
        "2:8: robot: ../../../etc/passwd: no such file",
    ),
    (
        "world: {}",
        "world: {goal: {x_m: 1}}",
        "6:15: world.goal.y_m: missing; it must be a number from -1000 to",
    ),
    (
        "world: {}",
        "\tworld: {}",
        "6:1: not YAML: while scanning for the next token: found character '\\t'",
    ),
    (
        "world: {}",
        "world: {bounds: {x_m: [1], y_m: [0, 1]}}",
        "6:23: world.bounds.x_m: must have 2 entries, not 1",
    ),
    (
        "world: {}",
        "start: {velocity_m_s: [1.0e+6, 0]}",
        "6:24: start.velocity_m_s[0]: must be a number from -10 to 10, not 1000000",
    ),
    (
        "world: {}",
        "name: ../evil",
        "6:7: name: must be text of 1 to 200 characters that contains no slash",
    ),
    (
        "world: {}",
        "seed: 1.0",
        "6:7: seed: must be a whole number from 0 to 4294967295, not 1.0; write it as"
        " a whole number, such as 1",
    ),
]


@pytest.mark.default_cases(10)
@pytest.mark.parametrize(("command", "message"), COMMANDS)
def test_mistyped_command_is_rejected_with_a_remedy(
    srs_twin, tmp_path, command, message
):
    done = srs_twin(*command.split(), cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert not done.stdout and not list(tmp_path.iterdir())


@pytest.mark.default_cases(10)
@pytest.mark.parametrize(("old", "new", "message"), SCENARIO_EDITS)
def test_mistake_in_a_scenario_is_rejected_with_a_remedy(
    srs_twin, tmp_path, old, new, message
):
    assert old in MINE
    (tmp_path / "mine.yaml").write_text(MINE.replace(old, new))
    done = srs_twin("run", "mine.yaml", cwd=tmp_path)
    assert done.returncode == 2
    assert any(
        line.startswith("mine.yaml:") and message in line
        for line in done.stderr.splitlines()
    )
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]


@pytest.fixture
def rejected(tmp_path, monkeypatch):
    """Return a function from the text of a scenario file to the message with which it is rejected."""
    monkeypatch.chdir(tmp_path)

    def rejected(text: str) -> str:
        with open("x.yaml", "wb") as stream:
            stream.write(text.encode())
        with pytest.raises(InputError) as error:
            load_scenario("x.yaml")
        assert error.value.exit_code == 2
        assert os.listdir() == ["x.yaml"], "a file was written"
        return str(error.value)

    return rejected


@pytest.mark.fast
def test_byte_order_mark_and_windows_line_ends_are_accepted(tmp_path):
    (tmp_path / "x.yaml").write_text("\ufeff" + GOOD.replace("\n", "\r\n"), newline="")
    assert load_scenario(tmp_path / "x.yaml").warnings == ()


@pytest.mark.fast
@pytest.mark.parametrize(
    ("written", "description"),
    [
        ("0", "0"),
        ("-2", "-2"),
        ("1e3", "1000"),
        *(each for each in NOT_NUMBERS.items() if all(each)),
    ],
)
def test_invalid_frequency_is_described(rejected, written, description):
    said = rejected(GOOD.replace("frequency_hz: 2.0", f"frequency_hz: {written}"))
    assert said.startswith(
        "x.yaml:5:40: controller.frequency_hz: must be a number from 0.01 to 50, not"
        f" {description}"
    )


@pytest.mark.fast
@pytest.mark.parametrize(("old", "new", "message"), POSITIONS)
def test_mistake_is_reported_with_line_and_column(rejected, old, new, message):
    assert old in GOOD
    text = rejected(GOOD.replace(old, new, 1))
    assert any(line.startswith(f"x.yaml:{message}") for line in text.splitlines()), text
    assert "Traceback" not in text and "pydantic" not in text


@pytest.mark.fast
def test_all_mistakes_are_reported_in_the_order_of_the_file(rejected):
    text = (
        GOOD.replace("title", "titel")
        .replace("gen2", "gen22")
        .replace("48.3", "x")
        .replace("2.0", "0")
    )
    text = text.replace("rolling", "&a rolling").replace("near: 0.214, ", "")
    assert [line.split(": ")[:2] for line in rejected(text).splitlines()] == [
        ["x.yaml:1:1", "titel"],
        ["x.yaml:2:8", "robot"],
        ["x.yaml:4:24", "supply.pressure_kpa"],
        ["x.yaml:5:40", "controller.frequency_hz"],
        ["x.yaml:9:18", "anchors (&a) are not allowed; write each value out"],
        ["x.yaml:11:5", "expect[0]"],
    ]


@pytest.mark.fast
@pytest.mark.parametrize(
    ("value", "description"),
    [
        ("2", "text '2'; write the number without quotes"),
        ("2.5", "text '2.5'"),
        ("-1", "text '-1'"),
        (1e3, "1000.0; write it as a whole number, such as 1000"),
        (1e20, "1e+20"),
    ],
)
def test_hint_for_a_whole_number_leads_to_an_allowed_value(value, description):
    with pytest.raises(InputError) as error:
        load_scenario("gen2_straight", set={"seed": value})
    assert str(error.value).endswith(f"from 0 to 4294967295, not {description}")


class Limits(StrictModel):
    above: Annotated[float, Field(gt=0)] = 1.0
    entries: (
        Annotated[list[int], Field(min_length=2)]
        | Annotated[list[str], Field(min_length=3, max_length=3)]
    ) = [1, 2]


@pytest.mark.fast
@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"above": ".5"}, "not text '.5'; write the number without quotes"),
        ({"above": "0"}, "not text '0'"),
        ({"entries": [1]}, "must have at least 2 entries, not 1"),
        ({"entries": ["a"]}, "must have 3 entries, not 1"),
    ],
)
def test_hint_belongs_to_the_violated_limit(data, message):
    document = Document("x.yaml")
    validate(Limits, document, data)
    assert any(text.endswith(message) for _, text in document.problems)
