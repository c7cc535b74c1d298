"""Images of episodes in the style of `srs-twin render`.

An image shows the obstacles, a ring around the goal, and the twin with colours that
indicate the chamber pressures.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from srs_twin.envs.task import Episode

if TYPE_CHECKING:
    from srs_twin.viewing.mujoco.canvas import Canvas

_GOAL_LINE = 0.003
"""Ratio of half the line width of the goal ring to the camera distance."""

_ELEVATION_DEG = -65.0

_BODY_LENGTHS = 4.0
"""Minimum ratio of the camera distance to the body length."""

_GOAL_DISTANCES = 1.7
"""Minimum ratio of the camera distance to the distance between snake and goal."""


class EpisodeRenderer:
    """Renderer that initialises OpenGL when the first image is requested.

    Attributes:
        size: width and height of the images, pixels.
    """

    def __init__(self, width: int, height: int) -> None:
        self.size = width, height
        self._canvas: Canvas | None = None
        self._model: mujoco.MjModel | None = None

    def __reduce__(self) -> tuple[object, ...]:
        return EpisodeRenderer, self.size  # A copy creates its own OpenGL context.

    def render(self, episode: Episode) -> np.ndarray:
        """Return an image of an episode as a uint8 array, shape (height, width, 3).

        Raises:
            InputError: OpenGL cannot render without a display on this machine.
        """
        from srs_twin.viewing.mujoco.canvas import Canvas
        from srs_twin.viewing.mujoco.stage import Skins

        physics = episode.twin.physics
        model = physics.model
        data = physics.data
        if model is not self._model:
            self.close()
            self._canvas = Canvas(model, *self.size)
            self._model = model
            self._skins = Skins(model, episode.twin.spec.segments)
        self._skins.show(episode.state.pressure, episode.twin.spec.supply.nominal)
        mujoco.mj_camlight(model, data)
        camera = _camera(episode)
        assert self._canvas is not None, "created for the first model"
        image: np.ndarray = self._canvas.draw(
            data, camera, lambda scene: _add_goal(scene, episode, camera.distance)
        )
        return image

    def close(self) -> None:
        """Release the OpenGL context."""
        if self._canvas is not None:
            self._canvas.__exit__(None, None, None)
            self._canvas = self._model = None


def _camera(episode: Episode) -> mujoco.MjvCamera:
    camera = mujoco.MjvCamera()
    target = episode.twin.physics.center_of_mass()
    camera.elevation = _ELEVATION_DEG
    camera.azimuth = 90.0
    camera.distance = _BODY_LENGTHS * episode.twin.spec.geometry.body_length
    if episode.goal is not None:
        to_goal = np.array([episode.goal.x, episode.goal.y]) - target[:2]
        target[:2] += to_goal / 2
        camera.distance = max(
            camera.distance, _GOAL_DISTANCES * float(np.hypot(*to_goal))
        )
    camera.lookat = target
    return camera


def _add_goal(scene: mujoco.MjvScene, episode: Episode, distance: float) -> None:
    from srs_twin.viewing.mujoco.stage import add_line
    from srs_twin.viewing.plots.signals import goal_ring
    from srs_twin.viewing.plots.style import GOAL_COLOR

    if episode.goal is not None:
        ring = goal_ring(episode.goal.x, episode.goal.y, episode.goal.radius)
        add_line(scene, ring, GOAL_COLOR, _GOAL_LINE * distance)
