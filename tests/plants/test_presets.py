"""Presets of the twin: settings, precedence, provenance and errors."""

from __future__ import annotations

import json
from typing import get_args

import numpy as np
import pytest
from preset_errors import FINE_S, METRICS, errors, measured

from srs_twin import InputError, TwinSnake, load_robot
from srs_twin.plants.twin.mjcf.numerics import PRESETS, Preset
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.scenario.plants import TwinFile
from srs_twin.studies.sweep.points import Experiment

KEY = "plants.twin.preset"
STATED = (1.95, 21.5, 2.45, 0.155, 0.915, 1.75, 0.0, 1.55)
"""Largest errors of `fast` that docs/verification.md#presets states, rounded up, in order of `METRICS`."""


def scenario(twin, **changes):
    data = {
        "robot": "gen2",
        "duration_s": 2,
        "controller": {"kind": "gait", "frequency_hz": 2.0},
    }
    return parse_scenario(data | {"plants": {"twin": twin}}, set=changes)


def settings(found):
    about = found.build_plant("twin").describe()
    return (
        about["contact"],
        about["timestep_s"],
        about["hinges_per_segment"],
        about["preset"],
    )


FAST = ("loaded", 0.002, 2, "fast")
DEFAULT = ("loaded", 0.001, 2, None)
REFERENCE = ("loaded", 0.00025, 2, "reference")


def test_preset_names_match_the_scenario_key():
    assert tuple(PRESETS) == get_args(Preset)
    assert PRESETS["fast"].keys() == PRESETS["reference"].keys(), (
        "or one could not take the other's place"
    )
    assert TwinFile().preset is None and TwinFile() == TwinFile.model_validate({})


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    ("twin", "used"),
    [
        ({}, DEFAULT),
        ({"preset": "reference"}, REFERENCE),
        ({"preset": "fast"}, FAST),
        ({"preset": "fast", "timestep_s": 0.001}, ("loaded", 0.001, 2, None)),
        ({"preset": "fast", "contact": "preloaded"}, ("preloaded", 0.002, 2, None)),
        (
            {"preset": "fast", "friction": "ellipse", "hinges_per_segment": 3},
            ("loaded", 0.002, 3, "fast"),
        ),
    ],
)
def test_explicit_setting_overrides_the_preset(twin, used):
    result = scenario(twin)
    assert settings(result) == used
    assert settings(parse_scenario(result.document)) == used, (
        "defaults written out, the same"
    )


def test_a_law_needs_the_loaded_contact():
    with pytest.raises(
        InputError, match="`friction` is allowed only with `contact: loaded`"
    ):
        scenario({"contact": "preloaded", "friction": "wheel"})


def test_another_preset_replaces_only_settings_of_the_first():
    """Sweeps, studies and `--set` modify documents that contain all settings."""
    resolved = scenario({"hinges_per_segment": 3}).document
    assert settings(parse_scenario(resolved, set={KEY: "fast"})) == (
        "loaded",
        0.002,
        3,
        "fast",
    )
    fast = scenario({"preset": "fast"}).document
    assert settings(parse_scenario(fast, set={KEY: "reference"})) == REFERENCE
    experiment = Experiment(scenario({}).document, ("twin",))
    both = {KEY: "fast", "plants.twin.timestep_s": 0.0005}
    for changes in (both, dict(reversed(both.items()))):
        assert settings(parse_scenario(experiment.document(changes))) == (
            "loaded",
            0.0005,
            2,
            None,
        )
    assert settings(parse_scenario(experiment.document({KEY: "fast"}))) == FAST


def test_unknown_preset_raises_with_the_allowed_names(srs_twin, tmp_path):
    done = srs_twin("run", "gen2_turn", "--set", f"{KEY}=fst", cwd=tmp_path)
    output = (
        f"{KEY}: must be one of reference, fast, not text 'fst'; did you mean fast?\n"
    )
    assert (done.returncode, done.stderr) == (2, f"--set {KEY}=fst: {output}")


@pytest.mark.parametrize(
    ("twin", "named"),
    [
        ({}, None),
        pytest.param({"preset": "reference"}, None, marks=pytest.mark.slow),
        pytest.param({"preset": "fast"}, "fast", marks=pytest.mark.slow),
        ({"preset": "fast", "timestep_s": 0.001}, "fast with timestep_s 0.001"),
    ],
)
def test_run_records_its_preset(srs_twin, tmp_path, twin, named):
    changes = [
        word
        for key, value in twin.items()
        for word in ("--set", f"plants.twin.{key}={value}")
    ]
    short = ("--set", "duration_s=2", "--out", "run")
    done = srs_twin(
        "run", "gen2_turn", "--plants", "twin", *changes, *short, cwd=tmp_path
    )
    metrics = json.loads((tmp_path / "run/metrics.json").read_text("utf-8"))
    report = (tmp_path / "run/report.html").read_text("utf-8")
    assert metrics.get("preset") == named
    for text in (" ".join(done.stdout.split()), report):
        assert (
            f"The twin ran with preset {named}, which is meant for searches:" in text
        ) == (named is not None)


def test_other_settings_have_no_preset(srs_twin, tmp_path):
    words = (
        "--set",
        f"{KEY}=fast",
        "--set",
        "duration_s=1",
        "--plants",
        "analytical",
        "--out",
        "run",
    )
    assert "preset" not in srs_twin("run", "gen2_turn", *words, cwd=tmp_path).stdout


def test_twin_built_from_a_preset_reports_it():
    assert (
        TwinSnake(load_robot("gen4"), **PRESETS["fast"]).describe()["preset"] == "fast"
    )


def test_no_shipped_scenario_uses_the_fast_preset(root):
    for path in (root / "scenarios").glob("*.yaml"):
        assert "preset" not in path.read_text("utf-8"), path.name
    assert settings(load_scenario("gen2_turn")) == DEFAULT


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gen2_turn", "gen3_turn"])
def test_fast_preset_has_the_stated_error(name):
    fast = PRESETS["fast"]
    actual = np.abs(
        errors([measured(name, fast)], [measured(name, fast | {"timestep": FINE_S})])
    )[:, 0]
    assert (actual <= STATED).all(), dict(zip(METRICS, actual, strict=True))
