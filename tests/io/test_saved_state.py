"""Saved states: a restored run continues bit for bit; a placed plant has the given state."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial
from itertools import cycle, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from subsets import first_by_default

from srs_twin import AnalyticalSnake, Gait, InputError, TwinSnake, load_robot, rollout
from srs_twin.control.base import Controller
from srs_twin.io.saved_state import SavedState
from srs_twin.plants.base import Plant, SnakeState
from srs_twin.pneumatics.valves import StuckValve
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.scenario import Scenario

PLANTS = {
    "complete": ("analytical", {"model": "complete"}),
    "simplified": ("analytical", {"model": "simplified", "friction": "wheel"}),
    "compliant": (
        "analytical",
        {"model": "compliant", "friction": "wheel", "load": "instantaneous"},
    ),
    "loaded": ("twin", {"contact": "loaded"}),
    "preloaded": ("twin", {"contact": "preloaded"}),
    "skid": ("twin", {"contact": "loaded", "hinges_per_segment": 4, "wheels": "skid"}),
}
CHAMBERS = {
    "lag": {"kind": "lag", "valve_delay_s": 0.013, "leak_per_s": 0.1},
    "orifice": {"kind": "orifice", "flow_limit_l_per_min": 8.0},
}
SENSORS = {"ideal": {"kind": "ideal"}, "hall": {"kind": "hall"}}
GAIT = {"kind": "gait", "frequency_hz": 1.5}
GIVEN = {
    "kind": "given",
    "footprint": "gen4_ilc",
    "turns_rad": [0.0, 0.4, -0.4, 0.0],
    "step_m": 0.4,
    "margin_m": 0.02,
}
CONTROLLERS = {
    "gait": GAIT | {"offset": 0.1},
    "ilc": {
        "kind": "ilc",
        "frequency_hz": 1.5,
        "offset": 0.1,
        "steering": "targets_and_wave",
    },
    "direct_smc": {
        "kind": "direct_smc",
        "reference": {"kind": "sine", "amplitude_rad": 0.5, "frequency_hz": 1.0},
    },
    "iterative_smc": {
        "kind": "iterative_smc",
        "reference": {"kind": "constant", "bend_rad": 0.4},
    },
    "follow": {
        "kind": "follow",
        "gait": {"kind": "ilc", "frequency_hz": 1.5},
        "delay_s": 0.1,
        "camera": {"position_noise_m": 0.002, "heading_noise_rad": 0.01},
    },
}
BENCH_CONTROLLERS = {"direct_smc", "iterative_smc"}


def scenario(plant: str, chambers: str, controller: str, sensor: str) -> Scenario:
    bench = controller in BENCH_CONTROLLERS
    name, own = PLANTS[plant] if not bench else (PLANTS[plant][0], {})
    if name == "twin" and chambers == "orifice":
        own = own | {"timestep_s": 0.00025}
    document = {
        "robot": "gen4_module" if bench else "gen4",
        "duration_s": 10.0,
        "seed": 3,
        "bench": bench,
        "controller": CONTROLLERS[controller],
        "pneumatics": CHAMBERS[chambers],
        "sensor": SENSORS[sensor],
        "plants": {name: own},
    }
    if controller == "follow":
        document["planner"] = GIVEN
    return parse_scenario(document)


def started(asked: Scenario, seed: int) -> tuple[Plant, Controller]:
    (name,) = asked.plants
    plant = asked.build_plant(name)
    controller = asked.build_controller()
    plant.reset(seed=seed)
    controller.reset(plant.spec, plant.tick, seed=seed)
    return plant, controller


def simulate(plant: Plant, controller: Controller, ticks: int) -> list[SnakeState]:
    return [plant.step(controller.step(plant.state)) for _ in range(ticks)]


def same(one: SnakeState, other: SnakeState) -> bool:
    pairs = (
        (getattr(one, field.name), getattr(other, field.name))
        for field in fields(SnakeState)
    )
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def cases() -> list[tuple[str, str, str, str]]:
    combinations = [
        (plant, chambers, controller)
        for plant, chambers, controller in product(PLANTS, CHAMBERS, CONTROLLERS)
        if controller not in BENCH_CONTROLLERS or plant in ("complete", "loaded")
    ]
    return [
        (*case, sensor)
        for case, sensor in zip(combinations, cycle(SENSORS), strict=False)
    ]


def thirds(values: list[Any]) -> list[Any]:
    """Return the values in an order in which the first third has cases of each plant."""
    return values[::3] + values[1::3] + values[2::3]


def written_and_read(state: SavedState, tmp_path: Path) -> SavedState:
    state.write(tmp_path / "state.npz")
    return SavedState.read(tmp_path / "state.npz")


@pytest.mark.default_cases(at=[0, 3, 6, 7, 9])
@pytest.mark.parametrize(
    "case", first_by_default(10, map(pytest.param, thirds(cases()))), ids="-".join
)
def test_restored_run_continues_bit_for_bit(case, tmp_path):
    asked = scenario(*case)
    rng = np.random.default_rng(sum(map(ord, "".join(case))))
    before = rng.integers(3, 40)
    after = 12
    plant, controller = started(asked, seed=5)
    simulate(plant, controller, int(before))
    state = plant.state
    kept, steering = (
        written_and_read(original.save(), tmp_path) for original in (plant, controller)
    )
    here = simulate(plant, controller, after)
    there, wheel = started(asked, seed=99)
    # The second time, an earlier run must not matter, and the run must not have changed
    # the state that it was restored from.
    for _ in range(2):
        assert same(there.restore(kept), state)
        wheel.restore(steering)
        moved = simulate(there, wheel, after)
        assert all(same(one, other) for one, other in zip(here, moved, strict=True))
    assert repr(controller.signals()) == repr(wheel.signals())
    assert controller.events() == wheel.events()


def test_three_differences_are_named_and_the_rest_counted():
    owner = dict.fromkeys("abcd", 1)
    named = (
        "plant: the saved state has other settings: a 2, was 1; b 2, was 1; c 2, was 1"
    )
    for changed, rest in (("abc", ""), ("abcd", "; and 1 more")):
        with pytest.raises(InputError) as error:
            SavedState(owner, {}).check("plant", owner | dict.fromkeys(changed, 2))
        assert str(error.value) == named + rest


def test_state_of_another_plant_or_robot_is_rejected():
    gen2 = load_robot("gen2")
    state = AnalyticalSnake(gen2).save()
    with pytest.raises(InputError, match="the saved state has other settings"):
        TwinSnake(gen2).restore(state)
    with pytest.raises(InputError, match="model simplified, was complete"):
        AnalyticalSnake(gen2, model="simplified").restore(state)
    softer = replace(gen2, friction=replace(gen2.friction, mu_t=0.2))
    with pytest.raises(InputError, match="robot_digest"):
        AnalyticalSnake(softer).restore(state)
    with pytest.raises(InputError, match="version 0"):
        AnalyticalSnake(gen2).restore(replace(state, version=0))
    with pytest.raises(InputError, match="pneumatics"):
        AnalyticalSnake(gen2, pneumatics="orifice").restore(state)


def test_class_without_state_attributes_is_not_saved():
    class Own(Gait):
        pass

    class Other(Controller):
        kind = "other"

        def reset(self, spec, tick, *, seed=0):
            self.count = 0

        def step(self, state):
            return state.valves

    own = Own(2.0)
    with pytest.raises(InputError, match="no state before its first reset"):
        own.save()
    own.reset(load_robot("gen2"), 0.02)
    own.save()  # it has the state attributes of a gait
    with pytest.raises(
        InputError,
        match="controller 'other' cannot be saved, because its class does not"
        " define `state_attributes`",
    ):
        Other().save()


def test_stuck_valve_is_restored():
    gen2 = load_robot("gen2")
    stuck = AnalyticalSnake(gen2)
    stuck.pneumatics.stuck = (StuckValve(1, 0, 1, 0.0),)
    whole = AnalyticalSnake(gen2)
    whole.restore(stuck.save())
    assert whole.pneumatics.stuck == stuck.pneumatics.stuck


def test_file_of_another_version_is_rejected(tmp_path):
    """Files of version 1 contain module names that no longer exist."""
    tree = (
        '{"version": 1, "of": {}, "content": {"@": "srs_twin.plants.loaded:Memory",'
        ' "parts": {}}}'
    )
    np.savez(tmp_path / "state.npz", state=np.array(tree))
    with pytest.raises(
        InputError,
        match=r"state.npz: the saved state has version 1, but this program reads only version \d",
    ):
        SavedState.read(tmp_path / "state.npz")


def physical(segments: int, seed: int) -> tuple[SnakeState, float]:
    """Return a random initial state and a yaw rate."""
    rng = np.random.default_rng(seed)
    resting = AnalyticalSnake(load_robot("gen2")).state
    bend = rng.uniform(-0.7, 0.7, segments)
    moved = replace(
        resting,
        com=rng.uniform(-1, 1, 2),
        com_velocity=rng.uniform(-0.2, 0.2, 2),
        heading=float(rng.uniform(-6, 6)),
        bend=bend,
        bend_rate=rng.uniform(-3, 3, segments),
        pressure=rng.uniform(0, 40e3, (segments, 2)),
    )
    return moved, float(rng.uniform(-2, 2))


MOVING = {
    "complete": lambda: AnalyticalSnake(load_robot("gen2")),
    "compliant": lambda: AnalyticalSnake(
        load_robot("gen2"), model="compliant", friction="wheel"
    ),
    "loaded": lambda: TwinSnake(
        load_robot("gen2"), contact="loaded", pneumatics="orifice"
    ),
    "preloaded": lambda: TwinSnake(
        load_robot("gen2"), contact="preloaded", hinges_per_segment=3
    ),
}


@pytest.mark.default_cases(at=[0, 1, 2, 3, 4, 8])
@pytest.mark.parametrize("name", MOVING)
@pytest.mark.parametrize("seed", range(3))
def test_placed_plant_has_the_given_state(name, seed):
    plant = MOVING[name]()
    asked, yaw = physical(plant.spec.segments, seed)
    placed = plant.set_state(asked, yaw_rate=yaw)
    attributes = ["com", "com_velocity", "heading", "bend", "pressure"]
    attributes += [] if name == "complete" else ["bend_rate"]
    for field in attributes:
        assert getattr(placed, field) == pytest.approx(
            getattr(asked, field), abs=1e-8
        ), field
    assert placed.connector_heading.mean() == pytest.approx(asked.heading, abs=1e-6)
    assert -np.diff(placed.connector_heading) == pytest.approx(asked.bend, abs=1e-5)
    assert placed.time == 0
    # The velocities show in a short first step, whose length limits the effect of
    # forces.
    h = plant.timestep / 2 if name in ("complete", "compliant") else plant.timestep
    plant.tick = h
    later = plant.step(np.full((plant.spec.segments, 2), -1, dtype=np.int8))
    reach = 40 * h**2 + 1e-9  # 80 m/s² or rad/s² of friction and air
    assert later.com == pytest.approx(placed.com + h * placed.com_velocity, abs=reach)


def test_compliant_model_continues_from_a_physical_state():
    """Only the mode states are not in a physical state; they change the motion for a few milliseconds."""
    snake = MOVING["compliant"]()
    gait = Gait(2.0, 0.1)
    rollout(snake, gait, 1.38, pose=(0.1, 0.2, 0.4))
    yaw = float(snake.body.velocity[2])
    other = MOVING["compliant"]()
    other.set_state(snake.state, yaw_rate=yaw)
    for _ in range(25):
        valves = gait.valves_at(float(snake.state.time))
        one = snake.step(valves)
        two = other.step(valves)
        assert two.com == pytest.approx(one.com, abs=1e-4)
        assert two.bend == pytest.approx(one.bend, abs=1e-3)


@pytest.mark.parametrize("contact", ["loaded", "preloaded"])
def test_twin_continues_near_a_physical_state(contact):
    """Hinge angles, wheel speeds and penetration are not in a physical state: deviations of mm/s."""
    make = partial(TwinSnake, load_robot("gen2"), contact=contact)
    twin = make()
    gait = Gait(2.0)
    rollout(twin, gait, 1.38)
    bodies = twin.physics
    yaw = float(bodies.data.cvel[bodies._connectors, 2].mean())
    other = make()
    other.set_state(twin.state, yaw_rate=yaw)
    for _ in range(10):
        valves = gait.valves_at(float(twin.state.time))
        one = twin.step(valves)
        two = other.step(valves)
    assert np.abs(two.com - one.com).max() < 0.0005
    assert np.abs(two.bend - one.bend).max() < 0.002


def test_impossible_initial_state_is_rejected():
    asked, _ = physical(4, 0)
    snake = AnalyticalSnake(load_robot("gen2"))
    asked = replace(asked, bend=asked.bend[: snake.spec.segments])
    with pytest.raises(
        InputError, match="chamber pressure .* is not allowed; it must be between 0 and"
    ):
        snake.set_state(replace(asked, pressure=np.full((snake.spec.segments, 2), 1e6)))
    with pytest.raises(InputError, match="clamped at its head can only start at rest"):
        AnalyticalSnake(load_robot("gen4_module"), base="clamped").set_state(
            physical(1, 0)[0]
        )
