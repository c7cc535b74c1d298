"""`srs-twin new`: files that are valid as they are written, and commands that work as printed."""

from __future__ import annotations

import math
import shlex
import subprocess
import sys
from dataclasses import fields

import numpy as np
import pytest

from srs_twin.identification.priors import Priors
from srs_twin.robot.file import load_robot, load_robot_file
from srs_twin.scenario.loading import load_scenario


@pytest.fixture
def new(srs_twin, tmp_path):
    """Return a function that runs `srs-twin new` and returns the path of the written file."""

    def new(words, options=""):
        done = srs_twin("new", *words.split(), *options.split(), cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        return tmp_path / f"{words.split()[1]}.yaml"

    return new


def test_a_new_robot_has_the_given_size(new):
    size = "--length 0.66 --segments 6 --mass 2.1 --pressure 60 --bend 1.2"
    spec = load_robot(new("robot worm", size))
    assert spec.segments == 6
    assert spec.geometry.body_length == pytest.approx(0.66, rel=1e-3)
    assert spec.mass.total == pytest.approx(2.1, rel=1e-3)
    assert spec.supply.nominal == pytest.approx(60e3)
    # The segments are twice as long as those of generation 2.
    gen2 = load_robot("gen2")
    for each in fields(gen2.geometry):
        if each.name != "connectors":
            own = getattr(spec.geometry, each.name)
            half = getattr(gen2.geometry, each.name)
            assert own == pytest.approx(2 * half, rel=1e-3), each.name
    damping_time = gen2.bending.damping_time * math.sqrt(2)
    assert spec.bending.damping_time == pytest.approx(damping_time, rel=1e-3)
    # The work of the air bends the segment: half of p V over q².
    grown = 45e-6 * (0.66 / 6 / 0.055) ** 3
    assert spec.bending.stiffness == pytest.approx(
        0.5 * 60e3 * grown / 1.2**2, rel=1e-3
    )
    assert spec.phase_step == pytest.approx(2 * math.pi / 6, rel=1e-3)
    assert spec.supply.pulsed_limit == pytest.approx(1.4 * 60e3)
    assert spec.chamber.dead_volume == pytest.approx(11e-6 * 2**3)
    assert spec.mass.wheel == pytest.approx(0.0015 * 2**3)
    assert spec.bending.pitch_stiffness == pytest.approx(0.1 * 2**4)


def test_a_new_robot_with_skin_is_valid(new):
    worm = new("robot worm", "--skin --mass 0.4")
    spec = load_robot(worm)
    assert spec.skin is not None and spec.mass.total == pytest.approx(0.4, rel=1e-3)
    crawl = new("scenario crawl", f"--robot {worm}")
    assert load_scenario(crawl).robot.skin == spec.skin


def test_a_new_robot_with_servos_asks_for_no_air(new):
    arm = new("robot arm", "--servo --segments 8 --length 0.48")
    record = load_robot_file(arm)
    assert record.has_servos and record.chamber is None and record.supply is None
    spec = record.spec()
    assert spec.segments == 8
    assert spec.geometry.body_length == pytest.approx(0.48, rel=1e-3)
    assert spec.geometry.segment_length == pytest.approx(0.06 / 15, rel=1e-3)
    assert "silicone" not in arm.read_text("utf-8")


SKIN = ("contact.forward", "contact.transverse")
WHEELS = ("friction.mu_t", "friction.mu_n")
SERVO = ("actuator.response_time_s",)
PNEUMATIC = (
    "bending.stiffness_nm_per_rad",
    "bending.damping_time_s",
    "actuator.tau_fill_s",
)


@pytest.mark.parametrize(
    ("options", "estimates"),
    [("", WHEELS + PNEUMATIC), ("--skin --servo", SKIN + SERVO)],
)
def test_estimates_that_affect_the_motion_have_intervals(options, estimates, new):
    priors = Priors.from_robot(load_robot_file(new("robot worm", options)))
    by_path = {prior.path: prior for prior in priors.parameters}
    for prior in map(by_path.__getitem__, estimates):
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
    words = [sys.executable, "wiggle.py"]
    said = subprocess.check_output(words, cwd=tmp_path, text=True)
    assert said.count(" m in 3 s") == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("robot Worm", "the name 'Worm' is not allowed"),
        (
            "robot worm --mass -1",
            "--mass -1 is not allowed; it must be above 0 and finite",
        ),
        (
            "robot worm --segments 0",
            "Invalid value for '--segments'",
        ),
        ("controller b --out x.yaml", "x.yaml: the name of the file must end in .py"),
        (
            "robot worm --servo --pressure 40",
            "a robot with servos has no supply pressure; remove --pressure",
        ),
        ("scenario walk --robot gen9", "gen9"),
        ("scenario walk --robot gen2\nseed:3", "control character"),
        ("study fast --scenario nothing", "nothing"),
    ],
)
def test_bad_input_leaves_no_file(words, message, srs_twin, tmp_path):
    done = srs_twin("new", *words.split(" "), cwd=tmp_path)
    assert done.returncode == 2 and message in done.stderr, done.stderr
    assert not list(tmp_path.iterdir())


def test_printed_commands_quote_their_paths(srs_twin, tmp_path):
    done = srs_twin("new", "scenario", "walk", "--out", "my walk.yaml", cwd=tmp_path)
    assert "next: srs-twin compare 'my walk.yaml'" in done.stdout


def test_an_existing_file_is_kept(srs_twin, tmp_path):
    (tmp_path / "walk.yaml").write_text("mine")
    done = srs_twin("new", "scenario", "walk", cwd=tmp_path)
    assert done.returncode == 2 and "walk.yaml already exists" in done.stderr
    assert (tmp_path / "walk.yaml").read_text() == "mine"


def test_the_written_scenario_has_the_given_numbers(new):
    numbers = "--robot gen4 --frequency 0.8 --duration 3"
    scenario = load_scenario(new("scenario walk", numbers))
    assert (scenario.robot.name, scenario.duration) == ("gen4", 3.0)
    assert scenario.controller.frequency_hz == 0.8
