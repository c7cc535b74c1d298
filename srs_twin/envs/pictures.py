"""Pictures of an episode: the twin, its obstacles and its goal, drawn without a screen."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from srs_twin.envs.task import Episode

_GOAL = np.array([0.69, 0.19, 0.19, 0.6], dtype=np.float32)
_GOAL_HEIGHT = 0.002  # m
_ELEVATION, _LENGTHS, _APART = -65.0, 4.0, 1.7


class Pictures:
    """Draws episodes one after the other; OpenGL is asked for with the first picture."""

    def __init__(self, width: int, height: int) -> None:
        """Prepare for pictures of so many pixels."""
        self._size = width, height
        self._canvas: Any = None
        self._model: mujoco.MjModel | None = None

    def of(self, episode: Episode) -> np.ndarray:
        """Return a picture of now, shape (height, width, 3), bytes.

        Raises:
            InputError: no OpenGL draws here without a screen.
        """
        from srs_twin.viewing.canvas import Canvas

        physics = episode.twin.physics
        model, data = physics.model.ptr, physics.data.ptr
        if model is not self._model:
            self.close()
            self._canvas, self._model = Canvas(model, *self._size), model
        mujoco.mj_camlight(model, data)
        camera = _camera(episode)
        picture: np.ndarray = self._canvas.draw(data, camera, lambda scene: _add_goal(scene, episode))
        return picture

    def close(self) -> None:
        """Give OpenGL's memory back."""
        if self._canvas is not None:
            self._canvas.__exit__(None, None, None)
            self._canvas = self._model = None


def _camera(episode: Episode) -> mujoco.MjvCamera:
    """Look down on the snake, and on the goal where there is one, from a distance that shows both."""
    camera, middle = mujoco.MjvCamera(), episode.twin.physics.center_of_mass()
    camera.elevation, camera.azimuth = _ELEVATION, 90.0
    camera.distance = _LENGTHS * episode.twin.spec.geometry.body_length
    if episode.goal is not None:
        way = np.array([episode.goal.x, episode.goal.y]) - middle[:2]
        middle[:2] += way / 2
        camera.distance = max(camera.distance, _APART * float(np.hypot(*way)))
    camera.lookat = middle
    return camera


def _add_goal(scene: mujoco.MjvScene, episode: Episode) -> None:
    """Lay the goal on the floor as a disc."""
    goal = episode.goal
    if goal is None or scene.ngeom == scene.maxgeom:
        return
    disc = scene.geoms[scene.ngeom]
    size = np.array([goal.radius, goal.radius, _GOAL_HEIGHT])
    place, cylinder = np.array([goal.x, goal.y, _GOAL_HEIGHT]), mujoco.mjtGeom.mjGEOM_CYLINDER
    mujoco.mjv_initGeom(disc, cylinder, size, place, np.eye(3).ravel(), _GOAL)
    scene.ngeom += 1
