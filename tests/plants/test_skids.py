"""Twin on skids: contact points, contact frames, and permanent contact with the floor."""

from __future__ import annotations

from functools import cache

import mujoco
import numpy as np
import pytest
from snakes import GRAVITY, robot, throw, vented

from srs_twin import Gait, PreloadedContact, TwinSnake, load_robot, rollout
from srs_twin.plants.twin.mjcf.model import scene_mjcf
from srs_twin.plants.twin.mjcf.numerics import ModelSettings
from srs_twin.plants.twin.mjcf.wheels import pair_attributes, preload_force, treads

pytestmark = pytest.mark.default_cases(3)

SPEC = robot(stiffness=20.0)
SKIDS = ModelSettings(contact=PreloadedContact("skid"))


@cache
def twin() -> TwinSnake:
    return TwinSnake(SPEC, contact=PreloadedContact("skid"))


@pytest.fixture(scope="module", params=["gen1", "gen2", "gen3", "gen4"])
def scene(request) -> tuple[mujoco.MjModel, mujoco.MjData, str]:
    """Each robot on skids, straight, slightly below the floor so that all contacts are detected."""
    model = scene_mjcf(load_robot(request.param), SKIDS).compile()
    data = mujoco.MjData(model)
    data.qpos[2] -= 1e-5
    mujoco.mj_forward(model, data)
    return model, data, request.param


def test_each_skid_touches_once_at_the_track(scene):
    _, data, name = scene
    g = load_robot(name).geometry
    assert data.ncon == 2 * g.connectors
    # MuJoCo finds them in the order of its tree of bodies, left before right.
    places = data.contact.pos.reshape(g.connectors, 2, 3)
    places = places[np.argsort(-places[:, 0, 0])]
    stations = g.body_length / 2 - g.pitch * np.arange(g.connectors)
    assert places[..., 0] == pytest.approx(
        np.stack([stations, stations], axis=1), abs=1e-9
    )
    assert places[..., 1] == pytest.approx(
        np.tile([g.half_track, -g.half_track], (g.connectors, 1))
    )


def test_skids_have_the_mass_and_inertia_of_wheels(scene):
    model, data, name = scene
    spec = load_robot(name)
    wheeled = scene_mjcf(spec, ModelSettings(contact=PreloadedContact())).compile()
    assert model.body_mass.sum() == pytest.approx(spec.mass.total, rel=1e-12)
    g = spec.geometry
    yaw = 2
    for i in range(1, g.connectors + 1):
        own = model.body(f"connector_{i}")
        axle = wheeled.body(f"connector_{i}")
        assert own.ipos == pytest.approx([0, 0, 0], abs=1e-15)
        wheels = [wheeled.body(f"wheel_{side}_{i}") for side in ("left", "right")]
        assert own.mass == pytest.approx(
            axle.mass + sum(wheel.mass for wheel in wheels)
        )
        offset = sum(wheel.mass[0] * wheel.pos[1] ** 2 for wheel in wheels)
        turning = (
            axle.inertia[yaw] + sum(wheel.inertia[yaw] for wheel in wheels) + offset
        )
        assert own.inertia[yaw] == pytest.approx(turning)
    assert model.nv == wheeled.nv - 2 * g.connectors == 6 + 4 * spec.segments, (
        "no axles"
    )


def test_preloaded_skid_has_the_friction_of_its_static_load(scene):
    model, _, name = scene
    spec = load_robot(name)
    along, across = pair_attributes(spec, SKIDS)["friction"][:2]
    for i, mass in enumerate(spec.mass.connectors):
        load = mass * GRAVITY / 2
        pressed = load + preload_force(spec, SKIDS.contact)[i, 0]
        assert along * pressed == pytest.approx(spec.friction.mu_t * load)
        assert across * pressed == pytest.approx(spec.friction.mu_n * load)
    assert model.npair == len(treads(spec)) == 10
    assert model.pair_friction[:, :2] == pytest.approx(
        np.tile([along, across], (10, 1))
    )


@pytest.mark.parametrize("heading", [0.0, 0.5, 2.0, -2.5])
def test_contact_frames_turn_with_the_skids(heading):
    plant = twin()
    plant.reset(pose=(0.2, 0.1, heading))
    plant.step(vented(SPEC))
    contacts = plant.physics.data.contact
    assert len(contacts.frame) == 10
    for normal, along, across in contacts.frame.reshape(-1, 3, 3):
        assert normal == pytest.approx([0, 0, 1])
        assert np.abs(along) == pytest.approx(
            np.abs([np.cos(heading), np.sin(heading), 0]), abs=1e-6
        )
        assert np.cross(normal, along) == pytest.approx(across)
    assert (contacts.friction[:, 0] < contacts.friction[:, 1]).all()


def test_skids_stay_on_the_floor_and_off_their_tips():
    plant = TwinSnake(robot(), contact=PreloadedContact("skid"))
    contacts = []
    rollout(
        plant,
        Gait(2.0, 0.2),
        2.0,
        observers=[lambda _: contacts.append(plant.physics.data.ncon)],
    )
    assert set(contacts[1:]) == {10}


@pytest.mark.parametrize("name", ["gen1", "gen2", "gen3", "gen4"])
def test_sideways_slide_does_not_roll_the_snake_over(name):
    plant = TwinSnake(robot(name, stiffness=20.0), contact=PreloadedContact("skid"))
    throw(plant, (-np.sin(0.7), np.cos(0.7)), heading=0.7)
    upright = []
    for _ in range(
        round((1.0 / (plant.spec.friction.mu_n * GRAVITY) + 0.2) / plant.tick)
    ):
        state = plant.step(vented(plant.spec))
        upright.append(plant.physics.data.xmat[plant.physics._connectors][:, 8].min())
    assert np.degrees(np.arccos(min(upright))) < 2
    assert np.abs(state.com_velocity).max() < 1e-5
    assert plant.physics.wheel_loads().min() > 0


def test_snake_at_rest_does_not_move():
    """MuJoCo's contact has no stiction, least along the heading: it creeps by micrometres."""
    plant = twin()
    start = plant.reset(pose=(0.0, 0.0, 1.0))
    for _ in range(100):
        state = plant.step(vented(SPEC))
    assert state.position == pytest.approx(start.position, abs=2e-5)
    assert state.connector_heading == pytest.approx(start.connector_heading, abs=1e-5)


def test_description_contains_the_wheels():
    described = twin().describe()
    assert (described["wheels"], described["preload"]) == ("skid", 99.0)
    assert TwinSnake(SPEC, contact="preloaded").describe()["preload"] == 39.0
    assert (
        TwinSnake(SPEC, contact=PreloadedContact("skid", 7.0)).describe()["preload"]
        == 7.0
    )
