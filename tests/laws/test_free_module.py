"""A module without load obeys the identified second-order law, in the chambers and in MuJoCo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from snakes import chain, robot

from srs_twin import RobotSpec, TwinSnake
from srs_twin.pneumatics import LagPneumatics

PSI = 6894.757
SUPPLY = 8 * PSI
FILL_PLUS = np.array([[1, -1]], dtype=np.int8)
VENT = np.array([[-1, -1]], dtype=np.int8)


def step_response(time: np.ndarray) -> np.ndarray:
    """Return the bend of gen 4 after a step to 8 psi from the printed coefficients (Eq. 15, E1, E2), rad."""
    return 0.8366 - 0.8531 * np.exp(-time / 0.1107) + 0.0165 * np.exp(-time / 0.00214)


def module(name: str, stiffness: float) -> RobotSpec:
    """Return one light segment between two connectors of a robot, on a floor without friction."""
    spec = robot(name)
    return replace(
        chain((0.01, 0.01), length=0.01, gap=0.0, mu_t=0.0, mu_n=0.0),
        actuator=spec.actuator,
        bending=replace(spec.bending, stiffness=stiffness),
    )


def test_chambers_give_the_identified_step_response():
    pneumatics = LagPneumatics(module("gen4", 1.0), supply_pa=SUPPLY)
    time = np.linspace(0, 0.6, 301)
    trace = pneumatics.advance(pneumatics.schedule(FILL_PLUS, 0.6), time)
    # The printed coefficients have four digits.
    assert trace.bend[:, 0] == pytest.approx(step_response(time), abs=2e-4)


@pytest.mark.parametrize("timestep", [0.001, 0.0005])
def test_bend_of_a_stiff_module_in_mujoco_follows_the_identified_step_response(
    timestep,
):
    plant = TwinSnake(module("gen4", 20.0), supply_pa=SUPPLY, timestep=timestep)
    samples = round(plant.tick / timestep)
    time = []
    bend = []
    for valves in [FILL_PLUS] * 30:
        for state in plant.advance(valves, samples):
            time.append(state.time)
            bend.append(state.bend[0])
    error = np.array(bend) - step_response(np.array(time))
    assert np.abs(error).max() < 0.01 * 0.8366
    assert abs(error[-1]) < 5e-4


def test_stiff_module_in_mujoco_follows_the_chambers_through_valve_events():
    """Random valve events every 5 ms: the deviation from the chambers is of first order in the step."""
    coarse = _distance_from_free_bend(0.001)
    fine = _distance_from_free_bend(0.00025)
    assert coarse < 0.02
    assert fine < 0.5 * coarse


def _distance_from_free_bend(timestep: float) -> float:
    """Return the RMS distance of the twin's bend from the free bend, relative to its deviation."""
    spec = module("gen2", 20.0)
    plant = TwinSnake(spec, timestep=timestep, tick=0.02)
    free = LagPneumatics(spec, supply_pa=spec.supply.nominal)
    generator = np.random.default_rng(5)
    twin = []
    chambers = []
    for _ in range(50):
        slots = generator.choice([-1, 1], size=(4, 1, 2)).astype(np.int8)
        twin.append(plant.step(slots).bend[0])
        chambers.append(
            free.advance(free.schedule(slots, plant.tick), np.array([plant.tick])).bend[
                0, 0
            ]
        )
    return float(np.sqrt(np.mean(np.subtract(twin, chambers) ** 2)) / np.std(chambers))
