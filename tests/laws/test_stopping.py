"""A coasting straight snake stops where Coulomb's law and axial drag predict, on both plants."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

import numpy as np
import pytest
from snakes import GRAVITY, robot, throw, vented

from srs_twin import (
    AnalyticalSnake,
    Gait,
    LoadedContact,
    Plant,
    PreloadedContact,
    TwinSnake,
    rollout,
)

SPEC = robot(stiffness=20.0)
MU_T = SPEC.friction.mu_t
MU_N = SPEC.friction.mu_n
MASS = SPEC.mass.total
# Rolling wheels must stop spinning, too: Σ I/R² with I = m R²/2, two wheels per
# connector.
SPIN_MASS = 2 * SPEC.geometry.connectors * SPEC.mass.wheel / 2


class Case(NamedTuple):
    """Plant and its accuracy.

    Attributes:
        make: function from a robot to a plant.
        along: relative tolerance of the distance along the heading.
        across: relative tolerance of the distance across it.
        sideways: tolerance of the perpendicular displacement, m.
        spin_mass: effective mass of rolling wheels, kg.
    """

    make: partial
    along: float
    across: float
    sideways: float
    spin_mass: float = 0.0


def analytical(friction: str, **options: str) -> Case:
    make = partial(AnalyticalSnake, friction=friction, slip_speed=1e-4, **options)
    return Case(make, 0.005, 0.005, 1e-5)


def on(contact: LoadedContact | PreloadedContact) -> partial:
    return partial(TwinSnake, contact=contact)


CASES = {
    "axis": analytical("axis"),
    "wheel": analytical("wheel"),
    "ellipse": analytical("ellipse"),
    "compliant": analytical("wheel", model="compliant"),
    "loaded": Case(on(LoadedContact(slip_speed=1e-4)), 1e-4, 1e-4, 1e-7, SPIN_MASS),
    "preloaded": Case(on(PreloadedContact()), 0.01, 0.03, 1e-4, SPIN_MASS),
    "skid": Case(on(PreloadedContact("skid")), 0.002, 0.02, 1e-3),
    "loaded skid": Case(
        on(LoadedContact("ellipse", slip_speed=1e-4)), 0.005, 0.005, 1e-5
    ),
}


@cache
def plant_of(name: str, drag: float = 0.0) -> Plant:
    return CASES[name].make(replace(SPEC, friction=replace(SPEC.friction, drag=drag)))


def stopped(
    plant: Plant, velocity: tuple[float, float], heading: float = 0.0
) -> np.ndarray:
    """Start a plant with a velocity; return its displacement until it rests, body frame, m."""
    c = math.cos(heading)
    s = math.sin(heading)
    turn = np.array([[c, -s], [s, c]])
    throw(plant, tuple(turn @ velocity), heading=heading)
    start = np.zeros(2)
    if isinstance(plant, TwinSnake):
        start = plant.physics.center_of_mass()[:2]
    duration = 1.2 * abs(velocity[0]) / (MU_T * GRAVITY) + 0.3
    for _ in range(round(duration / plant.tick)):
        state = plant.step(vented(SPEC))
    assert np.abs(state.com_velocity).max() < 1e-6
    return (state.com - start) @ turn


@pytest.mark.parametrize(("speed", "drag"), [(1.0, 0.0), (0.5, 0.08)])
@pytest.mark.parametrize("name", CASES)
def test_straight_snake_stops_along_and_across(name, speed, drag):
    """Axial drag brakes along the heading only, independently of the load."""
    case = CASES[name]
    plant = plant_of(name, drag)
    inertia = MASS + case.spin_mass
    distance = inertia * speed**2 / (2 * (MU_T * GRAVITY * MASS + drag))
    assert stopped(plant, (speed, 0.0), 2.0) == pytest.approx(
        [distance, 0], rel=case.along, abs=case.sideways
    )
    # With drag μ_t reserved, a wheel that does not roll still has its whole cone
    # across.
    assert stopped(plant, (0.0, -speed)) == pytest.approx(
        [0, -(speed**2) / (2 * MU_N * GRAVITY)], rel=case.across, abs=case.sideways
    )


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


@pytest.mark.parametrize("degrees", [30, 60])
@pytest.mark.parametrize("name", ["wheel", "loaded", "preloaded"])
def test_wheels_stop_at_an_angle_as_a_wheeled_point_does(name, degrees):
    velocity = (math.cos(math.radians(degrees)), math.sin(math.radians(degrees)))
    expected = sliding_wheel(velocity, CASES[name].spin_mass / MASS)
    rel = {"wheel": [0.005] * 2, "loaded": [0.01] * 2, "preloaded": [0.02, 0.03]}[name]
    error = stopped(plant_of(name), velocity, 0.3) / expected - 1
    assert (np.abs(error) < rel).all()


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("degrees", [10, 80])
@pytest.mark.parametrize(
    ("name", "rounding"), [("ellipse", 1e-4), ("skid", 5e-4), ("loaded skid", 1e-5)]
)
def test_skids_stop_at_an_angle_as_a_sliding_point_does(name, rounding, degrees):
    velocity = (math.cos(math.radians(degrees)), math.sin(math.radians(degrees)))
    rel = 0.01 if name == "skid" else 0.005
    assert stopped(plant_of(name), velocity, 0.3) == pytest.approx(
        sliding_skid(velocity), rel=rel, abs=rounding
    )


@pytest.mark.slow
def test_wheels_stopping_within_a_step_get_no_lateral_impulse():
    """By symmetry, the lateral impulse is 0.

    The friction solve has an error of at most 1e-7 of the friction impulse, along the
    wheels.
    """
    plant = plant_of("loaded")
    sideways = [stopped(plant, (0.3 + 0.02 * k, 0.0), 0.7 * k)[1] for k in range(20)]
    assert np.abs(sideways).max() < 1e-10


def test_drag_equals_a_larger_mu_t_under_the_axis_law():
    spec = robot()
    rougher = robot(mu_t=spec.friction.mu_t + 0.08 / (MASS * GRAVITY))
    dragged, rough = (
        rollout(AnalyticalSnake(item), Gait(2.0, offset=0.3), 1.0)
        for item in (robot(drag=0.08), rougher)
    )
    for name in ("com_x", "com_y", "heading"):
        assert dragged[name] == pytest.approx(rough[name], abs=1e-9)
