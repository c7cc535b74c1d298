"""Open a recording in Rerun's native viewer, or have Rerun check that it is whole."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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


def open_recording(path: str | Path) -> None:
    """Show a recording in the native viewer and wait until it is closed.

    Raises:
        InputError: there is no such recording, no display to show it on, or the viewer would not start.
    """
    recording = _recording(path)
    program = rerun_executable()
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
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
