"""Environments: copies continue with the same bits; what is not allowed is refused and changes nothing."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from test_gymnasium import same

from srs_twin import InputError
from srs_twin.envs import TASKS, dm
from srs_twin.envs.gymnasium import SnakeEnv, SnakeVectorEnv
from srs_twin.io.saved_state import SavedState

SHORT = {"limit_s": 0.5}
"""Five steps of a snake, ten of a module: copies see the end and a new beginning."""

WAYS = {
    "pickle": lambda thing: pickle.loads(pickle.dumps(thing)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
}


def played(env: Any, actions: list[np.ndarray]) -> list[Any]:
    """Return the outcomes of some steps, of a reset, and of as many steps more."""
    told = [env.step(action) for action in actions]
    told.append(env.reset())
    return told + [env.step(action) for action in actions]


def drawn(env: Any, count: int) -> list[np.ndarray]:
    env.action_space.seed(2)
    return [env.action_space.sample() for _ in range(count)]


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("when", ["before the first reset", "during an episode"])
def test_copies_of_what_gymnasium_makes_give_the_same_episodes(task, when):
    env = gymnasium.make(f"srs_twin.envs:SRSTwin/{task}-v0", **SHORT)
    env.reset(seed=3)
    actions = drawn(env, 2)
    if when == "before the first reset":
        env = gymnasium.make(f"srs_twin.envs:SRSTwin/{task}-v0", **SHORT)
    else:
        env.step(actions[0])
    others = {name: way(env) for name, way in WAYS.items()}
    if when == "before the first reset":
        for each in (*others.values(), env):
            each.reset(seed=3)
    # The copies move first, so that state which they share with the original has changed when it moves.
    moved = {name: played(other, actions) for name, other in others.items()}
    here = played(env, actions)
    for name in WAYS:
        assert same(moved[name], here), name


def test_deep_copies_of_wrapped_environments_give_the_same_episodes():
    env = TimeLimit(SnakeEnv("GoTo", render_mode="rgb_array"), 3)
    env.reset(seed=1)
    actions = drawn(env, 2)
    others = {name: WAYS[name](env) for name in ("pickle", "deepcopy")}
    moved = {name: played(other, actions) for name, other in others.items()}
    here = played(env, actions)
    assert same(moved["pickle"], here) and same(moved["deepcopy"], here)


def test_copies_of_a_vector_give_the_same_episodes():
    envs = SnakeVectorEnv("Module", 2, threads=2, limit_s=0.1)
    envs.reset(seed=3)
    actions = drawn(envs, 4)  # past the end of the first episodes
    envs.step(actions[0])
    others = {name: way(envs) for name, way in WAYS.items()}
    moved = {name: [other.step(action) for action in actions] for name, other in others.items()}
    here = [envs.step(action) for action in actions]
    for name in WAYS:
        assert same(moved[name], here), name


@pytest.mark.parametrize("task", ["Obstacles", "Module"])
def test_copies_of_a_dm_env_give_the_same_episodes(task):
    env = dm.load(task, seed=4, **SHORT)
    env.reset()
    spec, rng = env.action_spec(), np.random.default_rng(1)
    actions = [rng.uniform(spec.minimum, spec.maximum) for _ in range(2)]
    env.step(actions[0])
    others = {name: way(env) for name, way in WAYS.items()}
    moved = {name: played(other, actions) for name, other in others.items()}
    here = played(env, actions)
    for name in WAYS:
        assert same([tuple(each) for each in moved[name]], [tuple(each) for each in here]), name


BARE = SavedState({}, {})
OPTIONS = {
    "no options": (1, r"options 1 are not allowed; give a dict with state, snake, yaw_rate"),
    "list": ([], r"options \[\] are not allowed"),
    "unknown": ({"stat": 1}, r"unknown option of reset 'stat'; did you mean state\?"),
    "number": ({1: 1}, r"unknown option of reset '1'"),
    "state": ({"state": 1}, r"option state 1 is not allowed; give a SavedState, which episode"),
    "none": ({"state": None}, r"option state None is not allowed"),
    "other": ({"state": BARE}, r"episode of GoTo: the saved state has other settings"),
    "snake": ({"snake": {"com": (0, 0)}}, r"option snake .* give a SnakeState, such as plant.state"),
    "yaw alone": ({"yaw_rate": 0.1}, r"option yaw_rate belongs to option snake; give both"),
    "yaw nan alone": ({"yaw_rate": float("nan")}, r"option yaw_rate belongs to option snake; give both"),
}  # fmt: skip
MOMENTS = {
    "yaw nan": ({}, float("nan"), r"yaw_rate nan is not allowed; it must be a finite number"),
    "yaw infinite": ({}, np.inf, r"yaw_rate inf is not allowed"),
    "yaw text": ({}, "fast", r"yaw_rate 'fast' is not allowed"),
    "yaw list": ({}, [0.1], r"yaw_rate \[0.1\] is not allowed"),
    "yaw none": ({}, None, r"yaw_rate None is not allowed"),
    "bend nan": ({"bend": np.full(4, np.nan)}, 0.0, r"bend \[nan.* finite numbers of shape \(4,\)"),
    "three bends": ({"bend": np.zeros(3)}, 0.0, r"bend \[0.0, 0.0, 0.0\] is not allowed"),
    "place": ({"com": np.array([np.inf, 0.0])}, 0.0, r"com \[inf, 0.0\] is not allowed"),
    "heading": ({"heading": "north"}, 0.0, r"heading 'north' is not allowed; it must be a finite number"),
    "pressures": ({"pressure": np.zeros(4)}, 0.0, r"pressure .* shape \(4, 2\)"),
    "overpressure": ({"pressure": np.full((4, 2), 1e7)}, 0.0, r"it must be 0 to .* Pa"),
}  # fmt: skip
SEEDS = {"negative": -1, "real": 1.5, "text": "seven", "truth": True}


def refusals(env: SnakeEnv) -> dict[str, tuple[dict[str, Any], str]]:
    """Return arguments of `reset` that are refused, and the words of the error."""
    snake = env.episode.state
    found = {name: ({"options": options}, words) for name, (options, words) in OPTIONS.items()}
    for name, (change, yaw, words) in MOMENTS.items():
        found[name] = {"options": {"snake": replace(snake, **change), "yaw_rate": yaw}}, words
    found["both"] = {"options": {"snake": snake, "state": env.episode.save()}}, "option state excludes"
    incomplete = replace(env.episode.save(), content={})
    found["incomplete"] = {"seed": 3, "options": {"state": incomplete}}, "the state is incomplete; it has no"
    found["another seed"] = (
        {"seed": 4, "options": {"state": env.episode.save()}},
        "the saved state has other settings",
    )
    return found | {
        name: ({"seed": seed}, "it must be an integer of 0 or more") for name, seed in SEEDS.items()
    }


def test_a_refused_reset_leaves_the_environment_as_it_was():
    env, other = SnakeEnv("Obstacles", **SHORT), SnakeEnv("Obstacles", **SHORT)
    for each in (env, other):
        each.reset(seed=3)
        each.step(np.array([0.1, 1.5, 48.0]))
    for name, (arguments, words) in refusals(env).items():
        with pytest.raises(InputError, match=words.replace("GoTo", "Obstacles")):
            env.reset(**arguments)
            pytest.fail(name)
    actions = drawn(other, 2)
    assert same(played(env, actions), played(other, actions))


def test_a_refused_reset_of_a_vector_leaves_every_environment_as_it_was():
    envs, others = (SnakeVectorEnv("GoTo", 2, threads=2, **SHORT) for _ in range(2))
    for each in (envs, others):
        each.reset(seed=3)
        each.step(each.action_space.low)
    of_the_first = {"seed": 3, "options": {"state": envs.envs[0].episode.save()}}
    seeds = [{"seed": seed} for seed in ([5, -1], [5, 1.5], 1.5, "ab", True)]
    for arguments in (of_the_first, *seeds, {"options": {"state": 1}}):
        with pytest.raises(InputError):
            envs.reset(**arguments)
            pytest.fail(str(arguments))
    actions = drawn(others, 2)
    assert same(played(envs, actions), played(others, actions))


ACTIONS = {
    "nan": [0.0, np.nan, 45.0],
    "infinite": [np.inf, 1.5, 45.0],
    "minus infinite": np.array([0.0, 1.5, -np.inf], dtype=np.float32),
    "short": [0.0, 1.0],
    "column": np.zeros((3, 1)),
    "number": 1.0,
    "nothing": None,
    "with nothing": [0.0, None, 45.0],
    "text": "left",
    "texts": ["0.1", "1.5", "45"],
    "complex": np.array([0.1, 1.5, 45.0 + 1j]),
    "ragged": [[0.1], [1.5, 2.0], 45.0],
    "dict": {"offset": 0.1},
    "large": np.full((100, 100), np.nan),
}


@pytest.mark.parametrize("face", ["gymnasium", "dm_env"])
def test_a_refused_action_leaves_the_environment_as_it_was(face):
    env, other = (SnakeEnv("GoTo") if face == "gymnasium" else dm.load("GoTo", seed=3) for _ in range(2))
    for each in (env, other):
        each.reset(seed=3) if face == "gymnasium" else each.reset()
    for name, action in ACTIONS.items():
        with pytest.raises(InputError, match="give 3 finite numbers: offset, frequency_hz") as refused:
            env.step(action)
            pytest.fail(name)
        assert len(str(refused.value)) < 300
    actions = [np.array([0.1, 1.5, 48.0]), np.array([-0.1, 1.2, 50.0])]
    told = zip(played(env, actions), played(other, actions), strict=True)
    assert all(same(tuple(one), tuple(two)) for one, two in told)


def test_a_refused_action_leaves_every_environment_of_a_vector_as_it_was():
    envs, others = (SnakeVectorEnv("GoTo", 2, **SHORT) for _ in range(2))
    for each in (envs, others):
        each.reset(seed=3)
    good = np.array([0.1, 1.5, 48.0])
    for name, action in ACTIONS.items():
        for actions in ([good, action], action):
            with pytest.raises(InputError, match=r"give finite numbers of shape \(2, 3\)"):
                envs.step(actions)
                pytest.fail(name)
    assert same(envs.step([good, good]), others.step(np.stack([good, good])))
