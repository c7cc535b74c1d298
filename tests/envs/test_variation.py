"""Robots of episodes differ within what calibration leaves open, and as it says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from snakes import robot

from srs_twin import InputError
from srs_twin.envs import make_task
from srs_twin.envs.gymnasium import SnakeEnv
from srs_twin.envs.task import Variation
from srs_twin.identification.estimate import Estimate, Parameter
from srs_twin.identification.fit_file import DataSet, fit_file, write_fit
from srs_twin.io.documents import dump_yaml
from srs_twin.pneumatics import make_pneumatics
from srs_twin.robot.file import load_robot_file

DRAWS = 400


def parameter(name: str, value: float, error: float, unit: str) -> Parameter:
    return Parameter(name, unit, "identified", value, error, value - 1.96 * error, value + 1.96 * error, "")


@pytest.fixture
def fit(tmp_path: Path) -> Path:
    """A fit of gen2's friction whose two coefficients are known better together than apart."""
    found = (parameter("friction.mu_t", 0.05, 0.005, "1"), parameter("friction.mu_n", 0.6, 0.02, "1"))
    estimate = Estimate(found, np.array([[1.0, -0.9], [-0.9, 1.0]]))
    made = fit_file(
        estimate, name="floor", title="Floor", robot="gen2", method="pulls", command="x", versions={},
        data=[DataSet("a.csv", "a" * 64, "fit", 10)],
    )  # fmt: skip
    return write_fit(made, tmp_path / "floor.yaml")


def test_a_fit_is_drawn_within_its_intervals_with_its_errors_and_correlation(fit):
    variation, rng = Variation.of("gen2", fit=fit), np.random.default_rng(0)
    drawn = np.array(
        [(s.friction.mu_t, s.friction.mu_n) for s in (variation.draw(rng) for _ in range(DRAWS))]
    )
    assert (np.abs(drawn - [0.05, 0.6]) <= 1.96 * np.array([0.005, 0.02]) + 1e-12).all()
    # Held at ±1.96 errors, a normal number keeps 0.93 of its deviation; 400 draws tell 4 % of it.
    assert drawn.std(axis=0) == pytest.approx(0.96 * np.array([0.005, 0.02]), rel=0.15)
    assert np.corrcoef(drawn.T)[0, 1] == pytest.approx(-0.9, abs=0.05)


def test_ranges_are_drawn_evenly_and_everything_else_stays():
    variation, rng = Variation.of("gen2", ranges={"friction.mu_t": (0.02, 0.06)}), np.random.default_rng(0)
    drawn = [variation.draw(rng) for _ in range(DRAWS)]
    values = np.array([spec.friction.mu_t for spec in drawn])
    assert values.min() >= 0.02 and values.max() <= 0.06
    assert np.histogram(values, bins=4, range=(0.02, 0.06))[0].min() > DRAWS / 4 * 0.7
    assert {spec.friction.mu_n for spec in drawn} == {robot().friction.mu_n}


def test_spreads_of_a_robot_file_are_drawn_anew_for_each_episode(tmp_path):
    data = load_robot_file("gen2").model_dump(mode="json", exclude_none=True)
    data["modules"] = {"gain_spread": {"value": 0.1, "unit": "1", "status": "estimated", "source": "a test"}}
    path = tmp_path / "uneven.yaml"
    path.write_text(dump_yaml(data), "utf-8")
    env, gains = SnakeEnv("GoTo", robot=str(path)), []
    for seed in (0, 1, 0):
        env.reset(seed=seed)
        gains.append(env.episode.twin.spec.modules.gain)
    assert gains[0] == gains[2] != gains[1]


def test_references_of_a_module_stay_within_what_it_can_hold(tmp_path):
    """Also where bends flatten out: what full chambers come to rest at, on one side."""
    data = load_robot_file("gen4_module").model_dump(mode="json", exclude_none=True)
    limit = {"value": 0.5, "unit": "rad", "status": "estimated", "source": "a test"}
    data["actuator"]["bend_limit_rad"] = limit
    path = tmp_path / "flat.yaml"
    path.write_text(dump_yaml(data), "utf-8")
    spec = load_robot_file(path).spec()
    chambers = make_pneumatics("lag", spec, supply_pa=spec.supply.nominal, layout="3/2")
    fill = np.array([[1, -1]], dtype=np.int8)
    held = chambers.advance(chambers.schedule(fill, 5.0), np.array([5.0])).bend[0, 0]
    assert held < 0.5
    assert make_task("Module", robot=str(path)).reach == pytest.approx(0.8 * held)


def test_the_robot_that_was_drawn_is_the_one_that_moves():
    def way(ranges):
        env = SnakeEnv("GoTo", ranges=ranges)
        env.reset(seed=0)
        for _ in range(10):
            *_, info = env.step(np.array([0.0, 2.0, 48.0]))
        return np.hypot(info["com_x_m"], info["com_y_m"])

    assert way({"friction.mu_t": (0.2, 0.2)}) < 0.8 * way({"friction.mu_t": (0.02, 0.02)})


def test_what_cannot_be_is_refused(fit):
    with pytest.raises(InputError, match="fit floor is of robot 'gen2', not of 'gen4'"):
        Variation.of("gen4", fit=fit)
    with pytest.raises(InputError, match="friction.mu_t: the range 0.2 to 0.1 is not allowed; lowest first"):
        Variation.of("gen2", ranges={"friction.mu_t": (0.2, 0.1)})
    with pytest.raises(InputError, match="unknown .*friction.mu_s.*did you mean"):
        Variation.of("gen2", ranges={"friction.mu_s": (0.1, 0.2)})
    with pytest.raises(InputError, match=r"friction.mu_t: the start -1 is not allowed"):
        Variation.of("gen2", ranges={"friction.mu_t": (-1.0, 0.2)})
