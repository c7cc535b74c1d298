"""Plants and controllers are built once per command."""

from __future__ import annotations

from collections import Counter
from functools import wraps

import pytest

from srs_twin import load_scenario
from srs_twin.control.base import Controller
from srs_twin.control.gait import Gait
from srs_twin.io.files import shipped_names
from srs_twin.plants.analytical import AnalyticalSnake
from srs_twin.plants.base import Plant
from srs_twin.plants.twin.snake import TwinSnake

BRIEF = """\
title: Brief
robot: gen2
duration_s: 0.2
controller: {kind: gait, frequency_hz: 2.0}
"""


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


@pytest.mark.default_cases(at=[0, 2, 5, 25, 34, 37, 52])
@pytest.mark.parametrize("name", shipped_names("scenario"))
def test_loading_builds_no_plant_and_no_controller(built, name):
    load_scenario(name)
    assert not built


@pytest.mark.default_cases(1)
@pytest.mark.parametrize(("command", "twins"), [("compare", 1), ("run", 0)])
def test_a_command_builds_each_plant_and_each_controller_once(
    built, srs_twin, tmp_path, command, twins
):
    (tmp_path / "brief.yaml").write_text(BRIEF + "plants: {analytical: {}}\n")
    assert srs_twin(command, "brief.yaml", "-q", cwd=tmp_path).returncode == 0
    expected = {AnalyticalSnake.__name__: 1, TwinSnake.__name__: twins}
    assert built == Counter(expected | {Gait.__name__: 1 + twins})
