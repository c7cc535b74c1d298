"""Analytical plant: consistent states, momentum and energy, number of connectors, invalid settings."""

from __future__ import annotations

from dataclasses import replace
from typing import get_type_hints

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from snakes import chain, robot, throw, vented

from srs_twin import AnalyticalSnake, Gait, InputError, rollout
from srs_twin.plants.analytical import kernels
from srs_twin.plants.analytical.options import AnalyticalOptions, OptionKeywords
from srs_twin.pneumatics import Schedule

SPEC = robot()
MASSES = (0.03, 0.05, 0.02, 0.04, 0.1)
FRICTION_LAWS = pytest.mark.parametrize("friction_law", ["axis", "wheel"])


def test_reset_gives_a_straight_snake_at_rest_at_the_pose():
    spec = chain(MASSES)
    plant = AnalyticalSnake(spec)
    plant.step(np.tile([1, -1], (4, 1)))
    state = plant.reset(pose=(0.3, -0.1, np.pi / 3))
    ahead = np.array([0.5, np.sqrt(0.75)])
    assert state.com == pytest.approx([0.3, -0.1])
    assert spec.mass.array() @ state.position / spec.mass.total == pytest.approx(
        [0.3, -0.1]
    )
    assert -np.diff(state.position, axis=0) == pytest.approx(
        np.tile(spec.geometry.pitch * ahead, (4, 1))
    )
    assert state.connector_heading == pytest.approx([np.pi / 3] * 5)
    for quantity in (
        state.com_velocity,
        state.bend,
        state.bend_rate,
        state.pressure,
        state.contact_force,
    ):
        assert not quantity.any()
    assert state.time == 0 and state.qpos.size == 0


@pytest.fixture(scope="module")
def turning():
    """States of an uneven snake that turns left, every millisecond for one second, and its robot."""
    spec = chain(MASSES)
    plant = AnalyticalSnake(spec, friction="wheel", tick=0.001)
    states = []
    rollout(plant, Gait(2.0, 0.3), 1.0, record_hz=1000, observers=[states.append])
    return spec, states


def column(states, name: str) -> np.ndarray:
    return np.array([getattr(state, name) for state in states])


def test_state_fields_are_consistent(turning):
    spec, states = turning
    position, connector_heading, bend = (
        column(states, name) for name in ("position", "connector_heading", "bend")
    )
    centre = np.einsum("i,tij->tj", spec.mass.array(), position) / spec.mass.total
    assert centre == pytest.approx(column(states, "com"), abs=1e-12)
    assert connector_heading.mean(axis=1) == pytest.approx(
        column(states, "heading"), abs=1e-12
    )
    assert connector_heading[:, :-1] - connector_heading[:, 1:] == pytest.approx(
        bend, abs=1e-12
    )
    # Neighbours are one chord apart along their mean heading: an arc of l and half a
    # gap at each end.
    g = spec.geometry
    half = bend / 2
    chords = g.segment_length * np.sinc(half / np.pi) + g.rigid_gap * np.cos(half)
    mean = (connector_heading[:, :-1] + connector_heading[:, 1:]) / 2
    links = chords[..., None] * np.stack([np.cos(mean), np.sin(mean)], axis=-1)
    assert -np.diff(position, axis=1) == pytest.approx(links, abs=1e-12)
    assert column(states, "measured_bend") == pytest.approx(bend)


def test_velocities_are_time_derivatives_of_positions(turning):
    _, states = turning
    for name, rate, close in (
        ("com", "com_velocity", 2e-3),
        ("bend", "bend_rate", 0.2),
    ):
        difference = np.diff(column(states, name), axis=0) / 0.001
        middle = (column(states, rate)[1:] + column(states, rate)[:-1]) / 2
        error = np.abs(difference - middle)
        assert np.quantile(error, 0.97) < close  # valve events make kinks
        assert np.abs(column(states, rate)).max() > 20 * close


def test_momentum_changes_by_the_impulse_of_the_floor(turning):
    spec, states = turning
    momentum = spec.mass.total * column(states, "com_velocity")
    force = column(states, "contact_force").sum(axis=1)
    impulse = np.cumsum((force[1:] + force[:-1]) / 2, axis=0) * 0.001
    error = np.abs(momentum[1:] - momentum[0] - impulse)
    assert error.max() < 0.05 * np.abs(momentum).max()
    weight = spec.mass.array() * 9.81
    assert (
        np.hypot(*np.moveaxis(column(states, "contact_force"), -1, 0))
        <= 0.57 * weight * 1.0001
    ).all()


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


@pytest.mark.default_cases(at=[0, 3, 4])
@FRICTION_LAWS
@pytest.mark.parametrize("connectors", [2, 4, 9])
def test_any_number_of_connectors_runs(friction_law, connectors):
    plant = AnalyticalSnake(chain((0.03,) * connectors), friction=friction_law)
    step = np.pi / 2 if connectors == 2 else 2 * np.pi / (connectors - 1)
    trajectory = rollout(plant, Gait(2.0, phase_step=step), 2.0)
    assert trajectory.stack("x").shape == (201, connectors)
    assert trajectory.stack("bend").shape == (201, connectors - 1)
    assert np.isfinite(trajectory.com).all()
    # One segment flaps, a wave through two or more swims.
    assert (
        abs(trajectory["com_x"][-1]) < 0.05
        if connectors == 2
        else trajectory["com_x"][-1] > 0.05
    )


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


def test_prescribed_bends_are_independent_of_mass_and_stiffness():
    """In `complete`, friction and inertia scale with mass, and bends follow the chambers."""
    heavy = replace(
        SPEC,
        mass=replace(SPEC.mass, connectors=tuple(7 * m for m in SPEC.mass.connectors)),
        bending=replace(SPEC.bending, stiffness=0.01),
    )
    light, loaded = (
        rollout(AnalyticalSnake(s), Gait(2.0, 0.2), 1.0) for s in (SPEC, heavy)
    )
    assert loaded.position == pytest.approx(light.position, abs=1e-9)


def test_in_out_valves_can_hold_pressure():
    plant = AnalyticalSnake(SPEC, layout="in_out")
    for _ in range(10):
        filled = plant.step(np.tile([1, -1], (4, 1)))
    for _ in range(10):
        held = plant.step(np.zeros((4, 2), dtype=np.int8))
    assert held.pressure == pytest.approx(filled.pressure, rel=1e-12)
    assert held.valves.tolist() == [[0, 0]] * 4
    assert plant.openings().tolist() == [[1, 0]] * 4
    with pytest.raises(
        InputError, match="valve state 0 is not supported by layout 3/2"
    ):
        AnalyticalSnake(SPEC).step(np.zeros((4, 2), dtype=np.int8))


def test_unknown_models_and_laws_raise_with_the_allowed_names():
    with pytest.raises(
        InputError, match="model 'simple' is unknown; allowed: complete"
    ):
        AnalyticalSnake(SPEC, model="simple")
    with pytest.raises(
        InputError,
        match="friction law 'glue' is unknown; allowed: axis, wheel, viscous",
    ):
        AnalyticalSnake(SPEC, friction="glue")
    with pytest.raises(InputError, match="valve layout '5/2' is unknown"):
        AnalyticalSnake(SPEC, layout="5/2")


@settings(max_examples=100)
@given(
    st.lists(
        st.tuples(
            st.integers(1, 39), st.sampled_from([0.0, 1e-15, -1e-15, 3e-4, 7e-4])
        ),
        max_size=8,
    ),
    st.sampled_from([1, 2, 5, 10]),
    st.sampled_from([0.002, 0.001, 0.0007]),
)
def test_steps_end_once_on_each_event_and_sample(places, samples, timestep):
    """Events within rounding of the even grid neither add a step nor drop a sample."""
    plant = AnalyticalSnake(SPEC, timestep=timestep)
    starts = np.unique(
        [
            0.0,
            *(
                0.001 * k * (1 + deviation)
                + (deviation if abs(deviation) > 1e-9 else 0)
                for k, deviation in places
            ),
        ]
    )
    starts = starts[starts < 0.04 - 1e-6]
    states = np.resize([[[1, -1]] * 4, [[-1, 1]] * 4], (len(starts), 4, 2)).astype(
        np.int8
    )
    steps = plant.steps(Schedule(0.04, starts, states), samples)
    ends = steps.ends
    marks = steps.sample_steps
    assert (np.diff(np.append(0.0, ends)) > 1e-12).all() and ends[-1] == pytest.approx(
        0.04
    )
    assert np.diff(np.append(0.0, ends)).max() <= timestep * (1 + 1e-9)
    assert ends[marks - 1] == pytest.approx(
        0.04 * np.arange(1, samples + 1) / samples, abs=1e-12
    )
    assert all(np.abs(ends - event).min() < 1e-9 for event in starts[1:])


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
