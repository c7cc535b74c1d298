"""dm_env interface: dm_env's test mixin, agreement with Gymnasium, discounts at the end."""

from __future__ import annotations

import numpy as np
import pytest
from absl.testing import absltest
from dm_environments import dm_environments
from test_gymnasium import MARKED_TASKS
from test_pictures import can_render

from srs_twin import InputError
from srs_twin.envs.gymnasium import SnakeEnv

dm = dm_environments()

import dm_env  # noqa: E402
from dm_env import test_utils  # noqa: E402


class _Mixin(test_utils.EnvironmentTestMixin):
    task: str

    def make_object_under_test(self):
        # Short, so that the mixin's twenty steps include ends and resets.
        return dm.load(self.task, seed=1, limit_s=0.3)


class TestGoTo(_Mixin, absltest.TestCase):
    task = "GoTo"


class TestModule(_Mixin, absltest.TestCase):
    task = "Module"


@pytest.mark.parametrize("task", MARKED_TASKS)
def test_dm_env_and_gymnasium_give_equal_values(task):
    env = SnakeEnv(task, limit_s=0.3)
    twin = dm.load(task, seed=7, limit_s=0.3)
    env.action_space.seed(0)
    observation, _ = env.reset(seed=7)
    timestep = twin.reset()
    assert [signal.name for signal in env.task.observations] == list(
        timestep.observation
    )
    reward = None
    while True:
        seen = np.concatenate([*timestep.observation.values()])
        assert (seen.tolist(), timestep.reward) == (observation.tolist(), reward)
        if timestep.last():
            break
        action = env.action_space.sample()
        observation, reward, terminated, truncated, _ = env.step(action)
        timestep = twin.step(action)
    assert truncated and not terminated and timestep.discount == 1.0


def test_goal_ends_an_episode_with_discount_0():
    env = dm.load("GoTo", seed=0)
    assert env.action_spec().name.split("\t") == [
        "offset",
        "frequency_hz",
        "pressure_kpa",
    ]
    env.reset()
    physics = env.physics
    physics.episode.goal = type(physics.episode.goal)(0.0, 0.0, None, 0.1)
    timestep = env.step(np.array([0.0, 2.0, 45.0], dtype=np.float32))
    assert timestep.step_type is dm_env.StepType.LAST and timestep.discount == 0.0
    assert physics.twin.bend_angles().shape == (4,)


@pytest.mark.slow
def test_images_are_those_of_gymnasium():
    env = dm.load("GoTo", seed=3)
    other = SnakeEnv("GoTo", render_mode="rgb_array", width=160, height=120)
    env.reset()
    if not can_render():
        with pytest.raises(InputError, match="OpenGL"):
            env.physics.render()
        return
    other.reset(seed=3)
    image = env.physics.render(120, 160)
    larger = env.physics.render()
    assert (image == other.render()).all() and larger.shape == (240, 320, 3)
    other.close()


def test_a_physics_step_is_a_step_of_the_task():
    env = dm.load("GoTo", seed=3, limit_s=1.0)
    physics = env.physics
    assert physics.time() == 0.0
    env.reset()
    assert physics.timestep() == env.control_timestep() == 0.1
    physics.set_control(np.array([0.0, 2.0, 45.0]))
    for steps, time in ((3, 0.3), (1, 0.4)):
        physics.step(steps)
        assert physics.time() == pytest.approx(time)
