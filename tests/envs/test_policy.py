"""Stored policies: files, observations by name, and hostile input."""

from __future__ import annotations

import math

import numpy as np
import pytest

from srs_twin.envs import make_task, policy as policy_module
from srs_twin.envs.policy import NetworkPolicy, load_policy, play_episode
from srs_twin.errors import InputError

RNG = np.random.default_rng(0)
NAMES = ("goal_left_m", "goal_ahead_m")


def network():
    layers = (
        (RNG.normal(size=(5, 2)), RNG.normal(size=5)),
        (RNG.normal(size=(3, 5)), RNG.normal(size=3)),
    )
    return NetworkPolicy("GoTo", NAMES, layers)


def test_a_saved_policy_gives_the_same_actions(tmp_path):
    policy = network()
    policy.save(tmp_path / "p.npz")
    loaded = load_policy(tmp_path / "p.npz")
    for observation in RNG.normal(size=(20, 2)):
        assert loaded(observation) == pytest.approx(policy(observation), abs=1e-5)
        assert (np.abs(loaded(observation)) <= 1).all()


def test_a_policy_finds_its_observations_by_name():
    policy = network()
    task = make_task("GoTo")
    observation = RNG.normal(size=len(task.observations))
    names = [signal.name for signal in task.observations]
    expected = policy(observation[[names.index(name) for name in NAMES]])
    assert (policy.bind(task)(observation) == expected).all()
    with pytest.raises(
        InputError, match="does not provide goal_left_m, goal_ahead_m; select these"
    ):
        policy.bind(make_task("GoTo", observations=("pose",)))
    with pytest.raises(InputError, match="was trained for the task GoTo"):
        policy.bind(make_task("Obstacles"))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 damaged", b"policy"])
def test_damaged_files_are_refused(tmp_path, content):
    (tmp_path / "p.npz").write_bytes(content)
    with pytest.raises(InputError, match="p.npz: not a policy file"):
        load_policy(tmp_path / "p.npz")


def test_layers_must_fit_together(tmp_path):
    policy = network()
    NetworkPolicy("GoTo", ("x_m", *NAMES), policy.layers).save(tmp_path / "p.npz")
    with pytest.raises(InputError, match="layers do not match"):
        load_policy(tmp_path / "p.npz")
    with pytest.raises(InputError, match=r"gone\.npz"):
        load_policy(tmp_path / "gone.npz")


@pytest.mark.slow
def test_the_shipped_policy_reaches_goals():
    task = make_task("GoTo")
    act = load_policy("goto").bind(task)
    scores = [
        play_episode(task, act, np.random.default_rng(seed)) for seed in (501, 502)
    ]
    assert [score.ending for score in scores] == ["goal_reached"] * 2
    with pytest.raises(InputError, match="unknown policy 'go'; did you mean goto"):
        load_policy("go")


def test_places_seen_from_the_head_are_turned_into_the_world():
    """To the left of a snake that looks along y lies −x."""
    values = {
        "x_m": 1.0,
        "y_m": 2.0,
        "heading_sin": 1.0,
        "heading_cos": 0.0,
        "obstacle_1_ahead_m": 3.0,
        "obstacle_1_left_m": 0.5,
        "obstacle_1_radius_m": 0.1,
        "obstacle_2_ahead_m": -1.0,
        "obstacle_2_left_m": 0.0,
        "obstacle_2_radius_m": 0.2,
    }
    pose = policy_module._pose(values)
    assert pose.heading == pytest.approx(math.pi / 2)
    seen = [
        (circle.x, circle.y, circle.radius)
        for circle in policy_module._circles(values, pose)
    ]
    assert np.array(seen) == pytest.approx(np.array([[0.5, 5, 0.1], [1, 1, 0.2]]))


def test_the_score_of_an_episode_is_the_sum_of_its_rewards():
    task = make_task("GoTo", limit_s=0.3)
    rewards = []
    episode = task.begin(np.random.default_rng(4))
    action = np.array([0.0, 2.0, 45.0])
    while not episode.ending:
        rewards.append(episode.step(action).reward)
    score = play_episode(task, lambda seen: action, np.random.default_rng(4))
    assert len(rewards) > 1 and score.reward == pytest.approx(sum(rewards))
    assert (score.ending, score.time) == (episode.ending, pytest.approx(0.3))
