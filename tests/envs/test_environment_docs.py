"""docs/environments.md agrees with the tasks."""

from __future__ import annotations

import re
import runpy

import gymnasium
from conftest import ROOT

from srs_twin.envs import TASKS, make_task

update_tables = runpy.run_path(str(ROOT / "docs/environment_tables.py"))[
    "update_tables"
]
PAGE = (ROOT / "docs/environments.md").read_text("utf-8")


def test_signal_tables_are_current():
    assert update_tables(PAGE) == PAGE, (
        "uv run python docs/environment_tables.py docs/environments.md writes them"
    )


def test_signal_names_end_in_their_unit_and_bounds_are_finite():
    units = {"m": "m", "rad": "rad", "hz": "Hz", "kpa": "kPa"}
    for task in TASKS:
        instance = make_task(task)
        for signal in (*instance.actions, *instance.observations):
            assert units.get(signal.name.rpartition("_")[2], "1") == signal.unit, signal
            assert -1e3 < signal.low < signal.high < 1e3
        names = [observation.name for observation in instance.observations]
        assert len(set(names)) == len(names)


def test_documented_environments_are_registered():
    names = set(re.findall(r"SRSTwin/\w+-v0", PAGE))
    assert names == {f"SRSTwin/{task}-v0" for task in TASKS}
    assert names <= gymnasium.registry.keys()
