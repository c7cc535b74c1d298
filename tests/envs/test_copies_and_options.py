"""Environments: copies continue bit-identically; refused input leaves the state unchanged."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from dm_environments import dm_environments
from gymnasium.wrappers import TimeLimit
from test_gymnasium import MARKED_TASKS, equal_bits, named

from srs_twin import InputError
from srs_twin.envs.gymnasium import SnakeEnv, SnakeVectorEnv
from srs_twin.io.saved_state import SavedState

SHORT = {"limit_s": 0.5}
"""Five steps of a snake, ten of a module: copies reach the end of an episode and the next reset."""

COPY_METHODS = {
    "pickle": lambda thing: pickle.loads(pickle.dumps(thing)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
}


def play(env: Any, actions: list[np.ndarray]) -> list[Any]:
    """Return the outcomes of some steps, a reset, and the same steps again."""
    outcomes = [env.step(action) for action in actions]
    outcomes.append(env.reset())
    return outcomes + [env.step(action) for action in actions]


def sample_actions(env: Any, count: int) -> list[np.ndarray]:
    env.action_space.seed(2)
    return [env.action_space.sample() for _ in range(count)]


def assert_copies_continue(
    env: Any, actions: list[np.ndarray], others: dict[str, Any], *methods: str
) -> None:
    """Check that copies by the given methods, and the others, give the original's outcomes.

    The copies move first, so that any state shared with the original is visible in its
    results.
    """
    copies = others | {name: COPY_METHODS[name](env) for name in methods}
    of_copies = {name: play(other, actions) for name, other in copies.items()}
    of_original = play(env, actions)
    for name, of_copy in of_copies.items():
        assert equal_bits(of_copy, of_original), name


@pytest.mark.slow
@pytest.mark.parametrize("task", MARKED_TASKS)
def test_copies_of_gymnasium_environments_give_the_same_episodes(task):
    env = gymnasium.make(f"srs_twin.envs:SRSTwin/{task}-v0", **SHORT)
    others = {f"fresh {name}": make(env) for name, make in COPY_METHODS.items()}
    actions = sample_actions(env, 2)
    for environment in (env, *others.values()):
        environment.reset(seed=3)
        environment.step(actions[0])
    saved = gymnasium.make(f"srs_twin.envs:SRSTwin/{task}-v0", **SHORT)
    saved.reset(seed=3, options={"state": env.unwrapped.episode.save()})
    others["saved state"] = saved
    assert_copies_continue(env, actions, others, *COPY_METHODS)


def test_deep_copies_of_wrapped_environments_give_the_same_episodes():
    env = TimeLimit(SnakeEnv("GoTo", render_mode="rgb_array"), 3)
    env.reset(seed=1)
    assert_copies_continue(env, sample_actions(env, 2), {}, "pickle", "deepcopy")


def test_copies_of_a_vector_environment_give_the_same_episodes():
    envs = SnakeVectorEnv("Module", 2, threads=2, limit_s=0.1)
    envs.reset(seed=3)
    actions = sample_actions(envs, 4)  # past the end of the first episodes
    envs.step(actions[0])
    assert_copies_continue(envs, actions, {}, *COPY_METHODS)


@pytest.mark.parametrize("task", ["Obstacles", "Module"])
def test_copies_of_a_dm_env_give_the_same_episodes(task):
    env = dm_environments().load(task, seed=4, **SHORT)
    env.reset()
    spec = env.action_spec()
    rng = np.random.default_rng(1)
    actions = [rng.uniform(spec.minimum, spec.maximum) for _ in range(2)]
    env.step(actions[0])
    assert_copies_continue(env, actions, {}, *COPY_METHODS)


def refused_options(env: SnakeEnv) -> list[tuple[Any, str]]:
    """Return refused options of `reset` and the expected messages."""
    snake = env.episode.state
    state = env.episode.save()

    def placed(**change: Any) -> dict[str, Any]:
        return {"snake": replace(snake, **change)}

    return [
        (
            1,
            "the reset options 1 are not allowed; give a dict with keys from state,"
            " snake, yaw_rate, goal",
        ),
        ({"stat": 1}, r"unknown option of reset 'stat'; did you mean state\?"),
        ({1: 1}, "unknown option of reset '1'"),
        ({"state": None}, "`state` None is not allowed; give a SavedState, which"),
        (
            {"state": SavedState({}, {})},
            "episode of Obstacles: the saved state has other settings",
        ),
        (
            {"snake": snake, "state": state},
            "not allowed together with the option `state`",
        ),
        ({"snake": {"com": (0, 0)}}, "`snake` .* give a SnakeState, such as"),
        ({"yaw_rate": 0.1}, "`yaw_rate` needs the option `snake`; give both"),
        (
            placed() | {"yaw_rate": np.nan},
            "yaw_rate nan is not allowed; it must be a finite number",
        ),
        (placed() | {"yaw_rate": "fast"}, "yaw_rate 'fast' is not allowed"),
        (placed() | {"yaw_rate": None}, "yaw_rate None is not allowed"),
        (
            placed(bend=np.full(4, np.nan)),
            r"bend \[nan.* finite numbers of shape \(4,\)",
        ),
        (placed(bend=np.zeros(3)), r"bend \[0.0, 0.0, 0.0\] is not allowed"),
        (placed(com=np.array([np.inf, 0.0])), r"com \[inf, 0.0\] is not allowed"),
        (placed(heading="north"), "'north' is not allowed; it must be a finite number"),
        (placed(pressure=np.zeros(4)), r"pressure .* shape \(4, 2\)"),
        (placed(pressure=np.full((4, 2), 1e7)), "pressure .* must be between 0 and"),
    ]


def refusals(env: SnakeEnv) -> list[tuple[dict[str, Any], str]]:
    """Return refused arguments of `reset` and the expected messages."""
    state = env.episode.save()
    of_seed_3 = {"options": {"state": replace(state, content={})}, "seed": 3}
    of_seed_4 = {"options": {"state": state}, "seed": 4}
    return [
        *(({"options": given}, message) for given, message in refused_options(env)),
        (of_seed_3, "the state is incomplete, because it has no"),
        (of_seed_4, "the saved state has other settings"),
        *(
            ({"seed": seed}, "it must be an integer of 0 or more")
            for seed in (-1, 1.5, "seven", True)
        ),
    ]


def test_refused_reset_leaves_the_environment_unchanged():
    env = SnakeEnv("Obstacles", **SHORT)
    other = SnakeEnv("Obstacles", **SHORT)
    for environment in (env, other):
        environment.reset(seed=3)
        environment.step(np.array([0.1, 1.5, 48.0]))
    for arguments, message in refusals(env):
        with pytest.raises(InputError, match=message):
            env.reset(**arguments)
            pytest.fail(str(arguments))
    actions = sample_actions(other, 2)
    assert equal_bits(play(env, actions), play(other, actions))


def test_a_state_of_a_later_episode_continues_in_another_environment():
    """The later episode reuses the twin of the first one, whose goal is elsewhere."""
    env = SnakeEnv("GoTo", **SHORT)
    other = SnakeEnv("GoTo", **SHORT)
    env.reset(seed=3)
    env.reset(seed=4)
    env.step(np.array([0.1, 0.5, 0.8]))
    state = env.episode.save()
    other.reset(seed=4, options={"state": state})
    actions = sample_actions(other, 2)
    assert equal_bits([env.step(a) for a in actions], [other.step(a) for a in actions])
    with pytest.raises(InputError, match="the saved state has other settings"):
        other.reset(seed=3, options={"state": state})


def test_the_goal_of_an_episode_can_be_given():
    env = SnakeEnv("GoTo", **SHORT)
    observation, info = env.reset(seed=3, options={"goal": (0.3, -0.4)})
    assert (info["goal_x_m"], info["goal_y_m"]) == (0.3, -0.4)
    distance = np.hypot(0.3 - info["com_x_m"], -0.4 - info["com_y_m"])
    assert info["goal_distance_m"] == pytest.approx(distance)
    seen = named(env.task, observation)
    # The camera has 1 mm of noise.
    away = np.hypot(seen["goal_ahead_m"], seen["goal_left_m"])
    assert away == pytest.approx(distance, abs=0.01)
    _, reward, *_, after = env.step(np.array([0.1, 0.5, 0.8]))
    progress = pytest.approx(distance - after["goal_distance_m"])
    assert reward == after["reward_progress_m"] == progress
    _, info = env.reset()
    assert info["goal_x_m"] != 0.3


def test_a_given_goal_is_kept_by_saved_and_placed_states():
    env, other = (SnakeEnv("GoTo", **SHORT) for _ in range(2))
    goal = {"goal": (0.3, -0.4)}
    env.reset(seed=3, options=goal)
    env.step(np.array([0.1, 0.5, 0.8]))
    other.reset(seed=3, options=goal | {"state": env.episode.save()})
    actions = sample_actions(env, 2)
    with pytest.raises(
        InputError, match=r"other settings: .*goal .*, was \[0.3, -0.4\]"
    ):
        other.reset(seed=3, options={"state": env.episode.save()})
    assert equal_bits([env.step(a) for a in actions], [other.step(a) for a in actions])
    snake = replace(env.episode.state, com=np.array([0.1, 0.0]))
    _, info = other.reset(seed=3, options=goal | {"snake": snake})
    assert info["goal_distance_m"] == pytest.approx(np.hypot(0.2, 0.4), abs=1e-6)


@pytest.mark.parametrize(
    ("task", "goal", "message"),
    [
        ("GoTo", (1.0,), r"the option `goal` \(1\.0,\) is not allowed; give x and y"),
        ("GoTo", (1.0, np.nan), "is not allowed; give x and y in m"),
        ("GoTo", "here", "the option `goal` 'here' is not allowed"),
        (
            "GoTo",
            (2.6, 0.0),
            r"the option `goal` \(2\.6, 0\) is not allowed, because it is outside the"
            r" bounds",
        ),
        ("GoTo", (0.05, 0.0), "the snake is already within 0.1 m of it"),
        ("Module", (1.0, 0.0), "the task Module has no goal position"),
    ],
)
def test_goals_that_cannot_be_reached_are_refused(task, goal, message):
    env = SnakeEnv(task, **SHORT)
    env.reset(seed=1)
    with pytest.raises(InputError, match=message):
        env.reset(seed=1, options={"goal": goal})


def test_a_goal_in_an_obstacle_is_refused():
    env = SnakeEnv("Obstacles", **SHORT)
    env.reset(seed=1)
    circle = min(env.episode.world.obstacles, key=lambda item: abs(item.y))
    number = env.episode.world.obstacles.index(circle) + 1
    with pytest.raises(InputError, match=f"it is inside obstacle {number} "):
        env.reset(seed=1, options={"goal": (circle.x, circle.y)})


def test_unknown_settings_list_those_of_the_task():
    settings = ["fit", "limit_s", "observations", "ranges", "rewards", "robot"]
    twin = ["contact", "hinges_per_segment", "layout", "numerics", "pneumatics"]
    for task, more in (("Module", []), ("GoTo", ["camera"]), ("Pegs", ["camera"])):
        with pytest.raises(
            InputError, match="unknown setting of the task or its twin 'foo'"
        ) as refused:
            SnakeEnv(task, foo=1)
        listed = str(refused.value).partition("available: ")[2].rstrip(")").split(", ")
        assert listed == sorted([*settings, *twin, "sensor", "timestep", *more])


def test_refused_reset_leaves_all_environments_of_a_vector_unchanged():
    envs, others = (SnakeVectorEnv("GoTo", 2, threads=2, **SHORT) for _ in range(2))
    for environment in (envs, others):
        environment.reset(seed=3)
        environment.step(environment.action_space.low)
    state_of_one = {"seed": 3, "options": {"state": envs.envs[0].episode.save()}}
    seeds = [{"seed": seed} for seed in ([5, -1], [5, 1.5], 1.5, "ab", True)]
    for arguments in (state_of_one, *seeds, {"options": {"state": 1}}):
        with pytest.raises(InputError):
            envs.reset(**arguments)
            pytest.fail(str(arguments))
    actions = sample_actions(others, 2)
    assert equal_bits(play(envs, actions), play(others, actions))


ACTIONS = [
    None,
    [0.0, 1.0],
    np.zeros((3, 1)),
    [0.0, np.nan, 45.0],
    np.array([0.0, 1.5, -np.inf], dtype=np.float32),
    np.array([0.1, 1.5, 45.0 + 1j]),
    ["0.1", "1.5", "45"],
    [[0.1], [1.5, 2.0], 45.0],
    np.full((100, 100), np.nan),
]


@pytest.mark.parametrize("interface", ["gymnasium", "dm_env"])
def test_refused_action_leaves_the_environment_unchanged(interface):
    if interface == "gymnasium":
        env = SnakeEnv("GoTo")
        other = SnakeEnv("GoTo")
    else:
        env, other = (dm_environments().load("GoTo", seed=3) for _ in range(2))
    for environment in (env, other):
        environment.reset(seed=3) if interface == "gymnasium" else environment.reset()
    for action in ACTIONS:
        with pytest.raises(
            InputError, match=r"give 3 finite numbers \(offset, frequency_hz"
        ) as refused:
            env.step(action)
            pytest.fail(str(action))
        assert len(str(refused.value)) < 300
    actions = [np.array([0.1, 1.5, 48.0]), np.array([-0.1, 1.2, 50.0])]
    assert equal_bits(play(env, actions), play(other, actions))


def test_refused_action_leaves_all_environments_of_a_vector_unchanged():
    envs, others = (SnakeVectorEnv("GoTo", 2, **SHORT) for _ in range(2))
    for environment in (envs, others):
        environment.reset(seed=3)
    good = np.array([0.1, 1.5, 48.0])
    for action in ACTIONS:
        for actions in ([good, action], [good], action):
            with pytest.raises(
                InputError, match=r"numbers of shape \(2, 3\), one action for each of 2"
            ):
                envs.step(actions)
                pytest.fail(str(action))
    assert equal_bits(envs.step([good, good]), others.step(np.stack([good, good])))
