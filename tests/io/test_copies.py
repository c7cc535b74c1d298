"""Copies and pickles of plants, controllers and batches continue bit for bit or are rejected."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from snakes import chain
from subsets import first_by_default
from test_saved_state import same, scenario, simulate, started

from srs_twin import Gait, InputError, TwinBatch, TwinSnake, load_robot
from srs_twin.pneumatics.valves import StuckValve
from srs_twin.robot.file import RobotFile, load_robot_file

METHODS = {
    "pickle": lambda original: pickle.loads(pickle.dumps(original)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
}
# Each plant, chamber model, controller and sensor at least once.
CASES = [
    ("complete", "lag", "gait", "ideal"),
    ("complete", "lag", "direct_smc", "hall"),
    ("simplified", "lag", "follow", "ideal"),
    ("compliant", "orifice", "ilc", "hall"),
    ("loaded", "orifice", "gait", "hall"),
    ("loaded", "lag", "follow", "hall"),
    ("loaded", "lag", "iterative_smc", "ideal"),
    ("preloaded", "lag", "ilc", "ideal"),
    ("skid", "lag", "gait", "ideal"),
]
LONG = chain((0.05,) * 11)


def copies(original: Any) -> dict[str, Any]:
    return {name: method(original) for name, method in METHODS.items()}


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    "case", first_by_default(4, map(pytest.param, CASES)), ids="-".join
)
def test_copies_during_a_run_continue_bit_for_bit(case):
    plant, controller = started(scenario(*case), seed=5)
    simulate(plant, controller, 11)
    pairs = copies((plant, controller)) | {
        "alone": (copy.copy(plant), copy.copy(controller))
    }
    pairs.pop("copy")  # a shallow copy of a tuple is the tuple
    # The copies run first, so that state shared with the original would change before
    # it runs.
    moved = {name: simulate(*pair, 9) for name, pair in pairs.items()}
    here = simulate(plant, controller, 9)
    for name, (other, steering) in pairs.items():
        assert all(map(same, here, moved[name])), name
        assert repr(steering.signals()) == repr(controller.signals()), name
        assert (other.openings() == plant.openings()).all(), name
    events = controller.events()
    assert all(steering.events() == events for _, steering in pairs.values())


@pytest.mark.parametrize("contact", ["loaded", "preloaded"])
def test_copies_of_a_twin_keep_changes_of_its_model(contact):
    twin = TwinSnake(LONG, contact=contact)
    model = twin.physics.model
    model.body_mass[-1] *= 1.5
    model.dof_damping[6:] *= 0.7
    twin.pneumatics.stuck = (StuckValve(1, 0, 1, 0.0),)
    gait = Gait(2.0, 0.2)
    gait.reset(twin.spec, twin.tick)
    simulate(twin, gait, 3)
    others = copies(twin)
    for other in others.values():
        assert other.physics.model is not model
        assert other.pneumatics is other.physics._pneumatics is not twin.pneumatics
    moved = {name: simulate(other, gait, 3) for name, other in others.items()}
    here = simulate(twin, gait, 3)
    assert all(all(map(same, here, states)) for states in moved.values())
    assert not same(
        here[-1], simulate(restarted := TwinSnake(LONG, contact=contact), gait, 6)[-1]
    )
    assert restarted.physics.model.body_mass[-1] != model.body_mass[-1]


def test_copied_physics_steps_and_contacts_alone_are_rejected():
    twin = TwinSnake(load_robot("gen2"), contact="loaded")
    physics = copy.copy(twin.physics)
    schedule = twin.pneumatics.schedule(np.ones((4, 2)), twin.tick)
    for stepped in (physics, twin.physics):
        stepped.run(stepped.advance_chambers(schedule, 20))
    assert (physics.data.qpos == twin.physics.data.qpos).all()
    assert np.any(physics.data.qvel)
    for method in METHODS.values():
        with pytest.raises(
            InputError,
            match=r"contact.* neither copied nor pickled on its own; .*`save\(\)`",
        ):
            method(twin.physics.stepper)


@pytest.mark.slow
def test_copied_batch_continues_bit_for_bit():
    gen2 = load_robot("gen2")
    rough = replace(gen2, friction=replace(gen2.friction, mu_t=0.2))
    batch = TwinBatch([gen2, rough], threads=2)
    valves = np.random.default_rng(0).integers(0, 2, (8, 2, 4, 2)) * 2 - 1
    for commands in valves[:4]:
        batch.step(commands)
    others = copies(batch)
    moved = {
        name: [other.step(commands) for commands in valves[4:]]
        for name, other in others.items()
    }
    here = [batch.step(commands) for commands in valves[4:]]
    assert all(all(map(same, here, states)) for states in moved.values())


ELSEWHERE = """
import pickle, sys
from pathlib import Path
from srs_twin.io.saved_state import SavedState
def run():
    for _ in range(5):
        plant.step(controller.step(plant.state))
    print(plant.state.position.tobytes().hex())
plant, controller = pickle.loads(Path("pickle").read_bytes())
run()
plant.restore(SavedState.read(Path("plant.npz")))
controller.restore(SavedState.read(Path("controller.npz")))
run()
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [("loaded", "lag", "follow", "hall"), ("compliant", "orifice", "ilc", "hall")],
    ids="-".join,
)
def test_pickles_and_saved_states_continue_bit_for_bit_in_another_process(
    case, tmp_path
):
    plant, controller = started(scenario(*case), seed=5)
    simulate(plant, controller, 6)
    (tmp_path / "pickle").write_bytes(pickle.dumps((plant, controller)))
    plant.save().write(tmp_path / "plant.npz")
    controller.save().write(tmp_path / "controller.npz")
    expected = simulate(plant, controller, 5)[-1].position.tobytes().hex()
    command = [sys.executable, "-c", ELSEWHERE]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == [expected] * 2


class ScheduledOffset(Gait):
    """A user's gait with one more attribute."""

    def __init__(self, extra: Any) -> None:
        super().__init__(2.0)
        self.extra = extra


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (lambda time: 0.1, "a lambda or a nested function"),
        ((item for item in ()), "a generator"),
        (ThreadPoolExecutor(1).submit, "a task that runs in another thread"),
    ],
    ids=["function", "generator", "thread"],
)
def test_controller_with_an_attribute_that_cannot_be_copied_is_rejected(
    method, extra, message
):
    with pytest.raises(
        InputError,
        match=rf"attribute 'extra' is {message}; use save\(\) and restore\(\)",
    ):
        METHODS[method](ScheduledOffset(extra))


def test_incomplete_state_is_rejected_and_changes_nothing():
    twin = TwinSnake(load_robot("gen2"))
    state = twin.save()
    twin.step(np.ones((4, 2)))
    before = twin.state
    for name in state.content:
        incomplete = {key: value for key, value in state.content.items() if key != name}
        with pytest.raises(
            InputError,
            match=f"TwinSnake: the state is incomplete, because it has no {name}",
        ):
            twin.restore(replace(state, content=incomplete))
    assert twin.state is before


@pytest.mark.parametrize("name", ["gen2", "gen4"])
def test_pickled_robot_file_draws_the_same_robots(name):
    plain = load_robot_file(name).model_dump(exclude_unset=True)
    spread = {"value": 0.1, "unit": "1", "status": "estimated", "source": "a test"}
    file = RobotFile.model_validate(plain | {"modules": {"gain_spread": spread}})
    again = pickle.loads(pickle.dumps(file))
    assert again == file and repr(again) == repr(file)
    assert again.spec(3) == file.spec(3) != file.spec(4)
