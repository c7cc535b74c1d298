"""Off-screen rendering of a MuJoCo model."""

from __future__ import annotations

import atexit
import sys
import weakref
from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from srs_twin.errors import InputError
from srs_twin.viewing.mujoco.opengl import OpenGLContext, new_context, usable_opengl

_MAX_GEOMS = 20_000
_SHADOW_FACTOR = 2
"""Ratio of the shadow map size to the image size.

MuJoCo's default shadow map of 4096 pixels slows down the rendering of small images.
"""

_FONT_PIXELS = 180
"""Image height for each 50 % step of MuJoCo's font scale, pixels."""

_LABEL_HEIGHT = 0.065
"""Height of a label as a fraction of the image height."""

_MIN_LABELS_WIDTH = 480
"""Minimum width of an image with more than one label, pixels."""

Decorate = Callable[[mujoco.MjvScene], None]


class Label(NamedTuple):
    """White text in a coloured box at the lower edge of an image.

    Attributes:
        text: ASCII text, because MuJoCo's font has no other characters.
        color: box colour, #rrggbb.
    """

    text: str
    color: str


class Canvas:
    """Off-screen renderer for images of a model with a fixed image size."""

    def __init__(
        self, model: mujoco.MjModel, width: int, height: int, *, opengl: str = ""
    ) -> None:
        """Create the OpenGL context and the image buffers.

        Args:
            model: MuJoCo model, whose buffer size and shadow map size are changed.
            width: image width, pixels.
            height: image height, pixels.
            opengl: OpenGL backend, named as in MUJOCO_GL, or an empty string to use the
                first working backend.
        """
        model.vis.global_.offwidth = width
        model.vis.global_.offheight = height
        model.vis.quality.shadowsize = min(
            model.vis.quality.shadowsize, _SHADOW_FACTOR * max(width, height)
        )
        self._model = model
        self._frame = mujoco.MjrRect(0, 0, width, height)
        self._scene = mujoco.MjvScene(model, maxgeom=_MAX_GEOMS)
        self._option = mujoco.MjvOption()
        self._opengl = new_context(opengl or usable_opengl(), width, height)
        self._opengl.make_current()
        font = 50 * int(np.clip(round(height / _FONT_PIXELS), 1, 6))
        self._context = mujoco.MjrContext(model, font)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        # The context must be freed before the interpreter unloads OpenGL. Exit handlers
        # run in reverse order of registration, so this handler runs early enough.
        self._close = weakref.finalize(self, _free, self._context, self._opengl)
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
        """Render an image of the model, shape (height, width, 3), uint8."""
        all_categories = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, camera, all_categories, self._scene
        )
        if decorate is not None:
            decorate(self._scene)
        self._opengl.make_current()
        pixels = np.empty((self._frame.height, self._frame.width, 3), dtype=np.uint8)
        mujoco.mjr_render(self._frame, self._scene, self._context)
        if labels:
            self._draw_labels(labels)
        mujoco.mjr_readPixels(pixels, None, self._frame, self._context)
        return pixels[::-1]

    def _draw_labels(self, labels: Sequence[Label]) -> None:
        # The test of an OpenGL backend draws no labels and omits this slow import.
        from srs_twin.viewing.plots.style import unit_rgba

        drawn = labels
        if self._frame.width < _MIN_LABELS_WIDTH:
            drawn = labels[:1]
        height = int(_LABEL_HEIGHT * self._frame.height)
        font = mujoco.mjtFont.mjFONT_NORMAL.value
        for k, (text, color) in enumerate(drawn):
            left = self._frame.width * k // len(labels)
            right = self._frame.width * (k + 1) // len(labels)
            box = mujoco.MjrRect(left, 0, right - left, height)
            mujoco.mjr_label(
                box, font, text, *unit_rgba(color), 1.0, 1.0, 1.0, self._context
            )


def _free(context: mujoco.MjrContext, opengl: OpenGLContext) -> None:
    opengl.make_current()
    context.free()
    opengl.free()


def draw_box(name: str) -> None:
    """Render a white box on a black background to test a backend."""
    model = mujoco.MjModel.from_xml_string(
        # Software rendering would spend most time on shadows and multisampling.
        "<mujoco><visual><quality shadowsize='0'"
        " offsamples='0'/></visual><worldbody><geom type='box' size='.1 .1 .1' rgba='1"
        " 1 1 1'/></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    mujoco.mj_forward(model, data)
    mujoco.mjv_defaultFreeCamera(model, camera)
    with Canvas(model, 16, 16, opengl=name) as canvas:
        pixels = canvas.draw(data, camera)
    if pixels.max() == pixels.min():
        raise InputError("all pixels have the same colour")


if __name__ == "__main__":
    draw_box(sys.argv[1])
