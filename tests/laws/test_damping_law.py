"""The moment k (q_f − q) + c (q̇_f − q̇) on the twin: light bodies, hinges, closed chambers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from free_bends import free_bends
from snakes import robot

from srs_twin import (
    AnalyticalSnake,
    DivergedError,
    Gait,
    RobotSpec,
    SnakeState,
    TwinSnake,
    rollout,
)
from srs_twin.pneumatics.orifice import OrificePneumatics

SUPPLY = 48_300.0
FRICTIONLESS = {"mu_t": 1e-9, "mu_n": 1e-9}


def damped(time: float, *, fraction: float = 1.0) -> RobotSpec:
    """Return generation 2 without friction, with its masses multiplied by `fraction`."""
    spec = robot(**FRICTIONLESS)
    masses = tuple(fraction * mass for mass in spec.mass.connectors)
    mass = replace(spec.mass, connectors=masses, wheel=fraction * spec.mass.wheel)
    return replace(spec, mass=mass, bending=replace(spec.bending, damping_time=time))


def deviation(spec: RobotSpec, timestep: float = 0.001, **options: Any) -> float:
    """Return the largest deviation of the bends from Eq. 14 in a gait, rad."""
    plant = TwinSnake(spec, supply_pa=SUPPLY, timestep=timestep, **options)
    gait = Gait(2.0, 0.1)
    run = rollout(plant, gait, 0.6, record_hz=1000)
    return float(
        np.abs(run.stack("bend") - free_bends(plant, gait, run.time).bend).max()
    )


@pytest.mark.parametrize(
    "time",
    [0.00214, *(pytest.param(time, marks=pytest.mark.slow) for time in (0.008, 0.03))],
)
def test_bends_of_light_bodies_are_the_free_bends_to_first_order_in_the_step(time):
    heavy = deviation(damped(time))
    light = deviation(damped(time, fraction=1e-3))
    assert light < 0.15 * heavy
    fine = deviation(damped(time, fraction=1e-3), 0.0005)
    assert fine == pytest.approx(light / 2, rel=0.25)
    assert fine < 0.007


@pytest.mark.parametrize("hinges", [1, 4])
def test_held_bends_are_the_free_bends_on_any_number_of_hinges(hinges):
    spec = damped(0.008)
    plant = TwinSnake(spec, supply_pa=SUPPLY, hinges_per_segment=hinges)
    filled = np.tile(np.array([1, -1], dtype=np.int8), (spec.segments, 1))
    state = plant.play(plant.pneumatics.schedule(filled, 3.0), 1)
    assert state.bend[-1] == pytest.approx(plant.pneumatics.bend, abs=1e-6)


@pytest.mark.parametrize("time", [0.03, pytest.param(0.00214, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "kind", ["compliant", pytest.param("twin", marks=pytest.mark.slow)]
)
def test_closed_chambers_are_passive(kind, time):
    """Motion between closed chambers decays if T ≥ τ₂ a/(1 + a), with the air's stiffness a k."""
    spec = damped(time)
    chambers = OrificePneumatics(spec, supply_pa=SUPPLY, layout="in_out")
    common: dict[str, Any] = {
        "pneumatics": chambers,
        "layout": "in_out",
        "timestep": 2.5e-4,
    }
    plant: AnalyticalSnake | TwinSnake
    if kind == "twin":
        plant = TwinSnake(spec, **common)
    else:
        plant = AnalyticalSnake(spec, model="compliant", friction="wheel", **common)
    rollout(plant, Gait(2.0, 0.2), 0.62)
    closed = plant.pneumatics.schedule(np.zeros((spec.segments, 2)), 1.0)
    states = plant.play(closed, 500)
    speed = np.gradient(states.bend, states.time, axis=0)
    motion = (speed**2).sum(axis=1).reshape(10, 50).max(axis=1)
    # Energy moves between the bends. The motion in a tenth of the run may therefore
    # equal the motion in the tenth before, but it must not grow.
    rounding = 1e-20 * motion[0]
    assert (motion[1:] <= 1.001 * motion[:-1] + rounding).all()
    assert motion[-1] < 1e-2 * motion[0]


def lightly_damped(mode: float, timestep: float = 5e-4) -> TwinSnake:
    """Return a twin with orifices, a damping time of 0.7 ms and a mode time constant."""
    spec = robot()
    spec = replace(
        spec,
        bending=replace(spec.bending, damping_time=0.0007),
        actuator=replace(spec.actuator, tau_mode=mode),
    )
    return TwinSnake(spec, supply_pa=SUPPLY, pneumatics="orifice", timestep=timestep)


@pytest.mark.parametrize("timestep", [5e-4, 1e-3])
def test_a_delayed_moment_of_closed_chambers_drives_oscillations(timestep):
    """With the longer step, the engine diverges, and the error names the cause."""
    with pytest.raises(DivergedError, match="but can do only .* J") as caught:
        rollout(lightly_damped(0.00214, timestep), Gait(2.0, 0.4), 0.5)
    before = caught.value.trajectory
    assert before.time[-1] < caught.value.time
    assert before["work"][-1] < 2 * before["pneumatic_energy"][-1]


def test_a_moment_with_less_delay_does_not():
    run = rollout(lightly_damped(0.001), Gait(2.0, 0.4), 0.5)
    assert run["work"][-1] < 0.5 * run["pneumatic_energy"][-1]


def start_bent(plant: TwinSnake, seed: int) -> SnakeState:
    bend = np.array([1.3, -1.3, 1.3, -1.3])
    return plant.set_state(replace(plant.reset(seed=seed), bend=bend))


def close_supply(plant: TwinSnake, time: float) -> None:
    if time == 0.2:
        plant.pneumatics.set_supply_pressure(1000.0)


@pytest.mark.parametrize("case", ["bent", "supply", "line"])
def test_the_work_of_the_air_includes_only_what_the_air_does(case):
    """The elastic energy of a bent start and the air in the line are no excess."""
    chambers: Any = "orifice"
    if case == "line":
        chambers = OrificePneumatics(
            robot(), supply_pa=SUPPLY, layout="3/2", flow_limit=2e-5
        )
    plant = TwinSnake(robot(), supply_pa=SUPPLY, pneumatics=chambers, timestep=2.5e-4)
    options: dict[str, Any] = {}
    if case == "bent":
        options["initial_state"] = start_bent
    elif case == "supply":
        options["observers"] = [lambda state: close_supply(plant, state.time)]
    run = rollout(plant, Gait(2.0, 0.4), 0.4, **options)
    assert (np.diff(run["pneumatic_energy"][:20]) >= 0).all()
    assert run["pneumatic_energy"][-1] > 0.9 * run["pneumatic_energy"].max()
