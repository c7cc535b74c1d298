"""examine: try everything at once in child processes, beside what this process finds out by itself."""

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
from srs_twin.cli.doctor.checks import Answer, Check, ended
from srs_twin.cli.doctor.probes import LIBRARIES, PROBES
from srs_twin.compute.workers import processor_count
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
REMEDIES = {
    checks.INSTALLATION: {
        "imports": f"install it anew ({_REINSTALL}); where a system library is missing, "
        "the error names it; one about OpenGL: `unset MUJOCO_GL`"
    },
    SIMULATION: {
        "shipped data": f"install srs-twin anew: {_REINSTALL}",
        "kernels": f"install numba and llvmlite anew: {_REINSTALL}",
        "MuJoCo": f"install MuJoCo anew: {_REINSTALL}",
    },
    RENDERING: {
        "egl": _DRIVER,
        "osmesa": "apt-get install --reinstall libosmesa6, or use egl",
        "glfw": "needs a screen; without one `export MUJOCO_GL=egl`, or put `xvfb-run -a` before the command",
    },
    VIEWERS: {
        "rerun": "pip install --force-reinstall 'rerun-sdk>=0.41,<0.42', or `uv sync --reinstall`",
        "in a window": "open report.html of a run in a browser, or serve the recording: "
        "`srs-twin view RUN --web`",
        "without a screen": "apt-get install mesa-vulkan-drivers (Debian, Ubuntu), "
        "or any other Vulkan driver",
        "in a browser": "install rerun-sdk anew; report.html of a run needs nothing but a browser",
    },
}
"""Topic → probe → what to do where it fails without knowing a remedy itself; in the order of the output."""

BUDGET_S = 60.0
"""Wall time of one probe, s. It needs less than 1 s of a processor, of which a busy machine gives a part."""


def examine(folder: Path, *, budget_s: float = BUDGET_S) -> list[Check]:
    """Look at everything; takes some seconds and changes nothing.

    Args:
        folder: where results would go.
        budget_s: wall time that each probe may take, s.

    Raises:
        InputError: there is no room for temporary files.
    """
    about = checks.about_srs_twin()
    checkout = (data_root() / "pyproject.toml").is_file()
    wanted = checks.wanted(about.get_all("Requires-Dist") or [])
    tried = _tried(checks.modules(wanted), budget_s)
    return [
        _installation(bool(about), checkout=checkout),
        *([checks.python_check(platform.python_version(), about["Requires-Python"])] if about else []),
        checks.packages_check(wanted, checkout=checkout),
        *(check for check in tried if check.topic in (checks.INSTALLATION, SIMULATION)),
        checks.output_check(folder),
        checks.disk_check(folder),
        checks.processors_check(processor_count(), checks.processor_share()),
        checks.memory_check(checks.free_memory()),
        *(check for check in tried if check.topic in (RENDERING, VIEWERS)),
        *checks.extra_checks(about.get_all("Provides-Extra") or [], wanted, checkout=checkout),
    ]


def _installation(known: bool, *, checkout: bool) -> Check:
    where = f"{__version__}, {'checkout' if checkout else 'wheel'} in {data_root()}"
    if known:
        return Check(checks.INSTALLATION, "srs_twin", "ok", where, necessary=True)
    remedy = "uv sync" if checkout else "pip install the wheel again"
    detail = f"{where}; it is not installed, so that nobody knows which packages it asks for"
    return Check(checks.INSTALLATION, "srs_twin", "missing", detail, remedy, necessary=True)


def _tried(modules: Sequence[str], budget_s: float) -> list[Check]:
    known = untried(os.environ, sys.platform)
    answers = ask(modules, [name for name in PROBES if name not in known], budget_s=budget_s) | known
    answers.setdefault("in a window", answers["glfw"])
    names = [name for remedies in REMEDIES.values() for name in remedies]
    return [check_of(name, answers[name]) for name in names if name in answers]


def check_of(name: str, answer: Answer) -> Check:
    """Return the check that a probe decides, given what came of it."""
    topic = next(topic for topic, remedies in REMEDIES.items() if name in remedies)
    remedy = "" if answer.status == "ok" else answer.remedy or REMEDIES[topic][name]
    necessary = topic in (checks.INSTALLATION, SIMULATION)
    return Check(topic, name, answer.status, answer.detail, remedy, necessary)


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


def ask(modules: Sequence[str], names: Sequence[str], *, budget_s: float = BUDGET_S) -> dict[str, Answer]:
    """Import modules, then try all probes at once; return the answers by name, "imports" among them.

    One child imports the modules and forks a process for every probe, so that importing is paid once. A
    probe that crashes or takes too long costs only its own answer. However this ends, also by Ctrl-C, no
    child and nothing that a child started is left.

    Args:
        modules: what to import.
        names: keys of `probes.PROBES`.
        budget_s: wall time that each probe may take, s.

    Raises:
        InputError: there is no room for temporary files.
    """
    try:
        room, said = tempfile.TemporaryDirectory(prefix="srs-twin-doctor-"), tempfile.TemporaryFile()
    except OSError as error:
        raise InputError(
            f"cannot write temporary files ({error.strerror}); set TMPDIR to a folder that can be written"
        ) from error
    with room, said:
        sys.stdout.flush()
        sys.stderr.flush()
        pid = os.fork()
        if pid == 0:
            try:
                _become_child(room.name, said.fileno())
                probes.main(modules, names, budget_s)
            finally:
                os._exit(1)  # code 0 or not, it has said what it found; nobody's clean-up is its business
        try:
            code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        except BaseException:
            os.kill(pid, signal.SIGKILL)  # it may not have a group of its own yet
            os.waitpid(pid, 0)
            raise
        finally:
            # What is left of all that it started. macOS says PermissionError of what has only just ended.
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(pid, signal.SIGKILL)
        said.seek(0)
        return _answers(said.read().decode("utf-8", "replace").splitlines(), code, names)


def _become_child(folder: str, said: int) -> None:
    """Make a group of its own of this process, in a folder that goes away; what it says goes to a file."""
    os.setsid()
    os.chdir(folder)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for stream, to in ((nothing, 0), (said, 1), (said, 2)):
        os.dup2(stream, to)
    # As runs have it: MuJoCo loads a library of OpenGL at its import where the variable names one.
    os.environ.setdefault("MUJOCO_GL", "disabled")
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # threads do not survive a fork


def _answers(lines: Sequence[str], code: int, names: Sequence[str]) -> dict[str, Answer]:
    """Return the answers in what a child printed; libraries print other things there too."""
    found: dict[str, Answer] = {}
    importing, other = "Python", ""
    for line in lines:
        noise, _, text = line.partition(probes.MARK)
        other = noise.strip() or other
        said = json.loads(text) if text else {}
        importing = said.pop("importing", importing)
        if name := said.pop("name", ""):
            found[name] = Answer(**said)
    if "imports" not in found:
        how = ended(code)
        found["imports"] = Answer(how.status, f"{importing}: {other if code > 0 and other else how.detail}")
    untried = Answer("undecided", f"not tried: {found['imports'].detail}", "mend `imports` first")
    return {name: found.get(name, untried) for name in ("imports", *names)}
