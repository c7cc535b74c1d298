"""Pictures of episodes: the snake and its goal are seen, or it is said what is missing to draw them."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from srs_twin import InputError
from srs_twin.envs.gymnasium import SnakeEnv
from srs_twin.viewing.mujoco.opengl import usable_opengl
from srs_twin.viewing.plots.style import GOAL_COLOR, PLUS_COLOR, PLUS_RGB, rgb


def drawable() -> bool:
    try:
        usable_opengl()
    except InputError:
        return False
    return True


def alike(picture: np.ndarray, color: tuple[int, int, int]) -> int:
    """Count the pixels that have a colour's hue, in light and shade."""
    bright = picture / np.maximum(picture.max(axis=-1, keepdims=True), 1)
    return int((np.abs(bright - np.array(color) / max(color)).max(axis=-1) < 0.12).sum())


@pytest.mark.slow
def test_an_episode_is_drawn_or_what_is_missing_is_told():
    env = SnakeEnv("GoTo", render_mode="rgb_array", width=320, height=240)
    with pytest.raises(InputError, match="reset the environment first"):
        env.render()
    env.reset(seed=0)
    if not drawable():
        with pytest.raises(InputError, match="OpenGL"):
            env.render()
        return
    first = env.render()
    assert first.shape == (240, 320, 3) and first.dtype == np.uint8
    later = []
    for _ in range(8):
        env.step(np.array([0.3, 2.0, 55.0]))
        later.append(env.render())
    for color in (PLUS_COLOR, GOAL_COLOR):
        seen = max(alike(each, rgb(color)) for each in later)
        assert 20 < seen < 0.05 * first[..., 0].size, "chambers, and the ring of the goal"
    second = later[-1]
    green = [(each[..., 1].astype(int) - each[..., 0] > 60).sum() for each in later]
    assert max(green) > 20, "the other chambers"
    assert alike(first, PLUS_RGB) == 0, "chambers are empty at the start"
    assert (first != second).any(axis=-1).sum() > 100
    env.close()
    env.reset(seed=1)
    assert env.render().shape == (240, 320, 3)
    env.close()


def test_gymnasium_knows_the_modes_and_without_one_there_is_no_picture():
    env = gymnasium.make("srs_twin.envs:SRSTwin/Module-v0")
    env.reset(seed=0)
    assert env.unwrapped.render() is None
    assert env.metadata["render_modes"] == ["rgb_array"] and env.metadata["render_fps"] == 20
