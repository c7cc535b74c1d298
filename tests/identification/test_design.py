"""Design of experiments: predicted intervals against fits, and parameters that no walk identifies."""

from __future__ import annotations

import json

import numpy as np
import pytest
from snakes import GRAVITY

from srs_twin import load_robot
from srs_twin.errors import InputError
from srs_twin.identification.design import (
    PULL_FRACTION,
    _information,
    candidates,
    choose_experiments,
)
from srs_twin.identification.friction import Pulls, fit_pulls

SPEC = load_robot("gen2")


@pytest.mark.slow
def test_predicted_intervals_agree_with_the_scatter_of_fits():
    fit = choose_experiments(SPEC, {}, {"friction.mu_n": 0.04})
    assert [experiment.description for experiment in fit.chosen][0].startswith(
        "10 pulls across"
    )
    rng = np.random.default_rng(0)
    fits = []
    force = SPEC.friction.mu_n * SPEC.mass.total * GRAVITY
    for _ in range(300):
        pulled = (
            force * (1 + PULL_FRACTION * np.sqrt(10) * rng.standard_normal(10)) / 30.0
        )
        pulls = Pulls(
            along=[], across=list(pulled), stiffness=30.0, mass=SPEC.mass.total
        )
        fits.append(fit_pulls(pulls)["friction.mu_n"].value)
    scatter = 1.96 * np.std(fits) / SPEC.friction.mu_n
    assert fit.after["friction.mu_n"][0] == pytest.approx(scatter, rel=0.2)


def test_walks_do_not_separate_mass_from_stiffness():
    """A common factor of all masses and stiffnesses changes metrics by less than the third digit."""
    values = {
        "mass.connectors_kg": 0.03,
        "bending.stiffness_nm_per_rad": 0.44,
        "friction.mu_t": 0.043,
    }
    scale = np.array([*values.values()])
    walks = [
        experiment
        for experiment in candidates(SPEC)
        if experiment.description.startswith("gait run")
    ]
    for walk in walks[2:4]:
        fit = _information(walk, SPEC, values, scale)
        alike = np.array([1.0, 1.0, 0.0])
        assert alike @ fit @ alike < 0.01 * fit[0, 0]
        assert fit[1, 1] > 1e-2 * fit[2, 2]


@pytest.mark.slow
def test_a_load_separates_drag_from_wheel_inertia():
    known = {"friction.mu_t": (0.043, 0.01), "friction.drag_n": (0.0, 0.03)}
    fit = choose_experiments(SPEC, known, {"friction.mu_t": 0.06})
    loads = [
        experiment.description
        for experiment in fit.chosen
        if experiment.description.startswith("10 pulls along")
    ]
    assert any("300 g" in text for text in loads) and any(
        "g on it" not in text for text in loads
    )
    assert fit.unmet == ()
    assert list(fit.after["friction.mu_t"]) == sorted(
        fit.after["friction.mu_t"], reverse=True
    )


@pytest.mark.slow
def test_unreachable_targets_are_reported(srs_twin, tmp_path):
    done = srs_twin(
        "calibrate",
        "design",
        "gen2",
        "--target-accuracy",
        "friction.mu_n=0.1%",
        cwd=tmp_path,
    )
    assert done.returncode == 0
    assert "friction.mu_n: no further experiment of" in done.stdout
    printed = srs_twin(
        "calibrate",
        "design",
        "gen2",
        "--target-accuracy",
        "friction.mu_n=3%",
        "--json",
        cwd=tmp_path,
    )
    document = json.loads(printed.stdout)
    assert (
        document["unmet"] == []
        and document["experiments"][-1]["after"]["friction.mu_n"] <= 0.03
    )
    wrong = srs_twin(
        "calibrate",
        "design",
        "gen2",
        "--target-accuracy",
        "friction.mu_n=much",
        cwd=tmp_path,
    )
    assert wrong.returncode == 2
    assert "must have the form NAME=PERCENT" in wrong.stderr
    with pytest.raises(InputError, match="contains no parameters"):
        choose_experiments(SPEC, {}, {})
