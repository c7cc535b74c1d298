"""Domain randomisation: robots are drawn from fits, ranges and module tolerances."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from snakes import robot

from srs_twin import InputError
from srs_twin.envs import make_task
from srs_twin.envs.gymnasium import SnakeEnv
from srs_twin.envs.variation import Variation
from srs_twin.identification.estimate import FitEstimate, Parameter
from srs_twin.identification.fit_file import DataSet, fit_file, write_fit
from srs_twin.io.documents import dump_yaml
from srs_twin.pneumatics import make_pneumatics
from srs_twin.robot.file import load_robot_file

DRAWS = 400


def parameter(name: str, value: float, error: float, unit: str) -> Parameter:
    return Parameter(
        name,
        unit,
        "identified",
        value,
        error,
        value - 1.96 * error,
        value + 1.96 * error,
        "",
    )


@pytest.fixture
def fit(tmp_path: Path) -> Path:
    """A fit of gen2's friction with correlated coefficients."""
    parameters = (
        parameter("friction.mu_t", 0.05, 0.005, "1"),
        parameter("friction.mu_n", 0.6, 0.02, "1"),
    )
    estimate = FitEstimate(parameters, np.array([[1.0, -0.9], [-0.9, 1.0]]))
    fit = fit_file(
        estimate,
        name="floor",
        title="Floor",
        robot="gen2",
        method="pulls",
        command="x",
        versions={},
        data=[DataSet("a.csv", "a" * 64, "fit", 10)],
    )
    return write_fit(fit, tmp_path / "floor.yaml")


def test_fitted_parameters_are_drawn_with_their_errors_and_correlation(fit):
    variation = Variation.load("gen2", fit=fit)
    rng = np.random.default_rng(0)
    drawn = np.array(
        [
            (s.friction.mu_t, s.friction.mu_n)
            for s in (variation.draw(rng) for _ in range(DRAWS))
        ]
    )
    assert (np.abs(drawn - [0.05, 0.6]) <= 1.96 * np.array([0.005, 0.02]) + 1e-12).all()
    # Clipped at ±1.96 σ, a normal variable keeps 0.96 of its σ; 400 draws estimate σ to
    # about 4 %.
    assert drawn.std(axis=0) == pytest.approx(0.96 * np.array([0.005, 0.02]), rel=0.15)
    assert np.corrcoef(drawn.T)[0, 1] == pytest.approx(-0.9, abs=0.05)


def test_ranges_are_uniform_and_other_parameters_fixed():
    variation = Variation.load("gen2", ranges={"friction.mu_t": (0.02, 0.06)})
    rng = np.random.default_rng(0)
    drawn = [variation.draw(rng) for _ in range(DRAWS)]
    values = np.array([spec.friction.mu_t for spec in drawn])
    assert values.min() >= 0.02 and values.max() <= 0.06
    assert np.histogram(values, bins=4, range=(0.02, 0.06))[0].min() > DRAWS / 4 * 0.7
    assert {spec.friction.mu_n for spec in drawn} == {robot().friction.mu_n}


def test_module_tolerances_are_drawn_for_each_episode(tmp_path):
    data = load_robot_file("gen2").model_dump(mode="json", exclude_none=True)
    data["modules"] = {
        "gain_spread": {
            "value": 0.1,
            "unit": "1",
            "status": "estimated",
            "source": "a test",
        }
    }
    path = tmp_path / "uneven.yaml"
    path.write_text(dump_yaml(data), "utf-8")
    env = SnakeEnv("GoTo", robot=str(path))
    gains = []
    for seed in (0, 1, 0):
        env.reset(seed=seed)
        gains.append(env.episode.twin.spec.modules.gain)
    assert gains[0] == gains[2] != gains[1]


def test_module_references_stay_within_the_reachable_bend(tmp_path):
    """This holds for a saturating bend as well: the reach is the static bend of one full chamber."""
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


def test_drawn_robot_is_simulated():
    def distance(ranges):
        env = SnakeEnv("GoTo", ranges=ranges)
        env.reset(seed=0)
        for _ in range(10):
            *_, info = env.step(np.array([0.0, 2.0, 48.0]))
        return np.hypot(info["com_x_m"], info["com_y_m"])

    assert distance({"friction.mu_t": (0.2, 0.2)}) < 0.8 * distance(
        {"friction.mu_t": (0.02, 0.02)}
    )


def test_invalid_variations_are_refused(fit):
    for robot_name, settings, words in (
        ("gen4", {"fit": fit}, "fit floor is for robot 'gen2', not for 'gen4'"),
        (
            "gen2",
            {"ranges": {"friction.mu_t": (0.2, 0.1)}},
            "friction.mu_t: the range 0.2 to 0.1 is not allowed; give the lower limit",
        ),
        (
            "gen2",
            {"ranges": {"friction.mu_s": (0.1, 0.2)}},
            "unknown .*friction.mu_s.*did you mean",
        ),
        (
            "gen2",
            {"ranges": {"friction.mu_t": (-1.0, 0.2)}},
            "friction.mu_t: the initial value -1 of the fit is not allowed",
        ),
    ):
        with pytest.raises(InputError, match=words):
            Variation.load(robot_name, **settings)
