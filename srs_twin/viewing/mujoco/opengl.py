"""Selection of an OpenGL backend for off-screen rendering.

The backend is selected when the first image is drawn, because simulations without
rendering set `MUJOCO_GL` to "disabled". Each candidate backend renders a test image in
a separate process. A faulty library may crash this process, and PyOpenGL cannot change
the backend within a process.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from functools import lru_cache
from typing import Protocol

from srs_twin.errors import InputError

PACKAGES = {"egl": "libegl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}
"""Debian and Ubuntu packages that provide each OpenGL backend."""

_BACKENDS = ("egl", "osmesa", "glfw", "cgl")
"""OpenGL backends, which are modules of the package `mujoco`."""

_CANDIDATES = {"linux": ("egl", "osmesa"), "darwin": ("cgl",)}
_UNSPECIFIED = (
    "",
    "0",
    "off",
    "false",
    "disable",
    "disabled",
    "on",
    "true",
    "1",
    "enable",
    "enabled",
)
"""Values of MUJOCO_GL that do not select a backend."""

_TIMEOUT_S = 60.0
"""Time limit for testing a backend, s."""


@lru_cache(maxsize=1)
def usable_opengl() -> str:
    """Return the name of a working OpenGL backend and set `MUJOCO_GL` to this name.

    If `MUJOCO_GL` does not select a backend, the backends of the platform are tried in
    turn (first egl and then osmesa on Linux).
    """
    selected = os.environ.get("MUJOCO_GL", "").lower().strip()
    candidates: tuple[str, ...] = (selected,)
    if selected in _UNSPECIFIED:
        candidates = _CANDIDATES.get(sys.platform, ("glfw",))
    failures = {}
    for name in candidates:
        failure = _test(name)
        if not failure:
            os.environ["MUJOCO_GL"] = name
            return name
        failures[name] = failure
    reasons = "; ".join(f"{name}: {failure}" for name, failure in failures.items())
    if selected in _UNSPECIFIED:
        remedy = "; or ".join(
            f"apt-get install {packages}" for packages in PACKAGES.values()
        )
        raise InputError(
            f"no OpenGL backend can render off screen ({reasons}); on Debian and"
            f" Ubuntu, install a backend with {remedy}"
        )
    raise InputError(
        f"the OpenGL backend selected by MUJOCO_GL does not work ({reasons}); unset"
        f" this variable to choose {' or '.join(PACKAGES)} automatically"
    )


class OpenGLContext(Protocol):
    """OpenGL context of one of MuJoCo's backends."""

    def make_current(self) -> None:
        """Use the context in this thread."""

    def free(self) -> None:
        """Release the memory of the context."""


def new_context(name: str, width: int, height: int) -> OpenGLContext:
    """Create an OpenGL context with the given backend and image size."""
    module = importlib.import_module(f"mujoco.{name}")
    context: OpenGLContext = module.GLContext(width, height)
    return context


def _test(name: str) -> str:
    """Return why an OpenGL backend does not work, or an empty string if it works."""
    if name not in _BACKENDS:
        return f"unknown backend; allowed backends: {', '.join(_BACKENDS)}"
    command = [sys.executable, "-m", f"{__package__}.canvas", name]
    environment = {**os.environ, "MUJOCO_GL": name}
    try:
        done = subprocess.run(
            command,
            env=environment,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"no image was drawn within {_TIMEOUT_S:g} s"
    if done.returncode == 0:
        return ""
    lines = [line for line in done.stderr.splitlines() if line[:1].strip()]
    errors = [line for line in lines if "Error" in line]
    reasons = [*errors, *lines, f"exit code {done.returncode}"]
    return reasons[0]
