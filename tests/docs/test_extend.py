"""Additions of the page on extending: its diffs apply to the package, and the additions work."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT
from pages import Page

PAGE = Page(ROOT / "docs/extend.md")
ADDED = ("A friction law", "A metric", "A file format")

LAW = """
import numpy as np
from numba import njit
from srs_twin.robot import friction
from srs_twin.scenario.loading import parse_scenario

law, h = friction.blend, 1e-8
def forces(v_t, v_n):
    return np.array(law(v_t, v_n, 0.3, 0.1, 0.5, 1e-2)[:2])
slopes = np.array(njit(law)(0.02, -0.03, 0.3, 0.1, 0.5, 1e-2)[2:]).reshape(2, 2)
along = (forces(0.02 + h, -0.03) - forces(0.02 - h, -0.03)) / (2 * h)
across = (forces(0.02, -0.03 + h) - forces(0.02, -0.03 - h)) / (2 * h)
assert np.allclose(slopes, np.stack([along, across], axis=1), rtol=1e-5)

plants = {"analytical": {"friction": "blend"}, "twin": {"friction": "blend"}}
gait = {"kind": "gait", "frequency_hz": 2.0}
scenario = parse_scenario({"robot": "gen2", "duration_s": 1.0, "controller": gait, "plants": plants})
assert scenario.build_plant("analytical").friction == scenario.build_plant("twin").contact.law == "blend"

from types import SimpleNamespace
from srs_twin.plants.twin.friction_solve import _friction_law
from srs_twin.plants.twin.mjcf.numerics import LAWS_ON_LOADS
contact = SimpleNamespace(wheels=1, law=LAWS_ON_LOADS.index("blend"), coefficients=(0.1, 0.5, 1e-6, 0.0, 0.1))
sliding = _friction_law.py_func(contact, 0, 0.2, -0.3, 0.3, (0.0, 0.0, 0.0), 0.0, 1e-3)[:2]
assert np.allclose(sliding, law(0.2, -0.3, 0.3, 0.1, 0.5, 1e-6)[:2], rtol=1e-4)
"""


def sections() -> dict[str, str]:
    """Return heading → text of the page."""
    return dict(re.findall(r"^## (.*)\n((?:(?!## ).*\n)*)", PAGE.text, re.M))


def edits(section: str) -> list[tuple[str, list[str]]]:
    """Return the files that the diffs of a section change, with the lines of the diffs."""
    found: list[tuple[str, list[str]]] = []
    for diff in re.findall(r"^```diff\n((?:.*\n)*?)```$", section, re.M):
        for part in re.split(r"^--- ", diff, flags=re.M)[1:]:
            name, *lines = part.splitlines()
            found.append((name, lines))
    return found


def edited(text: str, lines: list[str]) -> str:
    """Return a file after the edits of a diff, whose context lines and removed lines it must contain."""
    result = text.splitlines()
    cursor = 0
    for index, line in enumerate(lines):
        if line.startswith("@@"):
            cursor = len(result) if line.endswith("end of the file") else 0
            continue
        mark, content = line[:1], line[1:]
        if mark == "+":
            # Lines before the first context line of their hunk belong directly above it.
            if cursor == 0 and result:
                following = next(each[1:] for each in lines[index:] if not each.startswith("+"))
                cursor = result.index(following)
            result.insert(cursor, content)
            cursor += 1
        else:
            at = result.index(content, cursor)
            cursor = at + (mark == " ")
            if mark == "-":
                del result[at]
    return "\n".join(result) + "\n"


@pytest.mark.parametrize(("name", "lines"), [edit for text in sections().values() for edit in edits(text)])
def test_diffs_apply_to_the_files(name, lines):
    path = ROOT / name
    if path.exists():
        assert edited(path.read_text("utf-8"), lines) != path.read_text("utf-8")
    else:
        assert all(line.startswith("+") for line in lines), f"{name} does not exist"


@pytest.fixture(scope="module")
def extended(tmp_path_factory):
    """Return a function that runs Python code with a copy of the package that has the page's additions."""
    folder = tmp_path_factory.mktemp("extended")
    shutil.copytree(ROOT / "srs_twin", folder / "srs_twin", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("scenarios", "models", "calibration", "pyproject.toml"):
        (folder / name).symlink_to(ROOT / name)
    for heading in ADDED:
        for name, lines in edits(sections()[heading]):
            path = folder / name
            path.write_text(edited(path.read_text("utf-8") if path.exists() else "", lines), "utf-8")

    def run(*words: str) -> str:
        done = subprocess.run(
            [sys.executable, *words],
            cwd=folder, env=os.environ | {"PYTHONPATH": str(folder)}, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


@pytest.mark.slow
def test_law_of_the_page_has_its_slopes_and_is_accepted_by_both_plants(extended):
    extended("-c", LAW)


def test_metric_of_the_page_is_listed_measured_and_shown(extended):
    code = """
import json
import numpy as np
from srs_twin.cli import main
from srs_twin.comparison.metrics import chosen, meanings, plant_metrics, result_rows
from srs_twin.scenario.expectation import known_metrics
from srs_twin.trajectory import Trajectory
time = np.arange(101) / 100
columns = {name: 0 * time for name in ("com_x", "com_y", "bend_1")} | {"time": time, "heading": 0.5 * time}
values = plant_metrics(Trajectory(columns, metadata={"body_length_m": 0.2}))
plants = {"twin": values}
table = {row[0]: row[1:3] for row in result_rows({"plants": plants}, chosen(plants), str)}
print(json.dumps([values["heading_range_rad"], table["heading_range_rad"], meanings()["heading_range_rad"]]))
assert "heading_range_rad" in known_metrics()
"""
    value, row, meaning = json.loads(extended("-c", code))
    assert value == 0.5 and row == ["rad", ["0.5"]] and meaning == "range of the heading over the whole run"


@pytest.mark.slow
def test_file_of_the_page_is_inspected(extended, tmp_path):
    time = np.arange(200) / 100
    rows = [[f"{t:.2f}", *(f"{1e3 * (0.1 * t + 0.05 * k):.3f}\t{k}\t20" for k in range(5))] for t in time]
    head = ["#tagged mm", "\t".join(["time", *(f"m{k}_{axis}" for k in range(5) for axis in "xyz")])]
    take = tmp_path / "take.bin"
    take.write_text("\n".join([*head, *map("\t".join, rows)]) + "\n")
    code = """
import sys
import numpy as np
from srs_twin.cli import main
from srs_twin.recordings.formats import read_markers
table = read_markers(sys.argv[1])
assert table.labels == ("m0", "m1", "m2", "m3", "m4") and len(table.time) == 200
assert np.allclose(table.points[100], [(0.1 + 0.05 * k, 1e-3 * k, 0.02) for k in range(5)])
sys.exit(main(["inspect", sys.argv[1], "--json"]))
"""
    (found,) = json.loads(extended("-c", code, str(take)))
    assert found["format"] == "Tagged TSV" and found["content"] == "markers"
