"""OpenGL without a screen: which one draws here, and a context of it.

MuJoCo takes its OpenGL from the variable MUJOCO_GL, and physics alone runs with "disabled". Here one is
chosen when the first picture is drawn, whether MuJoCo has been imported by then or not. What is installed
does not tell what draws, so each candidate draws a small picture in a process of its own: a library that
cannot may end its process, and PyOpenGL keeps to the first one that it has tried.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from functools import lru_cache
from typing import Any

import numpy as np

from srs_twin.errors import InputError

PACKAGES = {"egl": "libegl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}
"""What Debian and Ubuntu call the libraries."""

_MODULES = {"egl": "mujoco.egl", "osmesa": "mujoco.osmesa", "glfw": "mujoco.glfw", "cgl": "mujoco.cgl"}
_BY_PLATFORM = {"linux": ("egl", "osmesa"), "darwin": ("cgl",)}
_NONE_CHOSEN = ("", "0", "off", "false", "disable", "disabled", "on", "true", "1", "enable", "enabled")
_PATIENCE_S = 60.0


@lru_cache(maxsize=1)
def usable_opengl() -> str:
    """Return the OpenGL to draw with, and name it in MUJOCO_GL.

    One that the user named there is taken if it draws; else the first that does of egl and osmesa.

    Raises:
        InputError: none does; says why and what to install.
    """
    given = os.environ.get("MUJOCO_GL", "").lower().strip()
    wanted = _BY_PLATFORM.get(sys.platform, ("glfw",)) if given in _NONE_CHOSEN else (given,)
    reasons = {}
    for name in wanted:
        complaint = _complaint(name)
        if not complaint:
            os.environ["MUJOCO_GL"] = name
            return name
        reasons[name] = complaint
    found = "; ".join(f"{name}: {reason}" for name, reason in reasons.items())
    if given in _NONE_CHOSEN:
        remedy = "; or ".join(f"apt-get install {packages}" for packages in PACKAGES.values())
        raise InputError(f"no OpenGL draws here without a screen ({found}); on Debian and Ubuntu: {remedy}")
    raise InputError(
        f"the OpenGL that MUJOCO_GL names does not draw here ({found}); unset it to have one chosen "
        f"({' or '.join(PACKAGES)})"
    )


def new_context(name: str, width: int, height: int) -> Any:
    """Return a context of an OpenGL that draws here; it has `make_current` and `free`."""
    return importlib.import_module(_MODULES[name]).GLContext(width, height)


def _complaint(name: str) -> str:
    """Return why an OpenGL does not draw here, empty where it does."""
    if name not in _MODULES:
        return f"it is unknown; known are {', '.join(_MODULES)}"
    command = [sys.executable, "-m", __spec__.name, name]
    environment = {**os.environ, "MUJOCO_GL": name}
    try:
        tried = subprocess.run(
            command, env=environment, capture_output=True, text=True, errors="replace", timeout=_PATIENCE_S
        )
    except subprocess.TimeoutExpired:
        return f"no picture within {_PATIENCE_S:g} s"
    if tried.returncode == 0:
        return ""
    said = [line for line in tried.stderr.splitlines() if line and not line.startswith(" ")]
    errors = [line for line in said if "Error" in line]
    return (errors or said or [f"ended with code {tried.returncode}"])[0]


def draw_box(name: str) -> None:
    """Draw a white box on black, in a process that ends soon: a library that cannot draw may end it.

    Args:
        name: which OpenGL, as MUJOCO_GL names it.

    Raises:
        InputError: every pixel has the same colour; libraries raise errors of many other types.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_string(
        # Shadows and several samples a pixel cost a driver without a card most of the time.
        "<mujoco><visual><quality shadowsize='0' offsamples='0'/></visual>"
        "<worldbody><geom type='box' size='.1 .1 .1' rgba='1 1 1 1'/></worldbody></mujoco>"
    )
    data, camera, scene = mujoco.MjData(model), mujoco.MjvCamera(), mujoco.MjvScene(model, maxgeom=10)
    mujoco.mj_forward(model, data)
    mujoco.mjv_defaultFreeCamera(model, camera)
    all_kinds = mujoco.mjtCatBit.mjCAT_ALL.value
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, all_kinds, scene)
    size, picture = mujoco.MjrRect(0, 0, 16, 16), np.empty((16, 16, 3), dtype=np.uint8)
    context = new_context(name, 16, 16)
    context.make_current()
    drawing = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, drawing)
    mujoco.mjr_render(size, scene, drawing)
    mujoco.mjr_readPixels(picture, None, size, drawing)
    drawing.free()
    context.free()
    if picture.max() == picture.min():
        raise InputError("every pixel has the same colour")


if __name__ == "__main__":
    draw_box(sys.argv[1])
