"""Child processes that try things out, all at once; none outlives `ask`."""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from srs_twin.doctor import probes
from srs_twin.doctor.check import Answer, ended
from srs_twin.errors import InputError

BUDGET_S = 60.0
"""Wall time of one probe, s. It needs less than 1 s of a processor, of which a busy machine gives a part."""


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
        said = _object(line)
        if "importing" in said:
            importing = said["importing"]
        elif "name" in said:
            name = said.pop("name")
            found[name] = Answer(**said)
        elif line.strip():
            other = line.strip()
    if "imports" not in found:
        how = ended(code)
        found["imports"] = Answer(how.status, f"{importing}: {other if code > 0 and other else how.detail}")
    untried = Answer("undecided", f"not tried: {found['imports'].detail}", "mend `imports` first")
    return {name: found.get(name, untried) for name in ("imports", *names)}


def _object(line: str) -> dict[str, Any]:
    try:
        value = json.loads(line)
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}
