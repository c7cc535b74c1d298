"""Rigid-body motion of a pushed snake: statics, momentum and friction against their laws."""

from dataclasses import replace

import numpy as np
import pytest

from srs_twin import load_robot
from srs_twin.live.pushed_body import PushedBody
from srs_twin.robot.spec import GRAVITY

GEN2 = load_robot("gen2")
SMOOTH = replace(GEN2, friction=replace(GEN2.friction, mu_t=0.0, mu_n=0.0))
N = GEN2.segments
PITCH = GEN2.geometry.pitch
SAMPLE_S = 0.02
PERIOD = 25
STATIONS = np.linspace(0.0, GEN2.geometry.body_length, 9)
WAVE = 0.8 * np.sin(
    2 * np.pi * np.arange(PERIOD)[:, None] / PERIOD - np.pi / 2 * np.arange(N)
)
STRAIGHT = np.zeros((PERIOD, N))


def pushed(body, force, station, samples=1, start=0):
    """Return velocities and moments after a push from the free motion."""
    u = body.free_velocity[(start - 1) % PERIOD][None]
    for k in range(start, start + samples):
        u, moment = body.step(k, u, np.array([force]), np.array([station]))
    return u[0], moment[0]


def test_moments_of_a_force_on_a_free_chain_match_a_sum_over_the_connectors():
    """A force on the first connector of a straight chain without friction."""
    _, moment = pushed(PushedBody(SMOOTH, STRAIGHT, SAMPLE_S, STATIONS), 0.01, 0)
    x = PITCH * (N / 2 - np.arange(N + 1))
    mass = GEN2.mass.array()
    total = GEN2.mass.total
    gyration = GEN2.yaw_inertia()
    inertia = float(mass @ x**2 + gyration.sum())
    acceleration = 1 / total + x * x[0] / inertia
    for j in range(N):
        front = slice(0, j + 1)
        cut = x[j] - PITCH / 2
        expected = (x[0] - cut) - (
            mass[front] * acceleration[front] * (x[front] - cut)
        ).sum()
        expected -= gyration[front].sum() * x[0] / inertia
        assert moment[j] == pytest.approx(0.01 * expected, rel=1e-3)


def test_momentum_of_a_snake_without_friction_is_the_impulse():
    u, _ = pushed(PushedBody(SMOOTH, STRAIGHT, SAMPLE_S, STATIONS), 0.3, 4, samples=10)
    np.testing.assert_allclose(
        u, [0.0, 0.3 * 10 * SAMPLE_S / GEN2.mass.total, 0.0], atol=1e-9
    )


def test_friction_holds_a_small_force_and_yields_to_a_large_one():
    """A force at the middle of a straight snake, across all wheels."""
    body = PushedBody(GEN2, STRAIGHT, SAMPLE_S, STATIONS)
    holding = (
        np.sqrt(GEN2.friction.mu_n**2 - GEN2.friction.mu_t**2)
        * GEN2.mass.total
        * GRAVITY
    )
    u, _ = pushed(body, 0.8 * holding, 4, samples=20)
    assert 0.0 < u[1] < 0.01
    # Once it slides, the friction of the cone, μ_n, acts against a constant force.
    before, after = (
        pushed(body, 2 * holding, 4, samples)[0][1] for samples in (10, 20)
    )
    acceleration = 2 * holding / GEN2.mass.total - GEN2.friction.mu_n * GRAVITY
    assert after - before == pytest.approx(10 * SAMPLE_S * acceleration, rel=1e-3)


def test_motion_mirrors_with_the_body():
    left, right = (
        PushedBody(GEN2, sign * WAVE, SAMPLE_S, STATIONS) for sign in (1, -1)
    )
    (u, moment), (v, opposite) = (
        pushed(left, 0.5, 2, 8, 3),
        pushed(right, -0.5, 2, 8, 3),
    )
    np.testing.assert_allclose(u * [1, -1, -1], v, atol=1e-9)
    np.testing.assert_allclose(moment, -opposite, atol=1e-9)


def test_free_motion_is_periodic_and_crawls_forward():
    body = PushedBody(GEN2, WAVE, SAMPLE_S, STATIONS)
    u, _ = pushed(body, 0.0, 0, samples=PERIOD)
    np.testing.assert_allclose(u, body.free_velocity[(PERIOD - 1) % PERIOD], atol=2e-3)
    assert body.free_velocity[:, 0].mean() > 0.05
