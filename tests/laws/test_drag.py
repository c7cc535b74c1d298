"""Drag of tubes and belly brakes every connector along its heading, whatever it carries, on both plants."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from snakes import GRAVITY, robot, throw, vented

from srs_twin import AnalyticalSnake, Gait, LoadedContact, PreloadedContact, RobotSpec, TwinSnake, rollout

DRAG = 0.08
STIFF = robot(stiffness=20.0)
MASS = STIFF.mass.total
SPIN_MASS = 2 * STIFF.geometry.connectors * STIFF.mass.wheel / 2


def dragged(spec: RobotSpec, drag: float = DRAG, **changes: float) -> RobotSpec:
    return replace(spec, friction=replace(spec.friction, drag=drag, **changes))


@pytest.mark.parametrize(
    ("plant", "rolls"),
    [
        (lambda spec: AnalyticalSnake(spec, friction="wheel"), 0.0),
        (lambda spec: AnalyticalSnake(spec, model="compliant", friction="ellipse"), 0.0),
        (lambda spec: TwinSnake(spec, contact=LoadedContact(slip_speed=1e-4)), SPIN_MASS),
        (lambda spec: TwinSnake(spec, contact=PreloadedContact(slip_speed=1e-4)), SPIN_MASS),
        (lambda spec: TwinSnake(spec, contact=PreloadedContact("skid", slip_speed=1e-4)), 0.0),
    ],
    ids=["complete", "compliant", "loaded", "preloaded", "skid"],
)
def test_it_adds_to_what_the_wheels_take_along_and_nothing_across(plant, rolls):
    spec = dragged(STIFF)
    for direction, brake in (
        (0, STIFF.friction.mu_t * MASS * GRAVITY + DRAG),
        (1, STIFF.friction.mu_n * MASS * GRAVITY),
    ):
        snake, velocity = plant(spec), [0.0, 0.0]
        velocity[direction] = 0.5
        throw(snake, tuple(velocity))
        start = snake.physics.center_of_mass()[:2] if isinstance(snake, TwinSnake) else np.zeros(2)
        for _ in range(80):
            state = snake.step(vented(spec))
        way = (MASS + rolls * (direction == 0)) * 0.5**2 / (2 * brake)
        assert (state.com - start)[direction] == pytest.approx(way, rel=0.02)


def test_of_equal_connectors_under_the_axis_law_it_is_a_greater_mu_t():
    spec = robot()
    share = DRAG / (spec.mass.total * GRAVITY)
    rougher = replace(spec, friction=replace(spec.friction, mu_t=spec.friction.mu_t + share))
    found = [rollout(AnalyticalSnake(each), Gait(2.0, offset=0.3), 1.0) for each in (dragged(spec), rougher)]
    for name in ("com_x", "com_y", "heading"):
        assert found[0][name] == pytest.approx(found[1][name], abs=1e-9)


def test_with_two_contacts_per_connector_it_is_not_a_greater_mu_t():
    spec = robot()
    share = DRAG / (spec.mass.total * GRAVITY)
    rougher = replace(spec, friction=replace(spec.friction, mu_t=spec.friction.mu_t + share))
    ends = [
        rollout(TwinSnake(each, contact=LoadedContact("axis")), Gait(2.0), 2.0)["com_x"][-1]
        for each in (dragged(spec), rougher)
    ]
    assert abs(ends[0] - ends[1]) > 0.02 * abs(ends[1])


@pytest.mark.parametrize("contact", ["loaded", "preloaded"])
def test_it_slows_the_twin_as_it_slows_the_compliant_model_at_any_step(contact):
    def way(plant: AnalyticalSnake | TwinSnake) -> float:
        found = rollout(plant, Gait(2.0), 2.0)
        return float(found["com_x"][-1] - found["com_x"][0])

    both = robot(), dragged(robot())
    free, braked = (way(AnalyticalSnake(spec, model="compliant", friction="wheel")) for spec in both)
    coarse, fine = (
        [way(TwinSnake(spec, contact=contact, timestep=step)) for spec in both] for step in (1e-3, 5e-4)
    )
    assert coarse == pytest.approx(fine, rel=0.02)
    # Axial friction that is there anyway weighs more in the model, which is faster.
    for twin in (coarse, fine):
        assert 0.6 * (free - braked) < twin[0] - twin[1] < free - braked
