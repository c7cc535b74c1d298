"""The tables of docs/environments.md are those of the tasks, and its examples are what there is."""

from __future__ import annotations

import re
import runpy

import gymnasium
from conftest import ROOT

from srs_twin.envs import TASKS, make_task

update_tables = runpy.run_path(str(ROOT / "docs/environment_tables.py"))["update_tables"]
PAGE = (ROOT / "docs/environments.md").read_text("utf-8")


def test_the_tables_are_current():
    assert update_tables(PAGE) == PAGE, (
        "uv run python docs/environment_tables.py docs/environments.md writes them"
    )


def test_every_name_of_a_signal_tells_its_unit_and_every_bound_is_finite():
    units = {"m": "m", "rad": "rad", "hz": "Hz", "kpa": "kPa"}
    for task in TASKS:
        made = make_task(task)
        for signal in (*made.actions, *made.observations):
            assert units.get(signal.name.rpartition("_")[2], "1") == signal.unit, signal
            assert -1e3 < signal.low < signal.high < 1e3
        names = [each.name for each in made.observations]
        assert len(set(names)) == len(names)


def test_the_names_on_the_page_are_registered():
    found = set(re.findall(r"SRSTwin/\w+-v0", PAGE))
    assert found == {f"SRSTwin/{task}-v0" for task in TASKS}
    assert found <= gymnasium.registry.keys()
