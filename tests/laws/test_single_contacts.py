"""Single contacts with obstacles against laws of statics and dynamics, on both plants."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from free_bends import free_bends
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve
from snakes import GRAVITY, chain, robot, throw, vented

from srs_twin import (
    AnalyticalSnake,
    Gait,
    LoadedContact,
    Plant,
    RobotSpec,
    TwinSnake,
    rollout,
)
from srs_twin.plants.base import SnakeState
from srs_twin.robot.world import Circle, Floor, Polygon, World

POST = 0.02  # radius, m
TILT = math.radians(60)
PULL = GRAVITY * math.sin(TILT)  # m/s²


def beam(
    stiffness: float, *, masses: tuple[float, ...] = (0.03, 0.3, 0.03)
) -> RobotSpec:
    """Return a snake of two segments without friction on the floor, with strong damping and without gaps."""
    spec = chain(masses, length=0.06, gap=0.0, mu_t=0.0, mu_n=0.0)
    bending = replace(
        spec.bending,
        stiffness=stiffness,
        damping_time=0.02,
        pitch_stiffness=100.0,
        roll_stiffness=100.0,
        out_of_plane_damping_time=0.02,
    )
    return replace(spec, bending=bending, mass=replace(spec.mass, wheel=0.0))


def compliant(spec: RobotSpec, world: World | None, **options) -> AnalyticalSnake:
    settings = {"friction": "ellipse", "inertia": "connector", "contact": True}
    return AnalyticalSnake(spec, model="compliant", world=world, **settings | options)


def twin(spec: RobotSpec, world: World, hinges: int = 6) -> TwinSnake:
    contact = LoadedContact(law="ellipse")
    return TwinSnake(
        spec, world=world, hinges_per_segment=hinges, contact=contact, timestep=0.0005
    )


def settle(plant: Plant, duration: float) -> SnakeState:
    plant.reset()
    for _ in range(round(duration / plant.tick)):
        state = plant.step(vented(plant.spec))
    return state


def two_posts(
    spec: RobotSpec, distance: float, friction: float, uphill: float = math.pi / 2
) -> World:
    """Return a slope on which a straight snake along x lies above two posts."""
    y = -POST - spec.geometry.width / 2
    posts = Circle(distance, y, POST), Circle(-distance, y, POST)
    return World(posts, floor=Floor(TILT, uphill), friction=friction)


def elastica(spec: RobotSpec, distance: float) -> tuple[float, float]:
    """Return force of each post (N) and sag of the middle (m) of an inextensible beam on two smooth posts.

    κ = M/(EI) is integrated from the free end, which carries a mass, past the post to
    the middle; contact and tangent at the middle give two conditions.
    """
    rigidity = spec.bending.stiffness * spec.geometry.segment_length
    end = spec.mass.connectors[0] * PULL
    middle = spec.mass.connectors[1] * PULL
    reach = POST + spec.geometry.width / 2

    def rates(_, y, force_x, force_y):
        return [
            math.cos(y[2]),
            math.sin(y[2]),
            y[3] / rigidity,
            math.sin(y[2]) * force_x - math.cos(y[2]) * force_y,
        ]

    def shape(angle, place):
        tail = solve_ivp(
            rates,
            (spec.geometry.pitch, place),
            [0, 0, angle, 0],
            args=(0.0, -end),
            rtol=1e-9,
        ).y[:, -1]
        force = (middle / 2 + end) / math.cos(tail[2])
        load = -force * math.sin(tail[2]), force * math.cos(tail[2]) - end
        head = solve_ivp(rates, (place, 0.0), tail, args=load, rtol=1e-9).y[:, -1]
        x = tail[0] - head[0] + reach * math.sin(tail[2])
        y = tail[1] - head[1] - reach * math.cos(tail[2])
        return force, y + reach, head[2], x

    def residual(unknown):
        _, _, slope, x = shape(*unknown)
        return [10 * slope, 10 * (x / distance - 1)]

    force, sag, _, _ = shape(*fsolve(residual, [0.1, distance]))
    return force, sag


@pytest.mark.slow
def test_error_of_cells_falls_with_their_square():
    spec = beam(0.1)
    _, sag = elastica(spec, 0.045)
    errors = [
        abs(
            -settle(
                compliant(spec, two_posts(spec, 0.045, 0.0), cells=cells), 3.0
            ).position[1, 1]
            - sag
        )
        for cells in (4, 8, 16)
    ]
    assert errors[0] > 2.5 * errors[1] > 6 * errors[2]


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [0.4, 0.2, 0.1])
def test_plants_and_elastica_agree_on_force_and_deflection(stiffness):
    spec = beam(stiffness)
    world = two_posts(spec, 0.045, 0.0)
    force, sag = elastica(spec, 0.045)
    soft = settle(compliant(spec, world), 3.0)
    total = soft.obstacle_force.sum(axis=0)
    assert total == pytest.approx([0.0, spec.mass.total * PULL], abs=1e-6)
    assert -soft.position[1, 1] == pytest.approx(sag, rel=0.02)
    # The horizontal parts of the two normal forces cancel.
    assert total[1] / 2 == pytest.approx(force * math.cos(soft.bend[0]), rel=0.03)
    rods = settle(twin(spec, world, hinges=8), 2.0)
    assert rods.obstacle_force.sum(axis=0) == pytest.approx(total, rel=1e-3, abs=1e-3)
    assert rods.bend == pytest.approx(soft.bend, rel=0.03)
    assert -rods.position[1, 1] == pytest.approx(sag, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("slope", [0.3, 0.7])
@pytest.mark.parametrize("make", [compliant, twin])
def test_body_slides_along_posts_under_coulomb_friction(make, slope):
    # Gravity presses with cos φ and pulls along with sin φ: the body moves if tan φ >
    # μ.
    friction = 0.5
    spec = beam(20.0, masses=(0.1, 0.1, 0.1))
    angle = math.atan(slope)
    plant = make(spec, two_posts(spec, 0.045, friction, math.pi / 2 + angle))
    duration = 0.2
    state = settle(plant, duration)
    expected = PULL * max(math.sin(angle) - friction * math.cos(angle), 0.0)
    assert state.com_velocity[0] == pytest.approx(
        expected * duration, rel=0.03, abs=2e-3
    )


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_collision_conserves_moment_about_a_smooth_post_and_loses_energy(friction):
    spec = chain((0.03, 0.05, 0.02, 0.04), mu_t=0.0, mu_n=0.0)
    post = Circle(0.0, 0.12, POST)
    plant = compliant(spec, World((post,), friction=friction))
    throw(plant, (0.0, 0.4), spin=2.0)
    body = plant.body
    states = [plant.state]
    energies = []
    moments = []
    impulse = np.zeros(2)
    for _ in range(25):
        states.append(plant.step(vented(spec)))
        impulse += plant.tick * states[-1].obstacle_force.sum(axis=0)
        x, y, _, vx, vy, moment, _ = body.state[:7]
        moments.append(
            moment + spec.mass.total * ((x - post.x) * vy - (y - post.y) * vx)
        )
        bends, momenta = np.split(body.state[7 : 7 + 2 * (len(body.velocity) - 3)], 2)
        springs = (
            spec.bending.stiffness * np.ravel(body.cells.inverse_fraction) * bends**2
        ).sum() / 2
        turning = moment * body.velocity[2] + momenta @ body.velocity[3:]
        kinetic = (spec.mass.total * (vx**2 + vy**2) + turning) / 2
        energies.append(kinetic + springs)
    change = spec.mass.total * (states[-1].com_velocity - np.array([0.0, 0.4]))
    assert np.linalg.norm(change) > 0.01
    assert impulse == pytest.approx(change, abs=1e-9)
    assert max(energies) == pytest.approx(energies[0], rel=1e-9)
    assert energies[-1] < 0.98 * energies[0]
    if friction == 0.0:
        assert moments == pytest.approx(
            [moments[0]] * len(moments), abs=2e-3 * abs(moments[0])
        )


@pytest.mark.slow
@pytest.mark.parametrize("make", [compliant, twin])
def test_work_among_pegs_is_that_of_the_torques(make):
    # Impacts take much of it, in a step or two, with a velocity that changes within the
    # step.
    spec = robot("gen2")
    pegs = Circle(0.24, 0.03, POST), Circle(0.24, -0.07, POST), Circle(0.13, 0.05, POST)
    plant = make(spec, World(pegs))
    run = rollout(plant, Gait(2.0), 1.5, record_hz=1000)
    # The air works on the free bend. The material stores or dissipates the part that
    # does not reach the bend.
    torque = run.stack("torque")
    free = free_bends(plant, Gait(2.0), run.time).bend
    work = ((torque[1:] + torque[:-1]) / 2 * np.diff(free, axis=0)).sum()
    assert run["work"][-1] - run["work"][0] == pytest.approx(work, rel=0.02)


@pytest.mark.slow
def test_body_does_not_pass_through_walls():
    spec = robot("gen2")
    # The wall is so long that the body, which slides along it, does not reach its end.
    wall = Polygon(((0.2, -2.0), (0.21, -2.0), (0.21, 2.0), (0.2, 2.0)))
    plant = compliant(spec, World(polygons=(wall,)))
    trajectory = rollout(plant, Gait(2.0), 4.0)
    front = trajectory.position[..., 0].max() + spec.geometry.width / 2
    assert 0.19 < front < 0.2


@pytest.mark.slow
def test_mirrored_gait_among_mirrored_pegs_is_the_mirror_image():
    spec = robot("gen2")
    pegs = Circle(0.24, 0.03, POST), Circle(0.32, -0.04, POST)
    mirrored = tuple(replace(peg, y=-peg.y) for peg in pegs)
    left = rollout(compliant(spec, World(pegs)), Gait(2.0, 0.2), 1.5)
    right = rollout(
        compliant(spec, World(mirrored)), Gait(2.0, -0.2, phase=math.pi), 1.5
    )
    assert np.abs(left["com_y"] + right["com_y"]).max() < 1e-6
    assert np.abs(left["heading"][-1]) > 0.01


@pytest.mark.slow
def test_cells_do_not_change_a_free_snake():
    # A post far away: the divided body then bends like the undivided one, up to the
    # chord between its wheels.
    spec = robot("gen2")
    far = World((Circle(5.0, 5.0, 0.1),))
    divided = rollout(compliant(spec, far), Gait(2.0, 0.2), 2.0)
    whole = rollout(compliant(spec, None, contact=False), Gait(2.0, 0.2), 2.0)
    assert divided.com[-1] == pytest.approx(whole.com[-1], rel=0.02)


@pytest.mark.slow
def test_obstacles_do_not_matter_without_touch():
    spec = robot("gen2")
    near = World((Circle(0.2, 0.0, POST),))
    passing = rollout(compliant(spec, near, contact=False), Gait(2.0), 1.0)
    free = rollout(compliant(spec, None, contact=False), Gait(2.0), 1.0)
    assert np.array_equal(passing.com, free.com)


@pytest.mark.parametrize("plant", [compliant, twin])
def test_saved_state_among_obstacles_continues_with_the_same_bits(plant):
    spec = robot("gen2")
    world = World(
        tuple(Circle(x, y, POST) for x in (0.17, -0.02, -0.08) for y in (-0.06, 0.06))
    )
    first, second = (plant(spec, world) for _ in range(2))
    gait = Gait(2.0)
    gait.reset(spec, first.tick)
    touches = 0
    for _ in range(60):
        if touched := bool(np.any(first.state.obstacle_force)):
            second.restore(first.save())
        valves = gait.step(first.state)
        one = first.step(valves)
        if touched:
            touches += 1
            other = second.step(valves)
            assert np.array_equal(one.position, other.position)
            assert np.array_equal(one.obstacle_force, other.obstacle_force)
    assert touches > 1
