"""The loads of the wheels sum to the weight of the snake, and on each connector to its own weight."""

from __future__ import annotations

import numpy as np
import pytest
from snakes import GRAVITY, robot, vented

from srs_twin import Gait, PreloadedContact, TwinSnake, rollout
from srs_twin.plants.twin.mjcf.numerics import WHEELS

SPEC = robot()
WEIGHT = SPEC.mass.array() * GRAVITY


FLOORS = {
    **{wheels: {"contact": PreloadedContact(wheels)} for wheels in WHEELS},
    "loaded": {},
}


@pytest.mark.parametrize("floor", FLOORS)
def test_loads_of_a_crawling_snake_are_its_weight_on_average(floor):
    """With rigid pitch and roll, loads vary from 0.73 to 1.24 of their mean."""
    plant = TwinSnake(SPEC, **FLOORS[floor])
    seen = []
    rollout(
        plant,
        Gait(2.0),
        5.0,
        observers=[lambda _: seen.append(plant.physics.wheel_loads())],
    )
    loads = np.array(seen)[50:].sum(axis=2)
    assert loads.sum(axis=1).mean() == pytest.approx(WEIGHT.sum(), rel=2e-3)
    assert loads.mean(axis=0) == pytest.approx(WEIGHT, rel=0.10)
    assert (loads.std(axis=0) / WEIGHT).max() < 0.4


# gen3's tail weighs five times the rest and sinks deeper, so that the chain leans on it
# a little.
@pytest.mark.default_cases(3)
@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.parametrize(
    ("name", "fraction"), [("gen2", 0.03), ("gen4", 0.03), ("gen3", 0.06)]
)
def test_loads_at_rest_are_static(name, fraction, floor):
    plant = TwinSnake(robot(name), **FLOORS[floor])
    for _ in range(100):
        plant.step(vented(plant.spec))
    loads = plant.physics.wheel_loads()
    weight = plant.spec.mass.array() * GRAVITY
    assert loads.sum() == pytest.approx(weight.sum(), rel=1e-6)
    assert loads.sum(axis=1) == pytest.approx(weight, rel=fraction)
    # Without friction in the engine its solver has less to hold on to, and stops at its
    # tolerance, 1e-7.
    assert loads[:, 0] == pytest.approx(
        loads[:, 1], rel=1e-5 if floor == "loaded" else 1e-6
    )


def test_loads_are_independent_of_the_preload():
    bare, pressed = (
        TwinSnake(SPEC, contact=PreloadedContact(preload=k)) for k in (0.0, 9.0)
    )
    for plant in (bare, pressed):
        for _ in range(100):
            plant.step(vented(SPEC))
        assert plant.physics.wheel_loads().sum() == pytest.approx(
            WEIGHT.sum(), rel=1e-6
        )
    assert (
        pressed.physics.connector_positions()[2, 2]
        < bare.physics.connector_positions()[2, 2]
    )
