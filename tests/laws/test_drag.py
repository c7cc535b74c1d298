"""Axial drag brakes all connectors along their headings independently of their loads, on both plants."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from snakes import GRAVITY, robot, throw, vented

from srs_twin import (
    AnalyticalSnake,
    Gait,
    LoadedContact,
    PreloadedContact,
    RobotSpec,
    TwinSnake,
    rollout,
)

DRAG = 0.08
STIFF = robot(stiffness=20.0)
MASS = STIFF.mass.total
SPIN_MASS = 2 * STIFF.geometry.connectors * STIFF.mass.wheel / 2


def dragged(spec: RobotSpec, drag: float = DRAG, **changes: float) -> RobotSpec:
    return replace(spec, friction=replace(spec.friction, drag=drag, **changes))


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    ("plant", "rolls"),
    [
        (lambda spec: AnalyticalSnake(spec, friction="wheel"), 0.0),
        pytest.param(
            lambda spec: AnalyticalSnake(spec, model="compliant", friction="ellipse"),
            0.0,
            marks=pytest.mark.slow,
        ),
        (
            lambda spec: TwinSnake(spec, contact=LoadedContact(slip_speed=1e-4)),
            SPIN_MASS,
        ),
        (
            lambda spec: TwinSnake(spec, contact=PreloadedContact(slip_speed=1e-4)),
            SPIN_MASS,
        ),
        (
            lambda spec: TwinSnake(
                spec, contact=PreloadedContact("skid", slip_speed=1e-4)
            ),
            0.0,
        ),
    ],
    ids=["complete", "compliant", "loaded", "preloaded", "skid"],
)
def test_drag_acts_along_the_heading_only(plant, rolls):
    spec = dragged(STIFF)
    for direction, brake in (
        (0, STIFF.friction.mu_t * MASS * GRAVITY + DRAG),
        (1, STIFF.friction.mu_n * MASS * GRAVITY),
    ):
        snake = plant(spec)
        velocity = [0.0, 0.0]
        velocity[direction] = 0.5
        throw(snake, tuple(velocity))
        start = (
            snake.physics.center_of_mass()[:2]
            if isinstance(snake, TwinSnake)
            else np.zeros(2)
        )
        for _ in range(80):
            state = snake.step(vented(spec))
        distance = (MASS + rolls * (direction == 0)) * 0.5**2 / (2 * brake)
        assert (state.com - start)[direction] == pytest.approx(distance, rel=0.02)


def test_drag_equals_a_larger_mu_t_under_the_axis_law():
    spec = robot()
    fraction = DRAG / (spec.mass.total * GRAVITY)
    rougher = replace(
        spec, friction=replace(spec.friction, mu_t=spec.friction.mu_t + fraction)
    )
    result = [
        rollout(AnalyticalSnake(item), Gait(2.0, offset=0.3), 1.0)
        for item in (dragged(spec), rougher)
    ]
    for name in ("com_x", "com_y", "heading"):
        assert result[0][name] == pytest.approx(result[1][name], abs=1e-9)


def test_drag_differs_from_mu_t_with_two_contacts():
    spec = robot()
    fraction = DRAG / (spec.mass.total * GRAVITY)
    rougher = replace(
        spec, friction=replace(spec.friction, mu_t=spec.friction.mu_t + fraction)
    )
    ends = [
        rollout(TwinSnake(entry, contact=LoadedContact("axis")), Gait(2.0), 2.0)[
            "com_x"
        ][-1]
        for entry in (dragged(spec), rougher)
    ]
    assert abs(ends[0] - ends[1]) > 0.02 * abs(ends[1])


@pytest.mark.slow
@pytest.mark.parametrize("contact", ["loaded", "preloaded"])
def test_drag_slows_twin_and_compliant_model_equally(contact):
    def way(plant: AnalyticalSnake | TwinSnake) -> float:
        actual = rollout(plant, Gait(2.0), 2.0)
        return float(actual["com_x"][-1] - actual["com_x"][0])

    both = robot(), dragged(robot())
    free, braked = (
        way(AnalyticalSnake(spec, model="compliant", friction="wheel")) for spec in both
    )
    coarse, fine = (
        [way(TwinSnake(spec, contact=contact, timestep=step)) for spec in both]
        for step in (1e-3, 5e-4)
    )
    assert coarse == pytest.approx(fine, rel=0.02)
    # Axial friction that is there anyway weighs more in the model, which is faster.
    for twin in (coarse, fine):
        assert 0.6 * (free - braked) < twin[0] - twin[1] < free - braked
