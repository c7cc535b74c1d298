"""Loaded contact: compared with an explicit simulation that has its own MJCF and law, and with laws."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st
from load_reference import (
    POINTS,
    SLIPS_M_S,
    STEP_FRACTIONS_S2_M,
    Result,
    extrapolate,
    simulate,
    stored,
)
from snakes import GRAVITY, robot
from subsets import first_by_default
from twin_at_reference import crawled

from srs_twin import (
    AnalyticalSnake,
    InputError,
    LoadedContact,
    PreloadedContact,
    TwinSnake,
)
from srs_twin.plants.twin.friction_solve import _friction_law, _friction_load
from srs_twin.plants.twin.mjcf.numerics import LAWS_ON_LOADS, LOADS
from srs_twin.plants.twin.stick_slip import (
    FloorLaw,
    rolling_friction,
    stick_slip_friction,
)
from srs_twin.robot import friction
from srs_twin.robot.friction import ellipse, wheel
from srs_twin.robot.spec import Friction, Tail

SPEC = robot()
LOAD = 0.3
SPEED = st.floats(-1, 1, allow_subnormal=False)
MU = st.floats(0.01, 1.0)


def wheel_law(mu_t: float, mu_n: float, slip: float) -> FloorLaw:
    return FloorLaw(
        friction_law_index=LAWS_ON_LOADS.index("wheel"),
        forward=mu_t,
        across=mu_n,
        slip_speed=slip,
        spin_mass=1e-12,
        backward=mu_t,
    )


@given(v_t=SPEED, v_lat=SPEED, mu_t=MU, mu_n=MU, at=st.floats(0, 6.3))
def test_fast_contact_follows_the_ellipse_and_resting_contact_keeps_its_force(
    v_t, v_lat, mu_t, mu_n, at
):
    assume(abs(v_t) > 1e-3 and abs(v_lat) > 1e-3)
    p_t = 0.99 * LOAD * mu_t * math.cos(at)
    p_n = 0.99 * LOAD * mu_n * math.sin(at)
    assert stick_slip_friction(0.0, 0.0, LOAD, mu_t, mu_n, 1e-3, p_t, p_n)[
        :2
    ] == pytest.approx((p_t, p_n), rel=1e-12)
    assert stick_slip_friction(v_t, v_lat, LOAD, mu_t, mu_n, 1e-9, p_t, p_n)[
        :2
    ] == pytest.approx(
        ellipse(v_t, v_lat, LOAD, mu_t, mu_n, 0.0)[:2],
        rel=1e-3,
        abs=1e-3 * LOAD * max(mu_t, mu_n),
    )


@given(
    v_t=SPEED, v_lat=SPEED, rim=SPEED, mu_t=MU, mu_n=MU, lag=st.floats(1e-3, 10), p=MU
)
def test_rim_speed_balances_contact_and_axle(v_t, v_lat, rim, mu_t, mu_n, lag, p):
    push = (p * LOAD, -p * LOAD)
    friction_law = wheel_law(mu_t, mu_n, 1e-3)
    (f_t, f_lat, *_), w = rolling_friction(
        v_t, v_lat, LOAD, friction_law, *push, rim, lag
    )
    assert math.hypot(f_t, f_lat) <= mu_n * LOAD * (1 + 1e-12)
    drag = -f_t - lag * (w - rim)  # what the axle takes
    assert abs(drag) <= mu_t * LOAD * (1 + 1e-6)
    if w != 0:
        assert drag == pytest.approx(math.copysign(mu_t * LOAD, w), rel=1e-6)
    # With a rim at rest and no force from before friction only takes power.
    (f_t, f_lat, *_), _ = rolling_friction(
        v_t, v_lat, LOAD, friction_law, 0.0, 0.0, 0.0, lag
    )
    assert f_t * v_t + f_lat * v_lat <= 1e-15


@given(v_t=SPEED, v_lat=SPEED, mu_n=MU, fraction=st.floats(0.01, 0.9))
def test_wheel_without_inertia_follows_the_wheel_law(v_t, v_lat, mu_n, fraction):
    assume(abs(v_lat) > 1e-3 and abs(v_t) > 1e-3)
    slip = 1e-6
    expected = wheel(v_t, v_lat, LOAD, fraction * mu_n, mu_n, slip)[:2]
    friction_law = wheel_law(fraction * mu_n, mu_n, slip)
    traction, _ = rolling_friction(v_t, v_lat, LOAD, friction_law, 0.0, 0.0, 0.0, 1e-12)
    assert traction[:2] == pytest.approx(expected, abs=1e-4 * LOAD)


@pytest.mark.parametrize("friction_law", LAWS_ON_LOADS)
@given(v_t=SPEED, v_lat=SPEED, mu_n=MU, fraction=st.floats(0.01, 0.9))
def test_sliding_contact_follows_the_law_of_its_name(
    friction_law, v_t, v_lat, mu_n, fraction
):
    """A law without a branch of its own in the friction solve would run as another one."""
    assume(abs(v_lat) > 1e-3 and abs(v_t) > 1e-3)
    slip = 1e-6
    mu_t = fraction * mu_n
    expected = getattr(friction, friction_law)(v_t, v_lat, LOAD, mu_t, mu_n, slip)[:2]
    contact = SimpleNamespace(
        wheels=1,
        floor=wheel_law(mu_t, mu_n, slip)._replace(
            friction_law_index=LAWS_ON_LOADS.index(friction_law)
        ),
    )
    traction, _ = _friction_law.py_func(
        contact, 0, v_t, v_lat, LOAD, (0.0, 0.0, 0.0), 0.0, 1.0
    )
    assert traction[:2] == pytest.approx(expected, abs=1e-4 * LOAD)


@pytest.mark.default_cases(at=[0, 21, 38])
@pytest.mark.parametrize("slip", [1e-2, 10.0])  # slides; sticks
@pytest.mark.parametrize("seed", range(20))
def test_rolling_friction_derivatives_match_finite_differences(seed, slip):
    v_t, v_lat, rim, mu_t, mu_n, p_t, p_n = np.random.default_rng(seed).uniform(
        [-1, -1, -1, 0.01, 0.1, -0.1, -0.1], [1, 1, 1, 0.1, 1, 0.1, 0.1]
    )
    step = 1e-7
    arguments = (LOAD, wheel_law(mu_t, mu_n, slip), p_t, p_n, rim, 0.5)
    here, _ = rolling_friction(v_t, v_lat, *arguments)
    ahead, _ = rolling_friction(v_t + step, v_lat, *arguments)
    behind, _ = rolling_friction(v_t - step, v_lat, *arguments)
    left, _ = rolling_friction(v_t, v_lat + step, *arguments)
    right, _ = rolling_friction(v_t, v_lat - step, *arguments)
    found = [(ahead[k] - behind[k]) / (2 * step) for k in (0, 1)] + [
        (left[1] - right[1]) / (2 * step)
    ]
    assert found == pytest.approx(here[2:], rel=1e-4, abs=1e-6)


def assert_close(twin: Result, speed: float, yaw_rate: float, drift: float) -> None:
    assert twin.speed_mm_s == pytest.approx(speed, rel=0.01)
    assert twin.yaw_rate == pytest.approx(yaw_rate, rel=0.02, abs=drift)


@given(
    limit=st.floats(1, 300),
    derivative=st.floats(-10, 10),
    order=st.floats(0.5, 1),
    step=st.floats(-10, 10),
)
def test_extrapolation_is_exact_for_a_power_of_the_slip_speed(
    limit, derivative, order, step
):
    values = [
        [limit + derivative * e**order + step * e * s for s in (0.1, 0.05)]
        for e in (8.0, 4.0, 2.0, 1.0)
    ]
    found, error = extrapolate(values)
    assert found == pytest.approx(limit, abs=1e-6)
    assert error == pytest.approx(abs(0.05 * step), abs=1e-6)


@pytest.mark.slow
def test_transient_agrees_with_the_explicit_simulation():
    twin = crawled("gen2_straight", 2, contact="loaded")
    explicit = simulate(POINTS["gen2_straight"], 2)
    assert_close(twin, explicit.speed_mm_s, explicit.yaw_rate, drift=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gen2_turn", "gen1_straight", "gen3_straight"])
def test_stored_values_are_current(name):
    slip = SLIPS_M_S[0]
    result = simulate(POINTS[name], None, STEP_FRACTIONS_S2_M[0] * slip, slip)
    runs = stored()[name]
    assert result.speed_mm_s == pytest.approx(runs.speed_mm_s[0][0], rel=1e-3)
    assert result.yaw_rate == pytest.approx(runs.yaw_rate[0][0], rel=2e-3, abs=1e-3)


FIRST_POINTS = [
    "gen2_turn",
    "stiff_bend",
    "gen1_turn_damped",
    "gen3_straight",
    "gen4_turn_damped",
]
OTHER_POINTS = [
    name
    for name, point in POINTS.items()
    if point.tail is None and name not in FIRST_POINTS
]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", first_by_default(len(FIRST_POINTS), FIRST_POINTS + OTHER_POINTS)
)
def test_every_point_agrees_with_the_explicit_simulation(name):
    # This one turns 2.8 % too fast at 1 ms and 0.5 % at half of it.
    step = 0.0005 if name == "stiff_slow_turn" else 0.001
    twin = crawled(name, None, step, contact="loaded")
    runs = stored()[name]
    assert_close(twin, runs.speed[0], runs.yaw[0], drift=2e-3)
    assert twin.swing == pytest.approx(runs.swing, rel=0.1)
    assert abs(twin.ripple - runs.ripple) < 0.02
    assert abs(twin.air - runs.air) < 0.02


@pytest.mark.slow
def test_a_tail_on_two_axles_lifts_as_in_the_explicit_simulation():
    """Speeds converge to first order in the step: 1 ms is 1.2 % too fast, 0.5 ms is 0.6 %."""
    runs = stored()["gen3_tail"]
    speed = runs.speed[0]
    twin, fine = (
        crawled("gen3_tail", None, step, contact="loaded") for step in (0.001, 0.0005)
    )
    assert twin.air > 0.05
    assert 2 * fine.speed_mm_s - twin.speed_mm_s == pytest.approx(speed, rel=0.005)
    assert abs(fine.speed_mm_s - speed) < 0.6 * abs(twin.speed_mm_s - speed)
    assert abs(twin.air - runs.air) < 0.02


TAIL = Tail(axle=0.06, com=0.045, com_height=0.025, gyration=0.025)


def test_static_loads_of_a_two_axle_tail_follow_the_levers():
    spec = replace(robot("gen3"), tail=TAIL)
    plant = TwinSnake(spec, contact="loaded")
    state = plant.step(np.full((3, spec.segments, 2), -1))
    tail = spec.mass.connectors[-1] * GRAVITY
    assert plant.physics.wheel_loads()[-2:].sum(axis=1) == pytest.approx(
        [0.25 * tail, 0.75 * tail], rel=0.01
    )
    assert state.contact_force.shape == (spec.geometry.connectors, 2)


def test_spinning_snake_decelerates_by_the_lever_of_its_axles():
    spec = replace(robot("gen3"), tail=TAIL, friction=Friction(mu_t=0.5, mu_n=0.5))
    plant = TwinSnake(spec, contact=LoadedContact("ellipse"), tick=0.001)
    physics = plant.physics
    data = plant.physics.data
    axles = physics.connector_positions()[
        [axle.connector - 1 for axle in spec.axles], 0
    ]
    levers = axles - [axle.behind for axle in spec.axles] - physics.center_of_mass()[0]
    root = data.qpos[0] - physics.center_of_mass()[0]
    data.qvel[[1, 5]] = 10.0 * root, 10.0
    physics.refresh()
    before = float(data.subtree_angmom[0, 2])
    plant.step(np.full((spec.segments, 2), -1))
    physics.refresh()
    force = physics.floor_forces()
    side = spec.geometry.half_track * np.array([1, -1])
    moment = (levers[:, None] * force[..., 1] - side * force[..., 0]).sum()
    assert data.subtree_angmom[0, 2] - before == pytest.approx(0.001 * moment, rel=1e-3)
    assert moment < -0.1


@pytest.mark.parametrize(
    "plant", [partial(TwinSnake, contact="preloaded"), AnalyticalSnake]
)
def test_tail_on_two_axles_needs_loaded_contact(plant):
    with pytest.raises(InputError, match="tail"):
        plant(replace(robot("gen3"), tail=TAIL))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gen2_turn", "stiff_turn"])
def test_half_the_time_step_gives_the_same_result(name):
    coarse, fine = (
        crawled(name, 4, step, contact="loaded") for step in (0.001, 0.0005)
    )
    assert coarse.speed_mm_s == pytest.approx(fine.speed_mm_s, rel=0.01)
    assert coarse.yaw_rate == pytest.approx(fine.yaw_rate, rel=0.02)


def test_spinning_up_wheels_does_not_pitch_the_snake():
    # Thrown along with wheels at rest, the floor's force F at the hubs and the
    # bearings' drag tip it forward.
    plant = TwinSnake(SPEC, contact="loaded", tick=0.004)
    g = SPEC.geometry
    plant.physics.data.qvel[0] = 0.5
    plant.step(np.full((SPEC.segments, 2), -1))
    force = -plant.physics.floor_forces()[..., 0].sum()
    loads = plant.physics.wheel_loads().sum(axis=1)
    assert force == pytest.approx(SPEC.friction.mu_n * loads.sum(), rel=1e-3)
    places = plant.physics.connector_positions()[:, 0]
    moment = loads @ (places - plant.physics.center_of_mass()[0])
    drag = SPEC.friction.mu_t * loads.sum() * g.wheel_radius
    # In its first step the snake still pitches a little.
    assert moment == pytest.approx(
        force * (g.com_height - g.wheel_radius) + drag, rel=0.01
    )


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"contact": "lose"}, "did you mean"),
        ({"contact": "preload"}, "did you mean preloaded"),
        ({"contact": None}, "contact None is not allowed; it must be a LoadedContact"),
    ],
)
def test_unknown_contact_raises(given, words):
    with pytest.raises(InputError, match=words):
        TwinSnake(SPEC, **given)


def test_contact_rejects_unknown_options():
    for make in (
        partial(LoadedContact, "viscous"),
        partial(LoadedContact, load="dynamic"),
    ):
        with pytest.raises(InputError, match="unknown; allowed"):
            make()
    for make in (
        partial(LoadedContact, slip_speed=0.0),
        partial(PreloadedContact, slip_time=math.nan),
        partial(PreloadedContact, preload=-1.0),
    ):
        with pytest.raises(InputError, match="is not allowed; it must be finite and"):
            make()
    with pytest.raises(TypeError):
        LoadedContact(preload=3.0)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("normal", [(0.0, 2.0), (1e-12, 2.0), (0.5, 1.5), (0.0, 0.0)])
def test_wheels_of_an_axle_share_its_weight_in_the_ratio_of_their_normal_forces(
    normal,
):
    """A lifted wheel has no load; an axle without contact keeps the static load."""
    contacts = SimpleNamespace(
        load_kind=LOADS.index("across"), static_load=np.ones(2), wheels=2
    )
    workspace = SimpleNamespace(
        normal_force=np.array(normal), response=np.zeros((2, 9))
    )
    loads = [_friction_load.py_func(contacts, workspace, wheel) for wheel in range(2)]
    total = sum(normal)
    fractions = [each / total if total else 0.5 for each in normal]
    assert loads == pytest.approx([2 * fraction for fraction in fractions])
