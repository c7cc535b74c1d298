"""Execution of all checks; probes run in child processes."""

from __future__ import annotations

import json
import os
import platform
import signal
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from srs_twin import __version__
from srs_twin.cli.doctor import checks, probes
from srs_twin.cli.doctor.checks import Check, ProbeResult, result_of_exit
from srs_twin.cli.doctor.probes import LIBRARIES, PROBES
from srs_twin.compute.workers import processor_count
from srs_twin.errors import InputError
from srs_twin.io.files import data_root
from srs_twin.viewing.rerun.viewer import rerun_executable

SIMULATION = "simulation"
VIEWERS = "Rerun viewer"
RENDERING = "off-screen rendering by MuJoCo (one backend is enough)"
_REINSTALL = "`uv sync --reinstall` in a checkout, else `pip install --force-reinstall`"
_DRIVER = (
    "install a driver: apt-get install libegl1 libgl1-mesa-dri (Debian, Ubuntu;"
    " software rendering); for an NVIDIA GPU in a container, start the container with"
    " NVIDIA_DRIVER_CAPABILITIES=all"
)
REMEDIES = {
    checks.INSTALLATION: {
        "imports": (
            f"reinstall the package ({_REINSTALL}), or the system library that the"
            " error names; for errors of OpenGL: `unset MUJOCO_GL`"
        )
    },
    SIMULATION: {
        "shipped data": f"reinstall srs-twin: {_REINSTALL}",
        "kernels": f"reinstall numba and llvmlite: {_REINSTALL}",
        "MuJoCo": f"reinstall MuJoCo: {_REINSTALL}",
    },
    RENDERING: {
        "egl": _DRIVER,
        "osmesa": "apt-get install --reinstall libosmesa6, or use egl",
        "glfw": (
            "needs a display; without one `export MUJOCO_GL=egl`, or run the command"
            " under `xvfb-run -a`"
        ),
    },
    VIEWERS: {
        "rerun": (
            "pip install --force-reinstall 'rerun-sdk>=0.41,<0.42', or `uv sync"
            " --reinstall`"
        ),
        "in a window": (
            "open report.html of a run in a browser, or serve the recording with "
            "`srs-twin view RUN --web`"
        ),
        "without a screen": (
            "apt-get install mesa-vulkan-drivers (Debian, Ubuntu), "
            "or any other Vulkan driver"
        ),
        "in a browser": (
            "reinstall rerun-sdk; report.html of a run needs only a browser"
        ),
    },
}
"""Topic → probe → default remedy, in the order of the output."""

PROBE_TIMEOUT_S = 60.0
"""Time limit of a probe, s. A probe takes less than 1 s on an idle machine."""


def run_checks(folder: Path, *, time_limit_s: float = PROBE_TIMEOUT_S) -> list[Check]:
    """Run all checks; takes some seconds and leaves no files behind.

    Args:
        folder: output folder to check.
        time_limit_s: time limit of each probe, s.

    Raises:
        InputError: temporary files cannot be written.
    """
    metadata = checks.installed_metadata()
    checkout = (data_root() / "pyproject.toml").is_file()
    packages = checks.required_packages(metadata.get_all("Requires-Dist") or [])
    probed = _run_all_probes(checks.modules(packages), time_limit_s)
    return [
        _installation_check(bool(metadata), checkout=checkout),
        *(
            [
                checks.python_check(
                    platform.python_version(), metadata["Requires-Python"]
                )
            ]
            if metadata
            else []
        ),
        checks.packages_check(packages, checkout=checkout),
        *(
            check
            for check in probed
            if check.topic in (checks.INSTALLATION, SIMULATION)
        ),
        checks.output_check(folder),
        checks.disk_check(folder),
        checks.processors_check(processor_count(), checks.cpu_quota()),
        checks.memory_check(checks.free_memory()),
        *(check for check in probed if check.topic in (RENDERING, VIEWERS)),
        *checks.extra_checks(
            metadata.get_all("Provides-Extra") or [], packages, checkout=checkout
        ),
    ]


def _installation_check(installed: bool, *, checkout: bool) -> Check:
    detail = f"{__version__}, {'checkout' if checkout else 'wheel'} in {data_root()}"
    if installed:
        return Check(checks.INSTALLATION, "srs_twin", "ok", detail, necessary=True)
    if checkout:
        remedy = "uv sync"
    else:
        remedy = "pip install the wheel again"
    detail += "; it is not installed, so its required packages are unknown"
    return Check(
        checks.INSTALLATION, "srs_twin", "missing", detail, remedy, necessary=True
    )


def _run_all_probes(modules: Sequence[str], time_limit_s: float) -> list[Check]:
    known = known_results(os.environ, sys.platform)
    names = [name for name in PROBES if name not in known]
    results = run_probes(modules, names, time_limit_s=time_limit_s) | known
    results.setdefault("in a window", results["glfw"])
    ordered = [name for remedies in REMEDIES.values() for name in remedies]
    return [check_from(name, results[name]) for name in ordered if name in results]


def check_from(name: str, result: ProbeResult) -> Check:
    """Return the check with the result of a probe and a remedy."""
    topic = next(topic for topic, remedies in REMEDIES.items() if name in remedies)
    if result.status == "ok":
        remedy = ""
    else:
        remedy = result.remedy or REMEDIES[topic][name]
    necessary = topic in (checks.INSTALLATION, SIMULATION)
    return Check(topic, name, result.status, result.detail, remedy, necessary)


def known_results(env: Mapping[str, str], platform: str) -> dict[str, ProbeResult]:
    """Return the results that follow from the environment without running the probes.

    Args:
        env: environment variables.
        platform: `sys.platform`.
    """
    known = {}
    selected = env.get("MUJOCO_GL", "")
    for name in LIBRARIES:
        if selected in (*LIBRARIES, "glfw") and selected != name:
            # PyOpenGL cannot change its backend within a process.
            remedy = "unset MUJOCO_GL to test it"
            known[name] = ProbeResult(
                "undecided", f"not tested: MUJOCO_GL is {selected}", remedy
            )
        elif not platform.startswith("linux"):
            known[name] = ProbeResult("missing", "available only on Linux")
    if platform.startswith("linux") and not (
        env.get("DISPLAY") or env.get("WAYLAND_DISPLAY")
    ):
        no_display = ProbeResult(
            "missing", "no display: neither DISPLAY nor WAYLAND_DISPLAY is set"
        )
        known |= {"glfw": no_display, "in a window": no_display}
    try:
        known["rerun"] = ProbeResult("ok", str(rerun_executable()))
    except InputError as error:
        missing = ProbeResult("missing", str(error))
        known |= dict.fromkeys(
            ("rerun", "in a window", "without a screen", "in a browser"), missing
        )
    return known


def run_probes(
    modules: Sequence[str],
    names: Sequence[str],
    *,
    time_limit_s: float = PROBE_TIMEOUT_S,
) -> dict[str, ProbeResult]:
    """Import modules, then run probes; return the results by name, including "imports".

    One child process imports the modules and forks a process per probe, so the modules
    are imported only once. A crash or timeout of a probe affects only its own result.
    All processes have ended on return, also after Ctrl-C.

    Args:
        modules: modules to import.
        names: keys of `probes.PROBES`.
        time_limit_s: time limit of each probe, s.

    Raises:
        InputError: temporary files cannot be written.
    """
    try:
        folder = tempfile.TemporaryDirectory(prefix="srs-twin-doctor-")
        output = tempfile.TemporaryFile()
    except OSError as error:
        raise InputError(
            f"cannot write temporary files ({error.strerror}); set TMPDIR to a writable"
            " folder"
        ) from error
    with folder, output:
        sys.stdout.flush()
        sys.stderr.flush()
        pid = os.fork()
        if pid == 0:
            try:
                _prepare_child(folder.name, output.fileno())
                probes.main(modules, names, time_limit_s)
            finally:
                os._exit(1)  # skips exit handlers; the results are already written
        try:
            code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        except BaseException:
            os.kill(pid, signal.SIGKILL)  # it may not have its own process group yet
            os.waitpid(pid, 0)
            raise
        finally:
            # Kill all remaining processes. macOS raises PermissionError for processes
            # that have just ended.
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(pid, signal.SIGKILL)
        output.seek(0)
        return _parse_output(
            output.read().decode("utf-8", "replace").splitlines(), code, names
        )


def _prepare_child(folder: str, output: int) -> None:
    """Move this process to a new process group and a temporary folder; redirect its output to a file."""
    os.setsid()
    os.chdir(folder)
    null = os.open(os.devnull, os.O_RDONLY)
    for source, target in ((null, 0), (output, 1), (output, 2)):
        os.dup2(source, target)
    # As in a run: with another value, MuJoCo loads an OpenGL library during its import.
    os.environ.setdefault("MUJOCO_GL", "disabled")
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # threads do not survive a fork


def _parse_output(
    lines: Sequence[str], code: int, names: Sequence[str]
) -> dict[str, ProbeResult]:
    """Return the results in the output of a child process; lines of libraries are ignored.

    Args:
        lines: output of the child.
        code: exit code of the child; negative: signal.
        names: probes that should have run.
    """
    results: dict[str, ProbeResult] = {}
    importing = "Python"
    last_noise = ""
    for line in lines:
        noise, _, text = line.partition(probes.MARKER)
        last_noise = noise.strip() or last_noise
        fields = json.loads(text) if text else {}
        importing = fields.pop("importing", importing)
        if name := fields.pop("name", ""):
            results[name] = ProbeResult(**fields)
    if "imports" not in results:
        # The child ended during an import; its last line usually contains the error.
        exit_result = result_of_exit(code)
        if code > 0 and last_noise:
            reason = last_noise
        else:
            reason = exit_result.detail
        results["imports"] = ProbeResult(exit_result.status, f"{importing}: {reason}")
    not_run = ProbeResult(
        "undecided", f"not tested: {results['imports'].detail}", "fix `imports` first"
    )
    return {name: results.get(name, not_run) for name in ("imports", *names)}
