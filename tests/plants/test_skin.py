"""Robots with skin: symmetry, isotropic friction, rate independence, convergence, agreement of the plants."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from free_bends import free_bends

from srs_twin.control.gait import Gait
from srs_twin.errors import InputError
from srs_twin.plants.analytical import AnalyticalSnake
from srs_twin.plants.analytical.cells import Discretisation, cells_of_skin
from srs_twin.plants.twin.mjcf.belly import patches, rods
from srs_twin.plants.twin.mjcf.numerics import (
    LoadedContact,
    ModelSettings,
    PreloadedContact,
)
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.plants.twin.stick_slip import FloorLaw, skin_friction
from srs_twin.robot import friction
from srs_twin.robot.file import load_robot
from srs_twin.robot.spec import RobotSpec, Skin
from srs_twin.rollout import rollout

SPEC = load_robot("skin_example")
SETTINGS = ModelSettings()
FRICTION_LAWS = pytest.mark.parametrize("friction_law", friction.SKIN_LAWS)


def with_skin(spec: RobotSpec = SPEC, **changes: object) -> RobotSpec:
    assert spec.skin is not None
    return replace(spec, skin=replace(spec.skin, **changes))


def gait_run(plant, offset=0.0, phase=0.0, seconds=3.0):
    return rollout(plant, Gait(1.0, offset, phase=phase), seconds)


def test_bodies_have_the_mass_of_the_robot_spread_over_its_length():
    pitch = SPEC.geometry.pitch
    half = SPEC.geometry.body_length / 2
    expected = SPEC.mass.total * (2 * half) ** 2 / 12
    for places, masses in (
        (
            np.append(0.0, np.cumsum(cells_of_skin(SPEC).length)),
            cells_of_skin(SPEC).mass,
        ),
        (
            np.array([p.place for p in patches(SPEC, SETTINGS)]),
            [p.mass for p in patches(SPEC, SETTINGS)],
        ),
    ):
        assert np.sum(masses) == pytest.approx(SPEC.mass.total)
        assert masses @ places / SPEC.mass.total == pytest.approx(half)
        # Point masses on a grid of pitch/6 have the moment of a rod within (1/48)².
        assert masses @ (places - half) ** 2 == pytest.approx(expected, rel=2 / 48**2)
    width = SPEC.geometry.width
    inertia = AnalyticalSnake(SPEC, inertia="connector")._connector_inertia(np.ones(2))
    assert inertia == pytest.approx(width**2 / 12)
    ends = rods(SPEC, SETTINGS)
    assert [rod.back for rod in ends[:-1]] == [rod.front for rod in ends[1:]]
    assert ends[-1].back == pytest.approx(8 * pitch)


def test_cells_divide_the_arc_and_leave_the_gap_straight():
    cells = Discretisation.of(SPEC.geometry, SPEC.skin.points)
    assert cells.length.sum() == pytest.approx(SPEC.geometry.pitch)
    assert cells.fraction.sum() == pytest.approx(1.0)
    assert cells.length[cells.fraction > 0].sum() == pytest.approx(
        SPEC.geometry.segment_length
    )
    q = np.random.default_rng(0).normal(size=(3, SPEC.segments))
    discretisation = cells_of_skin(SPEC)
    assert discretisation.total(discretisation.split(q)) == pytest.approx(q)


def floor_law(slip: float) -> FloorLaw:
    return FloorLaw(
        friction_law_index=0,
        forward=0.1,
        across=0.5,
        slip_speed=slip,
        spin_mass=0.0,
        backward=0.15,
    )


@FRICTION_LAWS
def test_sliding_skin_of_the_twin_follows_the_law(friction_law):
    rng = np.random.default_rng(1)
    for v_t, v_lat in rng.normal(size=(50, 2)):
        mu = 0.1 if v_t > 0 else 0.15
        slipping = skin_friction(
            v_t, v_lat, 2.0, floor_law(1e-9), 0.0, 0.0, friction_law == "cosine"
        )
        assert slipping[:2] == pytest.approx(
            getattr(friction, friction_law)(v_t, v_lat, 2.0, mu, 0.5, 1e-12)[:2],
            rel=1e-6,
        )


@FRICTION_LAWS
def test_derivatives_of_the_twins_skin_match_finite_differences(friction_law):
    rng = np.random.default_rng(2)
    slip = 1e-2
    for _ in range(50):
        v = rng.normal(scale=slip, size=2)
        p = rng.normal(scale=0.2, size=2)
        values = skin_friction(*v, 2.0, floor_law(slip), *p, friction_law == "cosine")
        for k in range(2):
            h = np.eye(2)[k] * 1e-6 * slip
            ahead = skin_friction(
                *(v + h), 2.0, floor_law(slip), *p, friction_law == "cosine"
            )
            behind = skin_friction(
                *(v - h), 2.0, floor_law(slip), *p, friction_law == "cosine"
            )
            derivatives = (np.array(ahead[:2]) - behind[:2]) / (2e-6 * slip)
            assert [values[2 + k], values[4 + k]] == pytest.approx(
                list(derivatives), rel=1e-4, abs=1e-3
            )


@pytest.mark.slow
@FRICTION_LAWS
@pytest.mark.parametrize("plant", [AnalyticalSnake, TwinSnake])
def test_mirrored_gait_makes_the_mirrored_path(friction_law, plant):
    left = gait_run(plant(with_skin(friction_law=friction_law)), 0.3)
    right = gait_run(plant(with_skin(friction_law=friction_law)), -0.3, np.pi)
    tolerance = (
        1e-6 if plant is AnalyticalSnake else 2e-4
    )  # of a path of some decimetres, m
    assert np.abs(left.com[-1] - right.com[-1] * [1, -1]).max() < tolerance
    assert left["connector_heading_1"][-1] == pytest.approx(
        -right["connector_heading_1"][-1], abs=100 * tolerance
    )


def test_a_set_state_keeps_its_heading_if_the_segments_bend_at_rest():
    bias = tuple(np.linspace(0.05, 0.1, SPEC.segments))
    spec = replace(SPEC, variation=replace(SPEC.modules, bias=bias))
    plant = AnalyticalSnake(spec, model="compliant")
    start = plant.reset(pose=(0.0, 0.0, 0.3))
    state = plant.set_state(replace(start, bend=np.full(SPEC.segments, 0.2)))
    # A uniformly bent body turns by equal angles from the first to the last connector.
    assert state.heading == pytest.approx(0.3, abs=1e-9)
    assert np.ptp(state.connector_heading) == pytest.approx(0.2 * SPEC.segments)


@pytest.mark.slow
def test_backward_friction_brakes_only_backward_slip():
    """A straight body that slides along itself stops after v²/(2 μ g) with the μ of that direction."""
    for v, mu in ((0.3, 0.1), (-0.3, 0.14)):
        for plant in (AnalyticalSnake(SPEC), TwinSnake(SPEC)):
            start = replace(plant.reset(), com_velocity=np.array([v, 0.0]))
            plant.set_state(start)
            run = [
                plant.step(np.full((SPEC.segments, 2), -1)).com[0] for _ in range(25)
            ]
            assert abs(run[-1]) == pytest.approx(v * v / (2 * mu * 9.81), rel=0.02)


@pytest.mark.slow
@FRICTION_LAWS
def test_results_converge_with_the_contact_points(friction_law):
    few, more, most = (
        np.ptp(
            gait_run(
                AnalyticalSnake(with_skin(friction_law=friction_law, points=points))
            ).com[:, 0]
        )
        for points in (6, 12, 48)
    )
    assert abs(more - most) < 0.5 * abs(few - most) < 0.02 * most


@pytest.mark.slow
def test_results_of_the_twin_converge_with_the_contact_points():
    few, most = (
        np.ptp(gait_run(TwinSnake(with_skin(points=points))).com[:, 0])
        for points in (6, 18)
    )
    assert few == pytest.approx(most, rel=0.01)


@pytest.mark.slow
@FRICTION_LAWS
def test_twin_agrees_with_the_compliant_model(friction_law):
    spec = with_skin(friction_law=friction_law, points=12)
    model = AnalyticalSnake(
        spec, model="compliant", inertia="connector", load="instantaneous"
    )
    twin = TwinSnake(spec, hinges_per_segment=4)
    distance = [
        run.com[-1, 0] - run.com[-51, 0] for run in (gait_run(model), gait_run(twin))
    ]
    assert distance[1] == pytest.approx(distance[0], rel=0.03)


@pytest.mark.slow
def test_work_of_compliant_cells_is_the_integral_of_the_torque_power():
    """The work is that of the torques on the free bends of the segments."""
    step = 1e-3
    plant = AnalyticalSnake(SPEC, model="compliant", inertia="connector", timestep=step)
    plant.reset()
    gait = Gait(1.0)
    gait.reset(SPEC, plant.tick)
    h = plant.play(gait.script(1.0), round(1.0 / step))
    free = free_bends(plant, Gait(1.0), h.time).bend
    torque, bend = (
        np.concatenate([np.zeros((1, SPEC.segments)), a]) for a in (h.torque, free)
    )
    expected = np.cumsum(
        ((torque[1:] + torque[:-1]) / 2 * np.diff(bend, axis=0)).sum(axis=1)
    )
    assert np.abs(h.work - expected).max() < 0.005 * h.work[-1]


@pytest.mark.slow
def test_floor_carries_the_weight_evenly():
    twin = TwinSnake(SPEC)
    run = [twin.step(np.full((SPEC.segments, 2), -1)) for _ in range(5)]
    loads = twin.physics.wheel_loads()
    static = [patch.mass * 9.81 / 2 for patch in patches(SPEC, SETTINGS)]
    assert loads.sum() == pytest.approx(SPEC.mass.total * 9.81, rel=1e-6)
    assert loads == pytest.approx(
        np.repeat(np.array(static)[:, None], 2, axis=1), rel=0.05
    )
    assert run[-1].contact_force.shape == (SPEC.geometry.connectors, 2)


@pytest.mark.slow
def test_saved_state_continues_bit_for_bit():
    for plant in (AnalyticalSnake(SPEC, model="compliant"), TwinSnake(SPEC)):
        valves = np.tile([1, -1], (SPEC.segments, 1))
        plant.step(valves)
        saved = plant.save()
        first = plant.step(valves)
        plant.restore(saved)
        assert (plant.step(valves).com == first.com).all()


def test_options_that_a_skin_does_not_have_are_refused():
    with pytest.raises(
        InputError, match="model 'simplified' does not support a robot with skin"
    ):
        AnalyticalSnake(SPEC, model="simplified")
    with pytest.raises(
        InputError, match="does not support a robot with skin; use contact 'loaded'"
    ):
        TwinSnake(SPEC, contact=PreloadedContact())
    with pytest.raises(InputError, match="friction law of a skin"):
        Skin(friction_law="wheel")
    with pytest.raises(InputError, match="either a skin and segment masses, or wheels"):
        replace(SPEC, skin=None)
    assert TwinSnake(SPEC, contact=LoadedContact()).contact.law == "cosine"
