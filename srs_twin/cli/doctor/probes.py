"""Probes: what the children of `examination.ask` try.

A probe returns what it found, an `Answer` where something is wrong with it, or raises where it does not work.
Each runs in a process of its own, forked from the one that imported the modules.
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
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from srs_twin.cli.doctor.checks import Answer, ended

_SERVING_S = _PATIENCE_S = 40
_PNG = b"\x89PNG\r\n\x1a\n"
_SIMULATED_S = 0.2
LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
"""The system's library of each OpenGL that needs no screen."""
NEEDLESS = Answer(
    "undecided", "not tried: egl draws, and one is enough", "`MUJOCO_GL=osmesa srs-twin doctor` tries it"
)
MARK = "srs-twin doctor: "
"""How a line begins that is an answer: libraries print other things."""
_NO = 3
"""Exit code of a probe that has said itself what does not work."""


def imports(modules: Sequence[str]) -> str | Answer:
    """Import modules one after the other, and say so before each: it may be the last thing that is said."""
    faults = []
    for module in modules:
        _say(importing=module)
        try:
            importlib.import_module(module)
        except Exception as error:  # a child's outermost edge: whatever a package raises is the finding
            faults.append(f"{module}: {_in_words(error)}")
    if faults:
        return Answer("broken", "; ".join(faults))
    return "every package imports"


def data() -> str | Answer:
    """Load every robot that comes with the package; look for its model, and for scenarios."""
    from srs_twin.errors import SrsError
    from srs_twin.io.files import data_root, shipped_names
    from srs_twin.robot.file import load_robot

    robots, scenarios = shipped_names("robot"), shipped_names("scenario")
    scenes = [name for name in robots if _scene(name).is_file()]
    bad = [f"model {name}: {_scene(name)} is missing" for name in robots if name not in scenes]
    for name in robots:
        try:
            load_robot(name)
        except SrsError as error:
            bad.append(f"robot {name}: {str(error).splitlines()[0]}")
    found = f"{len(robots)} robots, {len(scenarios)} scenarios, {len(scenes)} models in {data_root()}"
    if not (robots and scenarios):
        return Answer("missing", found)
    if bad:
        return Answer("broken", f"{found}; {'; '.join(bad)}")
    return found


def models() -> str | Answer:
    """Compile every shipped model and move each under random control."""
    from srs_twin.io.files import shipped_names
    from srs_twin.plants.twin.mjcf.check import examine_model

    scenes = {name: _scene(name) for name in shipped_names("robot") if _scene(name).is_file()}
    reports = {name: examine_model(scene, _PATIENCE_S, _SIMULATED_S) for name, scene in scenes.items()}
    bad = [f"{name}: {fault}" for name, report in reports.items() for fault in report["faults"]]
    if bad:
        return Answer(
            "broken", "; ".join(bad), "`srs-twin models check` says more; else install srs-twin anew"
        )
    if not scenes:
        return Answer("missing", "there is no model to try")
    return f"compiles {', '.join(scenes)}, and simulates {_SIMULATED_S:g} s of each without a warning"


def _scene(robot: str) -> Path:
    """Return the MJCF file of a shipped robot on a floor."""
    from srs_twin.io.files import data_root

    return data_root() / "models" / robot / "scene.xml"


def kernels() -> str | Answer:
    """Run a kernel compiled, and as Python; numba takes it from a folder, or compiles it."""
    from srs_twin.pneumatics.flow import flow

    kernel: Any = flow
    arguments = (2e5, 1.5e5, 0.3)
    if not all(map(math.isclose, kernel(*arguments), kernel.py_func(*arguments))):
        return Answer("broken", "numba's machine code computes other numbers than Python")
    kept = kernel._cache.cache_path
    if kept is None:
        remedy = "export NUMBA_CACHE_DIR=/tmp/numba (any folder you may write) keeps it"
        return f"numba's machine code works, but every start compiles it anew; {remedy}"
    return f"numba's machine code works, and is kept in {kept}"


def drawing(opengl: str) -> str | Answer:
    """Draw a box off screen, with the OpenGL that MUJOCO_GL would name so."""
    from srs_twin.viewing.mujoco.opengl import PACKAGES, draw_box

    if opengl in LIBRARIES and ctypes.util.find_library(LIBRARIES[opengl]) is None:
        remedy = f"apt-get install {PACKAGES[opengl]} (Debian, Ubuntu)"
        return Answer("missing", "its library is not installed", remedy)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            draw_box(opengl)
        except Exception:
            if not heard:
                raise
            # GLFW warns of what is wrong, as "(65550) b'X11: …'"; the error that follows names a consequence.
            words = re.sub(r"^\(\d+\) b(['\"])(.*)\1$", r"\2", str(heard[0].message))
            return Answer("broken", words)
    return "draws"


def without_a_screen() -> str | Answer:
    """Let Rerun's viewer draw its own window without a screen."""
    picture = Path("window.png").resolve()
    window = ("--headless", "--window-size", "32x24", "--hide-welcome-screen")
    done = subprocess.run(
        [*_rerun(), *window, "--screenshot-to", str(picture)],
        capture_output=True,
        text=True,
        errors="replace",
    )
    if picture.is_file() and picture.read_bytes().startswith(_PNG):
        return "drew its window into a picture"
    panics = re.findall(r"panicked at '?(.*?)'?$", done.stdout + done.stderr, re.M)
    words = (*panics, f"ended with exit code {done.returncode}")[0]
    return Answer("missing", f"cannot draw ({words})")


def in_a_browser() -> str | Answer:
    """Let Rerun serve its viewer for browsers, and fetch the page and the head of the program."""
    from srs_twin.viewing.rerun.viewer import HOST, free_port

    port = free_port()
    # A child would go on to ignore interrupts where this process was started to.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # Not `running_rerun`: in a group of its own Rerun would outlive a probe that is killed with its group.
    words = [*_rerun(), "--serve-web", "--web-viewer-port", str(port)]
    server = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        if not _served(server, f"http://{HOST}:{port}/"):
            return Answer("broken", f"its page was not served on {HOST}")
    finally:
        # `rerun` is a script that starts the real program, and ends it when it is interrupted.
        server.send_signal(signal.SIGINT)
        server.wait()
    return "`srs-twin view RUN --web` serves it"


def _rerun() -> list[str]:
    """Return the words that start Rerun on a port of this machine that nobody uses."""
    from srs_twin.viewing.rerun.viewer import HOST, free_port, rerun_executable

    return [str(rerun_executable()), "--bind", HOST, "--port", str(free_port())]


def _served(server: subprocess.Popen[bytes], address: str) -> bool:
    """Wait until both parts are served; False if the server ends or never does."""
    import urllib.error
    import urllib.request

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


PROBES: dict[str, Callable[[], str | Answer]] = {
    "shipped data": data,
    "kernels": kernels,
    "MuJoCo": models,
    **{name: partial(drawing, name) for name in (*LIBRARIES, "glfw")},
    "without a screen": without_a_screen,
    "in a browser": in_a_browser,
}
"""By the name of the check that they decide."""


def main(modules: Sequence[str], names: Sequence[str], budget_s: float) -> None:
    """Import modules, then run probes, each in a process forked from this one; print a line an answer."""
    gc.disable()  # processes that live for a second have nothing to collect
    _answer("imports", partial(imports, modules), budget_s)
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    works = set()
    for name in names:  # in turn: side by side they would take turns in the processor's caches
        if name == "osmesa" and "egl" in works:
            _say(name=name, **vars(NEEDLESS))
            continue
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                code = 0 if _answer(name, PROBES[name], budget_s) else _NO
            finally:
                os._exit(code)  # what libraries do at the end of a process is no finding
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        if code == 0:
            works.add(name)
        elif code != _NO:
            _say(name=name, **vars(ended(code)))


def _answer(name: str, probe: Callable[[], str | Answer], budget_s: float) -> bool:
    """Say what comes of a probe; True if it works."""
    # Its default action ends the process, also where it hangs in a library and Python would not hear it.
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, budget_s)
    try:
        found = probe()
        answer = found if isinstance(found, Answer) else Answer("ok", found)
    except Exception as error:  # a child's outermost edge: what the error says is the finding
        answer = Answer("broken", _in_words(error))
    _say(name=name, **vars(answer))
    return answer.status == "ok"


def _in_words(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _say(**words: str) -> None:
    # In one write: several processes share the file.
    os.write(1, (MARK + json.dumps(words) + "\n").encode())
