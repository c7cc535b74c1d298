"""Movable objects: laws of motion of an object on the floor, and of its contacts with body and walls."""

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from free_bends import free_bends

from srs_twin import load_robot
from srs_twin.comparison.centre_line import body_overlap
from srs_twin.control.gait import Gait
from srs_twin.errors import InputError
from srs_twin.plants.analytical import AnalyticalSnake
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.spec import GRAVITY, Friction, RobotSpec
from srs_twin.robot.world import (
    OBSTACLE_FRICTION as FRICTION,
    Circle,
    MovableObject,
    Polygon,
    World,
)
from srs_twin.rollout import rollout
from srs_twin.trajectory import Trajectory

GEN2 = load_robot("gen2")
SLIPPERY = replace(GEN2, friction=Friction(0.0, 0.0))
VENTED = np.full((4, 2), -1, dtype=np.int8)
CYLINDER = MovableObject((0.03,), 0.05, 0.3, 0.3, 0.2)
BOX = MovableObject((0.08, 0.04), 0.05, 0.3, 0.3, 0.2, 0.4)


def twin_with(
    *objects: MovableObject, robot: RobotSpec = GEN2, **world: object
) -> TwinSnake:
    return TwinSnake(robot, world=World(objects=objects, **world))  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("item", "velocity"), [(CYLINDER, (0.3, 0.0)), (BOX, (-0.1, 0.2))]
)
def test_sliding_object_stops_after_the_distance_of_coulomb_friction(item, velocity):
    twin = twin_with(item)
    twin.physics.data.qvel[-3:-1] = velocity
    for _ in range(12):
        twin.step(VENTED)
    speed = math.hypot(*velocity)
    way = np.array(velocity) / speed * speed**2 / (2 * item.friction * GRAVITY)
    moved = twin.state.qpos[-3:] - [item.x, item.y, item.heading]
    # The stopping force is that of Coulomb up to the last slip speed (1 mm/s).
    np.testing.assert_allclose(moved[:2], way, atol=2e-3 * np.abs(way).max())
    assert abs(moved[2]) < 1e-9


@pytest.mark.slow
def test_spinning_cylinder_is_braked_by_the_moment_of_a_uniform_pressure():
    twin = twin_with(CYLINDER)
    spin = 20.0
    twin.physics.data.qvel[-1] = spin
    twin.step(VENTED)
    radius = CYLINDER.size[0]
    braking = (2 / 3 * CYLINDER.friction * GRAVITY * radius) / (radius**2 / 2)
    # The tolerance of the friction solve is relative to the friction of the whole
    # snake.
    assert twin.physics.data.qvel[-1] == pytest.approx(
        spin - braking * twin.tick, abs=5e-4 * spin
    )


@pytest.mark.slow
def test_object_at_rest_on_a_slope_stays_until_the_friction_angle():
    from srs_twin.robot.world import Floor

    for fraction, slides in ((0.9, False), (1.1, True)):
        floor = Floor(math.atan(fraction * CYLINDER.friction), 0.3)
        twin = twin_with(CYLINDER, floor=floor)
        for _ in range(10):
            twin.step(VENTED)
        moved = np.hypot(*(twin.state.qpos[-3:-1] - [CYLINDER.x, CYLINDER.y]))
        gained = (
            GRAVITY
            * (math.sin(floor.tilt) - CYLINDER.friction * math.cos(floor.tilt))
            * 0.2**2
            / 2
        )
        # Friction builds up within the slip speed of 1 mm/s.
        assert moved == pytest.approx(
            gained if slides else 0.0, abs=1.1e-3 * 0.2 if slides else 1e-5
        )


@pytest.mark.slow
@pytest.mark.parametrize("item", [CYLINDER, BOX])
def test_collision_conserves_momentum(item):
    """Without friction on the floor, momentum and angular momentum pass from the object to the snake."""
    item = replace(item, friction=0.0, x=0.03, y=0.08)
    twin = twin_with(item, robot=SLIPPERY)
    data = twin.physics.data
    model = twin.physics.model
    data.qvel[-2] = -0.5

    def momenta() -> np.ndarray:
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        total = np.zeros(3)
        for body, mass in ((1, GEN2.mass.total), (model.nbody - 1, item.mass)):
            velocity = data.subtree_linvel[body]
            place = data.subtree_com[body]
            spin = data.subtree_angmom[body][2] + mass * (
                place[0] * velocity[1] - place[1] * velocity[0]
            )
            total += [mass * velocity[0], mass * velocity[1], spin]
        return total

    before = momenta()
    force = [twin.step(VENTED).obstacle_force for _ in range(10)]
    assert np.abs(force).max() > 0.1, "they must touch"
    # Bodies that turn within a step of the impact change momenta by m l ω² h.
    np.testing.assert_allclose(momenta(), before, atol=0.01 * np.abs(before).max())


@pytest.mark.slow
@pytest.mark.parametrize("item", [CYLINDER, BOX])
def test_work_of_the_torques_is_the_energy_that_object_and_floor_receive(item):
    item = replace(item, x=0.2, y=0.01)
    twin = twin_with(item)
    run = rollout(twin, Gait(2.0), 2.0, record_hz=1000)
    assert abs(run["object_x_1"][-1] - item.x) > 0.03, "the snake must push it"
    power = (run.stack("torque") * free_bends(twin, Gait(2.0), run.time).bend_rate).sum(
        axis=1
    )
    work = np.trapezoid(power, run.time)
    assert run["work"][-1] - run["work"][0] == pytest.approx(work, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("item", [CYLINDER, BOX])
def test_wall_stops_an_object_that_the_snake_pushes(item):
    item = replace(item, x=0.19, y=0.0, heading=0.0)
    wall = Polygon(((0.25, -0.3), (0.30, -0.3), (0.30, 0.3), (0.25, 0.3)))
    twin = twin_with(item, polygons=(wall,))
    run = rollout(twin, Gait(2.0), 4.0)
    half = item.size[0] / 2 if item.is_box else item.size[0]
    reach = run["object_x_1"] + half
    assert reach.max() < 0.25
    assert reach.max() > 0.24, "it must have been pushed"


@pytest.mark.slow
def test_mirrored_push_gives_the_mirrored_motion():
    results = []
    for sign in (1, -1):
        box = replace(BOX, x=0.172, y=sign * 0.01, heading=sign * 0.4)
        gait = Gait(2.0, phase=0.0 if sign > 0 else math.pi)
        run = rollout(twin_with(box), gait, 1.0)
        results.append(
            [
                run["object_x_1"][-1],
                sign * run["object_y_1"][-1],
                sign * run["object_heading_1"][-1],
            ]
        )
    np.testing.assert_allclose(*results, atol=1e-6)
    assert abs(results[0][0] - 0.172) > 0.005


@pytest.mark.slow
def test_saved_state_continues_with_the_same_bits():
    gait = Gait(2.0)
    item = replace(CYLINDER, x=0.17, y=0.01)
    first = twin_with(item)
    second = twin_with(item)
    gait.reset(GEN2, first.tick)
    state = first.state
    touched = False
    for _ in range(30):
        state = first.step(gait.step(state))
        touched = touched or bool(np.any(state.obstacle_force))
    assert touched
    continued = second.restore(first.save())
    for _ in range(10):
        state = first.step(gait.step(state))
        continued = second.step(gait.step(continued))
    assert state.qpos.tobytes() == continued.qpos.tobytes()


@pytest.mark.slow
def test_contacts_with_an_immovable_object_are_those_with_an_obstacle():
    """Two code paths of friction: collision geoms on obstacles, and pairs of collision geoms and objects."""
    heavy = MovableObject((0.03,), 1000.0, 10.0, 0.2, 0.035)
    post = World(obstacles=(Circle(0.2, 0.035, 0.03),))
    runs = [
        rollout(TwinSnake(GEN2, world=world), Gait(2.0), 1.0)
        for world in (World(objects=(heavy,)), post)
    ]
    assert (
        np.hypot(
            runs[1].stack("obstacle_force_x"), runs[1].stack("obstacle_force_y")
        ).max()
        > 0.1
    )
    np.testing.assert_allclose(runs[0].com, runs[1].com, atol=1e-4)


@pytest.mark.slow
def test_curled_body_touches_itself():
    """Without floor friction the contacts are internal forces: shorter steps move the body less."""
    chain = replace(
        SLIPPERY,
        geometry=replace(GEN2.geometry, connectors=9),
        mass=replace(GEN2.mass, connectors=GEN2.mass.connectors[:1] * 9),
    )
    world = World(objects=(replace(CYLINDER, x=2.0),))
    width = chain.geometry.width
    coarse, overlap = curled(TwinSnake(chain, world=world))
    fine, _ = curled(TwinSnake(chain, world=world, timestep=0.00025))
    assert fine < 0.5 * coarse
    assert overlap == 0.0, "less than a quarter of the width"
    assert curled(TwinSnake(chain))[1] > 0.9 * width, (
        "a world without objects has no such contacts"
    )


def curled(twin: TwinSnake) -> tuple[float, float]:
    """Fill all left chambers for 0.8 s; return the displacement of the centre of mass and the overlap, m."""
    spec = twin.spec
    curl = np.tile(np.array([1, -1], dtype=np.int8), (twin.spec.segments, 1))
    start = twin.reset().com
    states = [twin.step(curl) for _ in range(40)]
    signals = {
        "x": [s.position[:, 0] for s in states],
        "y": [s.position[:, 1] for s in states],
    }
    signals["connector_heading"] = [s.connector_heading for s in states]
    columns = {
        f"{k}_{i + 1}": row
        for k, v in signals.items()
        for i, row in enumerate(np.transpose(v))
    }
    run = Trajectory({"time": np.arange(40.0)} | columns)
    return float(np.abs(states[-1].com - start).max()), body_overlap(run, spec.geometry)


@pytest.mark.slow
@pytest.mark.parametrize("wrap", [math.pi / 2, math.pi])
def test_chain_without_stiffness_follows_the_capstan_law(wrap):
    tension, hold_back = pulled_over_an_object(wrap, radius=0.18)
    assert tension / hold_back == pytest.approx(math.exp(FRICTION * wrap), rel=0.05)


def pulled_over_an_object(
    wrap: float, radius: float, hold_back: float = 1.0
) -> tuple[float, float]:
    """Return the tension that slides a limp chain over a fixed cylinder, and the hold-back tension, N.

    The chain has no floor friction. The hold-back tension acts on the tail; a stiff
    spring moves the head slowly, and its force is the tension.
    """
    connectors = 17
    width = 0.002
    chain = replace(
        SLIPPERY,
        geometry=replace(GEN2.geometry, connectors=connectors, width=width),
        mass=replace(GEN2.mass, connectors=(0.02,) * connectors, wheel=0.001),
        bending=replace(GEN2.bending, stiffness=1e-4, damping_time=1.0),
    )
    pitch = chain.geometry.pitch
    bent_radius = radius + width / 2 + 2e-4
    edges = np.arange(connectors) * pitch
    middle = edges[-1] / 2
    half = wrap * bent_radius / 2
    bend = np.clip(
        np.minimum(edges[1:], middle + half) - np.maximum(edges[:-1], middle - half),
        0,
        None,
    )
    bend /= bent_radius

    def wrapped(x: float, y: float) -> TwinSnake:
        world = World(objects=(MovableObject((radius,), 1000.0, 10.0, x, y),))
        twin = TwinSnake(chain, hinges_per_segment=4, world=world, tick=0.001)
        # Lay it down at a distance, because a straight chain would cross the object.
        twin.set_state(replace(twin.reset(pose=(0.0, 5.0, 0.0)), bend=bend))
        twin.physics.data.qpos[1] -= 5.0
        twin.physics.refresh()
        return twin

    place = wrapped(10.0, 10.0).physics.connector_positions()[:, :2]
    on_arc = place[np.abs(edges - middle) < half]
    centre = np.linalg.lstsq(
        np.column_stack([2 * on_arc, np.ones(len(on_arc))]), (on_arc**2).sum(axis=1)
    )[0]
    twin = wrapped(float(centre[0]), float(centre[1]))
    data = twin.physics.data
    model = twin.physics.model
    head = model.body("connector_1").id
    tail = model.body(f"connector_{connectors}").id
    ahead = data.xmat[head][[0, 3]].copy()
    behind = -data.xmat[tail][[0, 3]]
    start = data.xpos[head][:2].copy()
    vented = np.full((connectors - 1, 2), -1, dtype=np.int8)
    pulls = []
    speed = 0.01
    stiffness = 2000.0
    damping = 20.0
    for k in range(2000):
        time = k * twin.tick
        velocity = np.empty(6)
        mujoco.mj_objectVelocity(
            model, data, mujoco.mjtObj.mjOBJ_BODY, head, velocity, 0
        )
        pull = stiffness * (start + ahead * speed * time - data.xpos[head][:2])
        pull += damping * (ahead * speed - velocity[3:5])
        data.xfrc_applied[head, :2] = pull
        data.xfrc_applied[tail, :2] = hold_back * min(time / 0.2, 1.0) * behind
        twin.step(vented)
        pulls.append(pull @ ahead)
    return float(np.mean(pulls[-500:])), hold_back


def test_plants_without_objects_refuse_them():
    world = World(objects=(CYLINDER,))
    with pytest.raises(
        InputError, match="does not support movable objects; use the twin"
    ):
        AnalyticalSnake(GEN2, world=world)
    with pytest.raises(InputError, match="contact 'loaded'"):
        TwinSnake(GEN2, contact="preloaded", world=world)
