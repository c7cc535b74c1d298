"""MQTT broker on the loopback address, and waiting for messages."""

from __future__ import annotations

import shutil
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from srs_twin.live.links import BrokerAccess, Link
from srs_twin.live.messages import Message

MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
needs_broker = pytest.mark.skipif(
    MOSQUITTO is None, reason="mosquitto is not installed"
)


def free_port() -> int:
    """Return a free port of the loopback address."""
    with socket.create_server(("127.0.0.1", 0)) as own:
        return int(own.getsockname()[1])


class Broker:
    """Mosquitto in a process of its own, which can be killed and started again.

    Attributes:
        port: port number on which it listens.
        access: access for a link.
        process: the process.
    """

    def __init__(self, folder: Path, password: str | None = None) -> None:
        """Start a broker whose only user is `lab` if there is a password."""
        self.port = free_port()
        self.access = BrokerAccess(port=self.port)
        lines = [
            f"listener {self.port} 127.0.0.1",
            "persistence false",
            "user root",
            "log_dest none",
            "set_tcp_nodelay true",
        ]
        if password is None:
            lines.append("allow_anonymous true")
        else:
            kept = folder / "passwords"
            tool = shutil.which("mosquitto_passwd") or "/usr/bin/mosquitto_passwd"
            subprocess.run([tool, "-b", "-c", str(kept), "lab", password], check=True)
            lines += ["allow_anonymous false", f"password_file {kept}"]
        self._file = folder / "broker.conf"
        self._file.write_text("\n".join(lines) + "\n", "utf-8")
        self.start()

    def start(self) -> None:
        """Start it and wait until it listens."""
        assert MOSQUITTO is not None
        self.process = subprocess.Popen([MOSQUITTO, "-c", str(self._file)])
        wait(self._listens)

    def _listens(self) -> bool:
        with socket.socket() as own:
            own.settimeout(0.2)
            return own.connect_ex(("127.0.0.1", self.port)) == 0

    def kill(self) -> None:
        """End it at once."""
        self.process.kill()
        self.process.wait()

    def __enter__(self) -> Broker:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


def wait(condition: Callable[[], Any], seconds: float = 20.0) -> None:
    """Wait until a condition holds.

    Raises:
        TimeoutError: it does not hold in time.
    """
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"not within {seconds} s")
        time.sleep(0.005)


def heard(link: Link) -> list[Message]:
    """Wait for messages and return them."""
    messages: list[Message] = []
    wait(lambda: messages.extend(link.received()) or messages)
    return messages
