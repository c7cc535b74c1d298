"""Analytical plant: energy of coasting snakes, convergence, valve edges, time steps, invalid settings."""

from __future__ import annotations

from typing import get_type_hints

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from snakes import robot, throw, vented

from srs_twin import AnalyticalSnake, Gait, InputError, rollout
from srs_twin.plants.analytical import kernels
from srs_twin.plants.analytical.options import AnalyticalOptions, OptionKeywords

SPEC = robot()
FRICTION_LAWS = pytest.mark.parametrize("friction_law", ["axis", "wheel"])


@settings(max_examples=25)
@given(
    st.sampled_from(["axis", "wheel"]),
    st.floats(-1.5, 1.5),
    st.floats(-1.5, 1.5),
    st.floats(-15, 15),
    st.floats(-3, 3),
)
def test_coasting_snake_loses_energy_and_comes_to_rest(
    friction_law, vx, vy, spin, heading
):
    plant = AnalyticalSnake(robot(mu_t=0.2), friction=friction_law)
    throw(plant, (vx, vy), spin=spin, heading=heading)
    inertia = (plant.spec.mass.array() * (0.055 * np.arange(-2, 3)) ** 2).sum()

    last = np.inf
    for _ in range(75):
        state = plant.step(vented(plant.spec))
        moment = plant.body.state[kernels.MOMENT]
        now = (
            plant.spec.mass.total * (state.com_velocity @ state.com_velocity) / 2
            + moment**2 / inertia / 2
        )
        assert now <= last * (1 + 1e-6) + 1e-15
        last = now
    assert last < 1e-12


@pytest.mark.default_cases(at=[0, 18, 28])
@pytest.mark.parametrize("degrees", range(0, 91, 5))
@FRICTION_LAWS
def test_newton_converges_when_a_coasting_snake_stops(friction_law, degrees):
    """Regression: Newton's method alternated between the sides of the kink where a wheel stops rolling."""
    plant = AnalyticalSnake(SPEC, friction=friction_law, slip_speed=0.001)
    angle = np.radians(degrees)
    throw(plant, (0.5 * np.cos(angle), 0.5 * np.sin(angle)))
    for _ in range(65):
        state = plant.step(vented(SPEC))
    assert np.abs(state.com_velocity).max() < 1e-6


@FRICTION_LAWS
def test_spinning_snake_decelerates_by_the_friction_moment(friction_law):
    """A spinning straight snake slides sideways: I ω̇ = −μ_n g Σ m |r|, so Δθ = I ω²/(2 μ_n g Σ m|r|)."""
    plant = AnalyticalSnake(robot(mu_t=0.0), friction=friction_law, slip_speed=1e-5)
    throw(plant, (0.0, 0.0), spin=10.0)
    for _ in range(100):
        state = plant.step(vented(SPEC))
    mass = SPEC.mass.array()
    reach = np.abs(SPEC.geometry.pitch * np.arange(-2, 3))
    inertia = (mass * reach**2).sum()
    moment = 0.57 * 9.81 * (mass * reach).sum()
    assert state.heading == pytest.approx(inertia * 10.0**2 / (2 * moment), rel=0.01)


@FRICTION_LAWS
def test_finer_steps_change_the_speed_by_less_than_two_permille(friction_law):
    def speed(**options: float) -> float:
        plant = AnalyticalSnake(SPEC, friction=friction_law, **options)
        path = rollout(plant, Gait(2.0), 5.0, record_hz=50).com
        return float(np.hypot(*(path[-1] - path[50])) / 4)

    default = speed()
    for finer in ({"timestep": 0.0005}, {"slip_speed": 0.00005}):
        result = speed(**finer)
        assert result != default and result == pytest.approx(default, rel=2e-3), finer


def test_gait_is_independent_of_the_control_tick():
    """Valve edges have the same times in long and short ticks."""
    long, short = (
        rollout(AnalyticalSnake(SPEC, tick=t), Gait(1.7, 0.2), 1.0, record_hz=50)
        for t in (0.02, 0.005)
    )
    assert long.com == pytest.approx(short.com, abs=1e-6)
    assert long.stack("pressure_plus") == pytest.approx(
        short.stack("pressure_plus"), abs=1e-3
    )


@pytest.mark.parametrize(
    ("supply", "words"),
    [
        (48.3, r"so 48.3 means 0.0483 kPa, .* did you mean 48300 \(48.3 kPa\)\?"),
        (0.5, r"did you mean 50000 \(0.5 bar\)\?"),
        (7.0, r"needs about 48300 Pa; did you mean 48263.3 \(7 psi\)\?"),
        (480.0, "so 480 means 0.48 kPa"),
        (-1.0, "`supply_pa` -1.0 is not allowed; it must be a finite pressure"),
        (np.inf, "`supply_pa` inf is not allowed"),
    ],
)
def test_supply_pressure_in_another_unit_is_refused(supply, words):
    """Less than a hundredth of the nominal 48.3 kPa, 483 Pa, is taken for another unit."""
    with pytest.raises(InputError, match=words):
        AnalyticalSnake(SPEC, supply_pa=supply)
    assert AnalyticalSnake(SPEC, supply_pa=485.0).supply_pa == 485.0


def test_keywords_are_the_fields_of_the_options():
    assert get_type_hints(OptionKeywords) == get_type_hints(AnalyticalOptions)


def test_all_options_that_exclude_each_other_are_reported_at_once():
    with pytest.raises(InputError) as error:
        AnalyticalSnake(SPEC, friction_torque=False, contact=True, load="instantaneous")
    assert str(error.value).split("; ") == [
        "model 'complete' always has a friction torque",
        "use model 'simplified' to leave it out",
        "model 'complete' cannot touch obstacles, because its bends are prescribed",
        "use model 'compliant'",
        "instantaneous loads need two contacts per connector, but friction 'axis' has"
        " only one",
        "use friction 'wheel' or 'ellipse'",
    ]
