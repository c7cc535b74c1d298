"""Pictures of a MuJoCo model without a window, by the OpenGL that the variable MUJOCO_GL names."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def frame(path: Path, *, width: int = 160, height: int = 120) -> np.ndarray:
    """Return a picture of a model as it lies at the start, shape (height, width, 3), bytes.

    Set MUJOCO_GL to "egl", "osmesa" or "glfw" before MuJoCo is imported; it raises errors of many types
    where that cannot draw here.

    Args:
        path: the MJCF file.
        width: pixels.
        height: pixels.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, height, width) as renderer:
        renderer.update_scene(data)
        picture: np.ndarray = renderer.render()
    return picture
