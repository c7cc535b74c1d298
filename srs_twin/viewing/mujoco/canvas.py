"""Canvas: pictures of a MuJoCo model, drawn without a screen."""

from __future__ import annotations

import atexit
import weakref
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from srs_twin.viewing.mujoco.opengl import new_context, usable_opengl
from srs_twin.viewing.plots.style import unit_rgba

_MOST_GEOMS = 20_000
_SHADOW = 2  # size of the shadow map over that of the picture; MuJoCo's 4096 take longer than a small one

_FONT_PIXELS = 180  # height of a picture for each 50 % of MuJoCo's font
_BAND = 0.065  # height of the labels over that of the picture
_NARROW = 480  # pixels; narrower pictures have room for the first label alone

Decorate = Callable[[mujoco.MjvScene], None]


class Label(NamedTuple):
    """White words on a box, at the lower edge of a picture.

    Attributes:
        text: ASCII, which is what MuJoCo's font has.
        color: of the box, as #rrggbb.
    """

    text: str
    color: str


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
        font = 50 * int(np.clip(round(height / _FONT_PIXELS), 1, 6))
        self._drawing = mujoco.MjrContext(model, font)
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
        self,
        data: mujoco.MjData,
        camera: mujoco.MjvCamera,
        decorate: Decorate | None = None,
        labels: Sequence[Label] = (),
    ) -> np.ndarray:
        """Return a picture, shape (height, width, 3), bytes.

        Args:
            data: where everything is, positions computed (`mj_kinematics`, `mj_comPos`).
            camera: from where it is seen.
            decorate: adds to the scene what the model does not have.
            labels: side by side at the lower edge.
        """
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._option, None, camera, everything, self._scene)
        if decorate is not None:
            decorate(self._scene)
        self._opengl.make_current()
        picture = np.empty((self._frame.height, self._frame.width, 3), dtype=np.uint8)
        mujoco.mjr_render(self._frame, self._scene, self._drawing)
        shown = labels if self._frame.width >= _NARROW else labels[:1]
        for k, (text, color) in enumerate(shown):
            ends = [self._frame.width * each // len(labels) for each in (k, k + 1)]
            box = mujoco.MjrRect(ends[0], 0, ends[1] - ends[0], int(_BAND * self._frame.height))
            font = mujoco.mjtFont.mjFONT_NORMAL.value
            mujoco.mjr_label(box, font, text, *unit_rgba(color), 1.0, 1.0, 1.0, self._drawing)
        mujoco.mjr_readPixels(picture, None, self._frame, self._drawing)
        return picture[::-1]


def _free(drawing: mujoco.MjrContext, opengl: Any) -> None:
    opengl.make_current()
    drawing.free()
    opengl.free()
