"""Defaults that the help states, compared with what the commands do without the option.

Typer prints the defaults of signatures itself. Hand-written ones have the form
`[default: …]`; each is checked here, or is a phrase that names no value.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from srs_twin.cli.app import command
from srs_twin.errors import InputError

EXAMPLES = Path(__file__).parents[2] / "calibration/examples/my_snake"
# Command → a way to start it, and the words that take the place of the capitals in the
# stated folder or file.
PLACES = {
    "run": ("run gen2_straight", {"SCENARIO": "gen2_straight"}),
    "compare": ("compare gen2_straight", {"SCENARIO": "gen2_straight"}),
    "plan": ("plan follow_fig57", {"SCENARIO": "follow_fig57"}),
    "replay": (
        f"replay {EXAMPLES}/walk_left.csv --robot gen2",
        {"MOTION": "walk_left"},
    ),
    "sweep": ("sweep fig31_coarse --workers 1", {"SWEEP": "fig31_coarse"}),
    "optimize": ("optimize gen2_speed --workers 1", {"STUDY": "gen2_speed"}),
    "uncertainty": (
        "uncertainty gen2_straight --samples 16 --workers 1",
        {"SCENARIO": "gen2_straight"},
    ),
    "calibrate friction": (
        f"calibrate friction {EXAMPLES}/pulls.csv -r gen2",
        {"NAME": "gen2_friction"},
    ),
    "calibrate damping": (
        f"calibrate damping {EXAMPLES}/release.csv -r gen2",
        {"NAME": "gen2_damping"},
    ),
    "calibrate actuator": (
        f"calibrate actuator {EXAMPLES}/steps.csv -r gen2",
        {"NAME": "gen2_actuator"},
    ),
    "calibrate locomotion": (
        f"calibrate locomotion {EXAMPLES}/walk_left.csv -r gen2",
        {"NAME": "gen2_locomotion"},
    ),
    "calibrate robot": ("calibrate robot fit.yaml --name mine", {"NAME": "mine"}),
}
PHRASES = {
    "all except metrics",
    "start of the run",
    "end of the run",
    "one per processor",
    "those of the scenario",
    "from the scenario",
    "the models named in the scenario",
    "the models named in the sweep",
    "NAME.valves.csv in the folder of the recording",
    "detected",
    "from the robot file",
    "estimated",
    "computed from the valve pattern",
    "the marker at the end that leads the motion",
    "any free port",
    "none",
    "no motion capture",
    "run until Ctrl-C",
    "this machine's",
    "the run's folder",
    "ROBOT_COMMAND",
    "all shipped robots with wheels",
    "the pressure limit of the robot",
    "names of robot and controller, for example gen2_gait",
    "3, or 1 if the twin is fitted to shapes",
    "local",
    "orifice, or lag for spatial robots",
    "4",
    "mass of gen2, scaled to the given length and number of segments",
    "NAME.yaml, or NAME.py for a controller",
    "all trajectories in an MCAP file, only the twin in other files",
    "a file in the folder of the run, such as RUN/twin.csv or RUN/run.mcap",
}


def stated() -> Iterator[tuple[str, str, str]]:
    """Yield command, parameter and text of each default that the help states by hand."""

    def below(one: Any, words: tuple[str, ...]) -> Iterator[tuple[str, str, str]]:
        for name, other in getattr(one, "commands", {}).items():
            yield from below(other, (*words, name))
        for parameter in one.params:
            for text in re.findall(
                r"\[default: (.*?)\]", getattr(parameter, "help", None) or ""
            ):
                yield " ".join(words), parameter.name, text

    return below(command(), ())


def values() -> dict[tuple[str, str], str]:
    """Return command and parameter → default that the command takes, in the help's words."""
    from srs_twin.cli.new import (
        _BEND_RAD,
        _PITCH_M,
        _PRESSURE_KPA,
        _SERVO_BEND_RAD,
    )
    from srs_twin.comparison.diff import Tolerances
    from srs_twin.identification.calibration import _plant_settings
    from srs_twin.identification.footprint import FREQUENCY_HZ, GaitSetup
    from srs_twin.identification.replay import _plants
    from srs_twin.plants.twin.mjcf.numerics import ModelSettings
    from srs_twin.recordings.takes import RecordingReader
    from srs_twin.robot.file import load_robot

    spec = load_robot("gen2")
    most = {
        name: max(GaitSetup(spec, 2.0, 48e3, name).offsets) for name in ("gait", "ilc")
    }
    gap = f"{RecordingReader().longest_gap_s:g}"
    fitted = _plant_settings("analytical", None, None)
    return {
        ("diff", "rel"): f"{Tolerances().rel:.0e}".replace("e-0", "e-"),
        ("diff", "abs_"): f"{Tolerances().abs:.0e}".replace("e-0", "e-"),
        ("new robot", "bend"): f"{_BEND_RAD:g}, or {_SERVO_BEND_RAD:g} with --servo",
        ("new robot", "length"): f"{4 * _PITCH_M:g}",
        ("new robot", "pressure"): f"{_PRESSURE_KPA:g}",
        ("calibrate footprint", "contact"): ModelSettings.contact.name,
        ("replay", "friction_law"): _plants(["analytical"], "complete", None, False)[
            "analytical"
        ]["friction"],
        ("calibrate locomotion", "friction_law"): fitted["friction"],
        ("calibrate locomotion", "model"): fitted["model"],
        ("calibrate footprint", "frequency"): "{gait:g}, or {ilc:g} for ilc".format(
            **FREQUENCY_HZ
        ),
        (
            "calibrate footprint",
            "offsets",
        ): "from -{gait:g} to {gait:g}, or from -{ilc:g} to {ilc:g} for ilc".format(
            **most
        ),
        **{
            (name, "longest_gap_s"): gap
            for name in (
                "replay",
                "calibrate friction",
                "calibrate actuator",
                "calibrate locomotion",
            )
        },
    }


LIVE = {
    ("shadow", "mqtt"): "127.0.0.1:1883, or none with --mcap",
    ("shadow", "name"): "ROBOT",
    ("shadow", "robot"): "from --setup",
    ("shadow", "body"): "connector_1=1, connector_2=2, …",
    ("emulate", "name"): "ROBOT",
}


def test_documented_defaults_are_checked():
    checked = {*values(), *LIVE}
    rest = {
        each
        for each in stated()
        if each[:2] not in checked
        and each[2] not in PHRASES
        and not (each[1] == "out" and each[0] in PLACES)
    }
    assert rest == set()


def test_documented_defaults_equal_those_of_the_commands():
    texts = {each[:2]: each[2] for each in stated()}
    assert {key: texts[key] for key in values()} == values()


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("name", PLACES)
def test_default_output_is_the_documented_one(name, srs_twin, tmp_path):
    """A file blocks the stated folder: the command must report it before it runs anything."""
    (template,) = (
        text for of, parameter, text in stated() if (of, parameter) == (name, "out")
    )
    words, meant = PLACES[name]
    place = Path(re.sub("[A-Z]{2,}", lambda found: meant[found[0]], template))
    (tmp_path / place).parent.mkdir(parents=True)
    (tmp_path / place).write_text("in the way", "utf-8")
    done = srs_twin(*words.split(), cwd=tmp_path)
    assert done.returncode == 2
    assert str(place) in done.stderr
    assert [each for each in tmp_path.rglob("*") if each.is_file()] == [
        tmp_path / place
    ]


@pytest.mark.parametrize(
    ("words", "address"), [("shadow gen2", "127.0.0.1:1883"), ("emulate gen2", None)]
)
def test_live_command_uses_documented_name_and_broker(
    words, address, srs_twin, tmp_path, monkeypatch
):
    from srs_twin.live import session

    asked: list[tuple[Any, ...]] = []

    def refuse(*given: Any, **_: Any) -> None:
        asked.append(given)
        raise InputError("refused")

    name = words.split()[0]
    monkeypatch.setattr(f"srs_twin.live.{name}_command.broker_link", refuse)
    monkeypatch.setattr(session, "warm_up", lambda spec: None)
    assert srs_twin(*words.split(), cwd=tmp_path).returncode == 2
    robot, _, broker, *_ = asked[0]
    texts = {each[:2]: each[2] for each in stated()}
    assert robot == texts[name, "name"].replace("ROBOT", "gen2")
    if address is not None:
        assert broker == address == texts[name, "mqtt"].partition(",")[0]


def test_rigid_bodies_are_connectors_by_default():
    from srs_twin.live.shadow import Shadow
    from srs_twin.robot.file import load_robot

    first, number = (
        {each[:2]: each[2] for each in stated()}["shadow", "body"].split()[0].split("=")
    )
    shadow = Shadow(load_robot("gen2"), members=2)
    assert shadow._frames[first] == int(number)  # noqa: SLF001
