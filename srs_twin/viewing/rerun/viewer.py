"""Rerun's viewer as a process beside this one, and the check that a recording is whole.

The process listens on this machine alone and ends with whoever needs it.
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
    """Return the `rerun` program that was installed with the package Python uses.

    Raises:
        InputError: it is not beside the running Python.
    """
    program = Path(sys.executable).parent / ("rerun.exe" if os.name == "nt" else "rerun")
    if not program.is_file():
        raise InputError(f"{program} is missing; install it with: pip install 'rerun-sdk>=0.41,<0.42'")
    return program


def lacks_display() -> bool:
    """Say whether no window can be opened, as on a machine without a screen."""
    named = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return sys.platform.startswith("linux") and not named


def open_recording(path: str | Path) -> None:
    """Show a recording in the native viewer and wait until it is closed.

    Raises:
        InputError: there is no such recording, no display to show it on, or the viewer would not start.
    """
    recording = _recording(path)
    program = rerun_executable()
    if lacks_display():
        raise InputError(
            "there is no display to open a viewer on (neither DISPLAY nor WAYLAND_DISPLAY is set); "
            f"open {recording.parent / 'report.html'} in a browser instead, or the recording by "
            f"`srs-twin view {recording} --web`, or copy {recording} to a machine with a "
            f"screen and run 'rerun {recording.name}' there"
        )
    # Rerun would listen on every network interface.
    ended = subprocess.run([program, "--bind", "127.0.0.1", recording], check=False).returncode
    if ended > 0:
        raise InputError(f"the viewer ended with code {ended}; its message stands above")


def verify_recording(path: str | Path) -> None:
    """Let Rerun read a recording from end to end.

    Raises:
        InputError: there is no such recording, or it is not a whole one; with Rerun's words.
    """
    recording = _recording(path)
    command = [str(rerun_executable()), "rrd", "verify", str(recording)]
    said = subprocess.run(command, check=False, capture_output=True, text=True)
    # A file of junk also ends with 0, with "0 files verified".
    if "1 file verified" not in said.stdout + said.stderr:
        words = (said.stderr or said.stdout).strip().splitlines()
        raise InputError(f"{path}: not a whole recording ({words[-1] if words else 'rerun said nothing'})")


def _recording(path: str | Path) -> Path:
    recording = Path(path)
    if not recording.is_file():
        raise InputError(f"{path}: there is no such recording; 'srs-twin run SCENARIO' writes one")
    return recording


HOST = "127.0.0.1"
_END_S = 10.0

Rerun = subprocess.Popen[bytes]


@contextmanager
def running_rerun(*arguments: str) -> Iterator[tuple[Rerun, IO[bytes]]]:
    """Run Rerun; yield the process, and the file that what it says goes to.

    However the block ends, Rerun ends with it, and so does all that it has started.

    Args:
        arguments: besides the address that it listens on.

    Raises:
        InputError: it is not installed.
    """
    command = [str(rerun_executable()), "--bind", HOST, *arguments]
    with tempfile.TemporaryFile() as said:
        # `rerun` is a script that starts the real program: both are one group.
        rerun = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=said, stderr=said, start_new_session=True
        )
        try:
            yield rerun, said
        finally:
            _end(rerun)


def free_port() -> int:
    """Return a port of this machine that nobody uses now."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def output_lines(said: IO[bytes]) -> list[str]:
    """Return the lines that Rerun has said, one at least."""
    said.seek(0)
    return said.read().decode(errors="replace").strip().splitlines() or ["it said nothing"]


def _end(rerun: Rerun) -> None:
    """End Rerun, by force where it does not heed."""
    for way in (signal.SIGTERM, signal.SIGKILL):
        if rerun.poll() is not None:
            return
        os.killpg(rerun.pid, way)
        try:
            rerun.wait(timeout=_END_S)
        except subprocess.TimeoutExpired:
            continue
