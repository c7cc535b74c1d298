"""Plants and controllers are built once per command, and the call stack to the plant is short."""

from __future__ import annotations

import sys
from collections import Counter
from functools import partialmethod, wraps
from pathlib import Path

import pytest

import srs_twin
from srs_twin import load_scenario
from srs_twin.cli import main
from srs_twin.control.base import Controller
from srs_twin.control.gait import Gait
from srs_twin.io.files import shipped_names
from srs_twin.plants.analytical import AnalyticalSnake
from srs_twin.plants.base import Plant
from srs_twin.plants.twin.snake import TwinSnake

PACKAGE = Path(srs_twin.__file__).parent
BRIEF = """\
title: Brief
robot: gen2
duration_s: 0.2
controller: {kind: gait, frequency_hz: 2.0}
"""
# A feedback controller, so the rollout steps the plant tick by tick.
LEARNING = BRIEF.replace("kind: gait", "kind: ilc").replace("0.2", "1")


@pytest.fixture
def built(monkeypatch) -> Counter[str]:
    """Count what is constructed, by class."""
    counted: Counter[str] = Counter()

    def counting(cls: type) -> None:
        construct = cls.__init__

        @wraps(construct)
        def init(self, *arguments, **options):
            if type(self) is cls:
                counted[cls.__name__] += 1
            construct(self, *arguments, **options)

        monkeypatch.setattr(cls, "__init__", init)

    waiting: list[type] = [Plant, Controller]
    while waiting:
        waiting += (cls := waiting.pop()).__subclasses__()
        if "__init__" in vars(cls):
            counting(cls)
    return counted


def start(*words: str) -> None:
    with pytest.raises(SystemExit) as left:
        main(list(words))
    assert not left.value.code


@pytest.mark.default_cases(at=[0, 2, 5, 25, 34, 37, 52])
@pytest.mark.parametrize("name", shipped_names("scenario"))
def test_loading_builds_no_plant_and_no_controller(built, name):
    load_scenario(name)
    assert not built


@pytest.mark.default_cases(1)
@pytest.mark.parametrize(("command", "twins"), [("compare", 1), ("run", 0)])
def test_a_command_builds_each_plant_and_each_controller_once(
    built, tmp_path, monkeypatch, command, twins
):
    monkeypatch.chdir(tmp_path)
    Path("brief.yaml").write_text(BRIEF + "plants: {analytical: {}}\n")
    start(command, "brief.yaml", "--quiet")
    plants = {"AnalyticalSnake": 1} | ({"TwinSnake": 1} if twins else {})
    assert dict(built) == plants | {Gait.__name__: 1 + twins}


def way_from_compare() -> list[str]:
    """Return the package's files that are on the stack, one a frame, down to the function of the command."""
    frame = sys._getframe(1)
    files = []
    while frame is not None:
        file = Path(frame.f_code.co_filename)
        if file.is_relative_to(PACKAGE):
            files.append(str(file.relative_to(PACKAGE)))
        if files and (files[-1], frame.f_code.co_name) == ("cli/run.py", "compare"):
            return files
        frame = frame.f_back
    raise AssertionError("not called by compare")


@pytest.mark.default_cases(at=[0, 1])
@pytest.mark.parametrize(("text", "way"), [(BRIEF, "play"), (LEARNING, "advance")])
def test_call_stack_to_the_plant_has_eight_frames_in_six_files(
    tmp_path, monkeypatch, text, way
):
    ways: dict[str, list[str]] = {}

    def watched(self, step, *arguments):
        ways[self.name] = [type(self).__module__, *way_from_compare()]
        return step(self, *arguments)

    for plant in (AnalyticalSnake, TwinSnake):
        monkeypatch.setattr(plant, way, partialmethod(watched, getattr(plant, way)))
    monkeypatch.chdir(tmp_path)
    Path("brief.yaml").write_text(text)
    start("compare", "brief.yaml", "--quiet")
    assert set(ways) == {"analytical", "twin"}
    for files in ways.values():
        assert len(files) <= 8 and len(set(files)) <= 6, files
