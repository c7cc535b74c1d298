"""Design of experiments: foretold intervals against fits, and what no walk can tell."""

from __future__ import annotations

import json

import numpy as np
import pytest
from snakes import GRAVITY

from srs_twin import load_robot
from srs_twin.errors import InputError
from srs_twin.identification.design import PULL_SHARE, _information, candidates, choose_experiments
from srs_twin.identification.friction import Pulls, fit_pulls

SPEC = load_robot("gen2")


def test_a_foretold_interval_is_the_scatter_of_fits_to_what_it_says_to_record():
    found = choose_experiments(SPEC, {}, {"friction.mu_n": 0.04})
    assert [each.description for each in found.chosen][0].startswith("10 pulls across")
    rng, fits = np.random.default_rng(0), []
    force = SPEC.friction.mu_n * SPEC.mass.total * GRAVITY
    for _ in range(300):
        pulled = force * (1 + PULL_SHARE * np.sqrt(10) * rng.standard_normal(10)) / 30.0
        pulls = Pulls(along=[], across=list(pulled), stiffness=30.0, mass=SPEC.mass.total)
        fits.append(fit_pulls(pulls)["friction.mu_n"].value)
    scatter = 1.96 * np.std(fits) / SPEC.friction.mu_n
    assert found.after["friction.mu_n"][0] == pytest.approx(scatter, rel=0.2)


def test_no_walk_tells_mass_from_stiffness():
    """With all masses and stiffnesses scaled alike nothing changes, but for the third digit of metrics."""
    names = ["mass.connectors_kg", "bending.stiffness_nm_per_rad", "friction.mu_t"]
    values = {"mass.connectors_kg": 0.03, "bending.stiffness_nm_per_rad": 0.44, "friction.mu_t": 0.043}
    scale = np.array([values[name] for name in names])
    walks = [each for each in candidates(SPEC) if each.description.startswith("walk")]
    for walk in walks[2:4]:
        found = _information(walk, SPEC, names, values, scale)
        alike = np.array([1.0, 1.0, 0.0])
        assert alike @ found @ alike < 0.01 * found[0, 0]
        assert found[1, 1] > 1e-2 * found[2, 2]


def test_drag_is_told_from_the_wheels_by_a_load():
    known = {"friction.mu_t": (0.043, 0.01), "friction.drag_n": (0.0, 0.03)}
    found = choose_experiments(SPEC, known, {"friction.mu_t": 0.06})
    loads = [each.description for each in found.chosen if each.description.startswith("10 pulls along")]
    assert any("300 g" in each for each in loads) and any("g on it" not in each for each in loads)
    assert found.unmet == ()
    assert list(found.after["friction.mu_t"]) == sorted(found.after["friction.mu_t"], reverse=True)


@pytest.mark.slow
def test_what_cannot_be_reached_is_said(srs_twin, tmp_path):
    done = srs_twin("calibrate", "design", "gen2", "--want", "friction.mu_n=0.1%", cwd=tmp_path)
    assert done.returncode == 0
    assert "friction.mu_n: no further recording of these kinds narrows it to 0.1 %" in done.stdout
    printed = srs_twin("calibrate", "design", "gen2", "--want", "friction.mu_n=3%", "--json", cwd=tmp_path)
    document = json.loads(printed.stdout)
    assert document["unmet"] == [] and document["experiments"][-1]["after"]["friction.mu_n"] <= 0.03
    wrong = srs_twin("calibrate", "design", "gen2", "--want", "friction.mu_n=much", cwd=tmp_path)
    assert wrong.returncode == 2
    assert "must be NAME=PERCENT" in wrong.stderr
    with pytest.raises(InputError, match="names nothing"):
        choose_experiments(SPEC, {}, {})
