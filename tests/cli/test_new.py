"""`srs-twin new`: files that are valid as they are written, and commands that work as printed."""

from __future__ import annotations

import shlex
import subprocess
import sys

import numpy as np
import pytest

from srs_twin.identification.priors import Priors
from srs_twin.robot.file import load_robot, load_robot_file
from srs_twin.scenario.loading import load_scenario


def test_a_new_robot_has_the_given_size(srs_twin, tmp_path):
    words = (
        "--length",
        "0.66",
        "--segments",
        "6",
        "--mass",
        "2.1",
        "--pressure",
        "60",
        "--bend",
        "1.2",
    )
    done = srs_twin("new", "robot", "worm", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    spec = load_robot(tmp_path / "worm.yaml")
    assert spec.segments == 6 and spec.geometry.body_length == pytest.approx(
        0.66, rel=1e-3
    )
    assert spec.mass.total == pytest.approx(2.1, rel=1e-3)
    assert spec.supply.nominal == pytest.approx(60e3)
    # The work of the air bends the segment: half of p V over q².
    grown = 45e-6 * (0.66 / 6 / 0.055) ** 3
    assert spec.bending.stiffness == pytest.approx(
        0.5 * 60e3 * grown / 1.2**2, rel=1e-3
    )


def test_a_new_robot_with_skin_is_valid(srs_twin, tmp_path):
    done = srs_twin("new", "robot", "worm", "--skin", "--mass", "0.4", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    spec = load_robot(tmp_path / "worm.yaml")
    assert spec.skin is not None and spec.mass.total == pytest.approx(0.4, rel=1e-3)
    done = srs_twin(
        "new", "scenario", "crawl", "--robot", str(tmp_path / "worm.yaml"), cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert load_scenario(tmp_path / "crawl.yaml").robot.skin == spec.skin


def test_a_new_robot_with_servos_asks_for_no_air(srs_twin, tmp_path):
    done = srs_twin(
        "new",
        "robot",
        "arm",
        "--servo",
        "--segments",
        "8",
        "--length",
        "0.48",
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    record = load_robot_file(tmp_path / "arm.yaml")
    assert record.has_servos and record.chamber is None and record.supply is None
    assert load_robot(tmp_path / "arm.yaml").geometry.body_length == pytest.approx(
        0.48, rel=1e-3
    )
    assert "silicone" not in (tmp_path / "arm.yaml").read_text("utf-8")


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    "kinds", [(), ("--skin",), ("--servo",), ("--skin", "--servo")]
)
def test_estimates_that_affect_the_motion_have_intervals(kinds, srs_twin, tmp_path):
    done = srs_twin("new", "robot", "worm", *kinds, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    priors = Priors.from_robot(load_robot_file(tmp_path / "worm.yaml"))
    skin = ("contact.forward", "contact.transverse")
    wheels = ("friction.mu_t", "friction.mu_n")
    friction = skin if "--skin" in kinds else wheels
    pneumatic = (
        "bending.stiffness_nm_per_rad",
        "bending.damping_time_s",
        "actuator.tau_fill_s",
    )
    actuator = ("actuator.response_time_s",) if "--servo" in kinds else pneumatic
    by_path = {prior.path: prior for prior in priors.parameters}
    for prior in map(by_path.__getitem__, (*friction, *actuator)):
        low, high = prior.quantile(np.array([0.0, 1.0]))
        assert low <= prior.value < high, prior.path


def test_the_printed_commands_lead_from_a_robot_to_a_comparison(srs_twin, tmp_path):
    done = srs_twin("new", "robot", "worm", cwd=tmp_path)
    for _ in range(2):
        *_, last = done.stdout.splitlines()
        assert last.startswith("next: srs-twin ")
        words = shlex.split(last.removeprefix("next: srs-twin "))
        short = ("--duration", "2", "--quiet") if words[0] == "compare" else ()
        done = srs_twin(*words, *short, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "runs" / "worm_straight" / "metrics.json").is_file()


def test_a_new_study_and_controller_are_valid(srs_twin, tmp_path):
    done = srs_twin("new", "study", "fast", "--scenario", "gen2_turn", cwd=tmp_path)
    assert done.returncode == 0 and "next: srs-twin optimize fast.yaml" in done.stdout
    assert srs_twin("new", "controller", "wiggle", cwd=tmp_path).returncode == 0
    run = subprocess.run(
        [sys.executable, "wiggle.py"],
        check=False,
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0 and run.stdout.count(" m in 3 s") == 2, run.stderr


@pytest.mark.default_cases(at=[0, 1, 4, 7])
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("robot", "Worm"), "the name 'Worm' is not allowed"),
        (
            ("robot", "worm", "--mass", "-1"),
            "--mass -1 is not allowed; it must be above 0 and finite",
        ),
        (
            ("robot", "worm", "--servo", "--bend", "0"),
            "--bend 0 is not allowed; it must be above 0 and finite",
        ),
        (
            ("robot", "worm", "--segments", "0"),
            "--segments 0 is not allowed; it must be above 0 and finite",
        ),
        (
            ("robot", "worm", "--servo", "--pressure", "40"),
            "a robot with servos has no supply pressure; remove --pressure",
        ),
        (("scenario", "walk", "--robot", "gen9"), "gen9"),
        (("scenario", "walk", "--robot", "gen2\nseed: 3"), "control character"),
        (("study", "fast", "--scenario", "nothing"), "nothing"),
    ],
)
def test_bad_input_leaves_no_file(words, message, srs_twin, tmp_path):
    done = srs_twin("new", *words, cwd=tmp_path)
    assert done.returncode == 2 and message in done.stderr, done.stderr
    assert not list(tmp_path.iterdir())


def test_an_existing_file_is_kept(srs_twin, tmp_path):
    (tmp_path / "walk.yaml").write_text("mine")
    done = srs_twin("new", "scenario", "walk", cwd=tmp_path)
    assert done.returncode == 2 and "walk.yaml already exists" in done.stderr
    assert (tmp_path / "walk.yaml").read_text() == "mine"


def test_the_written_scenario_has_the_given_numbers(srs_twin, tmp_path):
    words = ("--robot", "gen4", "--frequency", "0.8", "--duration", "3")
    assert srs_twin("new", "scenario", "walk", *words, cwd=tmp_path).returncode == 0
    scenario = load_scenario(tmp_path / "walk.yaml")
    assert (scenario.robot.name, scenario.duration) == ("gen4", 3.0)
    assert scenario.controller.frequency_hz == 0.8
