"""Design of experiments: predicted intervals against fits, and parameters that no walk identifies."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from srs_twin import load_robot
from srs_twin.errors import InputError
from srs_twin.identification import design
from srs_twin.identification.command import _parse_targets
from srs_twin.identification.design import (
    PULL_FRACTION,
    _information,
    candidates,
    choose_experiments,
)

SPEC = load_robot("gen2")


def test_pulls_narrow_the_interval_with_the_root_of_their_number(monkeypatch):
    """Each direction can be pulled three times without and three times with a load."""
    monkeypatch.setattr(design, "candidates", design._pulls)

    def width(pulls: int) -> float:
        return 1.96 / math.sqrt(1 / 3.0**2 + pulls / PULL_FRACTION**2)

    enough = choose_experiments(SPEC, {}, {"friction.mu_n": 0.02})
    assert enough.before == {"friction.mu_n": pytest.approx(width(0))}
    assert enough.after["friction.mu_n"] == pytest.approx(
        [width(1), width(2), width(3)]
    )
    assert enough.unmet == ()
    few = choose_experiments(SPEC, {}, {"friction.mu_n": 0.01})
    assert few.unmet == ("friction.mu_n",)
    rows = few.document()["experiments"]
    assert rows[-1]["after"] == {"friction.mu_n": pytest.approx(width(6))}
    assert ["300 g on it" in row["do"] for row in rows] == [False] * 3 + [True] * 3
    assert all(row["do"].startswith("10 pulls across the body") for row in rows)


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


def test_targets_are_percentages_of_named_parameters():
    targets = _parse_targets("friction.mu_t=5%, mass.connectors_kg=2.5,friction.mu_n=")
    assert targets == {
        "friction.mu_t": 0.05,
        "mass.connectors_kg": 0.025,
        "friction.mu_n": 0.1,
    }
    for wrong in ("friction.mu_n=much", "friction.mu_n=0%"):
        with pytest.raises(InputError, match="must have the form NAME=PERCENT"):
            _parse_targets(wrong)
    with pytest.raises(InputError, match="contains no parameters"):
        choose_experiments(SPEC, {}, {})


def test_candidates_have_the_forces_and_the_noise_of_their_instruments():
    markers, scale, *pulls, held, _ = list(candidates(SPEC))[:8]
    assert markers.noise(np.ones(3)).tolist() == [4e-4] * 3
    assert scale.noise(np.ones(1)) == 1e-3 and held.noise(np.ones(1)) == 0.01
    weight = SPEC.mass.total * 9.81
    friction = SPEC.friction
    drag = replace(SPEC, friction=replace(friction, drag=0.02))
    assert [pull.predict(drag)[0] for pull in pulls] == pytest.approx(
        [
            friction.mu_t * weight + 0.02,
            friction.mu_n * weight,
            3 * friction.mu_t * weight + 0.02,
            3 * friction.mu_n * weight,
        ]
    )
    assert pulls[0].noise(np.array([2.0])) == pytest.approx([0.03])
    assert held.predict(SPEC)[-1] == pytest.approx(
        SPEC.actuator.gain * SPEC.supply.nominal
    )
    walk = list(candidates(SPEC))[-1]
    noise = walk.noise(np.array([0.1, 0.5, 0.5, 0.5, 0.5, -1.0]))
    bends = [math.sqrt(2) * 0.01] * 4
    assert noise == pytest.approx([0.002, *bends, 0.02])
