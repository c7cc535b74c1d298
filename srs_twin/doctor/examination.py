"""examine: ask everything at once, then judge."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path

from srs_twin.doctor import machine, packages, simulation, viewers
from srs_twin.doctor.check import Check
from srs_twin.doctor.children import Answer, Question, ask
from srs_twin.errors import InputError
from srs_twin.files import data_root

LIMIT_S = 15.0
"""Most that all probes together may take, s."""


def examine(folder: Path) -> list[Check]:
    """Look at everything; takes some seconds and changes nothing.

    Args:
        folder: where results would go.

    Raises:
        InputError: there is no room for temporary files.
    """
    about: Mapping[str, str]
    try:
        about, requirements, extras = packages.about_srs_twin()
    except metadata.PackageNotFoundError:
        about, requirements, extras = {}, [], []
    checkout = (data_root() / "pyproject.toml").is_file()
    answers = ask(_questions(packages.modules(requirements)), limit_s=LIMIT_S)
    wanted = packages.wanted(requirements)
    screen = viewers.display(os.environ, sys.platform)
    here = machine.Machine.here()
    return [
        _installation(about, checkout=checkout),
        *([packages.python_check(platform.python_version(), about["Requires-Python"])] if about else []),
        packages.packages_check(wanted, checkout=checkout),
        packages.imports_check(answers["imports"], gl=os.environ.get("MUJOCO_GL", "")),
        simulation.data_check(answers["data"]),
        simulation.kernels_check(answers["kernels"]),
        simulation.mujoco_check(answers["models"]),
        machine.output_check(folder),
        machine.disk_check(folder),
        machine.processors_check(here),
        machine.memory_check(here),
        *_looking(answers, screen),
        *packages.extra_checks(extras, wanted, checkout=checkout),
    ]


def _questions(modules: list[str]) -> dict[str, Question]:
    named = ("data", "kernels", "models", "headless_viewer", "web_viewer")
    drawing = {
        backend: Question(("frame",), {"MUJOCO_GL": backend}) for backend in viewers.backends(sys.platform)
    }
    # As runs have it: MuJoCo loads a library of OpenGL at its import where the variable names one.
    gl = {"MUJOCO_GL": os.environ.get("MUJOCO_GL", "disabled")}
    imports = {"imports": Question(("imports", *modules), gl)}
    return imports | {name: Question((name,), gl) for name in named} | drawing


def _installation(about: Mapping[str, str], *, checkout: bool) -> Check:
    from srs_twin import __version__

    where = f"{__version__}, {'checkout' if checkout else 'wheel'} in {data_root()}"
    if about:
        return Check(packages.TOPIC, "srs_twin", "ok", where, necessary=True)
    remedy = "uv sync" if checkout else "pip install the wheel again"
    detail = f"{where}; it is not installed, so that nobody knows which packages it asks for"
    return Check(packages.TOPIC, "srs_twin", "missing", detail, remedy, necessary=True)


def _looking(answers: Mapping[str, Answer], screen: str) -> list[Check]:
    drawn = [
        viewers.rendering_check(backend, answers[backend], screen)
        for backend in viewers.backends(sys.platform)
    ]
    return [
        *drawn,
        *viewers.viewer_checks(
            _program(), screen, answers["headless_viewer"], answers["web_viewer"], answers.get("glfw")
        ),
    ]


def _program() -> Path | None:
    from srs_twin.viewing.viewer import rerun_executable

    try:
        return rerun_executable()
    except InputError:
        return None
