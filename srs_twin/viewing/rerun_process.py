"""Rerun as a process beside this one, on this machine alone, which ends with whoever needs it."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

from srs_twin.viewing.viewer import rerun_executable

HOST = "127.0.0.1"
_END_S = 10.0

Rerun = subprocess.Popen[bytes]


@contextmanager
def rerun_beside(*arguments: str) -> Iterator[tuple[Rerun, IO[bytes]]]:
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


def words_of(said: IO[bytes]) -> list[str]:
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
