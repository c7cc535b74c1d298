"""Fast `check_mjcf` for thousands of files: each gets its own process, forked from one with MuJoCo loaded."""

from __future__ import annotations

import atexit
import json
import subprocess
import sys
from functools import cache
from pathlib import Path

from srs_twin.errors import InputError, InputFileError
from srs_twin.io.files import display_path, require_file
from srs_twin.plants.twin.mjcf.check import ModelReport, parse_report, scan_mjcf

LIMIT_S = 10
"""Time limit of one check, s."""

SERVER = """
import json, os, select, signal, sys, tempfile, time
from pathlib import Path
import mujoco
from srs_twin.plants.twin.mjcf.check import _child

os.chdir(tempfile.mkdtemp())
for line in sys.stdin:
    path, limit = json.loads(line)
    source, sink = os.pipe()
    child = os.fork()
    if not child:
        os.close(source)
        os.dup2(sink, 1)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        _child(path, str(limit))
        sys.stdout.flush()
        os._exit(0)
    os.close(sink)
    output, deadline = b"", time.monotonic() + limit
    while select.select([source], [], [], max(0.0, deadline - time.monotonic()))[0]:
        data = os.read(source, 65536)
        if not data:
            break
        output += data
    else:
        os.kill(child, signal.SIGKILL)
    os.close(source)
    _, status = os.waitpid(child, 0)
    print(json.dumps([output.decode(), f"exit status {os.waitstatus_to_exitcode(status)}"]), flush=True)
"""


@cache
def _server() -> subprocess.Popen[str]:
    server = subprocess.Popen(
        [sys.executable, "-c", SERVER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    atexit.register(server.kill)
    return server


def check(path: Path) -> ModelReport:
    """Return the report of `check_mjcf`."""
    model = require_file(path, suffix=".xml").resolve()
    faults = scan_mjcf(model)
    if faults:
        return ModelReport(tuple(faults))
    server = _server()
    assert server.stdin is not None and server.stdout is not None
    server.stdin.write(json.dumps([str(model), LIMIT_S]) + "\n")
    server.stdin.flush()
    return parse_report(*json.loads(server.stdout.readline()), LIMIT_S)


def raise_faults(path: Path, report: ModelReport) -> ModelReport:
    """Return a report without faults.

    Raises:
        InputError: there are faults; the message is that of the command line.
    """
    if report.faults:
        raise InputFileError(
            [f"{display_path(path)}: {fault}" for fault in report.faults]
        )
    if not report.sizes:
        raise InputError(f"{display_path(path)}: measured nothing")
    return report
