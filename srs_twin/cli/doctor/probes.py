"""Checks of `srs-twin doctor` that run in child processes, as they may crash or hang.

A probe is a function that returns a description of what works, or raises an exception
that states what does not work.
"""

from __future__ import annotations

import importlib
import math
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from srs_twin.cli.doctor.checks import (
    INSTALLATION,
    SIMULATION,
    VIEWING,
    Check,
    modules,
    required_packages,
)
from srs_twin.errors import InputError, SrsError, describe_error, describe_exit
from srs_twin.io.files import data_root
from srs_twin.viewing.rerun.viewer import (
    HOST,
    free_port,
    lacks_display,
    rerun_executable,
)

_TIME_LIMIT_S = 60.0
"""Time limit for a probe, s."""

_SIMULATED_S = 0.2
"""Simulated time for each model, s."""

_REINSTALL = "`uv sync --reinstall` in a checkout, else `pip install --force-reinstall`"


def imports() -> str:
    """Import every required package."""
    for module in modules(required_packages()):
        try:
            importlib.import_module(module)
        except Exception as error:  # a package may raise any exception
            raise SrsError(f"{module}: {describe_error(error)}") from error
    return "every required package imports"


def kernels() -> str:
    """Compare a compiled kernel with its Python source, and find the kernel cache."""
    from srs_twin.pneumatics.flow import flow

    kernel: Any = flow
    arguments = (2e5, 1.5e5, 0.3)
    if not all(map(math.isclose, kernel(*arguments), kernel.py_func(*arguments))):
        raise SrsError("numba's machine code and Python give different results")
    cache = kernel.entry._cache.cache_path  # noqa: SLF001 - numba names it nowhere else
    if cache is None:
        return (
            "numba's machine code works, but is compiled at every start; to avoid"
            " this, export NUMBA_CACHE_DIR=/tmp/numba (or any other writable"
            " folder)"
        )
    return f"numba's machine code works, cached in {cache}"


def models() -> str:
    """Compile and simulate every shipped model."""
    import mujoco

    scenes = sorted((data_root() / "models").glob("*/scene.xml"))
    if not scenes:
        raise SrsError(f"there are no models in {data_root()}")
    for scene in scenes:
        model = mujoco.MjModel.from_xml_path(str(scene))
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, round(_SIMULATED_S / model.opt.timestep))
        if data.warning.number.any():
            raise SrsError(f"{scene}: MuJoCo issues warnings during the simulation")
    return f"simulates the models of {', '.join(each.parent.name for each in scenes)}"


def rendering() -> str:
    """Render a small image off screen."""
    from srs_twin.viewing.mujoco.opengl import usable_opengl

    return f"{usable_opengl()} renders off screen"


class Probe(NamedTuple):
    """Probe, with its topic and a remedy for failures.

    Attributes:
        topic: topic of the check, one of `checks.TOPICS`.
        run: function that is called in the child process.
        remedy: instruction that is shown if the probe fails.
    """

    topic: str
    run: Callable[[], str]
    remedy: str


PROBES = {
    "imports": Probe(
        INSTALLATION,
        imports,
        f"reinstall the package ({_REINSTALL}) or the system library named in the"
        " error; for OpenGL errors: `unset MUJOCO_GL`",
    ),
    "kernels": Probe(
        SIMULATION, kernels, f"reinstall numba and llvmlite: {_REINSTALL}"
    ),
    "MuJoCo": Probe(SIMULATION, models, f"reinstall MuJoCo: {_REINSTALL}"),
    "pictures of MuJoCo": Probe(
        VIEWING,
        rendering,
        "apt-get install libegl1 libgl1-mesa-dri (Debian, Ubuntu), or apt-get install"
        " libosmesa6 (Debian, Ubuntu); for an NVIDIA GPU in a container, start the"
        " container with NVIDIA_DRIVER_CAPABILITIES=all",
    ),
}
"""Probes, keyed by the name of the check."""

NO_WINDOW = (
    "open the report.html of a run in a browser, or serve the recording with `srs-twin"
    " view RUN --web`"
)
NO_VULKAN = (
    "apt-get install mesa-vulkan-drivers (Debian, Ubuntu), or any other Vulkan driver;"
    " report.html of a run needs only a browser"
)


def probed_checks(*, time_limit_s: float = _TIME_LIMIT_S) -> Iterator[Check]:
    """Run all probes and yield their results.

    Raises:
        InputError: temporary files cannot be written.
    """
    try:
        temporary = tempfile.TemporaryDirectory(prefix="srs-twin-doctor-")
    except OSError as error:
        raise InputError(
            f"temporary files cannot be written ({error.strerror}); set the"
            " environment variable TMPDIR to a writable folder"
        ) from error
    with temporary as folder:
        for name in PROBES:
            yield _run(name, folder, time_limit_s)
        yield rerun_check(Path(folder), time_limit_s)
    if lacks_display():
        detail = "no display was found: neither DISPLAY nor WAYLAND_DISPLAY is set"
        yield Check(VIEWING, "window", "missing", detail, NO_WINDOW)


def _run(name: str, folder: str, time_limit_s: float) -> Check:
    topic, _, remedy = PROBES[name]
    necessary = topic != VIEWING
    # OpenGL is disabled as in simulations. Otherwise, importing MuJoCo would load an
    # OpenGL library.
    environment = {"MUJOCO_GL": "disabled"} | os.environ | {"PYTHONSAFEPATH": "1"}
    try:
        done = subprocess.run(
            [sys.executable, "-m", __spec__.name, name],
            check=False,
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=time_limit_s,
        )
    except subprocess.TimeoutExpired:
        return _undecided(topic, name, time_limit_s, necessary=necessary)
    if done.returncode == 0:
        detail = done.stdout.splitlines()[-1]
        return Check(topic, name, "ok", detail, necessary=necessary)
    detail = describe_exit(done.returncode)
    if done.returncode > 0 and done.stderr.strip():
        detail = done.stderr.strip().splitlines()[-1]
    return Check(topic, name, "broken", detail, remedy, necessary)


def _undecided(
    topic: str, name: str, time_limit_s: float, *, necessary: bool = False
) -> Check:
    detail = f"no result within {time_limit_s:g} s"
    remedy = "this machine is busy or very slow; run `srs-twin doctor` again later"
    return Check(topic, name, "undecided", detail, remedy, necessary)


def rerun_check(folder: Path, time_limit_s: float) -> Check:
    """Check that the Rerun viewer can draw its window without a display."""
    name = "Rerun viewer"
    try:
        program = rerun_executable()
    except InputError as error:
        reason, _, remedy = str(error).partition("; ")
        return Check(VIEWING, name, "missing", reason, remedy)
    image = folder / "window.png"
    command = [str(program), "--bind", HOST, "--port", str(free_port()), "--headless"]
    command += ["--window-size", "32x24", "--hide-welcome-screen"]
    command += ["--screenshot-to", str(image)]
    try:
        done = subprocess.run(
            command,
            check=False,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=time_limit_s,
        )
    except subprocess.TimeoutExpired:
        return _undecided(VIEWING, name, time_limit_s)
    if image.is_file():
        return Check(VIEWING, name, "ok", f"{program} draws its window")
    panics = re.findall(r"panicked at '?(.*?)'?$", done.stdout + done.stderr, re.M)
    reason = (*panics, describe_exit(done.returncode))[0]
    return Check(
        VIEWING, name, "missing", f"the window cannot be drawn ({reason})", NO_VULKAN
    )


if __name__ == "__main__":
    try:
        print(PROBES[sys.argv[1]].run())
    except Exception as failure:  # libraries may raise any exception
        if isinstance(failure, SrsError):
            sys.exit(" ".join(str(failure).split()))
        sys.exit(describe_error(failure))
