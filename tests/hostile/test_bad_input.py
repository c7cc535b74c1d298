"""What people put into scenario files, word for word: all mistakes at once, each with its place."""

from __future__ import annotations

import os

import pytest
from parsers import SCENARIO

from srs_twin.errors import InputError
from srs_twin.scenario.loading import load_scenario

pytestmark = pytest.mark.fast

GOOD = SCENARIO.decode()


@pytest.fixture
def refused(tmp_path, monkeypatch):
    """Return the message with which a file of this text is refused."""
    monkeypatch.chdir(tmp_path)

    def refused(text: str | bytes) -> str:
        with open("x.yaml", "wb") as stream:
            stream.write(text.encode() if isinstance(text, str) else text)
        with pytest.raises(InputError) as error:
            load_scenario("x.yaml")
        assert error.value.exit_code == 2
        assert os.listdir() == ["x.yaml"], "nothing else was written"
        return str(error.value)

    return refused


def test_the_good_one_is_good(tmp_path):
    (tmp_path / "x.yaml").write_text("\ufeff" + GOOD.replace("\n", "\r\n"), newline="")
    assert load_scenario(tmp_path / "x.yaml").warnings == ()


@pytest.mark.parametrize(
    ("written", "given"),
    [
        ("0", "0"), ("-2", "-2"), ("1e3", "1000"), (".nan", "NaN"), (".inf", "infinity"),
        ("1e999", "infinity"), ("9" * 5000, "infinity"), ("NaN", "text 'NaN'"),
        ("2Hz", "text '2Hz'; write the number alone, its unit stands in the key"),
        ("'2.0'", "text '2.0'"), ("true", "true"), ("[2]", "a list of 1"), ("{a: 1}", "a block of keys"),
        ("~", "nothing"),
    ],
)  # fmt: skip
def test_a_frequency_that_is_none(refused, written, given):
    expected = f"x.yaml:5:40: controller.frequency_hz: must be a number from 0.01 to 50, not {given}"
    assert refused(GOOD.replace("frequency_hz: 2.0", f"frequency_hz: {written}")) == expected


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("2.0", "2,0", "5:42: controller.0: unknown key"),
        ("2.0", "", "5:26: controller.frequency_hz: must be a number from 0.01 to 50, not nothing"),
        ("frequency_hz", "frequency", "5:26: controller.frequency: unknown key; did you mean frequency_hz?"),
        ("offset: 0.0", "offset: 1", "5:53: controller.offset: must be a number from -0.95 to 0.95, not 1"),
        (
            "duration_s: 1",
            "duration_s: 1e9",
            "3:13: duration_s: must be a number from 0.001 to 3600, not 10000",
        ),
        ("duration_s: 1", "duration: 1", "3:1: duration: unknown key; did you mean duration_s?"),
        (
            "world: {}",
            "world: []",
            "6:8: world: must be a block of keys (obstacles, circles, map, polygons, random, floor, steps, "
            "bounds, goal), ",
        ),
        (
            "world: {}",
            "world: {floor: {tilt_deg: 90}}",
            "6:27: world.floor.tilt_deg: must be a number from 0 to 60, not 90",
        ),
        (
            "world: {}",
            "world: {steps: [{x_m: 0.5, height_m: 0.002}]}",
            "6:16: world.steps: the floor of the analytical model is a plane; only the twin has steps",
        ),
        ("friction: axis", "load: momentary", "8:15: plants.analytical: friction axis acts at one point p"),
        ("twin: {wheels: rolling}", "twin:", "8:3: plants: twin is empty; write 'twin: {}' for"),
        ("kind: gait", "kind: smc", "5:20: controller.kind: must be one of gait, ilc, direct_smc, "),
        (
            "48.3",
            "96.5",
            "4:24: supply.pressure_kpa: 96.5 kPa is above the limit of gen2 in pulses of a gait, 68.9",
        ),
        ("48.3", "48kPa", "4:24: supply.pressure_kpa: must be a number from 0.1 to 2000, not text '48kPa'"),
        (
            "48.3}",
            "96, allow_overpressure: yes}",
            "4:48: supply.allow_overpressure: must be true or false, not t",
        ),
        (
            "friction: axis",
            "tick_s: 0.02005",
            "8:41: plants.analytical.tick_s: tick 0.02005 s is no multiple of",
        ),
        (
            "wheels: rolling",
            "wheels: ski",
            "9:18: plants.twin.wheels: must be one of rolling, skid, not text 'ski'; did you mean sk",
        ),
        (
            "gen2\n",
            "{base: gen2, mass: {wheel_kg: -1}}\n",
            "2:38: robot.mass.wheel_kg: must be a number from 1e-06",
        ),
        ("gen2\n", "gen2\nrobot: gen3\n", "3:1: robot: given twice; the first is in line 2"),
        ("gen2\n", "&r gen2\n", "2:8: anchors (&r) are not allowed"),
        (
            "gen2\n",
            "!!python/name:os.system\n",
            "2:8: tags (tag:yaml.org,2002:python/name:os.system) are not",
        ),
        ("gen2\n", "../../../etc/passwd\n", "2:8: robot: ../../../etc/passwd: no such file"),
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
        ("world: {}", "world: {}}", "6:10: not YAML: "),
        ("title: G", "---\ntitle: x\n---\ntitle: G", "3:1: a second document begins here"),
        ("title: G", "\x07title: G", "1:1: not YAML: unusable character U+0007"),
        ("title: G", "on: G", "1:1: on: unknown key; known here: "),
    ],
)
def test_one_mistake_one_message(refused, old, new, message):
    assert old in GOOD
    text = refused(GOOD.replace(old, new, 1))
    assert any(line.startswith(f"x.yaml:{message}") for line in text.splitlines()), text
    assert "Traceback" not in text and "pydantic" not in text


def test_all_mistakes_at_once_in_the_order_of_the_file(refused):
    text = GOOD.replace("title", "titel").replace("gen2", "gen22").replace("48.3", "x").replace("2.0", "0")
    text = text.replace("rolling", "&a rolling").replace("near: 0.214, ", "")
    places = [line.split(": ")[:2] for line in refused(text).splitlines()]
    assert places == [
        ["x.yaml:1:1", "titel"],
        ["x.yaml:2:8", "robot"],
        ["x.yaml:4:24", "supply.pressure_kpa"],
        ["x.yaml:5:40", "controller.frequency_hz"],
        ["x.yaml:9:18", "anchors (&a) are not allowed; write each value out"],
        ["x.yaml:11:5", "expect[0]"],
    ]


def test_missing_and_folder(tmp_path):
    with pytest.raises(InputError, match=r"nope\.yaml: no such file"):
        load_scenario(tmp_path / "nope.yaml")
    with pytest.raises(InputError, match="a folder; give one file"):
        load_scenario(tmp_path)
    with pytest.raises(InputError, match=r"unknown scenario 'gen2_strait'; did you mean gen2_straight\?"):
        load_scenario("gen2_strait")
