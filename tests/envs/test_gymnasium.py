"""Gymnasium interface: checker, seeds, endings, observations, vector environments."""

from __future__ import annotations

import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from conftest import ROOT
from gymnasium.utils.env_checker import check_env, check_space_limit
from gymnasium.utils.passive_env_checker import check_action_space
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from srs_twin import Gait, InputError, TwinSnake, rollout
from srs_twin.envs import TASKS, make_task
from srs_twin.envs.crawling import OPEN, CrawlTask
from srs_twin.envs.gymnasium import SnakeEnv, SnakeVectorEnv
from srs_twin.envs.policy import load_policy
from srs_twin.envs.task import Task
from srs_twin.errors import DivergedError
from srs_twin.planning.camera import Camera
from srs_twin.plants.base import SnakeState
from srs_twin.robot.world import Bounds

MARKED_TASKS = [
    (
        pytest.param(task, marks=pytest.mark.slow)
        if task in ("Grasp", "Pegs", "Crawl3D")
        else task
    )
    for task in TASKS
]
"""All tasks; those that need additional kernels are slow."""

SHORT = {"limit_s": 0.3}
"""Three steps of a snake, six of a module."""


def play(env: Any, seed: int, steps: int) -> list[Any]:
    """Return the outcomes of an episode whose actions depend only on the seed."""
    env.action_space.seed(seed)
    outcomes = [env.reset(seed=seed)]
    for _ in range(steps):
        outcomes.append(env.step(env.action_space.sample()))
    return outcomes


def named(task: Task, observation: np.ndarray) -> dict[str, float]:
    names = [signal.name for signal in task.observations]
    return dict(zip(names, observation.tolist(), strict=True))


def equal_bits(one: Any, other: Any) -> bool:
    """Return whether two outcomes are bit-identical."""
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and bool((one == other).all())
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(equal_bits, one, other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(
            equal_bits(one[key], other[key]) for key in one
        )
    return bool(one == other)


@pytest.mark.parametrize("task", MARKED_TASKS)
def test_gymnasium_checker_passes_without_warnings(task):
    env = gymnasium.make(
        f"srs_twin.envs:SRSTwin/{task}-v0", disable_env_checker=True
    ).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)


@pytest.mark.parametrize("task", MARKED_TASKS)
def test_actions_from_minus_1_to_1_span_the_physical_bounds(task):
    env = SnakeEnv(task)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_action_space(env.action_space)
        check_space_limit(env.action_space, "action")
    assert (env.action_space.low == -1).all() and (env.action_space.high == 1).all()
    values = [(signal.low + 3 * signal.high) / 4 for signal in env.task.actions]
    action = env.task.from_physical(values)
    assert action == pytest.approx(0.5, abs=1e-6)
    assert env.task.to_physical(action) == pytest.approx(values, rel=1e-6)
    beyond = np.full(env.action_space.shape, 2.0)
    assert env.task.to_physical(beyond) == [signal.high for signal in env.task.actions]
    assert env.task.to_physical(-beyond) == [signal.low for signal in env.task.actions]


@pytest.mark.parametrize("values", [[0.1, 2.0, 48300], [0.1, 2.0], [0.1, 2.0, np.nan]])
def test_physical_values_outside_the_ranges_of_actions_are_refused(values):
    with pytest.raises(
        InputError,
        match="give 3 numbers .offset from -0.4 to 0.4, .* pressure_kpa from 41",
    ):
        SnakeEnv("GoTo").task.from_physical(values)


@pytest.mark.parametrize("task", MARKED_TASKS)
def test_same_seed_gives_the_same_episode_after_other_episodes(task):
    fresh = SnakeEnv(task)
    used = SnakeEnv(task)
    first = play(fresh, 5, 3)
    other = play(used, 6, 3)
    assert not equal_bits(first, other)
    assert equal_bits(first, play(used, 5, 3))


def test_constant_action_equals_a_rollout_of_the_gait():
    env = SnakeEnv("GoTo", limit_s=2.0)
    _, info = env.reset(seed=3)
    heading = info["heading_rad"]
    for _ in range(20):
        *_, info = env.step(env.task.from_physical([0.1, 1.7, 45.0]))
    spec = make_task("GoTo").robot
    alone = rollout(
        TwinSnake(spec, supply_pa=45e3), Gait(1.7, 0.1), 2.0, pose=(0.0, 0.0, heading)
    )
    assert info["com_x_m"] == pytest.approx(alone["com_x"][-1], abs=1e-6)
    assert info["com_y_m"] == pytest.approx(alone["com_y"][-1], abs=1e-6)
    assert np.hypot(info["com_x_m"], info["com_y_m"]) > 0.1


@pytest.mark.parametrize("task", MARKED_TASKS)
def test_observations_depend_only_on_sensors_and_camera(task):
    """Observations stay the same if all other entries of the state are NaN."""

    def blinded(twin: TwinSnake) -> Callable[[np.ndarray], SnakeState]:
        def step(valves: np.ndarray) -> SnakeState:
            (state,) = twin.advance(valves, 1)
            whole = {
                field.name: np.asarray(getattr(state, field.name), dtype=float)
                for field in fields(state)
            }
            observed = ("time", "com", "heading", "measured_bend")
            lost = {
                name: np.full_like(value, np.nan)
                for name, value in whole.items()
                if name not in observed
            }
            return replace(state, **lost)

        return step

    seeing, blind = (make_task(task).begin(np.random.default_rng(2)) for _ in range(2))
    blind.twin.step = blinded(blind.twin)
    for _ in range(3):
        action = [1.0 for _ in make_task(task).actions]
        result = seeing.step(action).observation
        assert equal_bits(result, blind.step(action).observation)
        assert np.isfinite(result).all()


@pytest.mark.parametrize("camera", [Camera(10.0, 0.0, 0.05), Camera(10.0, 0.02, 0.0)])
def test_observed_pose_has_the_noise_of_the_camera(camera):
    """The bearing of the goal uses the observed heading, not the true one."""
    task = CrawlTask("noisy", OPEN, camera=camera)
    episode = task.begin(np.random.default_rng(3))
    errors = []
    for _ in range(40):
        result = episode.step([0.0, 2.0, 50.0])
        seen = named(task, result.observation)
        true = result.info
        place = complex(seen["x_m"], seen["y_m"])
        heading = complex(seen["heading_cos"], seen["heading_sin"])
        to_goal = heading * complex(seen["goal_ahead_m"], seen["goal_left_m"])
        goal = complex(true["goal_x_m"], true["goal_y_m"])
        assert place + to_goal == pytest.approx(goal, abs=1e-5)
        error = place - complex(true["com_x_m"], true["com_y_m"])
        turn = np.angle(heading * np.exp(-1j * true["heading_rad"]))
        errors.append((error.real, error.imag, turn))
    noise = (camera.position_noise, camera.position_noise, camera.heading_noise)
    assert np.std(errors, axis=0) == pytest.approx(noise, rel=0.35, abs=1e-6)
    assert np.abs(np.mean(errors, axis=0)) == pytest.approx((0, 0, 0), abs=0.02)


def near(**changes: Any) -> CrawlTask:
    """Return a task with the goal just ahead of the snake."""
    arena = replace(OPEN, distances=(0.13, 0.13), bearings=(0.0, 0.0), **changes)
    return CrawlTask("near", arena)


def test_reaching_the_goal_terminates_with_a_reward():
    episode = near().begin(np.random.default_rng(0))
    result = [episode.first]
    while not result[-1].terminated:
        result.append(episode.step([0.0, 2.0, 55.0]))
        assert not result[-1].truncated
    assert (
        result[-1].info["ending"] == "goal_reached"
        and result[-1].info["goal_distance_m"] <= 0.1
    )
    assert result[-1].reward > 1.0 > max(result.reward for result in result[:-1])
    with pytest.raises(InputError, match=r"episode is over \(goal_reached\); reset"):
        episode.step([0.0, 2.0, 55.0])


def test_leaving_the_room_terminates_with_a_penalty():
    task = near(room=Bounds((-0.01, 0.01), (-0.01, 0.01)))
    task.arena = replace(task.arena, distances=(1.0, 1.0))
    episode = task.begin(np.random.default_rng(0))
    result = episode.first
    while not result.terminated:
        result = episode.step([0.0, 1.0, 1.0])
    assert result.info["ending"] == "room_left" and result.reward < -0.9


def test_time_limit_truncates_the_episode():
    env = SnakeEnv("GoTo", **SHORT)
    env.reset(seed=0)
    ends = [env.step(np.array([0.0, -1.0, 0.0]))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]


@pytest.mark.parametrize("task", MARKED_TASKS)
def test_divergence_terminates_with_the_previous_observation(task):
    episode = make_task(task).begin(np.random.default_rng(0))
    action = [1.0 for _ in make_task(task).actions]
    last = episode.step(action)

    def diverge(valves: np.ndarray) -> SnakeState:
        raise DivergedError("twin", 0.1, "a bend is nan")

    episode.twin.step = diverge
    result = episode.step(action)
    assert result.terminated and not result.truncated and result.reward == 0.0
    assert equal_bits(result.observation, last.observation)
    assert (
        result.info["ending"] == "diverged" and "a bend is nan" in result.info["error"]
    )
    with pytest.raises(InputError, match=r"episode is over \(diverged\); reset"):
        episode.step(action)


def test_steps_before_a_reset_are_refused():
    with pytest.raises(InputError, match="reset the environment first"):
        SnakeEnv("Module").step(np.zeros(2))


@pytest.mark.parametrize(
    ("task", "settings", "words"),
    [
        ("Goto", {}, "unknown task 'Goto'; did you mean GoTo"),
        ("GoTo", {"render_mode": "human"}, "unknown render mode 'human'"),
        ("GoTo", {"action_range": "physical"}, "`action_range` has been removed"),
        ("GoTo", {"limit": 3}, "'limit'; did you mean limit_s"),
        ("Module", {"supply_pa": 1e3}, "unknown setting .*'supply_pa'"),
        ("Module", {"robot": "gen2"}, "'gen2' has 4 segments, .* needs .* with one"),
        ("Grasp", {"robot": "gen2"}, "4 holding segments are not allowed"),
        ("GoTo", {"robot": {"base": "gen9"}}, "unknown robot 'gen9'"),
        ("GoTo", {"robot": {"base": "gen2", "bending": {"stif": 1}}}, "bending.stif"),
        ("GoTo", {"robot": "spatial_example"}, "other than Crawl3D does not support"),
        ("Crawl3D", {"robot": "skin_example"}, "'skin_example' bends in one plane"),
        ("GoTo", {"rewards": {"time": -1.0}}, "reward term 'time'; .* mean time_s"),
        ("GoTo", {"rewards": {"time_s": np.nan}}, "nan} is not allowed; use finite"),
        ("GoTo", {"observations": "goals"}, "observations 'goals'; did you mean goal"),
        ("GoTo", {"observations": ("goals",)}, "unknown group of observations 'goals'"),
        ("GoTo", {"observations": ()}, "no group .* give at least one of pose, goal"),
        ("GoTo", {"limit_s": 0.25}, "limit_s 0.25 s is not a multiple of step 0.1 s"),
        ("Module", {"limit_s": -1.0}, "limit_s -1.0 s is not allowed"),
        ("Pegs", {"limit_s": "5"}, "limit_s '5' is not allowed; it must be a number"),
        ("GoTo", {"camera": 5}, "camera 5 is not allowed; it must be a Camera"),
        (
            "Obstacles",
            {"camera": Camera(5.0)},
            "camera of 5 Hz is too slow .* 10 Hz or more",
        ),
    ],
)
def test_invalid_settings_are_refused_at_construction(task, settings, words):
    with pytest.raises(InputError, match=words):
        SnakeEnv(task, **settings)


@pytest.mark.slow
@pytest.mark.parametrize("task", MARKED_TASKS)
def test_vector_environment_equals_single_environments(task):
    """The reference is Gymnasium's SyncVectorEnv, over ends and resets of episodes."""
    vector = gymnasium.make_vec(
        f"srs_twin.envs:SRSTwin/{task}-v0", num_envs=3, threads=2, **SHORT
    )
    assert isinstance(vector, SnakeVectorEnv)
    reference = SyncVectorEnv([lambda: SnakeEnv(task, **SHORT)] * 3)
    assert (
        vector.metadata["autoreset_mode"]
        == reference.metadata["autoreset_mode"]
        == AutoresetMode.NEXT_STEP
    )
    assert vector.action_space == reference.action_space
    assert vector.observation_space == reference.observation_space
    one = play(vector, 4, 9)
    other = play(reference, 4, 9)
    assert any(outcome[3].any() for outcome in one[1:])
    for k, (left, right) in enumerate(zip(one, other, strict=True)):
        assert equal_bits(left, right), k


def test_vector_environment_refuses_invalid_counts():
    with pytest.raises(
        InputError, match="`num_envs` 0 is not allowed; it must be 1 or more"
    ):
        SnakeVectorEnv("GoTo", 0)
    envs = SnakeVectorEnv("Module", 2)
    with pytest.raises(InputError, match="3 seeds are given for 2 environments"):
        envs.reset(seed=[1, 2, 3])
    assert equal_bits(envs.reset(seed=np.array([5, 6])), envs.reset(seed=5))


@pytest.mark.slow
def test_the_training_script_writes_a_policy_and_its_learning_curve(tmp_path):
    pytest.importorskip("stable_baselines3")
    few = ["--steps", "2048", "--seeds", "3", "--out", tmp_path]
    command = [sys.executable, ROOT / "tools/train_ppo.py", *few]
    subprocess.run(command, check=True, capture_output=True, timeout=600)
    act = load_policy(tmp_path / "seed_3/policy.npz").bind(make_task("GoTo"))
    assert act(SnakeEnv("GoTo").reset(seed=0)[0]).shape == (3,)
    assert (
        (tmp_path / "seed_3/curve.csv")
        .read_text()
        .startswith("steps,success,duration_s")
    )
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")


def test_the_reward_is_the_weighted_sum_of_its_terms():
    weights = {"time_s": -0.2, "air_j": -0.01, "offset_change": -0.1, "progress_m": 2.0}
    env = SnakeEnv("GoTo", rewards=weights)
    _, before = env.reset(seed=3)
    offset = 0.0
    for action in ([1.0, 1.0, 1.0], [-1.0, 0.0, 1.0], [-1.0, 1.0, 0.0]):
        _, reward, _, _, info = env.step(np.array(action))
        values = {
            "time_s": 0.1,
            "air_j": info["air_j"] - before["air_j"],
            "offset_change": abs(0.4 * action[0] - offset),
            "progress_m": before["goal_distance_m"] - info["goal_distance_m"],
        }
        for name, weight in weights.items():
            assert info[f"reward_{name}"] == pytest.approx(
                weight * values[name], abs=1e-9
            )
        assert reward == pytest.approx(
            sum(weights[name] * values[name] for name in weights), abs=1e-9
        )
        before = info
        offset = 0.4 * action[0]


def test_selected_observations_equal_those_of_all():
    every = SnakeEnv("GoTo")
    some = SnakeEnv("GoTo", observations=("gait", "goal"))
    names = [signal.name for signal in every.task.observations]
    chosen = [signal.name for signal in some.task.observations]
    assert chosen == ["goal_ahead_m", "goal_left_m", "gait_cos", "gait_sin"]
    every.reset(seed=4), some.reset(seed=4)
    for _ in range(3):
        one = every.step(np.ones(3))[0]
        other = some.step(np.ones(3))[0]
        assert equal_bits(one[[names.index(name) for name in chosen]], other)
    assert some.observation_space.contains(other)
    single = SnakeEnv("GoTo", observations="goal")
    assert single.observation_space.shape == (2,)
