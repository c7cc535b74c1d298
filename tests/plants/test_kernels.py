"""Kernel of the complete model, compared with an independent form of Newton's law; order of convergence."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp

from srs_twin.plants.analytical import kernels, kinematics
from srs_twin.plants.analytical.floor import (
    Twist,
    connector_friction,
    fill_forces,
    floor_friction,
    forces_and_derivatives,
)
from srs_twin.plants.analytical.kinematics import (
    COS,
    SIN,
    SPIN,
    VX,
    VY,
    BodyParameters,
    X,
    Y,
    pose_body,
)
from srs_twin.plants.analytical.steps import PrescribedState, advance, bend_within
from srs_twin.pneumatics import Trace
from srs_twin.robot import friction
from srs_twin.robot.friction import FRICTION_LAWS
from srs_twin.robot.geometry import body_shape, relative_headings

GRAVITY = 9.81

MARKED_FRICTION_LAWS = [
    pytest.param(
        friction_law,
        marks=[] if friction_law in ("wheel", "cosine") else [pytest.mark.slow],
    )
    for friction_law in FRICTION_LAWS
]
"""Friction laws; one for each of the two ways to add forces belongs to the default tests."""


@dataclass(frozen=True)
class Swim:
    """Masses on constant-curvature segments with prescribed bends, on a floor with friction."""

    mass: tuple[float, ...]
    friction_law: str
    length: float = 0.037
    gap: float = 0.018
    track: float = 0.0
    mu_t: float = 0.05
    mu_n: float = 0.5
    slip: float = 0.02
    amplitude: float = 0.9
    omega: float = 2 * math.pi * 1.5

    def bends(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return bends and rates at times, shape (…, segments); they start at rest."""
        lag = math.pi / 2 * np.arange(len(self.mass) - 1)
        t = np.asarray(t)[..., None]
        rise = 1 - np.exp(-((t / 0.1) ** 2))
        derivative = 200 * t * np.exp(-((t / 0.1) ** 2))
        wave = self.amplitude * np.sin(self.omega * t - lag)
        rate = self.amplitude * self.omega * np.cos(self.omega * t - lag)
        return rise * wave, derivative * wave + rise * rate


def by_kernel(
    swim: Swim, duration: float, step: float, tolerance: float = math.inf
) -> np.ndarray:
    """Return the kernel's final state."""
    return run(swim, duration, step, tolerance)[0]


def run(
    swim: Swim, duration: float, step: float, tolerance: float, across: float = 0.0
) -> tuple[np.ndarray, int]:
    """Return the final state of a body with an initial lateral velocity, and the number of substeps."""
    count = round(duration / step)
    starts = step * np.arange(count)
    stages = np.stack([starts + kernels.GAMMA * step, starts + step], axis=1).ravel()
    bends, rates = swim.bends(np.append(0.0, stages))
    state, derivative = np.zeros((2, kernels.STATES))
    state[kernels.STATE_VY] = across
    mass = np.array(swim.mass)
    solid = BodyParameters.of(mass, np.zeros_like(mass), swim.length, swim.gap)
    floor = floor_friction(
        swim.friction_law, swim.track, swim.mu_t, swim.mu_n, swim.slip
    )
    trace = Trace.empty(len(bends), len(mass) - 1)._replace(bend=bends, bend_rate=rates)
    now = PrescribedState(state, derivative, np.array([0.0, across, 0.0]))
    seen = kernels.Samples(np.empty((0, kernels.STATES)), np.empty((0, 3)))
    steps = np.full(count, step)
    marks = np.empty(0, dtype=int)
    model = kernels.PrescribedModel(solid, floor, True)
    done, substeps = advance(now, steps, trace, marks, model, tolerance, seen)
    assert done == count
    return state, substeps


def by_newton(swim: Swim, duration: float) -> np.ndarray:
    """Integrate Newton's law from rest; return centre of mass and mean heading.

    The moments of m_i r̈_i about the centre of mass equal those of the floor's forces.
    Velocities and accelerations of the shape are time differences.
    """
    mass = np.array(swim.mass)
    h = 1e-4
    contacts = (0.0,) if swim.track == 0 else (swim.track, -swim.track)
    law = getattr(friction, swim.friction_law)

    def shape(t: float) -> tuple[np.ndarray, np.ndarray]:
        bend = swim.bends(t)[0]
        place = body_shape(bend, mass, swim.length, swim.gap)
        return place[:, 0] + 1j * place[:, 1], relative_headings(bend)

    def rates(t: float, y: np.ndarray) -> list[float]:
        (a, p), (b, q), (c, r) = (shape(s) for s in (t - h, t, t + h))
        spin = y[5]
        turn = np.exp(1j * y[2])
        ahead = turn * np.exp(1j * q)
        arm = turn * b
        drift = (c - a) / (2 * h)
        velocity = y[3] + 1j * y[4] + turn * (drift + 1j * spin * b)
        load = mass * GRAVITY / len(contacts)
        total = 0j
        moment = 0.0
        for side in contacts:
            sideways = 1j * side * ahead
            v = (velocity + 1j * (spin + (r - p) / (2 * h)) * sideways) / ahead
            f_t, f_lat, *_ = law(v.real, v.imag, load, swim.mu_t, swim.mu_n, swim.slip)
            force = (f_t + 1j * f_lat) * ahead
            total += force.sum()
            moment += ((arm + sideways).conjugate() * force).imag.sum()
        # r̈_i = r̈ + i α ρ_i + known_i, with α the angular acceleration.
        known = turn * ((c - 2 * b + a) / h**2 + 2j * spin * drift - spin**2 * b)
        moment -= mass @ (arm.conjugate() * known).imag
        push = total / mass.sum()
        return [y[3], y[4], spin, push.real, push.imag, moment / (mass @ abs(arm) ** 2)]

    start = np.zeros(6)
    return solve_ivp(
        rates, (0, duration), start, method="LSODA", rtol=1e-7, atol=1e-9
    ).y[:3, -1]


CASES = {
    "axis_3": Swim((0.03, 0.05, 0.02), "axis"),
    "wheel_3": Swim((0.03, 0.02, 0.06), "wheel", track=0.015),
    "axis_5_gaps": Swim((0.0525, 0.0525, 0.0525, 0.0525, 0.2676), "axis", gap=0.035),
    "wheel_5": Swim((0.03, 0.03, 0.05, 0.03, 0.02), "wheel", track=0.02, gap=0.0),
}


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("name", CASES)
def test_kernel_satisfies_newtons_law(name):
    swim = CASES[name]
    duration = 1.0
    expected = by_newton(swim, duration)
    coarse = by_kernel(swim, duration, 1e-3)[:3]
    fine = by_kernel(swim, duration, 2.5e-4)[:3]
    travelled = np.hypot(*expected[:2])
    assert travelled > 0.01
    assert coarse == pytest.approx(expected, abs=1e-3 * travelled + 1e-4)
    assert fine == pytest.approx(expected, abs=2e-5)


def test_time_integration_has_second_order():
    swim = Swim((0.03, 0.05, 0.02, 0.04), "axis", slip=0.1, mu_t=0.1, mu_n=1.0)
    steps = np.array([2e-3, 1e-3, 5e-4])
    exact = by_kernel(swim, 0.8, 2e-5)
    errors = [np.linalg.norm((by_kernel(swim, 0.8, h) - exact)[:3]) for h in steps]
    order = np.diff(np.log(errors)) / np.diff(np.log(steps))
    assert order == pytest.approx([2, 2], abs=0.2)


def draw(seed: int, connectors: int) -> tuple[BodyParameters, np.ndarray, np.ndarray]:
    """Return a random body, bends and rates."""
    g = np.random.default_rng(seed)
    mass = g.uniform(0.02, 0.1, connectors)
    own = g.uniform(0, 1e-5, connectors)
    bend, rate = g.normal(size=(2, connectors - 1))
    return BodyParameters.of(mass, own, 0.04, 0.02), bend, rate


def posed(solid: BodyParameters, bend: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return the posed body."""
    body = np.empty((kinematics.ROWS, len(solid.mass)))
    pose_body(bend, rate, solid, body)
    return body


@pytest.mark.parametrize("friction_law", MARKED_FRICTION_LAWS)
@pytest.mark.parametrize("track", [0.0, 0.02])
def test_floor_force_derivatives_match_finite_differences(friction_law, track):
    solid, bend, rate = draw(2, 4)
    body = posed(solid, bend, rate)
    u = np.array([0.2, -0.1, 1.5])
    floor = floor_friction(friction_law, track, 0.1, 0.6, 0.05)

    def total(v: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        f = forces_and_derivatives(body, solid.mass, Twist(*v), floor)
        derivatives = [[f.xx, f.xy, f.xz], [f.yx, f.yy, f.yz], [f.zx, f.zy, f.zz]]
        return np.array([f.x, f.y, f.moment]), np.array(derivatives), f.power

    net, derivative, power = total(u)
    h = 1e-6 * np.eye(3)
    result = [(total(u + d)[0] - total(u - d)[0]) / 2e-6 for d in h]
    assert derivative == pytest.approx(np.transpose(result), abs=1e-6)
    # The same forces one connector at a time: their sum, their moment and the power
    # they take.
    force = np.empty((4, 3))
    fill_forces(body, solid.mass, u, floor, force)
    turn = body[COS] + 1j * body[SIN]
    pushed = (force[:, 0] + 1j * force[:, 1]) * turn
    place = body[X] + 1j * body[Y]
    own = body[VX] + 1j * body[VY]
    velocity = u[0] + 1j * u[1] + 1j * u[2] * place + own
    spin = u[2] + body[SPIN]
    assert net[:2] == pytest.approx([pushed.sum().real, pushed.sum().imag], abs=1e-14)
    assert net[2] == pytest.approx(
        (place.conjugate() * pushed).imag.sum() + force[:, 2].sum(), abs=1e-14
    )
    contact_power = (velocity.conjugate() * pushed).real.sum() + (
        force[:, 2] * spin
    ).sum()
    assert power == pytest.approx(-contact_power, rel=1e-12) and power > 0


@pytest.mark.parametrize("friction_law", MARKED_FRICTION_LAWS)
@pytest.mark.parametrize("track", [0.0, 0.02])
def test_floor_evaluates_the_named_law(friction_law, track):
    """A law without a kernel must not select another law."""

    @njit
    def compiled(along, across, spin, floor):
        return connector_friction(along, across, spin, 2.0, floor)

    along = 0.2
    across = -0.1
    spin = 3.0
    contacts = (0.0,) if track == 0 else (-track, track)
    force = np.zeros(2)
    moment = 0.0
    for arm in contacts:
        pushed = getattr(friction, friction_law)(
            along + spin * arm, across, 2.0 / len(contacts), 0.1, 0.6, 0.05
        )[:2]
        force = force + pushed
        moment = moment + arm * pushed[0]
    actual = compiled(
        along, across, spin, floor_friction(friction_law, track, 0.1, 0.6, 0.05)
    )
    assert actual[:3] == pytest.approx([*force, moment], rel=1e-12)


def test_posed_rates_match_finite_differences():
    solid, bend, rate = draw(3, 5)
    now, before, after = (
        posed(solid, bend + h * rate, rate) for h in (0.0, -1e-6, 1e-6)
    )
    difference = (after - before) / 2e-6
    turning = now[COS] * difference[SIN] - now[SIN] * difference[COS]
    assert now[SPIN] == pytest.approx(turning, abs=1e-8)
    assert now[VX : VY + 1] == pytest.approx(difference[X : Y + 1], abs=1e-9)
    inertia, moment = pose_body(bend, rate, solid, now)
    place = now[X : Y + 1]
    own = solid.inertia
    assert inertia == pytest.approx((solid.mass * (place**2).sum(axis=0) + own).sum())
    cross = now[X] * now[VY] - now[Y] * now[VX]
    assert moment == pytest.approx((solid.mass * cross + own * now[SPIN]).sum())


def test_mean_heading_is_zero_for_a_coil_of_several_turns():
    """With 1 rad in each of 40 segments, the head is 20 rad, three turns, ahead of the mean heading."""
    bend = np.ones(40)
    solid = BodyParameters.of(np.full(41, 0.03), np.zeros(41), 0.04, 0.02)
    body = posed(solid, bend, 0 * bend)
    phi = relative_headings(bend)
    assert body[COS] == pytest.approx(np.cos(phi), abs=1e-12)
    assert body[SIN] == pytest.approx(np.sin(phi), abs=1e-12)
    place = body_shape(bend, solid.mass, solid.length, solid.gap)
    assert pytest.approx(place, abs=1e-12) == body[X : Y + 1].T


def test_frozen_chords_have_the_straight_length():
    solid, bend, rate = draw(4, 5)
    now = posed(solid._replace(frozen=1.0), bend, rate)
    ahead, after = (
        posed(solid._replace(frozen=1.0), bend + h * rate, rate) for h in (-1e-6, 1e-6)
    )
    links = np.diff(now[X : Y + 1], axis=1)
    assert np.hypot(*links) == pytest.approx([0.06] * 4)
    assert now[VX : VY + 1] == pytest.approx(
        (after - ahead)[X : Y + 1] / 2e-6, abs=1e-9
    )
    # Along the mean of the two headings, as the arcs' chords.
    whole = posed(solid, bend, rate)
    arcs = np.diff(whole[X : Y + 1], axis=1)
    assert np.arctan2(*links) == pytest.approx(np.arctan2(*arcs), abs=1e-12)


TOLERANCE = 0.0002  # m/s, the default


def test_smooth_friction_needs_no_substeps_and_keeps_the_order():
    swim = Swim((0.03, 0.05, 0.02, 0.04), "viscous", mu_t=1.0, mu_n=10.0)
    exact = by_kernel(swim, 0.8, 2e-5)
    errors = []
    for step in (2e-3, 1e-3, 5e-4):
        state, substeps = run(swim, 0.8, step, TOLERANCE)
        assert substeps == round(0.8 / step)
        errors.append(np.linalg.norm((state - exact)[:3]))
    assert np.diff(np.log(errors)) / np.log(0.5) == pytest.approx([2, 2], abs=0.2)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("speed", [0.05, 0.0633, 0.11, 0.173])
def test_stop_within_a_step_has_the_exact_position(speed):
    """v̇ = −μ g v/√(v² + ε²) from v₀ to rest: μ g s = ½ [v₀ √(v₀² + ε²) + ε² asinh(v₀/ε)]."""
    swim = Swim((0.03,) * 4, "axis", amplitude=0.0, slip=0.00025)
    root = math.hypot(speed, swim.slip)
    distance = (speed * root + swim.slip**2 * math.asinh(speed / swim.slip)) / (
        2 * swim.mu_n * GRAVITY
    )
    state, substeps = run(swim, 0.2, 5e-3, TOLERANCE, speed)
    assert state[kernels.STATE_Y] == pytest.approx(distance, abs=2e-6)
    assert substeps < 2 * 40
    # The energy that the floor took is that of the throw.
    assert state[kernels.ENERGY_LOSS] == pytest.approx(0.06 * speed**2, rel=2e-3)


def test_substeps_reduce_the_error_where_friction_reverses():
    """The same longest step with and without substeps, compared with steps of 10 µs over many kinks."""
    whole = []
    cut = []
    for amplitude in (0.7, 0.8, 0.9, 1.0, 1.1):
        swim = Swim((0.03,) * 5, "axis", slip=0.00025, amplitude=amplitude)
        exact = by_kernel(swim, 1.0, 1e-5)[:2]
        whole.append(by_kernel(swim, 1.0, 2e-3)[:2] - exact)
        state, substeps = run(swim, 1.0, 2e-3, TOLERANCE)
        cut.append(state[:2] - exact)
        assert 500 < substeps < 1500
    assert np.linalg.norm(cut) < np.linalg.norm(whole) / 3


def test_bends_between_stages_are_cubic_polynomials():
    def cubic(t: float) -> np.ndarray:
        return np.array([1 + t - 3 * t**2 + 2 * t**3, t**3])

    def rate(t: float) -> np.ndarray:
        return np.array([1 - 6 * t + 6 * t**2, 3 * t**2])

    h = 0.3
    at = (0.0, kernels.GAMMA * h, h)
    bends = np.array([cubic(t) for t in at])
    rates = np.array([rate(t) for t in at])
    for fraction in (0.0, 0.1, kernels.GAMMA, 0.5, 0.9, 1.0):
        out = kernels.Bends(np.empty((1, 2)), np.empty((1, 2)))
        bend_within(fraction, h, kernels.Bends(bends, rates), out, 0)
        assert out.bend[0] == pytest.approx(cubic(fraction * h), abs=1e-14)
        assert out.rate[0] == pytest.approx(rate(fraction * h), abs=1e-13)
