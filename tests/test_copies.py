"""Copies and pickles of plants, controllers and batches continue with the same bits, or are refused."""

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
from test_memory import go_on, same, scenario, started

from srs_twin import Gait, InputError, TwinBatch, TwinSnake, load_robot
from srs_twin.pneumatics.valves import StuckValve
from srs_twin.robot.file import RobotFile, load_robot_file

WAYS = {
    "pickle": lambda thing: pickle.loads(pickle.dumps(thing)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
}
# Every plant, chamber, controller and sensor at least once.
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
]  # fmt: skip
LONG = chain((0.05,) * 11)


def copies(thing: Any) -> dict[str, Any]:
    return {name: way(thing) for name, way in WAYS.items()}


@pytest.mark.parametrize("case", first_by_default(4, map(pytest.param, CASES)), ids="-".join)
def test_copies_during_a_run_continue_identically(case):
    plant, controller = started(scenario(*case), seed=5)
    go_on(plant, controller, 11)
    pairs = copies((plant, controller)) | {"alone": (copy.copy(plant), copy.copy(controller))}
    pairs.pop("copy")  # the copy of a tuple is the tuple itself
    # The copies run first, so any state shared with the original changes before the original runs.
    moved = {name: go_on(*pair, 9) for name, pair in pairs.items()}
    here = go_on(plant, controller, 9)
    for name, (other, steering) in pairs.items():
        assert all(map(same, here, moved[name])), name
        assert repr(steering.signals()) == repr(controller.signals()), name
        assert (other.openings() == plant.openings()).all(), name
    events = controller.events()
    assert all(steering.events() == events for _, steering in pairs.values())


@pytest.mark.parametrize("contact", ["loaded", "preloaded"])
def test_copies_of_a_twin_keep_changes_of_its_model(contact):
    twin = TwinSnake(LONG, contact=contact)
    model = twin.physics.model.ptr
    model.body_mass[-1] *= 1.5
    model.dof_damping[6:] *= 0.7
    twin.pneumatics.stuck = (StuckValve(1, 0, 1, 0.0),)
    gait = Gait(2.0, 0.2)
    gait.reset(twin.spec, twin.tick)
    go_on(twin, gait, 3)
    others = copies(twin)
    for other in others.values():
        assert other.physics.model.ptr is not model
        assert other.pneumatics is other.physics._pneumatics is not twin.pneumatics
    moved = {name: go_on(other, gait, 3) for name, other in others.items()}
    here = go_on(twin, gait, 3)
    assert all(all(map(same, here, item)) for item in moved.values())
    assert not same(here[-1], go_on(restarted := TwinSnake(LONG, contact=contact), gait, 6)[-1])
    assert restarted.physics.model.ptr.body_mass[-1] != model.body_mass[-1]


def test_physics_can_be_copied_and_contacts_alone_cannot():
    twin = TwinSnake(load_robot("gen2"), contact="loaded")
    physics = twin.physics.copy()
    for item in (physics, twin.physics):
        item.set_control(np.ones((4, 2)))
        item.step(20)
    assert (physics.data.qpos == twin.physics.data.qpos).all() and np.any(physics.data.qvel)
    with pytest.raises(InputError, match="leave out share_model"):
        physics.copy(share_model=True)
    for way in WAYS.values():
        with pytest.raises(InputError, match=r"contacts .* neither copied nor pickled alone; .*save\(\)"):
            way(twin.physics.loaded)


def test_copied_batch_continues_identically():
    gen2 = load_robot("gen2")
    rough = replace(gen2, friction=replace(gen2.friction, mu_t=0.2))
    batch = TwinBatch([gen2, rough], threads=2)
    valves = np.random.default_rng(0).integers(0, 2, (8, 2, 4, 2)) * 2 - 1
    for item in valves[:4]:
        batch.step(item)
    others = copies(batch)
    moved = {name: [other.step(item) for item in valves[4:]] for name, other in others.items()}
    here = [batch.step(item) for item in valves[4:]]
    assert all(all(map(same, here, item)) for item in moved.values())


ELSEWHERE = """
import pickle, sys
for name in sys.argv[1:]:
    with open(name, "rb") as file:
        plant, controller = pickle.load(file)
    for _ in range(5):
        plant.step(controller.step(plant.state))
    print(plant.state.position.tobytes().hex())
"""


@pytest.mark.slow
def test_pickles_continue_identically_in_another_process(tmp_path):
    expected, names = [], []
    for case in (("loaded", "lag", "follow", "hall"), ("preloaded", "lag", "gait", "ideal")):
        plant, controller = started(scenario(*case), seed=5)
        go_on(plant, controller, 6)
        names.append(case[0])
        (tmp_path / case[0]).write_bytes(pickle.dumps((plant, controller)))
        go_on(plant, controller, 5)
        expected.append(plant.state.position.tobytes().hex())
    words = [sys.executable, "-c", ELSEWHERE, *names]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.split() == expected


class Steered(Gait):
    """A user's gait with one more attribute."""

    def __init__(self, own: Any) -> None:
        super().__init__(2.0)
        self.own = own


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    ("own", "words"),
    [
        (lambda time: 0.1, "a function without a name in its module"),
        ((item for item in ()), "a generator"),
        (ThreadPoolExecutor(1).submit, "a task of another thread"),
    ],
    ids=["function", "generator", "thread"],
)
def test_controller_that_cannot_be_copied_is_refused_with_a_remedy(way, own, words):
    with pytest.raises(InputError, match=rf"attribute 'own' is {words}; use save\(\) and restore\(\)"):
        WAYS[way](Steered(own))


def test_incomplete_state_is_refused_without_side_effects():
    twin = TwinSnake(load_robot("gen2"))
    state = twin.save()
    twin.step(np.ones((4, 2)))
    there = twin.state
    for name in state.content:
        less = {key: value for key, value in state.content.items() if key != name}
        with pytest.raises(InputError, match=f"TwinSnake: the state is incomplete; it has no {name}"):
            twin.restore(replace(state, content=less))
    assert twin.state is there


@pytest.mark.parametrize("name", ["gen2", "gen4"])
def test_pickled_robot_files_draw_the_same_robots(name):
    plain = load_robot_file(name).model_dump(exclude_unset=True)
    spread = {"value": 0.1, "unit": "1", "status": "estimated", "source": "a test"}
    file = RobotFile.model_validate(plain | {"modules": {"gain_spread": spread}})
    again = pickle.loads(pickle.dumps(file))
    assert again == file and repr(again) == repr(file)
    assert again.spec(3) == file.spec(3) != file.spec(4)
