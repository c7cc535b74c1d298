"""The Rerun viewer as a child process, and the verification of recordings.

The viewer accepts connections from this machine only. It ends when the `with` block that started it ends.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from srs_twin.errors import InputError


def rerun_executable() -> Path:
    """Return the path of the program `rerun` in the environment of the running Python.

    Raises:
        InputError: the program is missing.
    """
    program = Path(sys.executable).parent / ("rerun.exe" if os.name == "nt" else "rerun")
    if not program.is_file():
        raise InputError(f"{program} is missing; install it with: pip install 'rerun-sdk>=0.41,<0.42'")
    return program


def lacks_display() -> bool:
    """Return whether the machine has no display for a window."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return sys.platform.startswith("linux") and not display


def open_recording(path: str | Path) -> None:
    """Open a recording in the native viewer and wait until the viewer is closed.

    Raises:
        InputError: there is no such recording or no display, or the viewer failed.
    """
    recording = _recording(path)
    program = rerun_executable()
    if lacks_display():
        raise InputError(
            "no display found for the viewer (neither DISPLAY nor WAYLAND_DISPLAY is set); "
            f"open {recording.parent / 'report.html'} in a browser, serve the recording with "
            f"`srs-twin view {recording} --web`, or copy {recording} to a machine with a "
            f"screen and run 'rerun {recording.name}' there"
        )
    # The default address would accept connections from the network.
    exit_code = subprocess.run([program, "--bind", "127.0.0.1", recording], check=False).returncode
    if exit_code > 0:
        raise InputError(f"the viewer ended with exit code {exit_code}; see its message above")


def verify_recording(path: str | Path) -> None:
    """Verify a recording with `rerun rrd verify`.

    Raises:
        InputError: there is no such recording, or it is incomplete or damaged.
    """
    recording = _recording(path)
    command = [str(rerun_executable()), "rrd", "verify", str(recording)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    # The exit code is also 0 for files of other formats, with "0 files verified".
    if "1 file verified" not in done.stdout + done.stderr:
        lines = (done.stderr or done.stdout).strip().splitlines()
        raise InputError(
            f"{path}: incomplete or damaged recording ({lines[-1] if lines else 'no output of rerun'})"
        )


def _recording(path: str | Path) -> Path:
    recording = Path(path)
    if not recording.is_file():
        raise InputError(f"{path}: no such recording; 'srs-twin run SCENARIO' writes one")
    return recording


HOST = "127.0.0.1"
"""Address on which the viewer accepts connections."""

_STOP_TIMEOUT_S = 10.0
"""Time after SIGTERM before the viewer is killed, s."""

Rerun = subprocess.Popen[bytes]


@contextmanager
def running_rerun(*arguments: str) -> Iterator[tuple[Rerun, IO[bytes]]]:
    """Run Rerun; yield the process and the file with its output.

    Rerun and its child processes end with the block.

    Args:
        arguments: arguments of Rerun, in addition to its address.

    Raises:
        InputError: Rerun is not installed.
    """
    command = [str(rerun_executable()), "--bind", HOST, *arguments]
    with tempfile.TemporaryFile() as output:
        # `rerun` is a script that starts the actual program; a process group allows stopping both.
        rerun = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
        )
        try:
            yield rerun, output
        finally:
            _stop(rerun)


def free_port() -> int:
    """Return a free TCP port of this machine."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def output_lines(output: IO[bytes]) -> list[str]:
    """Return the lines of the output of Rerun, at least one."""
    output.seek(0)
    return output.read().decode(errors="replace").strip().splitlines() or ["no output"]


def _stop(rerun: Rerun) -> None:
    """Terminate Rerun, and kill it if it does not end in time."""
    for signal_number in (signal.SIGTERM, signal.SIGKILL):
        if rerun.poll() is not None:
            return
        os.killpg(rerun.pid, signal_number)
        try:
            rerun.wait(timeout=_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            continue
