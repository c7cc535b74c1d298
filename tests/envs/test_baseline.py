"""The project's own controllers, as policies that see what agents see."""

from __future__ import annotations

import numpy as np
import pytest

from srs_twin.envs import make_task
from srs_twin.envs.baseline import Balance, Pilot, play_episode


@pytest.mark.slow
@pytest.mark.parametrize(("task", "seed"), [("GoTo", 1), ("Obstacles", 0)])
def test_the_follower_arrives(task, seed):
    made = make_task(task)
    score = play_episode(made, Pilot(made), np.random.default_rng(seed))
    assert score.ending == "goal_reached"
    straight = play_episode(
        made, lambda _: np.array([0.0, 2.0, 48.3], dtype=np.float32), np.random.default_rng(seed)
    )
    assert straight.ending != "goal_reached" and straight.reward < score.reward


def test_balanced_duties_track_better_than_duties_at_rest():
    made = make_task("Module")
    tracked = play_episode(made, Balance(made), np.random.default_rng(0))
    resting = play_episode(made, lambda _: np.full(2, 0.5, dtype=np.float32), np.random.default_rng(0))
    assert tracked.ending == resting.ending == "time_up"
    assert 3 * abs(tracked.reward) < abs(resting.reward)
