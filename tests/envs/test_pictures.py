"""Rendering of episodes: snake and goal are visible, or the error names the missing OpenGL."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from srs_twin import InputError
from srs_twin.envs.gymnasium import SnakeEnv
from srs_twin.viewing.mujoco.opengl import usable_opengl
from srs_twin.viewing.plots.style import GOAL_COLOR, PLUS_COLOR, PLUS_RGB, rgb


def can_render() -> bool:
    try:
        usable_opengl()
    except InputError:
        return False
    return True


def count_pixels(image: np.ndarray, color: tuple[int, int, int]) -> int:
    """Count the pixels with the hue of a colour, at any brightness."""
    bright = image / np.maximum(image.max(axis=-1, keepdims=True), 1)
    return int(
        (np.abs(bright - np.array(color) / max(color)).max(axis=-1) < 0.12).sum()
    )


@pytest.mark.slow
def test_rendering_shows_chambers_and_goal():
    env = SnakeEnv("GoTo", render_mode="rgb_array", width=320, height=240)
    with pytest.raises(InputError, match="reset the environment first"):
        env.render()
    env.reset(seed=0)
    if not can_render():
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
        seen = max(count_pixels(image, rgb(color)) for image in later)
        assert 20 < seen < 0.05 * first[..., 0].size, (
            "chambers, and the ring of the goal"
        )
    second = later[-1]
    green = [(image[..., 1].astype(int) - image[..., 0] > 60).sum() for image in later]
    assert max(green) > 20, "the other chambers"
    assert count_pixels(first, PLUS_RGB) == 0, "chambers are empty at the start"
    assert (first != second).any(axis=-1).sum() > 100
    env.close()
    env.reset(seed=1)
    assert env.render().shape == (240, 320, 3)
    env.close()


def test_without_render_mode_there_is_no_image():
    env = gymnasium.make("srs_twin.envs:SRSTwin/Module-v0")
    env.reset(seed=0)
    assert env.unwrapped.render() is None
    assert (
        env.metadata["render_modes"] == ["rgb_array"]
        and env.metadata["render_fps"] == 20
    )
