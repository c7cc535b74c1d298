"""The face of dm_env: its own test mixin, the same numbers as gymnasium's, and its rules for the end."""

from __future__ import annotations

import dm_env
import numpy as np
import pytest
from absl.testing import absltest
from dm_env import test_utils

from srs_twin.envs import TASKS, dm
from srs_twin.envs.gymnasium import SnakeEnv


class _Mixin(test_utils.EnvironmentTestMixin):
    task: str

    def make_object_under_test(self):
        # Short, so that the mixin's twenty steps see ends and new beginnings.
        return dm.load(self.task, seed=1, limit_s=0.3)


class TestGoTo(_Mixin, absltest.TestCase):
    task = "GoTo"


class TestObstacles(_Mixin, absltest.TestCase):
    task = "Obstacles"


class TestModule(_Mixin, absltest.TestCase):
    task = "Module"


def test_every_task_has_met_the_mixin():
    assert {TestGoTo.task, TestObstacles.task, TestModule.task} == set(TASKS)


@pytest.mark.parametrize("task", TASKS)
def test_both_faces_tell_the_same(task):
    env, twin = SnakeEnv(task, limit_s=0.3), dm.load(task, seed=7, limit_s=0.3)
    env.action_space.seed(0)
    observation, _ = env.reset(seed=7)
    told = twin.reset()
    assert np.concatenate(list(told.observation.values())).tolist() == observation.tolist()
    assert [each.name for each in env.task.observations] == list(told.observation)
    while not told.last():
        action = env.action_space.sample()
        observation, reward, terminated, truncated, _ = env.step(action)
        told = twin.step(action)
        assert np.concatenate(list(told.observation.values())).tolist() == observation.tolist()
        assert told.reward == reward
    assert truncated and not terminated and told.discount == 1.0


def test_the_goal_ends_with_discount_0_and_names_are_those_of_the_table():
    env = dm.load("GoTo", seed=0)
    assert env.action_spec().name.split("\t") == ["offset", "frequency_hz", "pressure_kpa"]
    env.reset()
    physics = env.physics
    physics.episode.goal = physics.episode._goal = type(physics.episode._goal)(0.0, 0.0, None, 0.1)
    told = env.step(np.array([0.0, 2.0, 45.0], dtype=np.float32))
    assert told.step_type is dm_env.StepType.LAST and told.discount == 0.0
    assert physics.twin.bend_angles().shape == (4,)
    assert physics.time() == pytest.approx(0.1) and env.control_timestep() == pytest.approx(0.1)
