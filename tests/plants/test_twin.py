"""Twin: named accessors, consistent states, rolling wheels, unwrapped headings, invalid settings."""

from __future__ import annotations

import numpy as np
import pytest
from snakes import GRAVITY, chain, robot, throw, vented

from srs_twin import (
    AnalyticalSnake,
    Gait,
    InputError,
    PreloadedContact,
    TwinSnake,
    rollout,
)
from srs_twin.plants.twin.mjcf.model import ModelSettings

SPEC = robot()
MASSES = (0.03, 0.05, 0.02, 0.04, 0.1)
PLUS = np.tile(np.array([1, -1], dtype=np.int8), (4, 1))


def turn_left(timestep: float):
    """Return the plant and its states every 2 ms for 0.6 s, of an uneven snake that turns left."""
    plant = TwinSnake(chain(MASSES), tick=0.002, timestep=timestep)
    states = []
    rollout(plant, Gait(2.0, 0.3), 0.6, record_hz=500, observers=[states.append])
    return plant, states


@pytest.fixture(scope="module")
def turning():
    return turn_left(0.001)


def column(states, name: str) -> np.ndarray:
    return np.array([getattr(state, name) for state in states])


def test_reset_gives_a_straight_snake_at_rest_at_the_pose():
    plant = TwinSnake(chain(MASSES))
    plant.step(PLUS)
    state = plant.reset(pose=(0.3, -0.1, np.pi / 3))
    pitch = plant.spec.geometry.pitch * np.array([0.5, np.sqrt(0.75)])
    assert state.com == pytest.approx([0.3, -0.1], abs=1e-12)
    assert -np.diff(state.position, axis=0) == pytest.approx(np.tile(pitch, (4, 1)))
    assert state.connector_heading == pytest.approx([np.pi / 3] * 5)
    for quantity in (
        state.com_velocity,
        state.bend,
        state.bend_rate,
        state.pressure,
        state.contact_force,
    ):
        assert quantity == pytest.approx(np.zeros_like(quantity), abs=1e-15)
    assert state.time == 0 and not plant.openings().any()


def test_state_fields_are_consistent(turning):
    plant, states = turning
    mass = plant.spec.mass.array()
    position = column(states, "position")
    # Links between hinges, and wheels away from the centre of the axle, carry 2 % of
    # the mass.
    centre = np.einsum("i,tij->tj", mass, position) / mass.sum()
    assert centre == pytest.approx(column(states, "com"), abs=1e-3)
    connector_heading = column(states, "connector_heading")
    assert connector_heading.mean(axis=1) == pytest.approx(
        column(states, "heading"), abs=1e-12
    )
    # Bends are sums of hinge angles; pitch and roll change headings seen from above a
    # little.
    assert connector_heading[:, :-1] - connector_heading[:, 1:] == pytest.approx(
        column(states, "bend"), abs=0.02
    )
    assert np.abs(column(states, "bend")).max() > 0.8
    chords = np.linalg.norm(np.diff(position, axis=1), axis=-1)
    half = column(states, "bend") / 2
    g = plant.spec.geometry
    arcs = g.segment_length * np.sinc(half / np.pi) + g.rigid_gap * np.cos(half)
    assert chords == pytest.approx(arcs, rel=5e-3)


def test_velocities_are_time_derivatives_of_positions(turning):
    _, states = turning
    for name, rate in (("com", "com_velocity"), ("bend", "bend_rate")):
        difference = np.diff(column(states, name), axis=0) / 0.002
        middle = (column(states, rate)[1:] + column(states, rate)[:-1]) / 2
        rms = np.sqrt(((difference - middle) ** 2).mean())
        assert rms < 0.1 * np.sqrt((middle**2).mean())


def test_momentum_changes_by_the_impulse_of_the_floor(turning):
    """To second order in the time step; first order for the preloaded twin."""
    coarse = _momentum_error(*turning)
    fine = _momentum_error(*turn_left(0.00025))
    assert fine < 0.002
    assert fine == pytest.approx(coarse / 16, rel=0.3)


def _momentum_error(plant: TwinSnake, states) -> float:
    """Return the largest |Δp − ∫ Σ f dt| over the largest |p|."""
    momentum = plant.spec.mass.total * column(states, "com_velocity")
    impulse = (
        np.cumsum(column(states, "contact_force")[1:].sum(axis=1), axis=0) * plant.tick
    )
    return float(
        np.abs(momentum[1:] - momentum[0] - impulse).max() / np.abs(momentum).max()
    )


def test_friction_stays_near_the_static_friction_cone(turning):
    plant, states = turning
    horizontal = np.linalg.norm(column(states, "contact_force"), axis=-1)
    fraction = horizontal / (
        plant.spec.friction.mu_n * plant.spec.mass.array() * GRAVITY
    )
    # Loads swing about their mean, but the preload's part of the cone does not.
    assert (np.quantile(fraction, 0.95, axis=0) < 1.15).all()
    assert fraction.max() < 2
    assert (fraction.max(axis=0) > 0.5).all()


def test_named_accessors_agree_with_mujoco_arrays():
    plant = TwinSnake(SPEC)
    rollout(plant, Gait(2.0, 0.2), 0.3)
    physics = plant.physics
    data = plant.physics.data
    for j in range(1, 5):
        hinges = [
            data.joint(f"hinge_{j}_{k}")
            for k in range(1, ModelSettings.hinges_per_segment + 1)
        ]
        angle = sum(hinge.qpos[0] for hinge in hinges)
        rate = sum(hinge.qvel[0] for hinge in hinges)
        assert physics.bend_angles()[j - 1] == pytest.approx(angle, abs=1e-12)
        assert physics.bend_rates()[j - 1] == pytest.approx(rate, abs=1e-9)
    for i in range(1, 6):
        assert physics.connector_positions()[i - 1] == pytest.approx(
            data.body(f"connector_{i}").xpos
        )
        frame = data.body(f"connector_{i}").xmat.reshape(3, 3)
        heading = physics.connector_headings()[i - 1]
        assert [np.cos(heading), np.sin(heading)] == pytest.approx(
            frame[:2, 0] / np.hypot(*frame[:2, 0])
        )
    assert physics.floor_forces().shape == (5, 2, 3)
    assert (physics.wheel_loads() == physics.floor_forces()[..., 2]).all()
    weights = physics.model.body_mass
    assert physics.center_of_mass() == pytest.approx(
        weights @ physics.data.xipos / weights.sum()
    )


def test_accessors_return_copies():
    physics = TwinSnake(SPEC).physics
    for accessor in (
        physics.bend_angles,
        physics.connector_positions,
        physics.center_of_mass,
    ):
        accessor()[:] = 9.0
        assert np.abs(accessor()).max() < 1.0


def test_physics_alone_moves_as_in_the_plant():
    plant = TwinSnake(SPEC)
    physics = TwinSnake(SPEC).physics
    state = plant.step(PLUS)
    schedule = plant.pneumatics.schedule(PLUS, plant.tick)
    steps = round(plant.tick / physics.model.opt.timestep)
    physics.run(physics.advance_chambers(schedule, steps))
    assert (physics.data.qpos == state.qpos).all()
    assert physics.data.time == pytest.approx(0.02)


def test_samples_within_a_tick_belong_to_the_same_run():
    generator = np.random.default_rng(4)
    whole = TwinSnake(SPEC)
    parts = TwinSnake(SPEC)
    for _ in range(5):
        slots = np.repeat(generator.choice([-1, 1], size=(4, 4, 2)), 50, axis=0)
        end = whole.advance(slots, 1)
        samples = parts.advance(slots, 10)
        assert [s.time for s in samples] == pytest.approx(
            end[0].time - 0.002 * np.arange(9, -1, -1)
        )
        assert samples[-1].qpos == pytest.approx(end[0].qpos, abs=1e-9)


def test_wheels_roll_when_coasting_along_the_heading():
    plant = TwinSnake(robot(stiffness=20.0), contact="preloaded")
    throw(plant, (0.5, 0.0))
    state = plant.step(vented(SPEC))
    rim = plant.physics.data.joint("axle_left_3").qvel[0] * SPEC.geometry.wheel_radius
    # 1 %: pressed into a soft contact a wheel rolls on a slightly smaller radius.
    assert rim == pytest.approx(state.com_velocity[0], rel=0.015)
    assert state.com_velocity[0] < 0.5


def test_wheels_do_not_turn_when_sliding_sideways():
    plant = TwinSnake(robot(stiffness=20.0), contact="preloaded")
    throw(plant, (0.0, 0.5))
    for _ in range(4):
        plant.step(vented(SPEC))
    axles = [f"axle_{side}_{i}" for i in range(1, 6) for side in ("left", "right")]
    spins = [plant.physics.data.joint(axle).qvel[0] for axle in axles]
    assert np.abs(spins).max() * SPEC.geometry.wheel_radius < 1e-3


def test_headings_are_unwrapped_beyond_a_full_turn():
    plant = TwinSnake(
        robot(stiffness=20.0, mu_t=0.0, mu_n=0.0), contact=PreloadedContact(preload=0.0)
    )
    throw(plant, (0.0, 0.0), spin=12.0)
    headings = [plant.step(vented(SPEC)).heading for _ in range(60)]
    assert np.diff(headings) == pytest.approx([12.0 * 0.02] * 59, rel=0.02)
    assert headings[-1] > 4 * np.pi


def test_snake_at_rest_does_not_move():
    """MuJoCo's contact has no stiction: it creeps by micrometres."""
    plant = TwinSnake(SPEC)
    start = plant.reset(pose=(0.0, 0.0, 1.0))
    for _ in range(100):
        state = plant.step(vented(SPEC))
    assert state.position == pytest.approx(start.position, abs=5e-6)
    assert state.connector_heading == pytest.approx(start.connector_heading, abs=1e-5)


@pytest.mark.parametrize("connectors", [2, 9])
def test_any_number_of_connectors_runs(connectors):
    plant = TwinSnake(chain((0.03,) * connectors))
    trajectory = rollout(plant, Gait(2.0, phase_step=np.pi / 2), 0.5)
    assert trajectory.stack("x").shape == (51, connectors)
    assert np.isfinite(trajectory.com).all()


def test_both_plants_count_the_same_openings():
    counts = [
        rollout(build(SPEC), Gait(1.7, 0.3), 2.0, record_hz=10).metadata[
            "valve_switches"
        ]
        for build in (TwinSnake, AnalyticalSnake)
    ]
    assert counts[0] == counts[1]
    assert np.array(counts[0]).min() >= 3


def test_both_plants_have_the_same_pressures():
    twin, analytical = (
        rollout(build(SPEC), Gait(1.7, 0.3), 0.5)
        for build in (TwinSnake, AnalyticalSnake)
    )
    for name in ("pressure_plus", "pressure_minus"):
        assert twin.stack(name) == pytest.approx(analytical.stack(name), abs=1e-6)


def test_invalid_settings_raise():
    with pytest.raises(
        InputError, match="wheels 'round' is unknown; allowed: rolling, skid"
    ):
        TwinSnake(SPEC, contact=PreloadedContact("round"))
    with pytest.raises(
        InputError, match=r"tick 0.02 s is not a multiple of time step 0.0015 s"
    ):
        TwinSnake(SPEC, timestep=0.0015)
    with pytest.raises(InputError, match="`hinges_per_segment` 0 is not allowed"):
        TwinSnake(SPEC, hinges_per_segment=0)
    with pytest.raises(InputError, match="valve layout '5/2' is unknown"):
        TwinSnake(SPEC, layout="5/2")
    with pytest.raises(
        InputError, match="valve state 0 is not supported by layout 3/2"
    ):
        TwinSnake(SPEC).step(np.zeros((4, 2), dtype=np.int8))
