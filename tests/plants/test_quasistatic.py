"""The spatial body without inertia: kinematics, statics, friction and agreement with other plants."""

import math
from dataclasses import replace

import numpy as np
import pytest
from heavy_rod import sag
from scipy.spatial.transform import Rotation
from snakes import shortened

from srs_twin import AnalyticalSnake, Gait, load_robot, load_scenario, rollout
from srs_twin.control.gait import PitchWave
from srs_twin.errors import DivergedError, InputError, InputFileError
from srs_twin.plants.analytical import (
    quasistatic_kernels,
    spatial_kinematics as kernels,
)
from srs_twin.plants.analytical.quasistatic import make_constants
from srs_twin.robot.spec import GRAVITY, Skin
from srs_twin.robot.world import Floor, World

SLENDER = load_robot("spatial_slender")
SEGMENTS = 6


def short(segments=SEGMENTS, **bending):
    """Return the slender robot with fewer segments; its waves are as long as itself."""
    return replace(
        shortened(SLENDER, segments + 1),
        bending=replace(SLENDER.bending, **bending),
        phase_step=2 * math.pi / segments,
    )


SPEC = short()
SIDEWINDING = PitchWave(0.3, math.pi / 2)


def crawl(
    spec=SPEC,
    *,
    frequency=0.5,
    pitch=SIDEWINDING,
    periods=1.0,
    pose=(0.0, 0.0, 0.0),
    step=0.01,
    **gait,
):
    snake = AnalyticalSnake(spec, model="quasistatic", timestep=step)
    run = rollout(
        snake,
        Gait(frequency, pitch=pitch, **gait),
        periods / frequency,
        pose=pose,
        record_hz=25,
    )
    return snake, run


@pytest.fixture(scope="module")
def sidewinder():
    return crawl(periods=2.0)


def posed(seed):
    """Return a random state, its constants and workspace."""
    constants = make_constants(SPEC, 1e-4, "free")
    points = SPEC.skin.points
    workspace = kernels.work_arrays(SEGMENTS, points)
    state = np.zeros(kernels.BENDS + 3 * SEGMENTS + 4 * SEGMENTS * points)
    draw = np.random.default_rng(seed)
    state[:3] = draw.normal(size=3)
    state[kernels.ROTATION :][:9] = Rotation.random(rng=draw).as_matrix().ravel()
    state[kernels.BENDS :][: 3 * SEGMENTS] = draw.normal(size=3 * SEGMENTS) * 0.5
    return state, constants, workspace


@pytest.mark.slow
def test_velocities_of_all_points_are_the_derivatives_of_their_positions():
    state, constants, workspace = posed(0)
    kernels.pose(state, constants, workspace)
    motion = workspace.motion[:, :3].copy()
    size = 6 + 3 * SEGMENTS
    for row in range(size):
        velocity = np.eye(size)[row]
        places = []
        for step in (1e-6, -1e-6):
            moved = state.copy()
            workspace.bend[:] = workspace.load[:] = 0.0
            kernels.pose(state, constants, workspace)
            quasistatic_kernels.move_state(
                velocity,
                moved,
                constants,
                workspace,
                step,
                np.empty((3, 3)),
                np.empty(9),
            )
            kernels.pose(moved, constants, workspace)
            places.append(workspace.point.copy())
        assert (places[0] - places[1]) / 2e-6 == pytest.approx(
            motion[:, :, row], abs=1e-7
        )


def test_bends_and_twist_are_the_rotation_between_connectors():
    state, constants, workspace = posed(1)
    kernels.pose(state, constants, workspace)
    left, up, twist = state[kernels.BENDS :][: 3 * SEGMENTS].reshape(-1, 3).T
    turns = Rotation.from_rotvec(np.stack([twist, -up, left], axis=-1)).as_matrix()
    relative = np.einsum("jki,jkl->jil", workspace.frame[1:], workspace.frame[:-1])
    assert relative == pytest.approx(turns, abs=1e-12)


def test_a_segment_bent_in_one_plane_is_an_arc():
    state, constants, workspace = posed(2)
    bend = 1.1
    state[kernels.BENDS :][: 3 * SEGMENTS] = 0.0
    state[kernels.BENDS + 1] = bend
    kernels.pose(state, constants, workspace)
    behind = workspace.frame[0].T @ (workspace.position[1] - workspace.position[0])
    radius = constants.length / bend
    gap = constants.gap
    # Both ends of a body that bends upwards rise, so that the rear is above the frame
    # of the head.
    along = gap + radius * math.sin(bend) + gap * math.cos(bend)
    up = radius * (1 - math.cos(bend)) + gap * math.sin(bend)
    assert behind == pytest.approx([-along, 0.0, up], abs=1e-12)


@pytest.mark.slow
def test_a_cantilever_sags_as_the_elastica():
    segments = 8
    stiffness = 0.5
    spec = short(
        segments,
        stiffness=stiffness,
        pitch_stiffness=stiffness,
        roll_stiffness=stiffness,
    )
    # All of the body bends: rods with gaps are stiffer than the elastica.
    spec = replace(spec, geometry=replace(spec.geometry, rigid_gap=1e-6))
    snake = AnalyticalSnake(spec, model="quasistatic", base="clamped", timestep=0.01)
    state = snake.state
    for _ in range(25):
        state = snake.step(np.full((segments, 4), -1, dtype=np.int8))
    expected = sag(spec)
    assert expected > 0.1
    drop = state.height[0] - state.height[-1]
    assert drop / spec.geometry.body_length == pytest.approx(expected, rel=0.01)


@pytest.mark.slow
def test_loads_balance_the_weight_and_its_moment(sidewinder):
    snake, run = sidewinder
    body = snake.body
    state = body.state
    points = len(body.constants.mass)
    kernels.pose(state, body.constants, body.workspace)
    loads = state[-points:]
    place = body.workspace.point
    weight = body.constants.mass * GRAVITY
    assert 0.1 < (loads > 0.0).mean() < 0.9
    assert loads.sum() == pytest.approx(weight.sum(), rel=2e-3)
    radius = np.ptp(place[:, 0])
    for axis in (
        0,
        1,
    ):  # the friction acts at the radius below the axis: a moment of up to μ r W
        arm = place[:, axis] - place[:, axis].mean()
        lever = SPEC.friction.mu_n * SPEC.geometry.com_height
        assert abs(arm @ (loads - weight)) < weight.sum() * (lever + 1e-3 * radius)


@pytest.mark.slow
def test_the_work_of_the_air_is_dissipated_or_stored(sidewinder):
    snake, run = sidewinder
    body = snake.body
    state = body.state
    constants = body.constants
    twist = state[kernels.BENDS :][: 3 * SEGMENTS].reshape(-1, 3)[:, 2]
    kernels.pose(state, constants, body.workspace)
    height = body.workspace.point[:, 2] - constants.radius
    stored = (
        GRAVITY * constants.mass @ height + constants.stiffness[2] / 2 * twist @ twist
    )
    names = [kernels.FRICTION_LOSS, kernels.INTERNAL_LOSS, kernels.DRAG_LOSS]
    losses = state[names]
    assert state[kernels.WORK] == pytest.approx(losses.sum() + stored, rel=0.02)
    assert (losses > 0.0).all()


@pytest.mark.slow
def test_a_slower_gait_of_slower_chambers_has_the_same_path(sidewinder):
    slow = replace(
        SPEC.actuator,
        tau_fill=2 * SPEC.actuator.tau_fill,
        tau_vent=2 * SPEC.actuator.tau_vent,
    )
    _, run = crawl(replace(SPEC, actuator=slow), frequency=0.25, periods=2.0, step=0.02)
    moved, expected = (path.com[-1] - path.com[0] for path in (run, sidewinder[1]))
    assert np.linalg.norm(moved - expected) < 0.02 * np.linalg.norm(expected)


@pytest.mark.slow
def test_a_turned_start_turns_the_path_and_a_mirrored_gait_mirrors_it():
    _, run = crawl()
    _, turned = crawl(pose=(0.3, -0.2, 1.0))
    turn = np.array([[math.cos(1.0), -math.sin(1.0)], [math.sin(1.0), math.cos(1.0)]])
    assert turned.com - [0.3, -0.2] == pytest.approx(run.com @ turn.T, abs=1e-7)
    # Half a period later the wave to the left and right is mirrored; the pitch wave
    # lags by half a period.
    _, mirrored = crawl(pitch=PitchWave(0.3, -math.pi / 2), phase=math.pi)
    assert mirrored.com * [1, -1] == pytest.approx(run.com, abs=1e-7)


@pytest.mark.slow
def test_a_planar_gait_moves_as_the_compliant_planar_model():
    spec = replace(SPEC, friction=replace(SPEC.friction, mu_t=0.1, mu_back=0.1))
    snake = AnalyticalSnake(spec, model="quasistatic", timestep=0.01)
    planar = replace(spec, chamber=replace(spec.chamber, directions=None))
    reference = AnalyticalSnake(planar, model="compliant", timestep=0.002)
    gait = Gait(0.5)
    run, expected = (
        rollout(plant, gait, 4.0, record_hz=25) for plant in (snake, reference)
    )
    assert run.stack("bend") == pytest.approx(expected.stack("bend"), abs=0.01)
    step = expected.com[-1] - expected.com[0]
    assert np.linalg.norm(run.com[-1] - run.com[0] - step) < 0.03 * np.linalg.norm(step)
    assert abs(run.stack("z") - SPEC.geometry.com_height).max() < 1e-4


@pytest.mark.slow
def test_half_the_step_hardly_changes_the_path():
    coarse, fine = (crawl(step=step)[1].com[-1] for step in (0.02, 0.01))
    assert np.linalg.norm(coarse - fine) < 1e-3 * np.linalg.norm(fine)


@pytest.mark.slow
def test_a_saved_state_continues_with_the_same_bits():
    gait = Gait(0.5, pitch=SIDEWINDING)
    first = AnalyticalSnake(SPEC, model="quasistatic", timestep=0.01)
    gait.reset(SPEC, first.tick)
    commands = [gait.step(first.state) for _ in range(10)]
    for command in commands[:5]:
        first.step(command)
    saved = first.save()
    second = AnalyticalSnake(SPEC, model="quasistatic", timestep=0.01)
    second.restore(saved)
    for command in commands[5:]:
        one = first.step(command)
        other = second.step(command)
    assert (
        (one.com == other.com).all()
        and (one.load == other.load).all()
        and (one.connector_heading == other.connector_heading).all()
    )


@pytest.mark.slow
def test_a_heavy_snake_that_stands_on_its_bend_falls_over_and_the_jump_is_counted():
    spec = replace(SPEC, actuator=replace(SPEC.actuator, tau_fill=0.5, tau_vent=0.5))
    snake = AnalyticalSnake(spec, model="quasistatic", timestep=0.01)
    up = np.full((SEGMENTS, 4), -1, dtype=np.int8)
    up[:, 2] = 1
    for _ in range(100):
        state = snake.step(up)
    # All segments bent upwards form a ring with a single support, which topples.
    assert (
        snake.jumps >= 1 and abs(state.height - SPEC.geometry.com_height).min() < 1e-3
    )


@pytest.mark.slow
def test_a_step_that_cannot_be_made_short_enough_ends_the_run():
    snake = AnalyticalSnake(SPEC, model="quasistatic", timestep=0.01)
    snake.body.constants = snake.body.constants._replace(longest_move=1e-12)
    up = np.full((SEGMENTS, 4), -1, dtype=np.int8)
    up[:, 2] = 1
    before = snake.body.state.copy()
    with pytest.raises(DivergedError, match="step 1 of"):
        snake.step(up)
    assert (snake.body.state == before).all()


def test_robots_worlds_and_laws_that_have_no_solution_are_refused():
    with pytest.raises(
        InputError, match="'quasistatic' does not support the planar robot 'gen2'"
    ):
        AnalyticalSnake(load_robot("gen2"), model="quasistatic")
    with pytest.raises(InputError, match="'cosine', because it has no potential"):
        AnalyticalSnake(replace(SPEC, skin=Skin("cosine")), model="quasistatic")
    longer = replace(SPEC, actuator=replace(SPEC.actuator, extension=1e-7))
    with pytest.raises(InputError, match="only segments of constant length"):
        AnalyticalSnake(longer, model="quasistatic")
    with pytest.raises(InputError, match="level floor"):
        AnalyticalSnake(SPEC, model="quasistatic", world=World(floor=Floor(tilt=0.1)))
    with pytest.raises(
        InputFileError,
        match="the planar robot 'gen2' .without `chamber.directions_deg`",
    ):
        load_scenario(
            "gen2_straight", set={"plants.analytical": {"model": "quasistatic"}}
        )


@pytest.mark.slow
def test_twin_and_quasistatic_plant_agree_on_a_slow_sidewinder():
    from srs_twin import TwinSnake, compare

    gait = Gait(0.25, pitch=SIDEWINDING)
    snake = AnalyticalSnake(SLENDER, model="quasistatic", timestep=0.01)
    twin = TwinSnake(SLENDER, hinges_per_segment=3, timestep=0.002)
    one, other = (rollout(plant, gait, 16.0, record_hz=25) for plant in (snake, twin))
    metrics = compare(one, other).metrics
    assert abs(metrics["travel_speed_rel"]) < 0.03
    assert math.degrees(metrics["travel_direction_abs"]) < 3.0
    assert metrics["contact_agreement"] > 0.9
