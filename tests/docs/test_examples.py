"""Every script in examples/ runs, and prints what its table in examples/README.md says."""

import os
import re
import sys

import pytest
from conftest import ROOT
from processes import python

FOLDER = ROOT / "examples"
MAX_LINES = 60
MAX_SCRIPTS = 10


def run(folder, name, *arguments):
    """Run an example in a folder, and return what it prints."""
    path = os.pathsep.join([str(ROOT), *filter(None, sys.path)])
    script = FOLDER / f"{name}.py"
    return python(script, *arguments, cwd=folder, PYTHONPATH=path).stdout


def numbers(text, pattern):
    """Return the numbers that a pattern finds in a text."""
    return [float(found) for found in re.findall(pattern, text)]


def test_scripts_are_few_short_and_listed():
    scripts = sorted(FOLDER.glob("*.py"))
    assert 0 < len(scripts) <= MAX_SCRIPTS
    page = (FOLDER / "README.md").read_text("utf-8")
    for script in scripts:
        lines = len(script.read_text("utf-8").splitlines())
        assert lines < MAX_LINES, f"{script.name} has {lines} lines"
        assert f"`{script.name}`" in page
    for name in re.findall(r"`(\w+\.(?:py|yaml))`", page):
        assert name == "NAME.py" or (FOLDER / name).is_file(), name


def test_exported_model_crawls_without_srs_twin(tmp_path):
    text = run(tmp_path, "mujoco_model", str(ROOT / "models/gen2/scene.xml"))
    (covered,) = numbers(text, r"controls, (\d+) mm")
    assert covered > 100
    assert "import srs_twin" not in (FOLDER / "mujoco_model.py").read_text()


@pytest.mark.slow
def test_fit_recovers_the_friction_of_the_simulated_pulls(tmp_path):
    text = run(tmp_path, "fit_from_csv")
    for name, true in (("mu_t", 0.05), ("mu_n", 0.45)):
        low, high = numbers(text, rf"{name} = .* (0\.\d+) to") + numbers(
            text, rf"{name} = .* to (0\.\d+)\)"
        )
        assert low < true < high
        assert high - low < 0.1 * true
    assert "than the model" in text


@pytest.mark.slow
def test_own_robot_runs_with_two_stiffnesses(tmp_path):
    text = run(tmp_path, "own_robot")
    assert "5 segments, 0.20 kg" in text
    speeds = numbers(text, r"model \((0\.\d+) against")
    assert len(speeds) == 2
    # Only the twin depends on the stiffness.
    assert speeds[0] != speeds[1]
    assert len(set(numbers(text, r"against (0\.\d+) m/s"))) == 1


@pytest.mark.slow
def test_own_controller_turns_less_than_a_gait(tmp_path):
    text = run(tmp_path, "own_controller")
    for plant in ("analytical", "twin"):
        gait, own = (
            abs(numbers(text, rf"{plant}, {name}: turned by ([+-][\d.]+)")[0])
            for name in ("gait", "straight_ahead")
        )
        assert own < gait / 2


@pytest.mark.slow
def test_contributions_add_up_to_the_difference(tmp_path):
    text = run(tmp_path, "compare_and_explain")
    *parts, total = numbers(text, r" +([+-][\d.]+) mm/s  ")
    assert len(parts) > 10
    # Each number is rounded to 0.1 mm/s.
    assert sum(parts) == pytest.approx(total, abs=0.05 * (len(parts) + 1))
    twin, model = numbers(text, r"twin: ([\d.]+)"), numbers(text, r"cal: ([\d.]+)")
    assert twin[0] - model[0] == pytest.approx(total, abs=0.15)


@pytest.mark.slow
def test_both_plants_reach_the_goal_of_the_course(tmp_path):
    text = run(tmp_path, "own_course")
    assert "plan: found" in text
    assert text.count("goal reached, 0 contacts") == 2


@pytest.mark.slow
def test_stiffness_changes_only_the_twin_in_the_sweep(tmp_path):
    text = run(tmp_path, "sweep_with_pandas")
    rows = [
        line.split()[1:] for line in text.splitlines() if line[:3] in ("1.0", "2.0")
    ]
    assert len(rows) == 4
    assert all(left == right for left, right in rows[:2])
    assert all(float(left) < float(right) for left, right in rows[2:])
    assert "4 points; " in text


@pytest.mark.slow
def test_interval_contains_the_speed_and_shrinks(tmp_path):
    text = run(tmp_path, "uncertainty")
    pattern = r"speed: (\d+) mm/s, 95 % interval (\d+) to (\d+)\n"
    value, low, high = map(int, re.match(pattern, text).groups())
    assert low < value < high
    after = re.findall(r"(\d+) to (\d+) mm/s", text)
    assert after
    assert int(after[0][1]) - int(after[0][0]) < high - low


@pytest.mark.slow
def test_live_twin_detects_the_stuck_valve(tmp_path):
    text = run(tmp_path, "live_with_emulator")
    assert "segment 2, stuck_valve +=open\n" in text
    assert numbers(text, r"off by ([\d.]+) mm")[0] < 10


@pytest.mark.slow
def test_training_improves_the_policy(tmp_path):
    text = run(tmp_path, "train_policy", "2")
    before, after = numbers(text, r"([-\d.]+) (?:un)?trained")
    assert after > before
    assert (tmp_path / "policy.npz").is_file()
