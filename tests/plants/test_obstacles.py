"""Obstacles of the twin: no penetration, forces consistent with Newton's law, no effect at a distance."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from snakes import robot

from srs_twin import Gait, LoadedContact, Trajectory, TwinSnake, load_scenario, rollout
from srs_twin.compute.compiled import compiled
from srs_twin.plants.analytical import kinematics
from srs_twin.plants.analytical.cells import LumpedSegments
from srs_twin.plants.analytical.compliant_kernels import WorkArrays
from srs_twin.plants.analytical.obstacles import (
    add_contacts,
    find_near,
    make_obstacles,
)
from srs_twin.robot.world import Bounds, Circle, Goal, Polygon, World

ROUND = World((Circle(0.25, 0.02, 0.06), Circle(0.2, -0.25, 0.05)))
WALL = World(polygons=(Polygon(((0.2, -0.5), (0.3, -0.5), (0.3, 0.5), (0.2, 0.5))),))
OBLIQUE = World(polygons=(Polygon(((0.15, -0.3), (0.6, 0.2), (0.6, -0.3))),))
WORLDS = {"round": ROUND, "wall": WALL, "oblique": OBLIQUE}
met = pytest.mark.parametrize("name", WORLDS)


def driven(
    world: World | None, name: str = "gen2", duration: float = 4.0, **options
) -> tuple[TwinSnake, Trajectory]:
    twin = TwinSnake(robot(name), supply_pa=48e3, world=world, **options)
    return twin, rollout(twin, Gait(2.0), duration, record_hz=500)


def forces(run: Trajectory) -> np.ndarray:
    """Return the force of the obstacles on each connector, shape (samples, N, 2), N."""
    return np.stack([run.stack(f"obstacle_force_{axis}") for axis in "xy"], axis=-1)


def deepest(twin: TwinSnake, run: Trajectory) -> float:
    """Return the largest depth of the body in an obstacle, from the recorded positions, m."""
    model = twin.physics.model
    data = mujoco.MjData(model)
    result = 0.0
    for qpos in run.stack("qpos")[::5]:
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        for contact in data.contact:
            if any(
                model.geom(geom).name.startswith("collision") for geom in contact.geom
            ):
                result = max(result, -contact.dist)
    return result


@met
def test_a_snake_driven_into_an_obstacle_stays_out_of_it(name):
    twin, run = driven(WORLDS[name])
    assert np.abs(forces(run)).max() > 0.5, "it did run into it"
    assert deepest(twin, run) < 0.001
    if name == "wall":
        reach = run.position[..., 0].max()
        assert reach < 0.2 - twin.spec.geometry.width / 2 + 0.001


@pytest.mark.slow
@met
@pytest.mark.parametrize("friction_law", ["wheel", "ellipse"])
def test_floor_and_obstacle_forces_accelerate_the_centre_of_mass(name, friction_law):
    """Newton's law of the whole snake with recorded forces and positions."""
    twin = TwinSnake(
        robot(), supply_pa=48e3, world=WORLDS[name], contact=LoadedContact(friction_law)
    )
    gait = Gait(2.0)
    mass = twin.spec.mass.total
    gait.reset(twin.spec, twin.tick)
    history = twin.play(gait.script(3.0), 1500)
    pushed = history.contact_force.sum(axis=1) + history.obstacle_force.sum(axis=1)
    impulse = np.cumsum(pushed, axis=0) * 0.002
    momentum = mass * history.com_velocity
    assert np.abs(history.obstacle_force).max() > 0.5
    # Momentum drifts to first order in the step, as it does without obstacles
    # (laws/test_frictionless.py).
    assert impulse == pytest.approx(momentum, abs=0.05 * np.abs(momentum).max())
    without = np.cumsum(history.contact_force.sum(axis=1), axis=0) * 0.002
    assert np.abs(without - momentum).max() > np.abs(momentum).max()


def test_normal_force_of_a_circle_is_radial():
    circle = Circle(0.25, 0.02, 0.06)
    _, run = driven(World((circle,)), duration=2.0)
    force = forces(run)
    size = np.linalg.norm(force, axis=2)
    away = run.position - [circle.x, circle.y]
    away /= np.linalg.norm(away, axis=2, keepdims=True)
    hit = size > 0.2
    assert hit.any()
    # Friction of 0.5 turns it by 27°, half a pitch between connector and contact by
    # some 35° more.
    assert ((force * away).sum(axis=2)[hit] > 0.4 * size[hit]).all()


def test_remote_obstacles_do_not_change_the_motion():
    _, alone = driven(None, duration=1.0)
    _, bounded = driven(
        World(bounds=Bounds((-1, 1), (-1, 1)), goal=Goal(0.5, 0, None, 0.05)),
        duration=1.0,
    )
    assert all((bounded[name] == alone[name]).all() for name in alone.columns)
    assert not any(name.startswith("obstacle") for name in alone.columns)
    far, run = driven(World((Circle(5, 5, 0.1),)), duration=1.0)
    assert run["com_x"] == pytest.approx(alone["com_x"], abs=1e-6)
    assert far.has_contact and not forces(run).any()


def test_obstacle_contact_converges_with_the_time_step():
    ends = []
    for timestep in (0.001, 0.0005):
        _, run = driven(OBLIQUE, timestep=timestep, duration=2.0)
        ends.append([*run.com[-1], run["heading"][-1]])
    difference = np.abs(np.subtract(*ends))
    assert (difference < [0.02, 0.02, 0.2]).all()


def test_twin_of_a_scenario_has_its_obstacles(tmp_path):
    path = tmp_path / "blocked.yaml"
    path.write_text(
        "robot: gen2\nduration_s: 2\ncontroller: {kind: gait, frequency_hz: 2.0}\n"
        "world: {obstacles: [{x_m: 0.25, y_m: 0.02, radius_m: 0.06}]}\n"
    )
    scenario = load_scenario(path)
    run = rollout(scenario.build_plant("twin"), scenario.build_controller(), 2.0)
    assert np.abs(forces(run)).max() > 0.2 and run.unit("obstacle_force_x_1") == "N"
    assert (
        "obstacle_force_x_1"
        not in rollout(
            scenario.build_plant("analytical"), scenario.build_controller(), 1.0
        ).columns
    )


@compiled
def contact_forces(obstacles, body, velocity, loads, origin):
    """Call the contact kernel, which only other kernels can call."""
    find_near(obstacles, origin, 1.0)
    return add_contacts(obstacles, body, velocity, 0.0, loads)


@pytest.mark.parametrize(
    ("speed", "factor"), [(0.0, 1.0), (-0.05, 2.0), (0.05, 0.0), (0.1, 0.0)]
)
def test_analytical_contact_is_a_spring_whose_damping_prevents_tension(speed, factor):
    """The force is m/T² times the overlap at rest, and 0 at rebound speeds above 1/χ = 50 mm/s.

    Friction follows the normal force of the previous solution.
    """
    spec = robot()
    width = spec.geometry.width
    overlap = 1e-5
    slip = 1e-3
    circle = Circle(0.0, -(0.05 + width / 2 - overlap), 0.05)
    world = World((circle,), friction=0.4)
    cells = LumpedSegments(spec)
    obstacles = make_obstacles(world, spec, cells, slip)
    obstacles.pose[:] = 0.0, 0.0, 1.0, 0.0
    points = len(cells.mass)
    middle = points // 2
    obstacles.load[0, middle] = 0.3
    body = np.zeros((kinematics.ROWS, points))
    body[kinematics.COS] = 1.0
    # The middle connector is at the origin, above the circle.
    body[kinematics.X] = spec.geometry.pitch * (middle - np.arange(points))
    loads = WorkArrays.of(points).loads
    velocity = np.array([0.02, speed, 0.0])
    total = contact_forces(obstacles, body, velocity, loads, np.zeros(3))
    push = factor * spec.mass.total / 0.001**2 * overlap
    rub = -0.4 * 0.3 * 0.02 / np.hypot(0.02, slip)
    expected = [rub, push, width / 2 * rub, -push * speed - rub * 0.02]
    assert total == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert obstacles.force[middle] == pytest.approx([rub, push], rel=1e-9, abs=1e-12)
    assert obstacles.normal[0, middle] == pytest.approx(push, rel=1e-9)
    assert np.count_nonzero(obstacles.force.any(axis=1)) == 1
