"""What can be looked at here: MuJoCo's pictures off screen, and Rerun's viewers."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from srs_twin.doctor.check import Check
from srs_twin.doctor.children import Answer

RENDERING = "pictures by MuJoCo, off screen (one of them is enough)"
VIEWERS = "Rerun's viewer"

_LIBRARIES = {"egl": "libegl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}
_NO_DISPLAY = "neither DISPLAY nor WAYLAND_DISPLAY is set"


def backends(platform: str) -> tuple[str, ...]:
    """Return the values of MUJOCO_GL to try on a platform, as `sys.platform` names it."""
    return ("egl", "osmesa", "glfw") if platform.startswith("linux") else ("glfw",)


def display(env: Mapping[str, str], platform: str) -> str:
    """Return the screen that windows would open on, empty where there is none."""
    if not platform.startswith("linux"):
        return "the desktop"
    return next((f"{key}={env[key]}" for key in ("WAYLAND_DISPLAY", "DISPLAY") if env.get(key)), "")


def rendering_check(backend: str, answer: Answer, screen: str) -> Check:
    """Judge what came of drawing a shipped scene.

    Args:
        backend: value of MUJOCO_GL.
        answer: of the probe `frame`.
        screen: as `display` returns it.
    """
    said = answer.said
    if answer.well and said["shades"] > 1:
        height, width = said["size"]
        return Check(RENDERING, backend, "ok", f"drew a shipped scene, {width} × {height}")
    reason = _reason(answer) or "every pixel has the same colour"
    if backend == "glfw":
        remedy = "needs a screen; without one `export MUJOCO_GL=egl`, or put `xvfb-run -a` before the command"
        return Check(RENDERING, backend, "broken" if screen else "missing", reason, remedy)
    if said.get("library", "unknown") is None:
        detail, remedy = (
            "its library is not installed",
            f"apt-get install {_LIBRARIES[backend]} (Debian, Ubuntu)",
        )
        return Check(RENDERING, backend, "missing", detail, remedy)
    if backend == "osmesa":
        return Check(
            RENDERING, backend, "broken", reason, "apt-get install --reinstall libosmesa6, or use egl"
        )
    remedy = (
        f"install a driver: apt-get install {_LIBRARIES[backend]} (Debian, Ubuntu; draws on the processor); "
        "with an NVIDIA card in a container start that with NVIDIA_DRIVER_CAPABILITIES=all"
    )
    return Check(RENDERING, backend, "broken", reason, remedy)


def viewer_checks(
    program: Path | None, screen: str, headless: Answer, web: Answer, window: Answer | None
) -> Iterator[Check]:
    """Judge Rerun's viewer in its three forms: a window, a picture without a screen, a page.

    Args:
        program: the `rerun` that belongs to this Python, None where it is missing.
        screen: as `display` returns it.
        headless: of the probe `headless_viewer`.
        web: of the probe `web_viewer`.
        window: of MuJoCo's attempt to open a window, which shows whether the screen answers.
    """
    if program is None:
        remedy = "pip install --force-reinstall 'rerun-sdk>=0.41,<0.42', or `uv sync --reinstall`"
        yield Check(VIEWERS, "rerun", "missing", "there is no `rerun` beside this Python", remedy)
        return
    yield Check(VIEWERS, "rerun", "ok", str(program))
    yield _window(screen, window)
    if headless.well and headless.said["drawn"]:
        yield Check(VIEWERS, "without a screen", "ok", "drew its window into a picture")
    else:
        words = headless.complaint or headless.said.get("words", "")
        remedy = "apt-get install mesa-vulkan-drivers (Debian, Ubuntu), or any other Vulkan driver"
        yield Check(VIEWERS, "without a screen", "missing", f"cannot draw ({words})", remedy)
    if web.well and web.said["served"]:
        yield Check(VIEWERS, "in a browser", "ok", "`srs-twin view RUN --web` serves it")
    else:
        remedy = "install rerun-sdk anew; report.html of a run needs nothing but a browser"
        reason = web.complaint or "its page was not served on 127.0.0.1"
        yield Check(VIEWERS, "in a browser", "broken", reason, remedy)


def _window(screen: str, tried: Answer | None) -> Check:
    name = "in a window"
    instead = "open report.html of a run in a browser, or serve the recording: `srs-twin view RUN --web`"
    if not screen:
        return Check(VIEWERS, name, "missing", f"no screen: {_NO_DISPLAY}", instead)
    if tried is not None and not tried.well:
        detail = f"{screen} is set, but no window opens there: {_reason(tried)}"
        return Check(VIEWERS, name, "broken", detail, instead)
    return Check(VIEWERS, name, "ok", f"`srs-twin view` opens on {screen}")


def _reason(answer: Answer) -> str:
    """Return why a picture could not be drawn: what GLFW warned of, else the error."""
    first = next(iter(answer.said.get("warnings") or ()), answer.complaint)
    # GLFW's are printed as "(65550) b'X11: …'".
    return re.sub(r"^\(\d+\) b(['\"])(.*)\1$", r"\2", first)
