"""docs/your-robot.md runs as printed and identifies the hidden parameters of its recordings."""

from __future__ import annotations

import json
import re
import runpy
import shlex
import shutil

import numpy as np
import pytest
from conftest import ROOT

from srs_twin import load_robot
from srs_twin.identification.fit_file import load_fit
from srs_twin.identification.parameters import free_parameters

PAGE = (ROOT / "docs/your-robot.md").read_text("utf-8")
_, _, FITS = PAGE.partition("\n## Parameters from recordings\n")
COMMANDS = [
    line
    for text in re.findall(r"^```sh runnable\n(.*?)^```$", FITS, re.M | re.S)
    for line in text.splitlines()
]
RECORDINGS = "calibration/examples/my_snake"
MADE = runpy.run_path(str(ROOT / "docs/your_robot.py"))
HIDDEN = MADE["HIDDEN"]


@pytest.fixture(scope="module")
def walked_through(tmp_path_factory, srs_twin):
    """A folder in which all commands of the page were run, in their order."""
    folder = tmp_path_factory.mktemp("user")
    shutil.copytree(ROOT / RECORDINGS, folder / RECORDINGS)
    for command in COMMANDS:
        uv, run, program, *words = shlex.split(command)
        assert (uv, run, program) == ("uv", "run", "srs-twin")
        done = srs_twin(*words, cwd=folder)
        assert done.returncode == 0, (command, done.stderr)
    return folder


@pytest.mark.nightly
def test_hidden_parameters_are_in_the_intervals(walked_through):
    seen = set()
    for name in ("my_friction", "my_gains", "my_levels", "my_lags", "my_body"):
        fit = load_fit(walked_through / f"calibration/fits/{name}.yaml")
        for each in fit.parameters:
            if each.verdict == "cannot tell":
                assert "these intervals do not hold" in each.why, each
            elif each.value is not None:
                assert each.low <= HIDDEN[each.name] <= each.high, (name, each)
                seen.add(each.name)
            else:
                assert each.name not in HIDDEN, each
        assert {each.role for each in fit.data} == {"fit", "validation"}
        assert fit.quality.validation_rms is not None
    # Free segments swing, which the law of the air does not know; the stiffness needs
    # the twin (minutes).
    assert set(HIDDEN) - seen == {
        "bending.stiffness_nm_per_rad",
        "actuator.tau_fill_s",
        "actuator.tau_vent_s",
    }


@pytest.mark.slow
def test_release_identifies_the_hidden_stiffness_and_damping(walked_through):
    fit = load_fit(walked_through / "calibration/fits/my_damping.yaml")
    hidden = MADE["hidden_robot"]().bending
    stiffness, damping_time = fit.parameters
    assert stiffness.low <= hidden.stiffness <= stiffness.high
    assert damping_time.low <= hidden.damping_time <= damping_time.high


@pytest.mark.slow
def test_identified_robot_is_the_hidden_one(walked_through):
    robot = load_robot(walked_through / "robots/my_snake.yaml")
    found = [
        name for name in HIDDEN if name.startswith(("friction", "actuator", "modules"))
    ]
    for unknown in free_parameters(robot, found):
        near = {"friction": 0.02, "modules": 0.01, "actuator": 0.05}[
            unknown.name.partition(".")[0]
        ]
        assert unknown.start == pytest.approx(
            HIDDEN[unknown.name], rel=near, abs=0.005
        ), unknown.name


@pytest.mark.slow
def test_fitted_robot_replays_more_accurately_than_the_initial_one(
    walked_through, srs_twin
):
    options = ("-r", "gen2", "--plants", "analytical", "-q", "--out", "before")
    srs_twin("replay", f"{RECORDINGS}/walk_check.csv", *options, cwd=walked_through)
    after, before = (
        json.loads((walked_through / run / "metrics.json").read_text("utf-8"))[
            "plants"
        ]["analytical"]
        for run in ("runs/walk_check", "before")
    )
    for metric in ("measured_shape_rms_m", "measured_bend_rms_rad"):
        assert after[metric] < 0.8 * before[metric], metric


def test_the_script_makes_these_recordings():
    folder = ROOT / RECORDINGS
    assert MADE["pulls"](1) == (folder / "pulls.csv").read_text("utf-8")
    robot = MADE["hidden_robot"]()
    assert MADE["release"](robot, 14) == (folder / "release.csv").read_text("utf-8")
    log = MADE["log"](MADE["walk"](robot, 1.6, 0.25))
    assert log == (folder / "walk_left.valves.csv").read_text("utf-8")
    assert MADE["levels"](robot, (12, 24, 36, 48), 12) == (
        folder / "levels.csv"
    ).read_text("utf-8")
    rows = np.genfromtxt(folder / "held.csv", delimiter=",", skip_header=1)
    gains = np.array([HIDDEN[f"modules.gain_plus_{j}"] for j in range(1, 5)])
    biases = np.array([HIDDEN[f"modules.bias_rad_{j}"] for j in range(1, 5)])
    free = robot.actuator.gain * 24e3 * gains + biases
    assert rows[2, 8:] == pytest.approx(free, abs=0.02)
    assert sum(path.stat().st_size for path in folder.iterdir()) < 2e6
