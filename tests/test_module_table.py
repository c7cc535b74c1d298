"""The table of docs/module.md is the one that docs/module.json gives.

That the shipped scenarios still give these numbers is checked where they run:
tests/scenario.
"""

from __future__ import annotations

import json

import pytest
from conftest import ROOT
from module_lines import LINES

from srs_twin.comparison.metrics import METRIC_UNITS
from srs_twin.io.files import shipped_names

pytestmark = pytest.mark.fast

FIGURES = json.loads((ROOT / "docs/module.json").read_text("utf-8"))
PAGE = (ROOT / "docs/module.md").read_text("utf-8")


def test_the_page_holds_the_table_of_the_figures():
    _, _, rest = PAGE.partition("<!-- module: begin -->\n")
    head, rule, *rows = rest.partition("\n<!-- module: end -->")[0].splitlines()
    assert (
        head
        == "| quantity | dissertation | analytical | twin | difference | scenario |"
    )
    assert rule == "| --- | --- | --- | --- | --- | --- |"
    assert rows == [f"| {' | '.join(line.cells(FIGURES))} |" for line in LINES]


def test_the_figures_are_of_every_scenario_of_the_chapter():
    wanted = {name for name in shipped_names("scenario") if name.startswith("module_")}
    assert FIGURES["scenarios"].keys() == wanted
    for plants in FIGURES["scenarios"].values():
        for result in plants.values():
            assert result.keys() <= METRIC_UNITS.keys()
            assert not {"wall_s", "realtime_factor"} & result.keys()
    assert FIGURES["leak"]["draws"] >= 10


def test_benches_agree_within_ten_per_cent():
    worst = {}
    for line in LINES:
        cells = line.cells(FIGURES)
        worst[cells[0]] = float(cells[4].rstrip("%"))
    assert max(worst.values()) <= 10.0, worst
