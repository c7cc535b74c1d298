"""Set-up files of a lab, control by keys, and what the command says when nothing is heard."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import pytest
import yaml

from srs_twin import InputError
from srs_twin.live.links import typed_words
from srs_twin.live.setup_file import load_setup, setup_json_schema

LAB = """\
robot: gen4
name: snake
supply_kpa: 50
broker: {address: "10.0.0.2:1884", user: lab, ca: ca.pem}
motion_capture:
  address: 10.0.0.3
  local: 10.0.0.4
  up: z
  bodies: {head: 1, "a=b": 2}
limits: {duration_s: 60, allow_zero_margin: true}
"""
OPTIONS = {
    "robot": "gen4",
    "name": "snake",
    "pressure": 50.0,
    "mqtt": "10.0.0.2:1884",
    "user": "lab",
    "ca": Path("ca.pem"),
    "natnet": "10.0.0.3",
    "local": "10.0.0.4",
    "up": "z",
    "body": ["head=1", "a=b=2"],
    "duration": 60.0,
    "allow_zero_margin": True,
}


def test_a_setup_file_has_the_values_of_the_options(tmp_path):
    (tmp_path / "lab.yaml").write_text(LAB)
    (tmp_path / "ca.pem").touch()
    assert load_setup(tmp_path / "lab.yaml").options() == OPTIONS | {
        "ca": tmp_path / "ca.pem"
    }
    (tmp_path / "lab.yaml").write_text("robot: gen4\n")
    assert load_setup(tmp_path / "lab.yaml").options() == {
        "robot": "gen4",
        "allow_zero_margin": False,
    }


def test_the_schema_admits_the_file_and_describes_every_key():
    schema = setup_json_schema()
    jsonschema.validate(yaml.safe_load(LAB), schema)
    for block in (schema, *schema["$defs"].values()):
        assert all(each.get("description") for each in block["properties"].values())
    assert (
        "in s, 0.02 to 10000000"
        in schema["$defs"]["LimitsFile"]["properties"]["duration_s"]["description"]
    )


def test_the_command_prints_the_schema(srs_twin, tmp_path):
    assert (
        json.loads(srs_twin("schema", "setup", cwd=tmp_path).stdout)
        == setup_json_schema()
    )


@pytest.mark.default_cases(at=[0, 1, 2, 5, 6])
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("robot: gen4\nnam: x\n", "lab.yaml:2:1: nam: unknown key; did you mean name?"),
        (
            "robot: gen4\nname: a/b\n",
            "lab.yaml:2:7: name: the name cannot be part of an MQTT topic",
        ),
        (
            "robot: gen4\nbroker: {address: 'lab:0'}\n",
            "lab.yaml:2:19: broker.address: 'lab:0' is not an address",
        ),
        (
            "robot: gen4\nlimits: {duration_s: -1}\n",
            "limits.duration_s: must be a number from 0.02",
        ),
        (
            "robot: gen4\nmotion_capture: {address: lab, bodies: {head: 0}}\n",
            "must be a whole number from 1",
        ),
        ("name: x\n", "robot: missing"),
        (
            "robot: gen4\nsupply_kpa: 0\n",
            "supply_kpa: must be a number from 0.1 to 2000",
        ),
    ],
)
def test_mistakes_are_shown_where_they_are(tmp_path, srs_twin, text, words):
    (tmp_path / "lab.yaml").write_text(text)
    done = srs_twin("shadow", "--setup", "lab.yaml", cwd=tmp_path)
    assert done.returncode == 2
    assert words in " ".join(done.stderr.split())


def asked_for(srs_twin, tmp_path, monkeypatch, *words: str) -> SimpleNamespace:
    """Return the arguments with which the command connects to the broker and makes a shadow."""
    found = SimpleNamespace()

    def shadow(spec, **settings):
        found.shadow = settings
        return SimpleNamespace(spec=spec)

    def broker_link(name, segments, address, user, ca, *, speaks):
        found.name = name
        found.broker = address
        found.user = user
        found.ca = ca
        raise InputError("far enough")

    monkeypatch.setattr("srs_twin.live.session.warm_up", lambda _: None)
    monkeypatch.setattr("srs_twin.live.shadow.Shadow", shadow)
    monkeypatch.setattr("srs_twin.live.shadow_command.broker_link", broker_link)
    done = srs_twin("shadow", *words, cwd=tmp_path)
    assert done.returncode == 2 and "far enough" in done.stderr, done.stderr
    return found


def test_options_override_the_setup_file(srs_twin, tmp_path, monkeypatch):
    (tmp_path / "lab.yaml").write_text(LAB)
    (tmp_path / "ca.pem").touch()
    found = asked_for(srs_twin, tmp_path, monkeypatch, "--setup", "lab.yaml")
    expected = ("snake", "10.0.0.2:1884", "lab", Path("ca.pem"))
    assert (found.name, found.broker, found.user, found.ca) == expected
    words = ("gen2", "--setup", "lab.yaml", "--name", "other", "--mqtt", "1.2.3.4")
    defaults = {"supply_pa": 50e3, "members": 32, "seed": 0}
    assert found.shadow == defaults | {"frames": {"head": 1, "a=b": 2}}
    found = asked_for(srs_twin, tmp_path, monkeypatch, *words)
    assert (found.name, found.broker, found.user) == ("other", "1.2.3.4", "lab")


def test_without_a_robot_the_command_asks_for_one(srs_twin, tmp_path):
    done = srs_twin("shadow", cwd=tmp_path)
    assert done.returncode == 2 and "no robot is given; give ROBOT" in done.stderr


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--up", "x"], "'x' is not one of 'y', 'z'"),
        (["--up", "z"], "--up has no effect without --natnet"),
        (["--speed", "1"], "--speed has no effect without --mcap"),
        (["--allow-zero-margin"], "--allow-zero-margin has no effect without --follow"),
        (["--body", "a=1"], "--body has no effect without --natnet or --mcap"),
        (
            ["--natnet", "lab", "--body", "a=1", "--body", "b=1"],
            "the body or the connector of 'b=1' is used twice",
        ),
        (
            ["--natnet", "lab", "--body", "a=1", "--body", "a=2"],
            "the body or the connector of 'a=2' is used twice",
        ),
        (["--mqtt", "lab", "--mcap", "no.mcap"], "--mcap replays a recorded journal"),
        (["--follow", "gen2_straight"], "the scenario follows no planned path"),
        (["--pressure", "5000"], "Invalid value for '--pressure'"),
        (["--name", ""], "--name '' cannot be part of an MQTT topic"),
    ],
)
def test_options_without_effect_or_meaning_are_refused(
    srs_twin, tmp_path, options, words
):
    done = srs_twin("shadow", "gen4", *options, cwd=tmp_path)
    assert done.returncode == 2
    assert words in " ".join(done.stderr.split())


def test_a_session_that_hears_nothing_says_so_with_exit_code_2(
    srs_twin, tmp_path, broker
):
    address = f"127.0.0.1:{broker.port}"
    (tmp_path / "lab.yaml").write_text(
        f"robot: gen4\nbroker: {{address: '{address}'}}\n"
    )
    options = ("--setup", "lab.yaml", "--duration", "0.3", "--out", "lab")
    done = srs_twin("shadow", *options, cwd=tmp_path)
    assert done.returncode == 2
    assert (
        f"no messages of the robot 'gen4' arrived from {address} in 0 s" in done.stderr
    )
    assert "None" not in done.stderr and "Traceback" not in done.stderr
    assert "estimate" not in json.loads((tmp_path / "lab/shadow.json").read_text())


def test_keys_are_read_one_by_one_and_the_terminal_is_restored():
    import termios

    keyboard, terminal = os.openpty()
    with os.fdopen(terminal) as stream:
        before = termios.tcgetattr(stream)
        with typed_words(stream) as words:
            assert words() == []
            os.write(keyboard, b"pxG\xff v")
            end = time.monotonic() + 5
            found = []
            while len(found) < 3 and time.monotonic() < end:
                found += words()
            assert found == ["pause", "go", "vent"]
        assert termios.tcgetattr(stream) == before
    os.close(keyboard)


def test_without_a_terminal_no_key_is_read(tmp_path):
    (tmp_path / "file").write_text("ssss")
    with (tmp_path / "file").open() as stream, typed_words(stream) as words:
        assert words() == []
