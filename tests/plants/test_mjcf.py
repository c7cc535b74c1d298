"""Structure of the MuJoCo model: positions of hinges, masses, springs, signs and names."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from snakes import GRAVITY, chain, robot

from srs_twin import InputError, PreloadedContact, load_robot
from srs_twin.plants.twin.mjcf.model import robot_mjcf, scene_mjcf
from srs_twin.plants.twin.mjcf.numerics import ModelSettings, hinge_stations
from srs_twin.plants.twin.mjcf.rules import LEAST_INERTIA
from srs_twin.plants.twin.mjcf.wheels import pair_attributes, preload_force, treads

pytestmark = pytest.mark.fast

NAMES = ("gen1", "gen2", "gen3", "gen4")
RIGHT_ANGLE = np.pi / 2
HINGES = range(1, ModelSettings.hinges_per_segment + 1)


def hinged_chord(bend: float, hinges: int) -> float:
    """Return the chord of a unit segment whose hinges share a bend equally."""
    edges = np.concatenate([[0.0], hinge_stations(hinges, 1.0, 0.0), [1.0]])
    angles = bend * np.arange(hinges + 1) / hinges
    return float(abs((np.diff(edges) * np.exp(1j * angles)).sum()))


@pytest.mark.parametrize(("hinges", "error"), [(2, 0.0023), (4, 0.0006), (8, 0.0002)])
def test_hinge_stations_preserve_the_chord_of_the_arc(hinges, error):
    arc = np.sin(RIGHT_ANGLE / 2) / (RIGHT_ANGLE / 2)
    assert hinged_chord(RIGHT_ANGLE, hinges) == pytest.approx(arc, rel=error)


@pytest.mark.parametrize("hinges", [2, 3, 4, 7])
def test_chord_agrees_to_second_order(hinges):
    """Half the bend has a sixteenth of the error."""
    errors = [hinged_chord(q, hinges) - np.sinc(q / (2 * np.pi)) for q in (0.8, 0.4)]
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.05)


def test_known_hinge_stations():
    assert hinge_stations(1, 1.0, 0.0) == pytest.approx([0.5])
    assert hinge_stations(2, 1.0, 0.0) == pytest.approx([1 / 6, 5 / 6])
    assert hinge_stations(4, 1.0, 0.0) == pytest.approx(
        [0.1, 0.1 + 0.8 / 3, 0.9 - 0.8 / 3, 0.9]
    )
    assert hinge_stations(2, 0.06, 0.02) == pytest.approx([0.02, 0.06])
    with pytest.raises(
        InputError,
        match=r"`hinges_per_segment` 0 is not allowed; a segment needs 1 or more",
    ):
        hinge_stations(0, 1.0, 0.0)


@pytest.fixture(scope="module", params=NAMES)
def scene(request) -> tuple[mujoco.MjModel, mujoco.MjData, str]:
    """Compiled scene of each robot, straight, after forward kinematics."""
    spec = load_robot(request.param)
    model = scene_mjcf(spec, ModelSettings(contact=PreloadedContact())).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data, request.param


def test_centre_of_mass_equals_that_of_the_point_masses(scene):
    model, data, name = scene
    spec = load_robot(name)
    stations = data.xpos[[model.body(f"connector_{i}").id for i in range(1, 6)], 0]
    expected = spec.mass.array() @ stations / spec.mass.total
    assert data.subtree_com[0][0] == pytest.approx(
        expected, abs=2e-3 * spec.geometry.body_length
    )
    assert data.subtree_com[0][1] == pytest.approx(0, abs=1e-15)


def test_connector_masses_are_centred_on_their_frames(scene):
    model, data, _ = scene
    for i in range(1, 6):
        body = model.body(f"connector_{i}").id
        assert data.xipos[body] == pytest.approx(data.xpos[body], abs=1e-12)
        for side in ("left", "right"):
            wheel = model.body(f"wheel_{side}_{i}").id
            assert data.xipos[wheel] == pytest.approx(data.xpos[wheel], abs=1e-12)


def test_connectors_are_one_pitch_apart_on_their_wheels(scene):
    model, data, name = scene
    g = load_robot(name).geometry
    places = np.array([data.xpos[model.body(f"connector_{i}").id] for i in range(1, 6)])
    assert np.diff(places[:, 0]) == pytest.approx([-g.pitch] * 4, rel=1e-12)
    assert places[:, 2] == pytest.approx([g.com_height] * 5)
    left, right = (
        data.xpos[model.body(f"wheel_{side}_2").id] for side in ("left", "right")
    )
    assert left - right == pytest.approx([0, 2 * g.half_track, 0], abs=1e-12)
    assert left[2] == pytest.approx(g.wheel_radius)


def test_static_load_of_a_connector_is_its_weight(scene):
    """The mass of links between hinges is subtracted from the adjacent connectors."""
    model, data, name = scene
    spec = load_robot(name)
    own = np.zeros(5)
    stations = np.array(
        [data.xpos[model.body(f"connector_{i}").id][0] for i in range(1, 6)]
    )
    for body in range(1, model.nbody):
        fraction = (stations[0] - data.xipos[body][0]) / spec.geometry.pitch
        front = min(int(fraction + 1e-9), 3)
        own[front] += model.body_mass[body] * (1 - (fraction - front))
        own[front + 1] += model.body_mass[body] * (fraction - front)
    assert own == pytest.approx(spec.mass.array(), rel=0.01)


def test_series_hinges_have_the_stiffness_and_damping_of_the_segment(scene):
    model, _, name = scene
    bending = load_robot(name).bending
    for j in range(1, 5):
        hinges = [model.joint(f"hinge_{j}_{k}").id for k in HINGES]
        assert 1 / (1 / model.jnt_stiffness[hinges]).sum() == pytest.approx(
            bending.stiffness
        )
        damping = model.dof_damping[model.jnt_dofadr[hinges]]
        # The integrator evaluates springs at the end of a step, which adds the damping
        # stiffness × step.
        whole = damping + ModelSettings.timestep * model.jnt_stiffness[hinges]
        assert 1 / (1 / whole).sum() == pytest.approx(
            bending.stiffness * bending.damping_time
        )
        assert model.joint(f"pitch_{j}").stiffness == pytest.approx(
            bending.pitch_stiffness
        )
        assert model.joint(f"roll_{j}").stiffness == pytest.approx(
            bending.roll_stiffness
        )


def test_plus_pressure_bends_to_the_left(scene):
    """The moment k G p acts on the tendon, whose length is the bend; a left bend moves the head left."""
    model, data, name = scene
    spec = load_robot(name)
    for sign, chamber in ((1, "plus"), (-1, "minus")):
        data.ctrl[:] = 0.0
        data.ctrl[model.actuator(f"{chamber}_2").id] = 1e4
        mujoco.mj_forward(model, data)
        moment = data.qfrc_actuator[
            model.jnt_dofadr[[model.joint(f"hinge_2_{k}").id for k in HINGES]]
        ]
        expected = sign * spec.bending.stiffness * spec.actuator.gain * 1e4
        assert moment == pytest.approx([expected] * len(HINGES), rel=1e-9)
    data.ctrl[:] = 0.0


def test_tendon_length_is_the_difference_of_headings(scene):
    model, _, _ = scene
    data = mujoco.MjData(model)
    for j, bend in enumerate((0.4, -0.8, 1.2, 0.1), start=1):
        for k in HINGES:
            data.qpos[model.joint(f"hinge_{j}_{k}").qposadr] = bend / len(HINGES)
    mujoco.mj_forward(model, data)
    frames = data.xmat[[model.body(f"connector_{i}").id for i in range(1, 6)]]
    headings = np.unwrap(np.arctan2(frames[:, 3], frames[:, 0]))
    assert headings[:-1] - headings[1:] == pytest.approx(
        [0.4, -0.8, 1.2, 0.1], abs=1e-12
    )
    assert data.ten_length == pytest.approx([0.4, -0.8, 1.2, 0.1], abs=1e-12)
    # Segment 1 bends to the left: seen along segment 2, connector 1 is to the left of
    # its chord.
    ahead = np.array([np.cos(headings[1]), np.sin(headings[1])])
    to_head = (data.body("connector_1").xpos - data.body("connector_2").xpos)[:2]
    assert ahead[0] * to_head[1] - ahead[1] * to_head[0] > 0


def test_axle_and_tread_friction_are_proportional_to_the_load(scene):
    model, _, name = scene
    spec = load_robot(name)
    numerics = ModelSettings(contact=PreloadedContact())
    pressed = preload_force(spec, PreloadedContact())
    for i, mass in enumerate(spec.mass.connectors, start=1):
        load = mass * GRAVITY / 2
        for side in ("left", "right"):
            drag = model.dof_frictionloss[model.joint(f"axle_{side}_{i}").dofadr]
            assert drag / spec.geometry.wheel_radius == pytest.approx(
                [spec.friction.mu_t * load]
            )
        # The lateral friction limit of a preloaded wheel is μ_n times its static load.
        mu = pair_attributes(spec, numerics)["friction"][0]
        assert mu * (load + pressed[i - 1, 0]) == pytest.approx(
            spec.friction.mu_n * load
        )
    assert model.npair == len(treads(spec)) == 10
    for pair in range(model.npair):
        assert model.pair_friction[pair][:2] == pytest.approx(
            pair_attributes(spec, numerics)["friction"][:2]
        )


@pytest.mark.parametrize("connectors", [2, 12])
def test_any_number_of_connectors_builds(connectors):
    spec = chain((0.03,) * connectors)
    model = scene_mjcf(
        spec, ModelSettings(hinges_per_segment=2, contact=PreloadedContact())
    ).compile()
    assert model.ntendon == connectors - 1
    assert model.npair == 2 * connectors
    # Free joint; two hinges, pitch and roll per segment; two wheels per connector.
    assert model.nv == 6 + 4 * (connectors - 1) + 2 * connectors
    assert model.body_mass.sum() == pytest.approx(spec.mass.total)


@pytest.mark.parametrize("hinges", [1, 2, 3, 8])
def test_mass_and_stiffness_are_independent_of_the_number_of_hinges(hinges):
    spec = robot()
    model = robot_mjcf(
        spec, ModelSettings(hinges_per_segment=hinges, contact=PreloadedContact())
    ).compile()
    assert model.body_mass.sum() == pytest.approx(spec.mass.total)
    series = [
        model.jnt_stiffness[model.joint(f"hinge_1_{k}").id]
        for k in range(1, hinges + 1)
    ]
    assert 1 / np.sum(1 / np.array(series)) == pytest.approx(spec.bending.stiffness)


def test_control_range_reaches_the_supply_pressure():
    spec = robot()
    shipped = robot_mjcf(spec, ModelSettings(contact=PreloadedContact())).compile()
    over = robot_mjcf(
        spec,
        ModelSettings(contact=PreloadedContact()),
        supply_pa=2 * spec.supply.pulsed_limit,
    ).compile()
    assert shipped.actuator("plus_1").ctrlrange == pytest.approx(
        [0, spec.supply.pulsed_limit]
    )
    assert over.actuator("minus_4").ctrlrange == pytest.approx(
        [0, 2 * spec.supply.pulsed_limit]
    )


def test_numerics_set_the_engine_options():
    model = scene_mjcf(
        robot(), ModelSettings(0.0005, contact=PreloadedContact(slip_time=0.004))
    ).compile()
    assert model.opt.timestep == 0.0005
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert model.opt.jacobian == mujoco.mjtJacobian.mjJAC_SPARSE
    assert model.opt.gravity == pytest.approx([0, 0, -GRAVITY])
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET
    assert model.pair_solreffriction[:, 0] == pytest.approx([0.004] * 10)


def test_smallest_inertia_of_the_rules_is_that_of_mujoco():
    assert mujoco.mjMINVAL == LEAST_INERTIA


def test_time_step_above_the_damping_time_raises():
    """The limit is 1.5 times 2.14 ms, 3.21 ms."""
    robot_mjcf(robot(), ModelSettings(0.0032))
    with pytest.raises(
        InputError,
        match=r"time step 0.00322 s is too long .* c/k of 0.00214 s. It must be be",
    ):
        robot_mjcf(robot(), ModelSettings(0.00322))
