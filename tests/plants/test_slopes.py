"""Floors with slope or steps, and load transfer by lateral forces, on both plants."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from snakes import GRAVITY, robot

from srs_twin import (
    AnalyticalSnake,
    Gait,
    InputError,
    LoadedContact,
    Numerics,
    TwinSnake,
    rollout,
)
from srs_twin.control.replay import HoldValves
from srs_twin.robot.spec import Friction
from srs_twin.robot.world import (
    OBSTACLE_FRICTION as FRICTION,
    WALL_M,
    Floor,
    FloorStep,
    Polygon,
    World,
)

SPEC = robot()
MU = {"along": SPEC.friction.mu_t, "across": SPEC.friction.mu_n}
DOWNHILL = {"along": math.pi, "across": -math.pi / 2}
PLANTS = {
    "twin": lambda **given: TwinSnake(SPEC, contact="loaded", **given),
    "twin on skids": lambda **given: TwinSnake(
        SPEC, contact=LoadedContact("ellipse"), **given
    ),
    "complete": lambda **given: AnalyticalSnake(SPEC, **given),
    "compliant": lambda **given: AnalyticalSnake(
        SPEC, model="compliant", friction="wheel", load="instantaneous", **given
    ),
}
MARKED_PLANTS = [
    pytest.param(name, marks=[pytest.mark.slow] if name == "compliant" else [])
    for name in PLANTS
]
AIRLESS = HoldValves("vent", "vent")


def on_slope(plant: str, direction: str, fraction: float):
    """Return distance and downhill speed after 1 s on a slope relative to the friction angle."""
    tilt = math.atan(fraction * MU[direction])
    world = World(floor=Floor(tilt, DOWNHILL[direction] + math.pi))
    run = rollout(PLANTS[plant](world=world), AIRLESS, 1.0, record_hz=50)
    ahead = np.array([math.cos(DOWNHILL[direction]), math.sin(DOWNHILL[direction])])
    com = run.com @ ahead
    return com[-1] - com[0], (com[-1] - com[-2]) * 50, run


@pytest.mark.default_cases(at=[0, 3, 4])
@pytest.mark.parametrize("direction", MU)
@pytest.mark.parametrize("plant", MARKED_PLANTS)
def test_snake_at_rest_on_a_slope_does_not_creep(plant, direction):
    assert abs(on_slope(plant, direction, 0.5)[1]) < 1e-6
    assert (
        abs(on_slope(plant, direction, 0.995)[1]) < 2e-4
    )  # just below the friction angle


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("direction", MU)
@pytest.mark.parametrize("plant", MARKED_PLANTS)
def test_slide_beyond_the_friction_angle_follows_coulomb(plant, direction):
    assert on_slope(plant, direction, 1.005)[1] > 1e-3
    path, _, run = on_slope(plant, direction, 1.2)
    tilt = math.atan(1.2 * MU[direction])
    pulled = GRAVITY * (math.sin(tilt) - MU[direction] * math.cos(tilt))
    spun = 1 + SPEC.geometry.connectors * SPEC.mass.wheel / SPEC.mass.total
    expected = pulled / 2 / (spun if plant == "twin" and direction == "along" else 1)
    assert path == pytest.approx(expected, rel=0.01)
    # Nothing but the slope moves it.
    lost = SPEC.mass.total * GRAVITY * math.sin(tilt) * path
    assert abs(run["work"][-1]) < 0.01 * lost


def test_both_plants_climb_a_slope_with_similar_speed():
    tilt = math.radians(4.0)
    speeds = []
    for uphill in (0.0, 2.0):
        world = World(floor=Floor(tilt, uphill))
        for plant in ("twin", "compliant"):
            run = rollout(
                PLANTS[plant](world=world, supply_pa=48.3e3),
                Gait(2.0),
                2.0,
                pose=(0, 0, uphill),
            )
            speeds.append(math.hypot(*(run.com[-1] - run.com[50])))
    level = rollout(PLANTS["twin"](supply_pa=48.3e3), Gait(2.0), 2.0)
    assert speeds[0] == pytest.approx(speeds[1], rel=0.1)
    assert speeds[2:] == pytest.approx(
        speeds[:2], rel=1e-3
    )  # independent of the initial heading
    assert speeds[0] < 0.8 * (level["com_x"][-1] - level["com_x"][50])


def test_lateral_force_transfers_load():
    # All wheels slide sideways: h/(2a) times the friction of both is transferred
    # between them.
    plant = TwinSnake(SPEC, contact="loaded")
    plant.physics.data.qvel[1] = 0.5
    plant.step(np.full((SPEC.segments, 2), -1))
    loads = plant.physics.wheel_loads()
    force = plant.physics.floor_forces()[..., 1].sum(axis=1)
    shift = SPEC.geometry.com_height / (2 * SPEC.geometry.half_track) * force
    assert (loads[:, 1] - loads[:, 0]) / 2 == pytest.approx(shift, rel=0.02)


def test_momentary_loads_agree_between_plants():
    # On both plants what loads change is the same where the twin's connectors keep
    # their own weights.
    changes = {}
    for kind in ("twin", "compliant"):
        turned = []
        for load in ("static", "instantaneous"):
            contact = LoadedContact(load="across" if load == "instantaneous" else load)
            plant = (
                TwinSnake(
                    SPEC,
                    contact=contact,
                    numerics=Numerics(wheel_spin=0.0),
                    supply_pa=48.3e3,
                )
                if kind == "twin"
                else AnalyticalSnake(
                    SPEC,
                    model="compliant",
                    friction="wheel",
                    load=load,
                    inertia="connector",
                    supply_pa=48.3e3,
                )
            )
            run = rollout(plant, Gait(2.0, 0.3), 5.0)
            turned.append(run["heading"][-1] - run["heading"][50])
        changes[kind] = turned[1] / turned[0] - 1
    assert changes["twin"] == pytest.approx(changes["compliant"], abs=0.01)


@pytest.mark.parametrize(
    ("height", "reached"), [(0.002, True), (-0.005, True), (0.02, False)]
)
def test_wheels_climb_steps_up_to_the_limit(height, reached):
    front = SPEC.geometry.body_length / 2
    world = World(steps=(FloorStep(front + 0.03, height),))
    twin = TwinSnake(SPEC, contact="loaded", supply_pa=48.3e3, world=world)
    run = rollout(twin, Gait(2.0), 4.0)
    head = run.position[-1, 0, 0]
    assert (head > front + 0.1) == reached
    if reached:
        heights = twin.physics.connector_positions()[:, 2] - SPEC.geometry.com_height
        assert heights[0] == pytest.approx(height, abs=5e-4)


def test_snake_leaning_on_a_wall_is_in_static_equilibrium():
    tilt = math.radians(40)
    side = -SPEC.geometry.width
    wall = Polygon(((-1.0, side - 0.2), (1.0, side - 0.2), (1.0, side), (-1.0, side)))
    world = World(floor=Floor(tilt, math.pi / 2), polygons=(wall,))
    twin = TwinSnake(SPEC, contact="loaded", world=world)
    run = rollout(twin, AIRLESS, 3.0)
    assert abs(run["com_y"][-1] - run["com_y"][-11]) < 1e-6
    weight = SPEC.mass.total * GRAVITY
    g = SPEC.geometry
    resting = twin.pneumatics.rest_trace().at(np.zeros(2, dtype=int))
    _, pushed, held = twin.physics.run(resting).obstacle_force[0].sum(axis=0)
    loads = twin.physics.wheel_loads().sum(axis=0)
    across = twin.physics.floor_forces()[..., 1].sum()
    assert pushed + across == pytest.approx(weight * math.sin(tilt), rel=1e-3)
    assert loads.sum() + held == pytest.approx(weight * math.cos(tilt), rel=1e-3)
    assert abs(held) < FRICTION * pushed
    # Tipping moments of the floor force, below the centres of mass, and of the wall
    # force, beside them.
    tipped = (g.com_height * across - g.width / 2 * held) / g.half_track
    assert loads[1] - loads[0] == pytest.approx(tipped, rel=0.01)


def along_a_wall(uphill):
    """Snake on frictionless wheels, resting on a wall below it on a slope of 10 degrees."""
    side = -SPEC.geometry.width / 2 - WALL_M - 1e-4
    wall = Polygon(((-3.0, side - 0.2), (3.0, side - 0.2), (3.0, side), (-3.0, side)))
    world = World(floor=Floor(math.radians(10), uphill), polygons=(wall,))
    spec = replace(SPEC, friction=Friction(mu_t=0.0, mu_n=0.0))
    twin = TwinSnake(spec, contact="loaded", world=world)
    rollout(twin, AIRLESS, 2.0)
    return twin


def test_wall_friction_follows_coulomb():
    twin = along_a_wall(math.pi / 2)
    still = np.full((SPEC.segments, 2), -1)
    twin.physics.data.qvel[0] = 0.3
    states = [twin.step(still) for _ in range(6)]
    slowed = (states[0].com_velocity[0] - states[-1].com_velocity[0]) / (5 * twin.tick)
    assert slowed == pytest.approx(
        FRICTION * GRAVITY * math.sin(math.radians(10)), rel=1e-3
    )
    rubbed, pressed = states[-1].obstacle_force.sum(axis=0)
    assert -rubbed == pytest.approx(FRICTION * pressed, rel=1e-3)
    lost = states[-1].work - states[0].work  # motion less what friction took
    assert lost == pytest.approx(0.0, abs=0.01 * SPEC.mass.total * 0.3**2 / 2)


@pytest.mark.parametrize(("fraction", "moves"), [(0.98, False), (1.02, True)])
def test_snake_against_a_wall_sticks_up_to_the_friction_angle(fraction, moves):
    lean = math.atan(fraction * FRICTION)  # slope of the wall in the plane of the floor
    drift = (
        along_a_wall(math.pi / 2 - lean)
        .advance(np.full((SPEC.segments, 2), -1), 1)[-1]
        .com_velocity[0]
    )
    assert (abs(drift) > 1e-3) == moves
    assert moves or abs(drift) < 1e-6


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda world: TwinSnake(SPEC, contact="preloaded", world=world), "'loaded'"),
        (lambda world: AnalyticalSnake(SPEC, world=world), "use the twin"),
    ],
)
def test_unsupported_floor_raises(build, words):
    with pytest.raises(InputError, match=words):
        build(World(steps=(FloorStep(0.5, 0.002),)))


@pytest.mark.parametrize(
    "steps",
    [(FloorStep(500.0, 0.002),), (FloorStep(0.5, 0.002), FloorStep(0.5, 0.001))],
)
def test_steps_may_be_far_away_or_coincide(steps):
    plant = TwinSnake(SPEC, contact="loaded", world=World(steps=steps))
    assert rollout(plant, AIRLESS, 0.1)["com_x"][-1] == pytest.approx(0.0, abs=1e-6)


def test_snake_must_start_before_the_first_step():
    with pytest.raises(
        InputError, match="before the first step of the floor at x = -0.05 m"
    ):
        TwinSnake(SPEC, contact="loaded", world=World(steps=(FloorStep(-0.05, 0.002),)))


def test_momentary_loads_need_two_wheels():
    with pytest.raises(InputError, match="instantaneous"):
        AnalyticalSnake(SPEC, load="instantaneous")
