"""Baseline policies of the environments."""

from __future__ import annotations

import numpy as np
import pytest

from srs_twin.envs import make_task
from srs_twin.envs.policy import PathFollowing, ProportionalIntegral, play_episode


@pytest.mark.slow
@pytest.mark.parametrize(("task", "seed"), [("GoTo", 1), ("Obstacles", 0)])
def test_path_following_reaches_the_goal(task, seed):
    instance = make_task(task)
    score = play_episode(instance, PathFollowing(instance), np.random.default_rng(seed))
    assert score.ending == "goal_reached"
    straight = play_episode(
        instance, lambda _: np.array([0.0, 2.0, 48.3], dtype=np.float32), np.random.default_rng(seed)
    )
    assert straight.ending != "goal_reached" and straight.reward < score.reward


def test_pi_control_tracks_better_than_constant_duties():
    instance = make_task("Module")
    tracked = play_episode(instance, ProportionalIntegral(instance), np.random.default_rng(0))
    resting = play_episode(instance, lambda _: np.full(2, 0.5, dtype=np.float32), np.random.default_rng(0))
    assert tracked.ending == resting.ending == "time_up"
    assert 3 * abs(tracked.reward) < abs(resting.reward)
