"""Additions of the page on extending: its diffs apply to the package, and the additions work."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT
from pages import Page

PAGE = Page(ROOT / "docs/extend.md")
ADDED = ("A friction law", "A metric", "A file format", "A command")
OMITTED = "…"
"""Entries of a line that the page leaves out; it stands for any text in the file."""

FRICTION_LAW_CHECK = """
import numpy as np
from numba import njit
from srs_twin.robot import friction
from srs_twin.scenario.loading import parse_scenario

friction_law, h = friction.blend, 1e-8
def forces(v_t, v_n):
    return np.array(friction_law(v_t, v_n, 0.3, 0.1, 0.5, 1e-2)[:2])
derivatives = np.array(njit(friction_law)(0.02, -0.03, 0.3, 0.1, 0.5, 1e-2)[2:]).reshape(2, 2)
along = (forces(0.02 + h, -0.03) - forces(0.02 - h, -0.03)) / (2 * h)
across = (forces(0.02, -0.03 + h) - forces(0.02, -0.03 - h)) / (2 * h)
assert np.allclose(derivatives, np.stack([along, across], axis=1), rtol=1e-5)

plants = {"analytical": {"friction": "blend"}, "twin": {"friction": "blend"}}
gait = {"kind": "gait", "frequency_hz": 2.0}
scenario = parse_scenario({"robot": "gen2", "duration_s": 1.0, "controller": gait, "plants": plants})
assert scenario.build_plant("analytical").friction == scenario.build_plant("twin").contact.law == "blend"
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
    omitted = OMITTED
    for index, line in enumerate(lines):
        if line.startswith("@@"):
            cursor = len(result) if line.endswith("end of the file") else 0
            continue
        mark = line[:1]
        content = line[1:]
        if mark == "+":
            # Lines before the first context line of their hunk belong directly above
            # it.
            if cursor == 0 and result:
                following = next(
                    each[1:] for each in lines[index:] if not each.startswith("+")
                )
                cursor = result.index(following)
            result.insert(cursor, content.replace(OMITTED, omitted))
            cursor += 1
        else:
            pattern = re.escape(content).replace(OMITTED, "(.*)")
            at = next(
                k
                for k in range(cursor, len(result))
                if re.fullmatch(pattern, result[k])
            )
            if OMITTED in content:
                omitted = re.fullmatch(pattern, result[at])[1]
            cursor = at + (mark == " ")
            if mark == "-":
                del result[at]
    return "\n".join(result) + "\n"


@pytest.mark.parametrize(
    ("name", "lines"), [edit for text in sections().values() for edit in edits(text)]
)
def test_diffs_apply_to_the_files(name, lines):
    path = ROOT / name
    if path.exists():
        assert edited(path.read_text("utf-8"), lines) != path.read_text("utf-8")
    else:
        assert all(line.startswith("+") for line in lines), f"{name} does not exist"


def test_tests_that_the_page_names_exist():
    named = set(re.findall(r"`(test_\w+)`", PAGE.prose))
    defined = set(
        re.findall(
            r"^def (test_\w+)",
            (ROOT / "tests/comparison/test_metrics.py").read_text("utf-8"),
            re.M,
        )
    )
    assert named and named <= defined


@pytest.fixture(scope="module")
def extended(tmp_path_factory):
    """Return a function that runs Python code with a copy of the package that has the page's additions."""
    folder = tmp_path_factory.mktemp("extended")
    shutil.copytree(
        ROOT / "srs_twin",
        folder / "srs_twin",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    for name in ("scenarios", "models", "calibration", "pyproject.toml"):
        (folder / name).symlink_to(ROOT / name)
    for heading in ADDED:
        for name, lines in edits(sections()[heading]):
            path = folder / name
            path.write_text(
                edited(path.read_text("utf-8") if path.exists() else "", lines), "utf-8"
            )

    def run(*words: str, code: int = 0) -> str:
        done = subprocess.run(
            [sys.executable, *words],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(folder)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == code, done.stderr
        return done.stdout or done.stderr

    return run


def test_diffs_apply_after_other_additions():
    lines = ['-Law = Literal["axis", …]', '+Law = Literal["axis", …, "blend"]']
    assert (
        edited('Law = Literal["axis", "mine"]\n', lines)
        == 'Law = Literal["axis", "mine", "blend"]\n'
    )


@pytest.mark.slow
def test_law_of_the_page_has_its_derivatives_and_is_accepted_by_both_plants(extended):
    extended("-c", FRICTION_LAW_CHECK)


@pytest.mark.slow
def test_law_of_the_page_passes_the_tests_that_the_page_names(extended):
    (command,) = (
        line for line in PAGE.commands if "tests/robot/test_friction.py" in line
    )
    words = shlex.split(command)
    files = [word for word in words if word.startswith("tests/")]
    words = [
        str(ROOT / word) if word in files else word
        for word in words[words.index("pytest") :]
    ]
    output = extended("-m", *words, "-n", "0", "-rps", "-k", "blend")
    assert [name for name in files if name not in output] == [], (
        "each file tests every law"
    )


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
    assert (
        value == 0.5
        and row == ["rad", ["0.5"]]
        and meaning == "range of the heading over the whole run"
    )


@pytest.mark.slow
def test_file_of_the_page_is_inspected(extended, tmp_path):
    time = np.arange(200) / 100
    rows = [
        [f"{t:.2f}", *(f"{1e3 * (0.1 * t + 0.05 * k):.3f}\t{k}\t20" for k in range(5))]
        for t in time
    ]
    head = [
        "#tagged mm",
        "\t".join(["time", *(f"m{k}_{axis}" for k in range(5) for axis in "xyz")]),
    ]
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


@pytest.mark.slow
def test_command_of_the_page_prints_the_length_or_one_message(extended):
    start = "import sys; from srs_twin.cli import main; sys.exit(main(sys.argv[1:]))"
    metres = float(
        extended("-c", start, "plan-length", "follow_fig57").removesuffix(" m\n")
    )
    millimetres = float(
        extended("-c", start, "plan-length", "follow_fig57", "--mm").removesuffix(
            " mm\n"
        )
    )
    assert millimetres == pytest.approx(1000 * metres, abs=1)
    assert "In mm instead of m." in extended("-c", start, "plan-length", "--help")
    refused = extended("-c", start, "plan-length", "gen2_straight", code=2)
    assert (
        refused.startswith(
            "gen2_straight: the scenario has no planner; add the section `planner`"
        )
        and refused.count("\n") == 1
    )
