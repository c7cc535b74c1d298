"""A broker of the distribution, on loopback and a free port, with and without a password."""

from __future__ import annotations

import contextlib
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
needs_broker = pytest.mark.skipif(
    MOSQUITTO is None, reason="mosquitto is not installed"
)


def free_port() -> int:
    with socket.socket() as own:
        own.bind(("127.0.0.1", 0))
        return int(own.getsockname()[1])


@contextlib.contextmanager
def broker(
    folder: Path, port: int, *, password: str | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a broker while the block runs; the user is `lab` where there is a password."""
    lines = [
        f"listener {port} 127.0.0.1",
        "persistence false",
        "user root",
        "log_dest none",
    ]
    if password is None:
        lines.append("allow_anonymous true")
    else:
        kept = folder / "passwords"
        tool = shutil.which("mosquitto_passwd") or "/usr/bin/mosquitto_passwd"
        subprocess.run([tool, "-b", "-c", str(kept), "lab", password], check=True)
        lines += ["allow_anonymous false", f"password_file {kept}"]
    (folder / "broker.conf").write_text("\n".join(lines) + "\n", "utf-8")
    assert MOSQUITTO is not None
    process = subprocess.Popen([MOSQUITTO, "-c", str(folder / "broker.conf")])
    try:
        wait(lambda: _listens(port))
        yield process
    finally:
        process.kill()
        process.wait()


def _listens(port: int) -> bool:
    with socket.socket() as own:
        own.settimeout(0.2)
        return own.connect_ex(("127.0.0.1", port)) == 0


def wait(over, seconds: float = 20.0) -> None:
    """Wait until something is so; fail if it never is."""
    end = time.monotonic() + seconds
    while not over():
        assert time.monotonic() < end, "it never was"
        time.sleep(0.01)
