"""Probes: what `children` runs, one a process, as `python -m srs_twin.doctor.probes NAME …`.

Each prints JSON objects, a line each, and ends with 0 if it could try what it is for; errors are left to end
it, since what they say is the finding.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

_SERVING_S = 10.0
PNG = b"\x89PNG\r\n\x1a\n"


def imports(*modules: str) -> Iterator[dict[str, Any]]:
    """Import modules one after the other: the last one named is the one that did not survive it."""
    for module in modules:
        yield {"importing": module}
        importlib.import_module(module)
    yield {"importing": ""}


def data() -> Iterator[dict[str, Any]]:
    """Load every robot and every scenario that comes with the package, and look for the robots' models."""
    from srs_twin.errors import SrsError
    from srs_twin.files import data_root, shipped_names
    from srs_twin.scenario import load_scenario
    from srs_twin.spec import load_robot

    names = {kind: shipped_names(kind) for kind in ("robot", "scenario")}
    loaders: dict[str, Callable[[str], object]] = {"robot": load_robot, "scenario": load_scenario}
    bad = []
    for kind, load in loaders.items():
        for name in names[kind]:
            try:
                load(name)
            except SrsError as error:
                bad.append(f"{kind} {name}: {str(error).splitlines()[0]}")
    scenes = [name for name in names["robot"] if scene(name).is_file()]
    bad += [f"model {name}: {scene(name)} is missing" for name in names["robot"] if name not in scenes]
    counts = {"robots": len(names["robot"]), "scenarios": len(names["scenario"]), "models": len(scenes)}
    yield {"root": str(data_root()), **counts, "bad": bad}


def scene(robot: str) -> Path:
    """Return the MJCF file of a shipped robot on a floor."""
    from srs_twin.files import data_root

    return data_root() / "models" / robot / "scene.xml"


def models() -> Iterator[dict[str, Any]]:
    """Compile every shipped model and give it a second of random control."""
    from srs_twin.files import shipped_names
    from srs_twin.mjcf_check import check_mjcf

    bad, checked = [], []
    for name in shipped_names("robot"):
        if scene(name).is_file():
            checked.append(name)
            bad += [f"{name}: {fault}" for fault in check_mjcf(scene(name)).faults]
    yield {"models": checked, "bad": bad}


def kernels() -> Iterator[dict[str, Any]]:
    """Compile a friction law anew and compare; import the kernels, for which numba needs its cache folder."""
    import numpy as np
    from numba import njit

    from srs_twin import friction

    arguments = (0.02, -0.1, 0.4, 0.05, 0.3, 1e-3)
    compiled = njit(friction.wheel)(*arguments)
    yield {"agrees": bool(np.allclose(compiled, friction.wheel(*arguments), rtol=1e-12))}
    from srs_twin.plants.step_control import advance

    kernel: Any = advance
    yield {"cache": kernel._cache.cache_path}


def frame() -> Iterator[dict[str, Any]]:
    """Draw a shipped scene off screen, with the OpenGL that the variable MUJOCO_GL names."""
    import ctypes.util

    libraries = {"egl": "EGL", "osmesa": "OSMesa"}
    wanted = libraries.get(os.environ["MUJOCO_GL"])
    yield {"library": ctypes.util.find_library(wanted) if wanted else "glfw"}
    from srs_twin.files import shipped_names
    from srs_twin.viewing.offscreen import frame as drawn

    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            picture = drawn(scene(shipped_names("robot")[0]))
        finally:
            # GLFW warns of what is wrong; the error that follows names a consequence.
            yield {"warnings": [str(each.message) for each in heard]}
    yield {"size": picture.shape[:2], "shades": len(set(picture.reshape(-1).tolist()))}


def headless_viewer() -> Iterator[dict[str, Any]]:
    """Let Rerun's viewer draw its own window without a screen."""
    from srs_twin.viewing.rerun_process import HOST, free_port
    from srs_twin.viewing.viewer import rerun_executable

    picture = Path("window.png").resolve()
    command = [
        str(rerun_executable()), "--headless", "--bind", HOST, "--port", str(free_port()),
        "--window-size", "320x240", "--hide-welcome-screen", "--screenshot-to", str(picture),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    panics = re.findall(r"panicked at '?(.*?)'?$", done.stdout + done.stderr, re.M)
    drawn = picture.is_file() and picture.read_bytes().startswith(PNG)
    yield {"drawn": drawn, "words": (*panics, f"ended with exit code {done.returncode}")[0]}


def web_viewer() -> Iterator[dict[str, Any]]:
    """Let Rerun serve its viewer for browsers, and fetch the page and the head of the program."""
    from srs_twin.viewing.rerun_process import HOST, free_port
    from srs_twin.viewing.viewer import rerun_executable

    port = free_port()
    command = [
        str(rerun_executable()), "--serve-web", "--bind", HOST, "--port", str(free_port()),
        "--web-viewer-port", str(port),
    ]  # fmt: skip
    # A child would go on to ignore interrupts where this process was started to.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # Not `rerun_beside`: in a group of its own Rerun would outlive a probe that is killed with its group.
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield {"served": _served(server, f"http://{HOST}:{port}/")}
    finally:
        # `rerun` is a script that starts the real program, and ends it when it is interrupted.
        server.send_signal(signal.SIGINT)
        server.wait(timeout=5.0)


def _served(server: subprocess.Popen[bytes], address: str) -> bool:
    """Wait until both parts are served; False if the server ends or never does."""
    # A proxy has nothing to do with this machine itself.
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    deadline = time.monotonic() + _SERVING_S
    while server.poll() is None and time.monotonic() < deadline:
        try:
            for part in ("", "re_viewer_bg.wasm"):
                request = urllib.request.Request(address + part, method="HEAD")
                opener.open(request, timeout=2.0).close()
            return True
        except (urllib.error.URLError, OSError):
            time.sleep(0.1)
    return False


PROBES: dict[str, Callable[..., Iterator[dict[str, Any]]]] = {
    probe.__name__: probe for probe in (imports, data, models, kernels, frame, headless_viewer, web_viewer)
}

_OPTIONAL = ("frame", "headless_viewer", "web_viewer")

if __name__ == "__main__":
    name, *arguments = sys.argv[1:]
    if name in _OPTIONAL and hasattr(os, "nice"):
        os.nice(10)  # on a slow machine, what is necessary is to have its answer in time
    for finding in PROBES[name](*arguments):
        sys.stdout.write(json.dumps(finding) + "\n")
        sys.stdout.flush()
