"""A coasting straight snake stops where Coulomb's law predicts, on both plants."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from snakes import GRAVITY, robot, throw, vented

from srs_twin import AnalyticalSnake, LoadedContact, Plant, PreloadedContact, TwinSnake
from srs_twin.plants.twin.mjcf.numerics import FRICTION_LAW_OF

SPEC = robot(stiffness=20.0)
MU_T = SPEC.friction.mu_t
MU_N = SPEC.friction.mu_n
MASS = SPEC.mass.total
# Rolling wheels must stop spinning, too: Σ I/R² with I = m R²/2, two wheels per
# connector.
SPIN_MASS = 2 * SPEC.geometry.connectors * SPEC.mass.wheel / 2


@cache
def twin(
    wheels: str = "rolling", contact: str = "preloaded", slip_speed: float = 1e-4
) -> TwinSnake:
    loaded_contact = LoadedContact(FRICTION_LAW_OF[wheels], slip_speed=slip_speed)
    return TwinSnake(
        SPEC,
        contact=loaded_contact if contact == "loaded" else PreloadedContact(wheels),
    )


def stopped(
    plant: Plant, velocity: tuple[float, float], heading: float = 0.0
) -> np.ndarray:
    """Start a plant with a velocity; return its displacement until it rests, body frame, m."""
    c = math.cos(heading)
    s = math.sin(heading)
    throw(
        plant,
        (c * velocity[0] - s * velocity[1], s * velocity[0] + c * velocity[1]),
        heading=heading,
    )
    start = (
        plant.physics.center_of_mass()[:2]
        if isinstance(plant, TwinSnake)
        else np.zeros(2)
    )
    for _ in range(
        round((1.2 * abs(velocity[0]) / (MU_T * GRAVITY) + 0.3) / plant.tick)
    ):
        state = plant.step(vented(SPEC))
    assert np.abs(state.com_velocity).max() < 1e-6
    return (state.com - start) @ np.array([[c, -s], [s, c]])


def sliding_wheel(velocity: tuple[float, float], spin_fraction: float) -> np.ndarray:
    """Integrate a unit mass on wheels under sharp friction until it rests; return its displacement, m.

    The force along is the axle's drag, reduced by the wheels' inertia, or the whole
    friction cone if that is smaller; the force across is the remainder of the cone.
    """
    step = 2e-4
    v = np.array(velocity)
    place = np.zeros(2)
    while np.hypot(*v) > 0:
        speed = np.hypot(*v)
        along = min(MU_T / (1 + spin_fraction), MU_N * abs(v[0]) / speed)
        across = math.sqrt(MU_N**2 - along**2) * (v[1] != 0)
        brake = np.array([along, across]) * GRAVITY * step
        after = np.sign(v) * np.maximum(np.abs(v) - brake, 0.0)
        place += step * (v + after) / 2
        v = after
    return place


@pytest.mark.default_cases(at=[0, 3, 4])
@pytest.mark.parametrize("heading", [0.0, 2.0])
@pytest.mark.parametrize("friction_law", ["axis", "wheel", "ellipse"])
def test_analytical_stops_along_and_across(friction_law, heading):
    plant = AnalyticalSnake(SPEC, friction=friction_law)
    along = stopped(plant, (0.5, 0.0), heading)
    assert along == pytest.approx(
        [0.5**2 / (2 * MU_T * GRAVITY), 0], rel=0.01, abs=1e-9
    )
    # With drag μ_t reserved, a wheel that does not roll still has its whole cone
    # across.
    across = stopped(plant, (0.0, -0.5), heading)
    assert across == pytest.approx(
        [0, -(0.5**2) / (2 * MU_N * GRAVITY)], rel=0.01, abs=1e-9
    )


@pytest.mark.parametrize("speed", [0.5, 1.0])
def test_twin_stops_along(speed):
    expected = (MASS + SPIN_MASS) * speed**2 / (2 * MU_T * GRAVITY * MASS)
    displacement = stopped(twin(), (speed, 0.0))
    assert displacement == pytest.approx([expected, 0], rel=0.01, abs=1e-6)


@pytest.mark.parametrize("speed", [0.5, 1.0])
def test_twin_stops_across(speed):
    displacement = stopped(twin(), (0.0, speed))
    assert displacement == pytest.approx(
        [0, speed**2 / (2 * MU_N * GRAVITY)], rel=0.03, abs=1e-4
    )


@pytest.mark.parametrize("speed", [0.5, 1.0])
def test_loaded_wheels_stop_along_and_across(speed):
    along = stopped(twin(contact="loaded"), (speed, 0.0), 2.0)
    expected = (MASS + SPIN_MASS) * speed**2 / (2 * MU_T * GRAVITY * MASS)
    assert along == pytest.approx([expected, 0], rel=1e-4, abs=1e-9)
    across = stopped(twin(contact="loaded"), (0.0, -speed))
    assert across == pytest.approx(
        [0, -(speed**2) / (2 * MU_N * GRAVITY)], rel=1e-4, abs=1e-7
    )


@pytest.mark.slow
def test_wheels_stopping_within_a_step_get_no_lateral_impulse():
    """By symmetry, the lateral impulse is 0.

    The friction solve has an error of at most 1e-7 of the friction impulse, along the
    wheels.
    """
    plant = twin(contact="loaded")
    sideways = [stopped(plant, (0.3 + 0.02 * k, 0.0), 0.7 * k)[1] for k in range(20)]
    assert np.abs(sideways).max() < 1e-10


@pytest.mark.parametrize("degrees", [30, 60])
def test_loaded_wheels_stop_at_an_angle(degrees):
    velocity = (math.cos(math.radians(degrees)), math.sin(math.radians(degrees)))
    expected = sliding_wheel(velocity, SPIN_MASS / MASS)
    assert stopped(twin(contact="loaded"), velocity, 0.3) == pytest.approx(
        expected, rel=0.01
    )


@pytest.mark.parametrize("degrees", [30, 60, 87])
def test_analytical_stops_at_an_angle_as_a_wheeled_point_does(degrees):
    velocity = (math.cos(math.radians(degrees)), math.sin(math.radians(degrees)))
    displacement = stopped(
        AnalyticalSnake(SPEC, friction="wheel", slip_speed=1e-4), velocity
    )
    assert displacement == pytest.approx(
        sliding_wheel(velocity, 0.0), rel=0.005, abs=1e-5
    )


@pytest.mark.parametrize("degrees", [30, 60])
def test_twin_stops_at_an_angle_as_a_wheeled_point_does(degrees):
    velocity = (math.cos(math.radians(degrees)), math.sin(math.radians(degrees)))
    displacement = stopped(twin(), velocity)
    expected = sliding_wheel(velocity, SPIN_MASS / MASS)
    assert displacement[0] == pytest.approx(expected[0], rel=0.02)
    assert displacement[1] == pytest.approx(expected[1], rel=0.03)


def sliding_skid(velocity: tuple[float, float]) -> np.ndarray:
    """Integrate a unit mass on skids under friction of maximum dissipation; return its displacement, m."""
    step = 1e-4
    v = np.array(velocity)
    place = np.zeros(2)
    mu = np.array([MU_T, MU_N])
    while np.hypot(*v) > 1e-3:
        after = v - step * GRAVITY * mu**2 * v / np.hypot(*(mu * v))
        place += step * (v + after) / 2
        v = after
    return place


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("heading", [0.0, 2.0])
@pytest.mark.parametrize("speed", [0.5, 1.0])
def test_skids_stop_along_and_across(speed, heading):
    """Without wheel inertia the stopping distance is v²/(2 μ g)."""
    along = stopped(twin("skid"), (speed, 0.0), heading)
    assert along == pytest.approx(
        [speed**2 / (2 * MU_T * GRAVITY), 0], rel=0.002, abs=1e-5
    )
    across = stopped(twin("skid"), (0.0, speed), heading)
    assert across == pytest.approx(
        [0, speed**2 / (2 * MU_N * GRAVITY)], rel=0.02, abs=1e-3
    )


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [10, 30, 60, 80])
def test_both_plants_stop_at_an_angle_as_a_sliding_point_does(degrees):
    velocity = (math.cos(math.radians(degrees)), math.sin(math.radians(degrees)))
    expected = sliding_skid(velocity)
    model = stopped(
        AnalyticalSnake(SPEC, friction="ellipse", slip_speed=1e-4), velocity
    )
    assert model == pytest.approx(expected, rel=0.005, abs=1e-4)
    assert stopped(twin("skid"), velocity, 0.3) == pytest.approx(
        expected, rel=0.01, abs=5e-4
    )
    assert stopped(twin("skid", "loaded"), velocity, 0.3) == pytest.approx(
        expected, rel=0.005, abs=1e-5
    )


def test_axis_law_stops_each_direction_independently():
    displacement = stopped(AnalyticalSnake(SPEC, friction="axis"), (0.6, 0.8))
    expected = [0.6**2 / (2 * MU_T * GRAVITY), 0.8**2 / (2 * MU_N * GRAVITY)]
    assert displacement == pytest.approx(expected, rel=0.01)
