"""examine: try everything at once, beside what this process finds out by itself."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from srs_twin import __version__
from srs_twin.doctor import machine, packages
from srs_twin.doctor.check import Answer, Check
from srs_twin.doctor.children import BUDGET_S, ask
from srs_twin.doctor.probes import LIBRARIES, PROBES
from srs_twin.errors import InputError
from srs_twin.io.files import data_root
from srs_twin.viewing.rerun.viewer import rerun_executable

SIMULATION, VIEWERS = "simulation", "Rerun's viewer"
RENDERING = "pictures by MuJoCo, off screen (one of them is enough)"
_REINSTALL = "`uv sync --reinstall` in a checkout, else `pip install --force-reinstall`"
_DRIVER = (
    "install a driver: apt-get install libegl1 libgl1-mesa-dri (Debian, Ubuntu; draws on the processor); "
    "with an NVIDIA card in a container start that with NVIDIA_DRIVER_CAPABILITIES=all"
)


@dataclass(frozen=True)
class Trial:
    """A probe, and what to do where it fails without knowing a remedy itself."""

    topic: str
    name: str
    remedy: str
    necessary: bool = False

    def check(self, answer: Answer) -> Check:
        """Return its check, given what came of it."""
        remedy = "" if answer.status == "ok" else answer.remedy or self.remedy
        return Check(self.topic, self.name, answer.status, answer.detail, remedy, self.necessary)


TRIALS = (
    Trial(
        packages.TOPIC,
        "imports",
        f"install it anew ({_REINSTALL}); where a system library is missing, "
        "the error names it; one about OpenGL: `unset MUJOCO_GL`",
        True,
    ),
    Trial(SIMULATION, "shipped data", f"install srs-twin anew: {_REINSTALL}", True),
    Trial(SIMULATION, "kernels", f"install numba and llvmlite anew: {_REINSTALL}", True),
    Trial(SIMULATION, "MuJoCo", f"install MuJoCo anew: {_REINSTALL}", True),
    Trial(RENDERING, "egl", _DRIVER),
    Trial(RENDERING, "osmesa", "apt-get install --reinstall libosmesa6, or use egl"),
    Trial(
        RENDERING,
        "glfw",
        "needs a screen; without one `export MUJOCO_GL=egl`, or put `xvfb-run -a` before the command",
    ),
    Trial(
        VIEWERS, "rerun", "pip install --force-reinstall 'rerun-sdk>=0.41,<0.42', or `uv sync --reinstall`"
    ),
    Trial(
        VIEWERS,
        "in a window",
        "open report.html of a run in a browser, or serve the recording: `srs-twin view RUN --web`",
    ),
    Trial(
        VIEWERS,
        "without a screen",
        "apt-get install mesa-vulkan-drivers (Debian, Ubuntu), or any other Vulkan driver",
    ),
    Trial(
        VIEWERS, "in a browser", "install rerun-sdk anew; report.html of a run needs nothing but a browser"
    ),
)
"""In the order in which they are shown."""


def examine(folder: Path, *, budget_s: float = BUDGET_S) -> list[Check]:
    """Look at everything; takes some seconds and changes nothing.

    Args:
        folder: where results would go.
        budget_s: wall time that each probe may take, s.

    Raises:
        InputError: there is no room for temporary files.
    """
    about: Mapping[str, str]
    try:
        about, requirements, extras = packages.about_srs_twin()
    except metadata.PackageNotFoundError:
        about, requirements, extras = {}, [], []
    checkout = (data_root() / "pyproject.toml").is_file()
    wanted = packages.wanted(requirements)
    here = machine.Machine.here()
    tried = _tried(packages.modules(wanted), budget_s)
    return [
        _installation(about, checkout=checkout),
        *([packages.python_check(platform.python_version(), about["Requires-Python"])] if about else []),
        packages.packages_check(wanted, checkout=checkout),
        *(check for check in tried if check.topic in (packages.TOPIC, SIMULATION)),
        machine.output_check(folder),
        machine.disk_check(folder),
        machine.processors_check(here),
        machine.memory_check(here),
        *(check for check in tried if check.topic in (RENDERING, VIEWERS)),
        *packages.extra_checks(extras, wanted, checkout=checkout),
    ]


def _installation(about: Mapping[str, str], *, checkout: bool) -> Check:
    where = f"{__version__}, {'checkout' if checkout else 'wheel'} in {data_root()}"
    if about:
        return Check(packages.TOPIC, "srs_twin", "ok", where, necessary=True)
    remedy = "uv sync" if checkout else "pip install the wheel again"
    detail = f"{where}; it is not installed, so that nobody knows which packages it asks for"
    return Check(packages.TOPIC, "srs_twin", "missing", detail, remedy, necessary=True)


def _tried(modules: Sequence[str], budget_s: float) -> list[Check]:
    known = untried(os.environ, sys.platform)
    answers = ask(modules, [name for name in PROBES if name not in known], budget_s=budget_s) | known
    answers.setdefault("in a window", answers["glfw"])
    return [trial.check(answers[trial.name]) for trial in TRIALS if trial.name in answers]


def untried(env: Mapping[str, str], system: str) -> dict[str, Answer]:
    """Return what is known of probes without trying them.

    Args:
        env: variables of this process.
        system: as `sys.platform` names it.
    """
    known, chosen = {}, env.get("MUJOCO_GL", "")
    for name in LIBRARIES:
        if chosen in (*LIBRARIES, "glfw") and chosen != name:
            # PyOpenGL keeps to the first one that it has been told.
            known[name] = Answer(
                "undecided", f"not tried: MUJOCO_GL is {chosen}", "unset MUJOCO_GL to have it tried"
            )
        elif not system.startswith("linux"):
            known[name] = Answer("missing", "is Linux's")
    if system.startswith("linux") and not (env.get("DISPLAY") or env.get("WAYLAND_DISPLAY")):
        blind = Answer("missing", "no screen: neither DISPLAY nor WAYLAND_DISPLAY is set")
        known |= {"glfw": blind, "in a window": blind}
    try:
        known["rerun"] = Answer("ok", str(rerun_executable()))
    except InputError as error:
        gone = Answer("missing", str(error))
        known |= dict.fromkeys(("rerun", "in a window", "without a screen", "in a browser"), gone)
    return known
