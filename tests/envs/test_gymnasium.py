"""The face of gymnasium: its own checker, seeds, ends, what agents are told, and many side by side."""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, check_space_limit
from gymnasium.utils.passive_env_checker import check_action_space
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import RescaleAction

from srs_twin import Gait, InputError, TwinSnake, rollout
from srs_twin.control.camera import Camera
from srs_twin.envs import TASKS, make_task
from srs_twin.envs.crawling import OPEN, CrawlTask, Field
from srs_twin.envs.gymnasium import SnakeEnv, SnakeVectorEnv
from srs_twin.errors import DivergedError
from srs_twin.plants.base import SnakeState
from srs_twin.robot.world import Bounds

SHORT = {"limit_s": 0.3}
"""Three steps of a snake, six of a module."""


def played(env: Any, seed: int, steps: int) -> list[Any]:
    """Return all that an episode tells under actions that depend on the seed alone."""
    env.action_space.seed(seed)
    told = [env.reset(seed=seed)]
    for _ in range(steps):
        told.append(env.step(env.action_space.sample()))
    return told


def same(one: Any, other: Any) -> bool:
    """Say whether two outcomes agree in every bit."""
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and bool((one == other).all())
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    return bool(one == other)


@pytest.mark.parametrize("task", TASKS)
def test_gymnasiums_checker_has_nothing_to_say(task):
    env = gymnasium.make(f"srs_twin.envs:SRSTwin/{task}-v0", disable_env_checker=True).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Actions have units; gymnasium.wrappers.RescaleAction is for who wants them from -1 to 1.
        warnings.filterwarnings("ignore", ".*normalized space")
        check_env(env, skip_render_check=True)


@pytest.mark.parametrize("task", TASKS)
def test_rescaled_actions_are_those_of_the_units_and_nobody_warns(task):
    plain, env = SnakeEnv(task), RescaleAction(SnakeEnv(task), np.float32(-1), np.float32(1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_action_space(env.action_space)
        check_space_limit(env.action_space, "action")
    assert (env.action_space.low == -1).all() and (env.action_space.high == 1).all()
    plain.reset(seed=1), env.reset(seed=1)
    box = plain.action_space
    one, other = plain.step((box.low + 3 * box.high) / 4), env.step(np.full(box.shape, 0.5, dtype=np.float32))
    assert one[0] == pytest.approx(other[0], abs=1e-5) and one[1] == pytest.approx(other[1], abs=1e-6)


@pytest.mark.parametrize("task", TASKS)
def test_the_same_seed_gives_the_same_episode_also_after_others(task):
    fresh, used = SnakeEnv(task), SnakeEnv(task)
    first = played(fresh, 5, 3)
    other = played(used, 6, 3)
    assert not same(first, other)
    assert same(first, played(used, 5, 3))


def test_a_constant_action_crawls_as_a_rollout_of_the_gait_does():
    env = SnakeEnv("GoTo", limit_s=2.0)
    _, info = env.reset(seed=3)
    heading = info["heading_rad"]
    for _ in range(20):
        *_, info = env.step(np.array([0.1, 1.7, 45.0]))
    spec = make_task("GoTo").robot
    alone = rollout(TwinSnake(spec, supply_pa=45e3), Gait(1.7, 0.1), 2.0, pose=(0.0, 0.0, heading))
    assert info["com_x_m"] == pytest.approx(alone["com_x"][-1], abs=1e-6)
    assert info["com_y_m"] == pytest.approx(alone["com_y"][-1], abs=1e-6)
    assert np.hypot(info["com_x_m"], info["com_y_m"]) > 0.1


@pytest.mark.parametrize("task", TASKS)
def test_observations_hold_what_sensors_and_a_camera_tell_and_nothing_else(task):
    """Whatever else the state holds may be lost, and agents are told the same."""

    def blinded(twin: TwinSnake) -> Callable[[np.ndarray], SnakeState]:
        def step(valves: np.ndarray) -> SnakeState:
            (state,) = twin.advance(valves, 1)
            whole = {each.name: np.asarray(getattr(state, each.name), dtype=float) for each in fields(state)}
            told = ("time", "com", "heading", "sensed")
            lost = {name: np.full_like(value, np.nan) for name, value in whole.items() if name not in told}
            return replace(state, **lost)

        return step

    seeing, blind = (make_task(task).begin(np.random.default_rng(2)) for _ in range(2))
    blind.twin.step = blinded(blind.twin)
    for _ in range(3):
        action = [each.high for each in make_task(task).actions]
        told = seeing.step(action).observation
        assert same(told, blind.step(action).observation)
        assert np.isfinite(told).all()


@pytest.mark.parametrize("camera", [Camera(10.0, 0.0, 0.05), Camera(10.0, 0.02, 0.0)])
def test_place_and_heading_are_those_of_the_camera_with_its_noise(camera):
    """The bearing of the goal as well: whoever knew the true heading would tell a truer one."""
    episode = CrawlTask("noisy", OPEN, camera=camera).begin(np.random.default_rng(3))
    names = [each.name for each in make_task("GoTo").observations]
    off = []
    for _ in range(40):
        told = episode.step([0.0, 2.0, 50.0])
        seen, true = dict(zip(names, told.observation.astype(float), strict=True)), told.info
        heading = np.arctan2(seen["heading_sin"], seen["heading_cos"])
        bearing = heading + np.arctan2(seen["goal_left_m"], seen["goal_ahead_m"])
        goal = np.array([true["goal_x_m"] - seen["x_m"], true["goal_y_m"] - seen["y_m"]])
        assert np.hypot(seen["goal_ahead_m"], seen["goal_left_m"]) == pytest.approx(np.hypot(*goal), abs=1e-5)
        assert np.cos(bearing - np.arctan2(goal[1], goal[0])) == pytest.approx(1, abs=1e-9)
        turn = np.remainder(heading - true["heading_rad"] + np.pi, 2 * np.pi) - np.pi
        off.append((seen["x_m"] - true["com_x_m"], seen["y_m"] - true["com_y_m"], turn))
    noise = (camera.position_noise, camera.position_noise, camera.heading_noise)
    assert np.std(off, axis=0) == pytest.approx(noise, rel=0.35, abs=1e-6)
    assert np.abs(np.mean(off, axis=0)) == pytest.approx((0, 0, 0), abs=0.02)


def test_the_reward_adds_up_to_the_way_made_good():
    env = SnakeEnv("GoTo")
    _, first = env.reset(seed=1)
    rewards = []
    for _ in range(30):
        _, reward, ended, _, last = env.step(np.array([0.0, 2.0, 50.0]))
        rewards.append(reward)
        assert not ended
    assert sum(rewards) == pytest.approx(first["goal_distance_m"] - last["goal_distance_m"], abs=1e-9)


def near(**changes: Any) -> CrawlTask:
    """Return a task whose goal lies just ahead."""
    place = replace(OPEN, distances=(0.13, 0.13), bearings=(0.0, 0.0), **changes)
    return CrawlTask("near", place)


def test_an_episode_terminates_at_the_goal_and_pays_for_it():
    episode = near().begin(np.random.default_rng(0))
    told = [episode.first]
    while not told[-1].terminated:
        told.append(episode.step([0.0, 2.0, 55.0]))
        assert not told[-1].truncated
    assert told[-1].info["ending"] == "goal_reached" and told[-1].info["goal_distance_m"] <= 0.1
    assert told[-1].reward > 1.0 > max(each.reward for each in told[:-1])
    with pytest.raises(InputError, match=r"episode is over \(goal_reached\); reset"):
        episode.step([0.0, 2.0, 55.0])


def test_an_episode_terminates_outside_the_room():
    task = near(room=Bounds((-0.01, 0.01), (-0.01, 0.01)))
    task.place = replace(task.place, distances=(1.0, 1.0))
    episode = task.begin(np.random.default_rng(0))
    told = episode.first
    while not told.terminated:
        told = episode.step([0.0, 2.0, 55.0])
    assert told.info["ending"] == "room_left" and told.reward < -0.9


def test_the_time_limit_truncates():
    env = SnakeEnv("GoTo", **SHORT)
    env.reset(seed=0)
    ends = [env.step(np.array([0.0, 1.0, 45.0]))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]


@pytest.mark.parametrize("task", TASKS)
def test_a_twin_that_diverges_ends_the_episode_with_what_was_seen_last(task):
    episode = make_task(task).begin(np.random.default_rng(0))
    action = [each.high for each in make_task(task).actions]
    last = episode.step(action)

    def diverge(valves: np.ndarray) -> SnakeState:
        raise DivergedError("twin", 0.1, "a bend is nan")

    episode.twin.step = diverge
    told = episode.step(action)
    assert told.terminated and not told.truncated and told.reward == 0.0
    assert same(told.observation, last.observation)
    assert told.info["ending"] == "diverged" and "a bend is nan" in told.info["error"]
    with pytest.raises(InputError, match=r"episode is over \(diverged\); reset"):
        episode.step(action)


def test_touching_an_obstacle_costs():
    place = Field(OPEN.room, (0.0, 0.0), (1.5, 1.5), (0.0, 0.0), 1, Bounds((0.42, 0.43), (-0.01, 0.01)))
    episode = CrawlTask("wall", place, limit_s=4.0).begin(np.random.default_rng(0))
    told, touched = episode.first, []
    while not (told.truncated or told.terminated):
        before = told.info["goal_distance_m"]
        told = episode.step([0.0, 2.0, 55.0])
        good = before - told.info["goal_distance_m"]
        assert told.reward == pytest.approx(good - 0.05 * told.info["touching"], abs=1e-9)
        touched.append(told.info["touching"])
    assert any(touched) and not touched[0]


def test_an_action_beyond_its_bounds_is_brought_to_them_and_nonsense_refused():
    one, other = SnakeEnv("GoTo"), SnakeEnv("GoTo")
    one.reset(seed=0)
    other.reset(seed=0)
    offset, frequency, pressure = one.task.actions
    ends = np.array([offset.high, frequency.low, pressure.high])
    assert same(one.step(np.array([9.0, 0.0, 1e9])), other.step(ends))
    for action in ([0.0, 1.0], [0.0, np.nan, 45.0], 1.0):
        with pytest.raises(InputError, match="give 3 finite numbers: offset, frequency_hz, pressure_kpa"):
            one.step(np.array(action))


def test_what_is_done_out_of_turn_is_refused():
    env = SnakeEnv("Module")
    with pytest.raises(InputError, match="reset the environment first"):
        env.step(np.zeros(2))
    with pytest.raises(InputError, match="unknown option of reset 'goal'"):
        env.reset(options={"goal": 1})
    with pytest.raises(InputError, match="unknown task 'Goto'; did you mean GoTo"):
        SnakeEnv("Goto")
    with pytest.raises(InputError, match="unknown render mode 'human'"):
        SnakeEnv("GoTo", render_mode="human")
    with pytest.raises(InputError, match="robot 'gen2' has 4 segments; this task is for one module"):
        SnakeEnv("Module", robot="gen2")


@pytest.mark.parametrize(
    ("task", "settings", "words"),
    [
        ("GoTo", {"time_step": 0.002}, "unknown setting .*'time_step'; did you mean timestep"),
        ("Module", {"supply_pa": 1e3}, "unknown setting .*'supply_pa'"),
        ("GoTo", {"limit_s": 0.25}, "limit_s 0.25 s is not a multiple of step 0.1 s"),
        ("Module", {"limit_s": -1.0}, "limit_s -1.0 s is not allowed"),
        ("Obstacles", {"camera": Camera(5.0)}, "camera of 5 Hz is too slow .* 10 Hz or more"),
        ("GoTo", {"robot": "gen5"}, "unknown robot 'gen5'"),
    ],
)
def test_settings_that_cannot_be_are_refused_when_the_environment_is_made(task, settings, words):
    with pytest.raises(InputError, match=words):
        SnakeEnv(task, **settings)


@pytest.mark.parametrize("task", TASKS)
def test_many_side_by_side_are_what_each_is_alone(task):
    """Gymnasium's own vector of single environments says the same, over ends and new beginnings too."""
    ours = gymnasium.make_vec(f"srs_twin.envs:SRSTwin/{task}-v0", num_envs=3, threads=2, **SHORT)
    assert isinstance(ours, SnakeVectorEnv)
    theirs = SyncVectorEnv([lambda: SnakeEnv(task, **SHORT)] * 3)
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    assert ours.action_space == theirs.action_space
    assert ours.observation_space == theirs.observation_space
    one, other = played(ours, 4, 9), played(theirs, 4, 9)
    assert any(told[3].any() for told in one[1:])
    for k, (left, right) in enumerate(zip(one, other, strict=True)):
        assert same(left, right), k


def test_a_vector_refuses_what_does_not_fit_it():
    with pytest.raises(InputError, match="num_envs 0 is not allowed"):
        SnakeVectorEnv("GoTo", 0)
    envs = SnakeVectorEnv("Module", 2)
    with pytest.raises(InputError, match="3 were given for 2 environments"):
        envs.reset(seed=[1, 2, 3])
    envs.reset(seed=0)
    before = [float(env.episode.state.time) for env in envs.envs]
    for actions in (np.zeros((1, 2)), np.zeros(4), np.array([[0.0, 0.0], [0.0, np.nan]])):
        with pytest.raises(
            InputError, match=r"give finite numbers of shape \(2, 2\), an action for each of 2"
        ):
            envs.step(actions)
    assert [float(env.episode.state.time) for env in envs.envs] == before


@pytest.mark.slow
def test_the_training_script_writes_a_policy_and_its_learning_curve(tmp_path):
    script = Path(__file__).parents[2] / "examples/train_goto.py"
    few = "--generations 1 --candidates 4 --goals 1 --out".split()
    subprocess.run([sys.executable, script, *few, tmp_path], check=True, capture_output=True, timeout=600)
    assert np.shape(json.loads((tmp_path / "policy.json").read_text())["weights"]) == (3, 3)
    assert (tmp_path / "curve.csv").read_text().count("\n") == 2
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
