"""What the README tells a newcomer to type works as it stands, and what it names is there."""

from __future__ import annotations

import json
import re
import shlex

import pytest
from conftest import ROOT
from pages import PAGES

README = (ROOT / "README.md").read_text("utf-8")
FENCES = re.findall(r"^```(\w*)( runnable)?\n(.*?)^```$", README, re.M | re.S)
SHELL = [line for kind, _, text in FENCES if kind == "sh" for line in text.splitlines()]
RUNNABLE = [line for kind, mark, text in FENCES if mark for line in text.splitlines()]
INLINE = re.findall(r"`((?:uv run )?srs-twin [a-z][^`]*)`", README)


def fence(kind: str) -> str:
    (text,) = (text for language, _, text in FENCES if language == kind)
    return text


def words_of(command: str) -> list[str]:
    """Return the words after `srs-twin`."""
    return shlex.split(command.partition("srs-twin")[2])


def measured(row: str) -> list[float]:
    """Return the numbers of the analytical and the twin column in the README's table of measured values."""
    (cells,) = re.findall(rf"^\| {row}[^|]*\|([^|]*)\|([^|]*)\|", README, re.M)
    return [float(cell) for cell in cells if cell.strip()]


@pytest.fixture
def checkout(tmp_path, root):
    """A folder with what a checkout has and room for what the commands write."""
    for name in ("scenarios", "calibration"):
        (tmp_path / name).symlink_to(root / name)
    return tmp_path


def marked(command):
    """Leave the long ones of what is run to the slow tests; `compare` is run below."""
    long = "compare" in command or "sweep" in command
    return pytest.param(command, marks=[pytest.mark.slow] if long else [])


@pytest.mark.parametrize("command", [marked(command) for command in RUNNABLE])
def test_commands_run_as_printed(command, checkout, srs_twin_process):
    assert command.startswith("uv run srs-twin ")
    done = srs_twin_process(*words_of(command), cwd=checkout)
    assert done.returncode == 0, done.stderr


def test_first_command_is_the_main_job(checkout, srs_twin_process):
    first = SHELL[0]
    assert first == "pip install uv && uv run srs-twin compare scenarios/gen2_straight.yaml"
    assert SHELL[1].endswith(first.partition("uv run ")[2])
    done = srs_twin_process(*words_of(first), cwd=checkout)
    assert done.returncode == 0, done.stderr
    promised = re.findall(r"^\| ((?:`[\w.]+`(?:, )?)+) \|", README, re.M)
    files = {name for cell in promised for name in re.findall(r"`([\w.]+)`", cell)}
    run = checkout / "runs/gen2_straight"
    assert {path.name for path in run.iterdir()} == files
    metrics = json.loads((run / "metrics.json").read_text("utf-8"))
    speeds = [metrics["plants"][plant]["com_speed_m_s"] for plant in ("analytical", "twin")]
    assert measured("CoM speed") == pytest.approx(speeds, rel=0.01)
    assert measured("body shape") == pytest.approx([metrics["comparison"]["shape_rms_body"]], abs=0.001)


def test_every_verb_named_exists(root, srs_twin_process):
    commands = [command for command in SHELL + INLINE if "srs-twin" in command]
    verbs = {word for command in commands for word in words_of(command)[:1] if word.isalpha()}
    assert verbs >= {"run", "compare", "view", "models", "schema"}
    for verb in verbs:
        assert srs_twin_process(verb, "--help", cwd=root).returncode == 0, verb


def test_scenario_of_the_readme_loads(tmp_path):
    from srs_twin import load_scenario

    text = fence("yaml").replace("{…}", "{stiffness_nm_per_rad: 0.2}")
    path = tmp_path / "printed.yaml"
    path.write_text(text)
    scenario = load_scenario(str(path))
    assert (scenario.robot.name, scenario.duration) == ("gen2", 10.0)
    assert len(scenario.expect) == 2


def test_python_of_the_readme_runs(tmp_path):
    (page,) = (page for page in PAGES if page.name == "README.md")
    assert abs(float(page.run_script(tmp_path))) < 1


def test_links_and_pictures_are_there():
    targets = [t for t in re.findall(r"\]\(([^)#]+)\)", README) if "//" not in t]
    assert targets
    assert [t for t in targets if not (ROOT / t).is_file()] == []


def test_one_test_command_everywhere():
    assert "uv run pytest" in SHELL
    assert "uv run pytest" in (ROOT / ".ci/run").read_text("utf-8")
