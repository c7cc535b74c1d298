"""Pictures of episodes: the snake and its goal are seen, or it is said what is missing to draw them."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from srs_twin import InputError
from srs_twin.envs.gymnasium import SnakeEnv
from srs_twin.viewing.mujoco.opengl import usable_opengl


def drawable() -> bool:
    try:
        usable_opengl()
    except InputError:
        return False
    return True


def test_an_episode_is_drawn_or_what_is_missing_is_told():
    env = SnakeEnv("GoTo", render_mode="rgb_array", width=160, height=120)
    with pytest.raises(InputError, match="reset the environment first"):
        env.render()
    env.reset(seed=0)
    if not drawable():
        with pytest.raises(InputError, match="OpenGL"):
            env.render()
        return
    first = env.render()
    assert first.shape == (120, 160, 3) and first.dtype == np.uint8
    for _ in range(8):
        env.step(np.array([0.3, 2.0, 55.0]))
    second = env.render()
    # Floor and shadows are grey and blue; the body and the goal are warm.
    warm = second[..., 0].astype(int) - second[..., 2] > 40
    assert 50 < warm.sum() < 0.2 * warm.size
    red = second[..., 0].astype(int) - second[..., 1] > 60
    assert 20 < red.sum() < warm.sum(), "the goal lies there as well"
    assert (first != second).any(axis=-1).sum() > 100
    env.close()
    env.reset(seed=1)
    assert env.render().shape == (120, 160, 3)
    env.close()


def test_gymnasium_knows_the_modes_and_without_one_there_is_no_picture():
    env = gymnasium.make("srs_twin.envs:SRSTwin/Module-v0")
    env.reset(seed=0)
    assert env.unwrapped.render() is None
    assert env.metadata["render_modes"] == ["rgb_array"] and env.metadata["render_fps"] == 20
