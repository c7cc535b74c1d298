"""Canvas: pictures of a MuJoCo model, drawn without a screen."""

from __future__ import annotations

import atexit
import weakref
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from srs_twin.viewing.mujoco.opengl import new_context, usable_opengl

_MOST_GEOMS = 20_000
_SHADOW = 2  # size of the shadow map over that of the picture; MuJoCo's 4096 take longer than a small one

Decorate = Callable[[mujoco.MjvScene], None]


class Canvas:
    """Draws a model in pictures of one size; a context manager, since OpenGL's memory is not Python's."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int, *, opengl: str = "") -> None:
        """Make room for pictures of so many pixels.

        Args:
            model: what is drawn; its size of pictures and of shadows is set.
            width: pixels.
            height: pixels.
            opengl: which one, as MUJOCO_GL names it; default one that draws here.

        Raises:
            InputError: none does.
        """
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        model.vis.quality.shadowsize = min(model.vis.quality.shadowsize, _SHADOW * max(width, height))
        self._model = model
        self._frame = mujoco.MjrRect(0, 0, width, height)
        self._scene = mujoco.MjvScene(model, maxgeom=_MOST_GEOMS)
        self._option = mujoco.MjvOption()
        self._opengl = new_context(opengl or usable_opengl(), width, height)
        self._opengl.make_current()
        self._drawing = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._drawing)
        # Also where nobody closes it: OpenGL ends with the interpreter; what is registered last goes first.
        self._close = weakref.finalize(self, _free, self._drawing, self._opengl)
        self._close.atexit = False
        atexit.register(self._close)

    def __enter__(self) -> Canvas:
        return self

    def __exit__(self, *error: object) -> None:
        self._close()
        atexit.unregister(self._close)

    def draw(
        self, data: mujoco.MjData, camera: mujoco.MjvCamera, decorate: Decorate | None = None
    ) -> np.ndarray:
        """Return a picture, shape (height, width, 3), bytes.

        Args:
            data: where everything is, positions computed (`mj_kinematics`, `mj_comPos`).
            camera: from where it is seen.
            decorate: adds to the scene what the model does not have.
        """
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, camera, everything, self._scene)
        if decorate is not None:
            decorate(self._scene)
        self._opengl.make_current()
        picture = np.empty((self._frame.height, self._frame.width, 3), dtype=np.uint8)
        mujoco.mjr_render(self._frame, self._scene, self._drawing)
        mujoco.mjr_readPixels(picture, None, self._frame, self._drawing)
        return picture[::-1]


def _free(drawing: mujoco.MjrContext, opengl: Any) -> None:
    opengl.make_current()
    drawing.free()
    opengl.free()
