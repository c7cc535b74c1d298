"""Friction laws: derivatives, dissipation, cones, limits, and the wheel law against a simulated wheel."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st
from numba import njit

from srs_twin.robot import friction

pytestmark = pytest.mark.fast

FRICTION_LAWS = {name: getattr(friction, name) for name in friction.FRICTION_LAWS}
LOAD = 0.3
SPEED = st.floats(-1, 1, allow_subnormal=False)
MU = st.floats(0, 1.2, allow_subnormal=False)
SLIP = st.floats(1e-4, 0.1)
EACH_FRICTION_LAW = pytest.mark.parametrize(
    "friction_law", FRICTION_LAWS.values(), ids=FRICTION_LAWS
)


def forces(friction_law, v_t, v_lat, mu_t, mu_n, slip=1e-3):
    return friction_law(v_t, v_lat, LOAD, mu_t, mu_n, slip)[:2]


@EACH_FRICTION_LAW
@given(v_t=SPEED, v_lat=SPEED, mu_t=MU, mu_n=MU, slip=SLIP)
def test_derivatives_match_finite_differences(
    friction_law, v_t, v_lat, mu_t, mu_n, slip
):
    # The wheel law has kinks at the transition from rolling to skidding and at v_t = 0.
    fraction = mu_n * abs(v_t) / math.sqrt(v_t**2 + v_lat**2 + slip**2)
    assume(
        friction_law is not friction.wheel
        or (abs(fraction - mu_t) > 1e-3 and (fraction < mu_t or abs(v_t) > 1e-3))
    )
    h = 1e-5 * slip
    derivatives = friction_law(v_t, v_lat, LOAD, mu_t, mu_n, slip)[2:]
    ahead = forces(friction_law, v_t + h, v_lat, mu_t, mu_n, slip)
    behind = forces(friction_law, v_t - h, v_lat, mu_t, mu_n, slip)
    left = forces(friction_law, v_t, v_lat + h, mu_t, mu_n, slip)
    right = forces(friction_law, v_t, v_lat - h, mu_t, mu_n, slip)
    steepest = LOAD * max(mu_t, mu_n) / slip
    differences = [
        (ahead[0] - behind[0]) / (2 * h),
        (left[0] - right[0]) / (2 * h),
        (ahead[1] - behind[1]) / (2 * h),
        (left[1] - right[1]) / (2 * h),
    ]
    assert derivatives == pytest.approx(differences, abs=1e-5 * steepest + 1e-7)


@EACH_FRICTION_LAW
@given(v_t=SPEED, v_lat=SPEED, mu_t=MU, mu_n=MU, slip=SLIP)
def test_friction_never_does_positive_work(friction_law, v_t, v_lat, mu_t, mu_n, slip):
    f_t, f_lat = forces(friction_law, v_t, v_lat, mu_t, mu_n, slip)
    assert f_t * v_t <= 0
    assert f_lat * v_lat <= 0


@EACH_FRICTION_LAW
@given(v_t=SPEED, v_lat=SPEED, mu_t=MU, mu_n=MU)
def test_reversed_motion_reverses_the_force(friction_law, v_t, v_lat, mu_t, mu_n):
    there = forces(friction_law, v_t, v_lat, mu_t, mu_n)
    back = forces(friction_law, -v_t, -v_lat, mu_t, mu_n)
    assert back == pytest.approx([-f for f in there], abs=1e-15)


@given(v_t=SPEED, v_lat=SPEED, mu_t=MU, mu_n=MU, slip=SLIP)
def test_axis_law_stays_in_its_box_and_wheel_law_in_its_cone(
    v_t, v_lat, mu_t, mu_n, slip
):
    f_t, f_lat = forces(friction.axis, v_t, v_lat, mu_t, mu_n, slip)
    assert abs(f_t) <= LOAD * mu_t * (1 + 1e-12)
    assert abs(f_lat) <= LOAD * mu_n * (1 + 1e-12)
    f_t, f_lat = forces(friction.wheel, v_t, v_lat, mu_t, mu_n, slip)
    assert math.hypot(f_t, f_lat) <= LOAD * mu_n * (1 + 1e-12)
    assert abs(f_t) <= LOAD * mu_t * (1 + 1e-12)


@given(SPEED, SPEED, MU, SLIP, st.floats(1, 3))
def test_wheel_with_a_locked_axle_slides_isotropically(v_t, v_lat, mu_n, slip, excess):
    f_t, f_lat = forces(friction.wheel, v_t, v_lat, mu_n * excess, mu_n, slip)
    speed = math.sqrt(v_t**2 + v_lat**2 + slip**2)
    assert (f_t, f_lat) == pytest.approx(
        (-LOAD * mu_n * v_t / speed, -LOAD * mu_n * v_lat / speed), abs=1e-12
    )


def test_wheel_law_is_continuous_where_rolling_begins():
    mu_t = 0.1
    mu_n = 0.6
    slip = 1e-3
    v_lat = 0.2
    edge = mu_t * math.sqrt((v_lat**2 + slip**2) / (mu_n**2 - mu_t**2))
    below, above = (
        forces(friction.wheel, edge * k, v_lat, mu_t, mu_n, slip)
        for k in (1 - 1e-9, 1 + 1e-9)
    )
    assert below == pytest.approx(above, rel=1e-7)
    assert below[0] == pytest.approx(-LOAD * mu_t, rel=1e-7)


def spinning_wheel(
    v_t: float, v_lat: float, mu_t: float, mu_n: float
) -> tuple[float, float]:
    """Return the steady floor force on a wheel towed at v_t along and v_n across, N.

    The wheel spins with Coulomb friction in its axle, and its contact slides
    isotropically. The spin is integrated from rest to its steady state.
    """
    radius = 0.01
    inertia = 2e-7
    step = 2e-5
    tiny = 1e-3
    rim = 0.0  # ω R
    for _ in range(40_000):
        creep = v_t - rim
        slide = math.sqrt(creep**2 + v_lat**2 + tiny**2)
        f_t = -mu_n * LOAD * creep / slide
        f_lat = -mu_n * LOAD * v_lat / slide
        # The floor force changes the spin; the axle friction opposes the spin or locks
        # the wheel.
        turning = rim - step * f_t * radius**2 / inertia
        drag = step * mu_t * LOAD * radius**2 / inertia
        after = math.copysign(max(abs(turning) - drag, 0.0), turning)
        if abs(after - rim) < 1e-12:
            break
        rim = after
    return f_t, f_lat


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("mu_t", [0.043, 0.3, 0.9])
@pytest.mark.parametrize(
    ("v_t", "v_lat"),
    [
        (0.3, 0.0),
        (0.3, 0.1),
        (0.1, 0.3),
        (-0.1, 0.3),
        (0.01, 0.3),
        (0.05, -0.05),
        (0.2, 0.01),
    ],
)
def test_wheel_law_equals_a_simulated_spinning_wheel(v_t, v_lat, mu_t):
    mu_n = 0.57
    expected = spinning_wheel(v_t, v_lat, mu_t, mu_n)
    force = forces(friction.wheel, v_t, v_lat, mu_t, mu_n, 1e-4)
    assert force == pytest.approx(expected, abs=0.005 * LOAD * mu_n)


@given(st.floats(-3.2, 3.2), st.floats(0.02, 1.2), st.floats(0.02, 1.2))
def test_ellipse_law_has_maximum_dissipation(angle, mu_t, mu_n):
    v = 0.3 * np.array([math.cos(angle), math.sin(angle)])
    taken = -np.dot(forces(friction.ellipse, *v, mu_t, mu_n, 1e-8), v)
    turn = np.linspace(0, 2 * np.pi, 721)
    rim = LOAD * np.array([mu_t * np.cos(turn), mu_n * np.sin(turn)])
    assert (-v @ rim).max() == pytest.approx(taken, rel=1e-4)
    assert (-v @ rim).max() <= taken * (1 + 1e-9)


@given(SPEED, MU, st.floats(0, 1), SLIP)
def test_ellipse_law_along_its_longer_axis_is_the_axis_law(v, greater, fraction, slip):
    """The slip speed applies to the larger coefficient."""
    for velocity, mu in (
        ((v, 0.0), (greater, fraction * greater)),
        ((0.0, v), (fraction * greater, greater)),
    ):
        assert forces(friction.ellipse, *velocity, *mu, slip) == pytest.approx(
            forces(friction.axis, *velocity, *mu, slip), abs=1e-12
        )


def test_axis_and_viscous_laws_at_the_slip_speed():
    slip = 0.02
    coulomb = LOAD * np.array([-0.1, 0.5])
    assert forces(friction.axis, slip, -slip, 0.1, 0.5, slip) == pytest.approx(
        coulomb / math.sqrt(2)
    )
    assert forces(friction.viscous, slip, -slip, 0.1, 0.5) == pytest.approx(
        coulomb * slip
    )


@pytest.mark.parametrize(
    ("mu_t", "mu_n", "times"),
    [(0.043, 0.57, 3.69), (0.0966, 0.68, 2.13)],
    ids=["gen2", "gen1, measured"],
)
def test_skid_has_less_axial_drag_than_the_axis_law_at_15_degrees_of_slip(
    mu_t, mu_n, times
):
    velocity = (0.1 * math.cos(math.pi / 12), 0.1 * math.sin(math.pi / 12))
    axis, ellipse = (
        forces(friction_law, *velocity, mu_t, mu_n, 1e-6)[0]
        for friction_law in (friction.axis, friction.ellipse)
    )
    assert axis / ellipse == pytest.approx(times, abs=0.01)


@EACH_FRICTION_LAW
def test_zero_coefficients_give_zero_force(friction_law):
    for v in ((0.1, -0.2), (0.0, 0.0)):
        assert list(friction_law(*v, LOAD, 0.0, 0.0, 1e-3)) == pytest.approx(
            [0] * 6, abs=1e-15
        )
        force = friction_law(*v, LOAD, 0.0, 0.5, 1e-3)
        assert np.isfinite(force).all() and force[0] == pytest.approx(0, abs=1e-15)


@EACH_FRICTION_LAW
@given(v_t=SPEED, v_lat=SPEED, mu_t=MU, mu_n=MU, slip=SLIP)
def test_mixed_derivatives_are_equal_except_of_cosine(
    friction_law, v_t, v_lat, mu_t, mu_n, slip
):
    """Other laws have a potential; the kernels store only one of their two mixed derivatives."""
    _, _, _, t_by_n, n_by_t, _ = friction_law(v_t, v_lat, LOAD, mu_t, mu_n, slip)
    fraction_t, fraction_n = (
        (mu_n, mu_t) if friction_law is friction.cosine else (1.0, 1.0)
    )
    assert fraction_t * t_by_n == pytest.approx(
        fraction_n * n_by_t, rel=1e-12, abs=1e-15
    )


@given(v_t=SPEED, v_lat=SPEED, mu=MU, slip=SLIP)
def test_laws_of_isotropic_skin_agree(v_t, v_lat, mu, slip):
    assert forces(friction.cosine, v_t, v_lat, mu, mu, slip) == pytest.approx(
        forces(friction.ellipse, v_t, v_lat, mu, mu, slip), rel=1e-9, abs=1e-12
    )


@given(
    angle=st.floats(0, 2 * math.pi),
    mu_t=st.floats(0.05, 1),
    mu_n=st.floats(0.05, 1),
    slip=SLIP,
)
def test_skin_stays_in_its_friction_ellipse_and_reaches_it(angle, mu_t, mu_n, slip):
    for name in friction.SKIN_LAWS:

        def filled(slip, friction_law=FRICTION_LAWS[name]):
            velocity = (math.cos(angle), math.sin(angle))
            f_t, f_lat = forces(friction_law, *velocity, mu_t, mu_n, slip)
            return math.hypot(f_t / mu_t, f_lat / mu_n) / LOAD

        assert filled(slip) < 1
        assert filled(1e-9) == pytest.approx(1, rel=1e-9)


@EACH_FRICTION_LAW
def test_compiled_scalars_equal_arrays(friction_law):
    v_t, v_lat = np.random.default_rng(1).uniform(-0.1, 0.1, size=(2, 20))
    whole = friction_law(v_t, v_lat, LOAD, 0.1, 0.5, 1e-2)
    scalar = njit(friction_law)
    for k in range(20):
        assert [part[k] for part in whole] == pytest.approx(
            scalar(v_t[k], v_lat[k], LOAD, 0.1, 0.5, 1e-2)
        )
