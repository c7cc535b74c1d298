"""Probes: tests that run in child processes of `examination.run_probes`.

A probe returns a description of the working component, returns a `ProbeResult` for a
fault, or raises an exception. Each probe runs in a separate process, forked from the
one that imported the modules.
"""

from __future__ import annotations

import ctypes.util
import gc
import importlib
import json
import math
import os
import re
import signal
import subprocess
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from srs_twin.cli.doctor.checks import ProbeResult, result_of_exit

_SERVER_TIMEOUT_S = 40
"""Time within which the web viewer must respond, s."""

_MODELS_TIMEOUT_S = 40
"""Time limit of the check of one model, s."""

_SIMULATED_S = 0.2
"""Simulated time of each model, s."""

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
"""Off-screen OpenGL backend of MuJoCo → its system library."""

SKIPPED_OSMESA = ProbeResult(
    "undecided",
    "not tested: egl works, and one backend is enough",
    "`MUJOCO_GL=osmesa srs-twin doctor` tests it",
)
MARKER = "srs-twin doctor: "
"""Prefix of the lines with results; libraries print other lines."""

_REPORTED = 3
"""Exit code of a probe that failed and has reported its result."""


def imports(modules: Sequence[str]) -> str | ProbeResult:
    """Import modules; each name is printed first, because the import may end the process."""
    faults = []
    for module in modules:
        _send(importing=module)
        try:
            importlib.import_module(module)
        except Exception as error:  # a package may raise anything
            faults.append(f"{module}: {_error_text(error)}")
    if faults:
        return ProbeResult("broken", "; ".join(faults))
    return "every package imports"


def data() -> str | ProbeResult:
    """Load every shipped robot; look for models and scenarios."""
    from srs_twin.errors import SrsError
    from srs_twin.io.files import data_root, shipped_names
    from srs_twin.robot.file import load_robot

    robots = shipped_names("robot")
    scenarios = shipped_names("scenario")
    scenes = [name for name in robots if _scene(name).is_file()]
    faults = []
    for name in robots:
        has_model = True
        try:
            has_model = (
                load_robot(name).skin is None
            )  # robots with skin have no exported model
        except SrsError as error:
            faults.append(f"robot {name}: {str(error).splitlines()[0]}")
        if has_model and name not in scenes:
            faults.append(f"model {name}: {_scene(name)} is missing")
    detail = (
        f"{len(robots)} robots, {len(scenarios)} scenarios, {len(scenes)} models in"
        f" {data_root()}"
    )
    if not (robots and scenarios):
        return ProbeResult("missing", detail)
    if faults:
        return ProbeResult("broken", f"{detail}; {'; '.join(faults)}")
    return detail


def models() -> str | ProbeResult:
    """Compile every shipped model and simulate it with random control."""
    from srs_twin.io.files import shipped_names
    from srs_twin.plants.twin.mjcf.check import examine_model

    scenes = {
        name: _scene(name) for name in shipped_names("robot") if _scene(name).is_file()
    }
    reports = {
        name: examine_model(scene, _MODELS_TIMEOUT_S, _SIMULATED_S)
        for name, scene in scenes.items()
    }
    faults = [
        f"{name}: {fault}"
        for name, report in reports.items()
        for fault in report["faults"]
    ]
    if faults:
        remedy = "run `srs-twin models check` for details, or reinstall srs-twin"
        return ProbeResult("broken", "; ".join(faults), remedy)
    if not scenes:
        return ProbeResult("missing", "there are no models")
    return (
        f"compiles {', '.join(scenes)}, and simulates {_SIMULATED_S:g} s of each"
        " without warnings"
    )


def _scene(robot: str) -> Path:
    """Return the MJCF scene of a shipped robot."""
    from srs_twin.io.files import data_root

    return data_root() / "models" / robot / "scene.xml"


def kernels() -> str | ProbeResult:
    """Compare a compiled kernel with the same function in Python."""
    from srs_twin.pneumatics.flow import flow

    kernel: Any = flow
    arguments = (2e5, 1.5e5, 0.3)
    if not all(map(math.isclose, kernel(*arguments), kernel.py_func(*arguments))):
        return ProbeResult(
            "broken", "numba's machine code and Python give different results"
        )
    cache = kernel.entry._cache.cache_path
    if cache is None:
        remedy = "export NUMBA_CACHE_DIR=/tmp/numba (any writable folder) avoids that"
        return (
            "numba's machine code works, but is compiled again at every start;"
            f" {remedy}"
        )
    return f"numba's machine code works, cached in {cache}"


def drawing(opengl: str) -> str | ProbeResult:
    """Draw a box off screen with an OpenGL backend, named as in MUJOCO_GL."""
    from srs_twin.viewing.mujoco.opengl import PACKAGES, draw_box

    if opengl in LIBRARIES and ctypes.util.find_library(LIBRARIES[opengl]) is None:
        remedy = f"apt-get install {PACKAGES[opengl]} (Debian, Ubuntu)"
        return ProbeResult("missing", "its library is not installed", remedy)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            draw_box(opengl)
        except Exception:
            if not caught:
                raise
            # The warning of GLFW, "(65550) b'X11: …'", names the cause; the subsequent
            # error only a consequence.
            return ProbeResult(
                "broken",
                re.sub(r"^\(\d+\) b(['\"])(.*)\1$", r"\2", str(caught[0].message)),
            )
    return "works"


def headless_viewer() -> str | ProbeResult:
    """Draw the window of the Rerun viewer without a display."""
    screenshot = Path("window.png").resolve()
    window = ("--headless", "--window-size", "32x24", "--hide-welcome-screen")
    done = subprocess.run(
        [*_rerun_command(), *window, "--screenshot-to", str(screenshot)],
        capture_output=True,
        text=True,
        errors="replace",
    )
    if screenshot.is_file() and screenshot.read_bytes().startswith(_PNG_SIGNATURE):
        return "drew its window into an image"
    panics = re.findall(r"panicked at '?(.*?)'?$", done.stdout + done.stderr, re.M)
    reason = (*panics, f"ended with exit code {done.returncode}")[0]
    return ProbeResult("missing", f"cannot draw ({reason})")


def web_viewer() -> str | ProbeResult:
    """Serve the Rerun web viewer, and request its page and its WebAssembly module."""
    from srs_twin.viewing.rerun.viewer import HOST, free_port, is_served

    port = free_port()
    # Reset the handler: otherwise the child would inherit one that ignores interrupts.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # Not `running_rerun`: in another process group Rerun would survive the kill of the
    # probe's group.
    command = [*_rerun_command(), "--serve-web", "--web-viewer-port", str(port)]
    server = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        page = f"http://{HOST}:{port}/"
        if not is_served(server, [page, f"{page}re_viewer_bg.wasm"], _SERVER_TIMEOUT_S):
            return ProbeResult("broken", f"its page was not served on {HOST}")
    finally:
        # `rerun` is a script that starts the actual program, and stops it when
        # interrupted.
        server.send_signal(signal.SIGINT)
        server.wait()
    return "`srs-twin view RUN --web` serves it"


def _rerun_command() -> list[str]:
    """Return the command that starts Rerun on a free local port."""
    from srs_twin.viewing.rerun.viewer import HOST, free_port, rerun_executable

    return [str(rerun_executable()), "--bind", HOST, "--port", str(free_port())]


PROBES: dict[str, Callable[[], str | ProbeResult]] = {
    "shipped data": data,
    "kernels": kernels,
    "MuJoCo": models,
    **{name: partial(drawing, name) for name in (*LIBRARIES, "glfw")},
    "without a screen": headless_viewer,
    "in a browser": web_viewer,
}
"""Name of a check → its probe."""


def main(modules: Sequence[str], names: Sequence[str], time_limit_s: float) -> None:
    """Import modules, then run each probe in a forked process; print one line per result."""
    gc.disable()  # saves time; the processes live for about a second
    _run("imports", partial(imports, modules), time_limit_s)
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    passed = set()
    for name in names:  # one after the other: parallel probes would only compete for the processor's caches
        if name == "osmesa" and "egl" in passed:
            _send(name=name, **vars(SKIPPED_OSMESA))
            continue
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                if _run(name, PROBES[name], time_limit_s):
                    code = 0
                else:
                    code = _REPORTED
            finally:
                os._exit(code)  # skips the exit handlers of libraries
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        if code == 0:
            passed.add(name)
        elif code != _REPORTED:
            _send(name=name, **vars(result_of_exit(code)))


def _run(
    name: str, probe: Callable[[], str | ProbeResult], time_limit_s: float
) -> bool:
    """Run a probe and send its result; return whether it passed."""
    # The default action of SIGALRM ends the process even if a library hangs outside
    # Python.
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, time_limit_s)
    try:
        outcome = probe()
        if isinstance(outcome, ProbeResult):
            result = outcome
        else:
            result = ProbeResult("ok", outcome)
    except Exception as error:  # a library may raise anything
        result = ProbeResult("broken", _error_text(error))
    _send(name=name, **vars(result))
    return result.status == "ok"


def _error_text(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _send(**fields: str) -> None:
    # A single write, because several processes share the file.
    os.write(1, (MARKER + json.dumps(fields) + "\n").encode())
